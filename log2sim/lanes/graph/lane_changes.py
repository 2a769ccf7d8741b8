"""Changes of lane, which make no lane of their own: paths are cut into what they drove in each lane."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.graph.beside import MAX_APART_M, MIN_APART_M, PARALLEL_RAD
from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import MAX_TURN_RAD

SAME_M = 1.3
"""Two vehicles in one lane are less apart than this: each keeps within some half meter of its middle."""

SETTLED_M = 0.4
"""An offset that stays within this is that of a vehicle which keeps its lane."""

PLATEAU_M = 8.0
"""Two cars' lengths: so long two vehicles are in the same lane, or beside each other, before and after a change."""

MAX_CHANGES = 20
"""Changes of lane of one vehicle in one log; a bound for odd paths."""


@dataclass(frozen=True)
class _Change:
    """Samples `first` to `last` of a path over which it changes from `before_m` to `after_m` left of another's path."""

    other: int
    first: int
    last: int
    before_m: float
    after_m: float
    known_m: float


def without_lane_changes(paths: Sequence[DrivenPath]) -> list[DrivenPath]:
    """Cut paths where their vehicles change lanes beside others that keep theirs.

    Both parts are continued to the end and from the beginning of the change, along the path of the other vehicle. Of two paths
    that come apart or together, the one that bends more changes lanes.
    """
    open_paths = [(path, MAX_CHANGES) for path in paths]
    out = []
    while open_paths:
        path, left = open_paths.pop(0)
        change = _find_change(path, paths) if left else None
        if change is None:
            out.append(path)
            continue
        one, two = _parts(path, paths[change.other], change)
        out.append(one)
        open_paths.insert(0, (two, left - 1))
    return sorted(out, key=lambda p: (p.rank, -round(p.line.length_m, 2), p.agent))


def _find_change(path: DrivenPath, others: Sequence[DrivenPath]) -> _Change | None:
    """Return the first change of lane of a path, beside the vehicle that is beside it longest."""
    found = []
    for k, other in enumerate(others):
        if other.agent == path.agent or other.rank == 2 or path.rank == 2:
            continue
        low, high = path.line.bounds_m
        if np.any(other.line.bounds_m[0] - MAX_APART_M > high) or np.any(other.line.bounds_m[1] + MAX_APART_M < low):
            continue
        change = _change_beside(path, other, k)
        found += [change] if change is not None else []
    return min(found, key=lambda c: (c.first, -c.known_m)) if found else None


def _change_beside(path: DrivenPath, other: DrivenPath, k: int) -> _Change | None:
    at = other.line.project(path.line.points_m[:, :2], path.line.heading_rad)
    along = at.inside & (np.abs(at.turn_rad) <= MAX_TURN_RAD) & (np.abs(at.aside_m) <= MAX_APART_M)
    s = path.line.s_m
    for rows in np.split(np.arange(len(s)), np.flatnonzero(np.diff(along.astype(int))) + 1):
        if not along[rows[0]] or s[rows[-1]] - s[rows[0]] < 2 * PLATEAU_M:
            continue
        levels = _levels(s[rows], at.aside_m[rows], at.turn_rad[rows])
        for (a, b, one), (c, d, two) in itertools.pairwise(levels):
            kinds = {_kind(one), _kind(two)}
            if kinds != {"same", "beside"}:
                continue
            first, last = rows[b], rows[c]
            if _bend(path, s[first], s[last]) <= _bend(other, at.s_m[first], at.s_m[last]):
                continue
            known = float(s[rows[d]] - s[rows[a]])
            return _Change(k, int(first), int(last), one, two, known)
    return None


def _kind(level_m: float) -> str:
    apart = abs(level_m)
    return "same" if apart <= SAME_M else "beside" if apart >= MIN_APART_M else "between"


def _levels(s: Array, aside: Array, turn: Array) -> list[tuple[int, int, float]]:
    """Return stretches on which an offset stays within `SETTLED_M`: first and last row and its mean."""
    found, a = [], 0
    while a < len(s) - 1:
        low = high = aside[a]
        b = a
        while b + 1 < len(s):
            low, high = min(low, aside[b + 1]), max(high, aside[b + 1])
            if high - low > 2 * SETTLED_M or abs(turn[b + 1]) > PARALLEL_RAD:
                break
            b += 1
        if s[b] - s[a] >= PLATEAU_M:
            found.append((a, b, float(np.median(aside[a : b + 1]))))
            a = b
        a += 1
    return _longest([level for level in found if _kind(level[2]) != "between"])


def _longest(levels: list[tuple[int, int, float]]) -> list[tuple[int, int, float]]:
    """Keep the longest of consecutive levels in the same lane, where a vehicle surely keeps it."""
    out: list[tuple[int, int, float]] = []
    for level in levels:
        if out and _kind(out[-1][2]) == _kind(level[2]) and (_kind(level[2]) == "same" or out[-1][2] * level[2] > 0):
            out[-1] = max(out[-1], level, key=lambda kept: kept[1] - kept[0])
        else:
            out.append(level)
    return out


def _bend(path: DrivenPath, first_m: float, last_m: float) -> float:
    """Return the sum of squared turns from one station to another."""
    steps = np.linspace(first_m, last_m, max(int((last_m - first_m) / 5.0), 4) + 1)
    return float((np.diff(path.line.heading_at(steps)) ** 2).sum())


def _parts(path: DrivenPath, other: DrivenPath, change: _Change) -> tuple[DrivenPath, DrivenPath]:
    at = other.line.project(path.line.points_m[:, :2], path.line.heading_rad)
    span = at.s_m[change.first], at.s_m[change.last]
    s = np.linspace(*span, max(int(np.ceil(span[1] - span[0])), 2) + 1)
    share = (s - s[0]) / (s[-1] - s[0])
    eased = share * share * (3 - 2 * share)
    now = at.aside_m[[change.first, change.last]]
    before = other.line.offset(s, now[0] + eased * (change.before_m - now[0]))
    after = other.line.offset(s, change.after_m + eased * (now[1] - change.after_m))
    one = np.concatenate([path.line.points_m[: change.first], before])
    two = np.concatenate([after, path.line.points_m[change.last + 1 :]])
    return path.with_points(one), path.with_points(two)
