"""Which routes run side by side, as lanes of one road do."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.lanes.graph.polyline import Polyline

STEP_M = 2.0
"""Stations at which distances are taken."""

MIN_APART_M, MAX_APART_M = 2.2, 5.0
"""Between the middles of neighboring lanes: from the narrowest of roadworks to the widest."""

PARALLEL_RAD = float(np.deg2rad(8.0))
"""Lanes of one road differ less in heading; ramps leave at 3 to 5 degrees and are apart soon."""

MIN_LENGTH_M = 8.0
"""Lines that pass each other at a small angle are that near for less than this."""


@dataclass(frozen=True, eq=False)
class Beside:
    """A stretch of a route with another beside it.

    Attributes
    ----------
    route, other : int
    s_m, other_s_m : (K,) float64
        Stations on both; those of `other` fall where it leads the other way.
    aside_m : (K,) float64
        Of the other, to the left.
    same_way : bool
        Whether both lead the same way.
    """

    route: int
    other: int
    s_m: Array
    other_s_m: Array
    aside_m: Array
    same_way: bool


def find_beside(lines: Sequence[Polyline]) -> list[Beside]:
    """Return for each polyline those next to it on both sides, stretch by stretch."""
    found = []
    for i, line in enumerate(lines):
        s = _stations(line, lines)
        points, heading = line.at(s)[:, :2], line.heading_at(s)
        candidates = []
        for j, other in enumerate(lines):
            apart = np.any(other.bounds_m[0] - MAX_APART_M > line.bounds_m[1]) or np.any(
                other.bounds_m[1] + MAX_APART_M < line.bounds_m[0]
            )
            if i != j and not apart:
                candidates += [(j, same, *_next_to(points, heading, other, same)) for same in (True, False)]
        for sign in (1, -1):
            found += _nearest(i, s, [c for c in candidates if np.any(sign * c[3] > 0)], sign)
    return found


def _stations(line: Polyline, lines: Sequence[Polyline]) -> Array:
    """Return stations about `STEP_M` apart on a polyline, and those next to the ends of others."""
    s = np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / STEP_M)), 1) + 1)
    low, high = (bound + sign * MAX_APART_M for bound, sign in zip(line.bounds_m, (-1, 1)))
    ends = [(other.points_m[k, :2], other.heading_rad[k]) for other in lines if other is not line for k in (0, -1)]
    ends = [end for end in ends if np.all(end[0] >= low) and np.all(end[0] <= high)]
    if not ends:
        return s
    xy, heading = np.array([end[0] for end in ends]), np.array([end[1] for end in ends])
    extra = [line.project(xy, heading + turned).s_m for turned in (0.0, np.pi)]
    at = np.concatenate(extra)
    at = at[(at > 0) & (at < line.length_m)]
    return np.unique(np.round(np.concatenate([s, at, at - 1e-3, at + 1e-3]).clip(0.0, line.length_m), 6))


def _next_to(points: Array, heading: Array, other: Polyline, same: bool) -> tuple[Array, Array]:
    """Stations on another polyline (K,) and its offset (K,) to the left of the points; NaN where it is not beside them."""
    at = other.project(points, heading if same else heading + np.pi)
    turn = np.abs(wrap_angle(at.turn_rad))
    good = (
        at.inside & (turn <= PARALLEL_RAD) & (np.abs(at.aside_m) >= MIN_APART_M) & (np.abs(at.aside_m) <= MAX_APART_M)
    )
    aside = -at.aside_m if same else at.aside_m
    return np.where(good, at.s_m, np.nan), np.where(good, aside, np.nan)


def _nearest(route: int, s: Array, candidates: list[tuple[int, bool, Array, Array]], sign: int) -> list[Beside]:
    """Return the stretches of the nearest of candidates on one side."""
    if not candidates:
        return []
    aside = np.array([np.where(sign * c[3] > 0, np.abs(c[3]), np.inf) for c in candidates])
    best = aside.argmin(axis=0)
    best[~np.isfinite(aside.min(axis=0))] = -1
    found = []
    for k, (other, same, other_s, offset) in enumerate(candidates):
        rows = np.flatnonzero(best == k)
        long = [run for run in _stretches(rows, other_s) if s[run[-1]] - s[run[0]] >= MIN_LENGTH_M]
        found += [Beside(route, other, s[run], other_s[run], offset[run], same) for run in long]
    return found


def _stretches(rows: NDArray[np.intp], other_s: Array) -> list[NDArray[np.intp]]:
    """Cut rows where one is missing or the other's station jumps."""
    if not len(rows):
        return []
    cut = (np.diff(rows) > 1) | (np.abs(np.diff(other_s[rows])) > 3 * STEP_M)
    return np.split(rows, np.flatnonzero(cut) + 1)
