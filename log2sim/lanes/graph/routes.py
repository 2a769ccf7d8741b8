"""Merges the paths of many vehicles into routes: one center line for each lane that somebody drove."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import ENTER_M, MAX_TURN_RAD, SHORT_M, STAY_M, Match, match
from log2sim.lanes.graph.polyline import Polyline

LANE_M = 3.5
"""Width of a lane where none is measured: 3.5 m on rural roads (RAL 2012), 3.25 to 3.75 m elsewhere."""

CLEARANCE_M = 0.8
"""Free space beside the vehicle that a lane is made for, both sides together."""

MAX_LANE_M = 5.0
"""Wider strips are two lanes or a parking lane more."""

JOIN_M = 5.0
"""A path that leaves a route within this distance of its end goes on where the other vehicle was last seen."""

BLEND_M = 20.0
"""Over this length a path that lengthens a route comes to its own offset from it: 2.5 degrees at most, as a driver steers."""

GAP_M = 8.0
"""Between two routes that a vehicle drove one after the other, for the way from the middle of one to that of the next."""

KEEP_M = 1.6
"""Center lines stay this close to every path on them, so that all lie within half of a lane of `LANE_M`."""

GRID_M = 2.0
"""Stations at which offsets of paths are compared."""

SMOOTH_M = 8.0
"""Standard deviation of the smoothing along the lane of the mean offset, which jumps by up to a meter where a vehicle appears."""

RETURN_M = 15.0
"""A path that comes back to a place after this distance, which is less than the smallest roundabout, is there a second time."""

BESIDE_M = 3.5
"""Two-wheelers ride beside the middle of a lane by up to its width: nearer ones make no lane of their own."""


@dataclass(frozen=True, eq=False)
class Route:
    """A center line that vehicles follow.

    Attributes
    ----------
    line : Polyline
    width_m : (K,) float64
        At the stations `width_s_m` (K,), constant beyond.
    width_s_m : (K,) float64
    free : (2,) tuple of bool
        Whether start and end are where a vehicle was first or last seen, so that others may lengthen it.
    marked_m : (2,) tuple of float or None
        Stations between which markings make it; elsewhere its middle is that of the paths.
    left, right : str or None
        Ids of the markings or borders beside it, there.
    confidence : float
        That it is a lane in this direction, by its markings.
    """

    line: Polyline
    width_m: Array
    width_s_m: Array
    free: tuple[bool, bool] = (True, True)
    marked_m: tuple[float, float] | None = None
    left: str | None = None
    right: str | None = None
    confidence: float = 0.0

    def width_at(self, s_m: Array) -> Array:
        """Return the width (N,) at stations (N,)."""
        return np.asarray(np.interp(s_m, self.width_s_m, self.width_m))


def merge_paths(paths: Sequence[DrivenPath], marked: Sequence[Route] = ()) -> list[Route]:
    """Return routes that hold all paths: those that markings make, and one wherever a path leaves the routes before.

    Notes
    -----
    Incremental merging of traces (as Cao and Krumm 2009, From GPS traces to a routable road map), then the median of the
    offsets at each station. Cost: paths times routes times samples.
    """
    routes = list(marked)
    for path in paths:
        _add(routes, path)
    matches = [match_path(routes, path) for path in paths]
    return [
        route if route.marked_m is not None else _center(route, k, paths, matches) for k, route in enumerate(routes)
    ]


def match_path(routes: Sequence[Route], path: DrivenPath) -> Match:
    """Match a path to routes; two-wheelers from farther away."""
    reach = (BESIDE_M, BESIDE_M) if path.rank == 2 else (ENTER_M, STAY_M)
    return match([route.line for route in routes], path.line, *reach)


def _add(routes: list[Route], path: DrivenPath) -> None:
    """Add or lengthen routes until a path is on them."""
    s = path.line.s_m
    tried: set[int] = set()
    for _ in range(len(s)):
        found = match_path(routes, path)
        runs = found.runs
        off = [k for k in range(len(runs)) if runs[k].first not in tried and _is_new(routes, found, k, s)]
        if not off:
            return
        k = off[0]
        first, last = runs[k].first, runs[k].last
        tried.add(first)
        back = _first_return(path.line, first, last)
        if back is None and _is_bridge(routes, found, k):
            last = int(np.searchsorted(s, s[last] - GAP_M))
        last = back if back is not None else last
        before = runs[k - 1].route if k > 0 else -1
        after = runs[k + 1].route if k + 1 < len(runs) and back is None else -1
        free = (first == 0, last == len(s) - 1)
        if before >= 0 and _is_at_end(routes[before], found.s_m[first - 1]):
            routes[before] = _lengthened(routes[before], path, (first, last), found.aside_m[first - 1], free[1])
        elif after >= 0 and _is_at_start(routes[after], found.s_m[last + 1]):
            routes[after] = _preceded(routes[after], path, (first, last), found.aside_m[last + 1], free[0])
        elif last > first:
            width = min(max(LANE_M, path.width_m + CLEARANCE_M), MAX_LANE_M)
            line = Polyline.through(path.line.points_m[first : last + 1])
            routes.append(Route(line, np.array([width]), np.zeros(1), free))


def _is_new(routes: Sequence[Route], found: Match, k: int, s: Array) -> bool:
    """Whether run k of a path is off all routes for long, or beyond the end of one."""
    run = found.runs[k]
    if run.route >= 0:
        return False
    before = found.runs[k - 1].route if k > 0 else -1
    after = found.runs[k + 1].route if k + 1 < len(found.runs) else -1
    if _is_bridge(routes, found, k) and s[run.last] - s[run.first] <= GAP_M + SHORT_M:
        return False
    if before >= 0 and run.last == len(s) - 1 and _is_at_end(routes[before], found.s_m[run.first - 1]):
        return True
    if after >= 0 and run.first == 0 and _is_at_start(routes[after], found.s_m[run.last + 1]):
        return True
    return bool(s[run.last] - s[run.first] >= SHORT_M)


def _is_bridge(routes: Sequence[Route], found: Match, k: int) -> bool:
    """Whether run k of a path leads from the end of a route to the start of another."""
    if not 0 < k < len(found.runs) - 1:
        return False
    one, run, two = found.runs[k - 1 : k + 2]
    if one.route < 0 or two.route < 0:
        return False
    left = routes[one.route].line.length_m - found.s_m[run.first - 1]
    return bool(left < JOIN_M and found.s_m[run.last + 1] < JOIN_M)


def _is_at_end(route: Route, s_m: float) -> bool:
    return route.free[1] and route.line.length_m - s_m < JOIN_M


def _is_at_start(route: Route, s_m: float) -> bool:
    return route.free[0] and s_m < JOIN_M


def _first_return(line: Polyline, first: int, last: int) -> int | None:
    """Return the sample of `first` to `last` before a path comes back to where it was, None if it does not."""
    xy, heading, s = line.points_m[first : last + 1, :2], line.heading_rad[first : last + 1], line.s_m[first : last + 1]
    if s[-1] - s[0] < RETURN_M or np.ptp(heading) < np.pi:
        return None
    for k in range(len(xy)):
        earlier = s[:k] < s[k] - RETURN_M
        if not earlier.any():
            continue
        near = np.hypot(*(xy[:k][earlier] - xy[k]).T) <= ENTER_M
        turn = np.abs((heading[:k][earlier] - heading[k] + np.pi) % (2 * np.pi) - np.pi)
        if np.any(near & (turn <= MAX_TURN_RAD)):
            return first + k - 1
    return None


def _lengthened(route: Route, path: DrivenPath, rows: tuple[int, int], aside_m: float, free: bool) -> Route:
    """Lengthen a route by samples of a path that was `aside_m` left of its end."""
    first, last = rows
    s = path.line.s_m[first : last + 1]
    moved = path.line.offset(s, -aside_m * (1 - _ease((s - s[0]) / BLEND_M)))
    head = route.line.points_m[:-1] if route.line.length_m > path.line.s_m[1] else route.line.points_m
    return replace(route, line=Polyline.through(_forward(np.concatenate([head, moved]))), free=(route.free[0], free))


def _preceded(route: Route, path: DrivenPath, rows: tuple[int, int], aside_m: float, free: bool) -> Route:
    """Put samples of a path that comes to `aside_m` left of a route before its start."""
    first, last = rows
    s = path.line.s_m[first : last + 1]
    moved = path.line.offset(s, -aside_m * (1 - _ease((s[-1] - s) / BLEND_M)))
    points = np.concatenate([moved, route.line.points_m[1:]])
    grown = Polyline.through(_forward(points[::-1])[::-1])
    later = grown.length_m - route.line.length_m
    marked = None if route.marked_m is None else (route.marked_m[0] + later, route.marked_m[1] + later)
    return replace(route, line=grown, width_s_m=route.width_s_m + later, marked_m=marked, free=(free, route.free[1]))


def _forward(points: Array) -> Array:
    """Drop points (N, 3) that lie behind those before them, where two parts overlap."""
    kept = [0]
    for k in range(1, len(points)):
        ahead = points[k, :2] - points[kept[-1], :2]
        onward = points[min(k + 1, len(points) - 1), :2] - points[k, :2] if k + 1 < len(points) else ahead
        if ahead @ onward > 0:
            kept.append(k)
    return points[kept]


def _ease(u: Array) -> Array:
    """Cubic from 0 at 0 to 1 at 1, level at both ends."""
    v = np.clip(u, 0.0, 1.0)
    return np.asarray(v * v * (3 - 2 * v))


def _center(route: Route, k: int, paths: Sequence[DrivenPath], matches: Sequence[Match]) -> Route:
    """Move a route to the median of the paths on it."""
    grid = np.linspace(0.0, route.line.length_m, max(int(np.ceil(route.line.length_m / GRID_M)), 1) + 1)
    asides = []
    width = float(route.width_m.max())
    for path, found in zip(paths, matches):
        for run in found.runs:
            if run.route == k and path.rank < 2 and run.last > run.first:
                rows = slice(run.first, run.last + 1)
                asides.append(np.interp(grid, found.s_m[rows], found.aside_m[rows], left=np.nan, right=np.nan))
                width = max(width, min(path.width_m + CLEARANCE_M, MAX_LANE_M))
    route = replace(route, width_m=np.array([width]), width_s_m=np.zeros(1))
    if len(asides) < 2:
        return route
    shift = _smoothed(_middle(np.array(asides)), GRID_M)
    moved = route.line.offset(route.line.s_m, np.interp(route.line.s_m, grid, shift))
    return replace(route, line=Polyline.through(moved)) if np.any(shift) else route


def _middle(asides: Array) -> Array:
    """Return the medians (K,) of offsets (P, K), as near to every path as `KEEP_M` demands; zero where there is none."""
    known = np.isfinite(asides).any(axis=0)
    held = np.where(known, asides, 0.0)
    middle, low, high = np.nanmedian(held, axis=0), np.nanmin(held, axis=0), np.nanmax(held, axis=0)
    near = np.clip(middle, high - KEEP_M, np.maximum(low + KEEP_M, high - KEEP_M))
    return np.asarray(np.where(high - low > 2 * KEEP_M, (high + low) / 2, near))


def _smoothed(values: Array, step_m: float) -> Array:
    from scipy.ndimage import gaussian_filter1d

    return np.asarray(gaussian_filter1d(values, SMOOTH_M / step_m, mode="nearest"))
