"""Where routes branch, merge and cross: stretches of them that belong to one junction."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import JUMP_M, STAY_M, Match, Run
from log2sim.lanes.graph.polyline import Projection, crossings
from log2sim.lanes.graph.routes import JOIN_M, LANE_M, MAX_LANE_M, Route

ALIGNED_RAD = float(np.deg2rad(2.0))
"""A path that is turned less against a route follows it: within its lane a vehicle turns by a degree or two."""

MAX_TURNOFF_M = 20.0
"""How far before it leaves a route a path may begin to turn."""

CHANGE_RAD = float(np.deg2rad(10.0))
"""Routes that differ less in heading run side by side; a path from one to the other changes lanes."""

MARGIN_M = 2.0
"""Between where two lanes touch and where a junction begins: vehicles there overlap no lane but their own."""

MAX_HALF_M = 15.0
"""Half of the length of the place where two lanes cross at a small angle."""


@dataclass(frozen=True)
class Interval:
    """A stretch of a route in a conflict or junction."""

    route: int
    first_m: float
    last_m: float


@dataclass(frozen=True)
class Conflict:
    """Stretches of routes that share ground.

    Attributes
    ----------
    intervals : tuple of Interval
    crossing : bool
        Whether lanes cross there; else they branch, merge or follow each other.
    """

    intervals: tuple[Interval, ...]
    crossing: bool


def find_transitions(match: Match) -> Iterator[tuple[Run, Run]]:
    """Yield consecutive runs of a path on two routes, or on one that it comes back to."""
    on = [run for run in match.runs if run.route >= 0]
    for one, two in pairwise(on):
        if one.route != two.route or abs(match.s_m[two.first] - match.s_m[one.last]) > JUMP_M:
            yield one, two


def find_conflicts(routes: Sequence[Route], paths: Sequence[DrivenPath], matches: Sequence[Match]) -> list[Conflict]:
    """Return where routes cross, and where paths go from one to another without being beside each other."""
    found = []
    for path, match in zip(paths, matches):
        if path.rank < 2 or len({run.route for run in match.runs}) > 1:
            for one, two in find_transitions(match):
                conflict = _transition(routes, path, match, one, two)
                found += [conflict] if conflict is not None else []
    for i, a in enumerate(routes):
        for j, b in enumerate(routes[i:], start=i):
            found += [_crossing(routes, i, j, float(s), float(t)) for s, t in crossings(a.line, b.line)]
    return found


def _crossing(routes: Sequence[Route], i: int, j: int, s: float, t: float) -> Conflict:
    one, two = routes[i], routes[j]
    turn = float(one.line.heading_at(np.array(s)) - two.line.heading_at(np.array(t)))
    sine, cosine = max(abs(np.sin(turn)), 1e-3), abs(np.cos(turn))
    wide = [float(r.width_at(np.array(x))) for r, x in ((one, s), (two, t))]
    intervals = []
    for k, x, own, other in ((i, s, wide[0], wide[1]), (j, t, wide[1], wide[0])):
        half = min((other / 2 + own / 2 * cosine) / sine, MAX_HALF_M) + MARGIN_M
        intervals.append(hold(routes[k], k, x - half, x + half))
    return Conflict(tuple(intervals), crossing=True)


def hold(route: Route, k: int, first: float, last: float) -> Interval:
    """Return a stretch of route k as far as the route goes."""
    return Interval(k, max(first, 0.0), min(last, route.line.length_m))


def is_lane_change(routes: Sequence[Route], path: DrivenPath, one: Run, two: Run) -> bool:
    """Whether a path goes from a route to one that runs beside it, before and after."""
    if one.route == two.route:
        return False
    for other, k in ((two.route, one.last), (one.route, two.first)):
        line = routes[other].line
        at = line.project(path.line.points_m[k : k + 1, :2], path.line.heading_rad[k : k + 1])
        there = JOIN_M < at.s_m[0] < line.length_m - JOIN_M
        if not there or not STAY_M / 2 <= abs(at.aside_m[0]) <= MAX_LANE_M or abs(at.turn_rad[0]) > 2 * CHANGE_RAD:
            return False
    return True


def _transition(routes: Sequence[Route], path: DrivenPath, match: Match, one: Run, two: Run) -> Conflict | None:
    """Return the stretches between leaving a route and following another, None for a change of lanes."""
    if is_lane_change(routes, path, one, two):
        return None
    rows = np.arange(one.first, two.last + 1)
    xy, heading, s = path.line.points_m[rows, :2], path.line.heading_rad[rows], path.line.s_m[rows]
    a, b = (routes[run.route].line.project(xy, heading) for run in (one, two))
    leave, arrive = one.last - one.first, two.first - one.first
    straight = np.flatnonzero(
        (np.abs(a.turn_rad[: leave + 1]) <= ALIGNED_RAD) & (s[: leave + 1] >= s[leave] - MAX_TURNOFF_M)
    )
    begin = int(straight[-1]) if len(straight) else int(np.searchsorted(s, s[leave] - MAX_TURNOFF_M))
    aligned = np.flatnonzero((np.abs(b.turn_rad[arrive:]) <= ALIGNED_RAD) & (s[arrive:] <= s[arrive] + MAX_TURNOFF_M))
    end = (
        arrive + int(aligned[0])
        if len(aligned)
        else int(np.searchsorted(s, s[arrive] + MAX_TURNOFF_M, side="right")) - 1
    )
    apart = _first(_is_apart(a)[leave:]) + leave
    together = arrive - _first(_is_apart(b)[arrive::-1])
    own = match.s_m[rows]
    first = own[max(min(begin, together), 0)] if together <= leave else own[begin]
    last = max(own[leave], min(a.s_m[apart], routes[one.route].line.length_m))
    enter = min(own[arrive], max(b.s_m[together], 0.0)) if b.inside[together] else own[arrive]
    out = max(own[end], own[apart] if apart >= arrive else -np.inf)
    length = routes[one.route].line.length_m
    room = JUMP_M if s[arrive] - s[leave] < JUMP_M else 0.0
    if length - own[leave] < JOIN_M and own[arrive] < JOIN_M:  # one goes on as the other
        return Conflict((Interval(one.route, length - room, length), Interval(two.route, 0.0, room)), crossing=False)
    return Conflict(
        (
            hold(
                routes[one.route],
                one.route,
                min(first, own[leave] - JUMP_M),
                length if length - own[leave] < JOIN_M else last,
            ),
            hold(routes[two.route], two.route, 0.0 if own[arrive] < JOIN_M else enter, max(out, own[arrive] + JUMP_M)),
        ),
        crossing=False,
    )


def _is_apart(at: Projection) -> NDArray[np.bool_]:
    return np.asarray((np.abs(at.aside_m) >= LANE_M) | ~at.inside)


def _first(mask: NDArray[np.bool_]) -> int:
    """Return the first index at which a mask holds, the last index if it never does."""
    return int(mask.argmax()) if mask.any() else len(mask) - 1
