"""Paths that vehicles drove, and routes: many of them merged, one center line for each lane."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, GROUP_OF, Agent, Scenario
from log2sim.geometry import SPACING_M, Array, Polyline

# A vehicle that moves back by less is settling; more begins a new path.
REVERSAL_M = 0.1
# Shorter paths say nothing of a lane: half a car's length, as one moves when it parks.
MIN_PATH_M = 2.0
# Points closer than this along a path are merged: below the error of any position.
MIN_STEP_M = 0.01
# Greatest distance of points between waypoints.
WAYPOINT_STEP_M = 0.5
# Between waypoints farther apart in time nobody knows where an agent went: the trajectory is a guess that can overshoot.
MAX_GAP_S = 60.0
# Points between two waypoints, which bounds what a jump in a trajectory costs.
MAX_STEPS = 200
# Standard deviation of the smoothing of observed paths along them: a curve of 6 m becomes 8 cm tighter, and no car turns in
# less.
OBSERVED_SMOOTH_M = 1.0
# Standard deviation of the smoothing of heights of observed agents: roads curve over tens of meters.
LEVEL_M = 8.0
# Categories whose paths make lanes; two-wheelers make some only where those have none.
VEHICLES_FIRST = ("car", "truck", "bus")


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """A stretch of an agent's path without a reversal."""

    agent: str
    line: Polyline  # ground under the middle of the box, in the direction of the heading
    width_m: float  # of the agent
    rank: int  # 0 for the ego, 1 for vehicles, 2 for two-wheelers: in this order paths make lanes
    confidence: float  # of the agent


def collect_paths(scenario: Scenario) -> list[DrivenPath]:
    """Return the paths of all vehicles of a scenario that are `MIN_PATH_M` long: the ego's first, then long before short."""
    found = []
    for agent in scenario.agents:
        drives = GROUP_OF[agent.category] in ("vehicle", "two_wheeler") and not agent.static
        if not drives or len(agent.waypoints) < 2:
            continue
        rank = 0 if agent.id == EGO else 1 if agent.category in VEHICLES_FIRST else 2
        for points in directed_paths(agent):
            line = Polyline.through(points)
            line = line if rank == 0 else _smoothed(line)
            if line.length_m >= MIN_PATH_M:
                found.append(DrivenPath(agent.id, line, agent.size_m[1], rank, agent.confidence))
    return sorted(found, key=lambda p: (p.rank, -round(p.line.length_m, 2), p.agent))


def _smoothed(line: Polyline) -> Polyline:
    """Smooth a path, which is that of a box observed from afar; its ends stay."""
    from scipy.ndimage import gaussian_filter1d

    points = line.points_m.copy()
    for columns, sigma_m in ((slice(0, 2), OBSERVED_SMOOTH_M), (slice(2, 3), LEVEL_M)):
        pad = min(int(4 * sigma_m / SPACING_M), len(points) - 1)
        if pad:
            before, after = 2 * points[:1] - points[pad:0:-1], 2 * points[-1:] - points[-2 : -pad - 2 : -1]
            padded = np.concatenate([before, points, after])[:, columns]
            points[:, columns] = gaussian_filter1d(padded, sigma_m / SPACING_M, axis=0, mode="nearest")[pad:-pad]
    return Polyline.through(points)


def directed_paths(agent: Agent) -> list[Array]:
    """Return the stretches (N, 3) of an agent's path between its reversals; none for one that stands."""
    w = agent.waypoints
    steps = np.hypot(np.diff(w.x_m), np.diff(w.y_m))
    unknown = agent.trajectory.discontinuous | (np.diff(w.t_s) > MAX_GAP_S)
    parts = np.where(unknown, 1, np.clip(np.ceil(steps / WAYPOINT_STEP_M), 1, MAX_STEPS)).astype(int)
    pieces = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(w.t_s, w.t_s[1:], parts)]
    state = agent.trajectory.at(np.concatenate([*pieces, w.t_s[-1:]]))
    points = np.column_stack([state.x_m, state.y_m, state.z_m - agent.size_m[2] / 2])
    yaw, jump = np.unwrap(state.yaw_rad), np.zeros(len(points) - 1, dtype=bool)
    jump[(np.cumsum(parts) - 1)[unknown]] = True
    found = []
    for rows in np.split(np.arange(len(points)), np.flatnonzero(jump) + 1):
        # The distance traveled along the heading, which decreases in reverse.
        mean, step = (yaw[rows[1:]] + yaw[rows[:-1]]) / 2, np.diff(points[rows, :2], axis=0)
        progress = np.concatenate([[0.0], np.cumsum(step[:, 0] * np.cos(mean) + step[:, 1] * np.sin(mean))])
        for first, last, sign in _monotone_stretches(progress):
            stretch = rows[first : last + 1][::sign]
            kept = [stretch[0]]
            # Points that lie ahead of the ones before, by more than aside: no wheel rolls sideways.
            for k in stretch[1:]:
                dx, dy = (points[k] - points[kept[-1]])[:2]
                c, s = np.cos(yaw[k]), np.sin(yaw[k])
                ahead, aside = dx * c + dy * s, dy * c - dx * s
                if ahead >= MIN_STEP_M and ahead >= abs(aside):
                    kept.append(k)
            if len(kept) > 1:
                found.append(points[kept])
    return found


def _monotone_stretches(progress: Array) -> Iterator[tuple[int, int, int]]:
    """Yield first and last row and direction of each stretch in one direction, ignoring reversals up to `REVERSAL_M`."""
    start, extreme, sign = 0, 0, 0
    for k in range(1, len(progress)):
        if sign == 0:
            if abs(progress[k] - progress[start]) > REVERSAL_M or k == len(progress) - 1:
                sign, extreme = (1 if progress[k] >= progress[start] else -1), k
        elif sign * (progress[k] - progress[extreme]) > 0:
            extreme = k
        elif sign * (progress[extreme] - progress[k]) > REVERSAL_M:
            yield start, extreme, sign
            start, extreme, sign = extreme, k, -sign
    if sign:
        yield start, extreme, sign


# A vehicle closer than this to a route is on it: half of the narrowest usual lane, 3.0 m (RAA 2008, urban roads).
ENTER_M = 1.5
# It is on it until it is farther away than the narrowest lane of roadworks is wide; a lane beside cannot be nearer.
STAY_M = 2.2
# Larger differences of heading are crossings of a route.
MAX_TURN_RAD = float(np.deg2rad(30.0))
# Stations of two neighboring samples that differ by more belong to two passes of the same route.
JUMP_M = 5.0
# Stretches off all routes that are shorter are gaps between two routes.
SHORT_M = 2.0


class Run(NamedTuple):
    """Samples `first` to `last` (inclusive) of a path on a route, -1 for none."""

    route: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Match:
    """Where a path is on routes."""

    runs: tuple[Run, ...]  # in order; together they hold every sample once
    # `s_m`, `aside_m`, `turn_rad`: (N,): station on the route of the run, offset to its left and difference of heading;
    # NaN off all routes
    s_m: Array
    aside_m: Array
    turn_rad: Array


def match(routes: Sequence[Polyline], line: Polyline, enter_m: float = ENTER_M, stay_m: float = STAY_M) -> Match:
    """Match the vertices of a path to routes."""
    n = len(line.points_m)
    shape = (len(routes), n)
    s, aside, turn = np.full(shape, np.nan), np.full(shape, np.inf), np.full(shape, np.inf)
    stay = np.zeros(shape, dtype=bool)
    for r, route in enumerate(routes):
        if not line.is_near(route, stay_m):
            continue
        at = route.project(line.points_m[:, :2], line.heading_rad)
        s[r], aside[r], turn[r] = at.s_m, at.aside_m, at.turn_rad
        stay[r] = at.inside & (np.abs(at.aside_m) <= stay_m) & (np.abs(at.turn_rad) <= MAX_TURN_RAD)
    if not len(routes):
        return Match((Run(-1, 0, n - 1),), *(np.full(n, np.nan) for _ in range(3)))
    route_of = _choose(s, np.where(stay, np.abs(aside), np.inf), enter_m)
    # Stretches that were never far from one route are on it.
    for run in _runs(route_of, s):
        if run.route < 0:
            rows = slice(run.first, run.last + 1)
            held = np.all(np.abs(np.diff(s[:, rows], axis=1)) <= JUMP_M, axis=1)
            held &= stay[:, rows].all(axis=1)
            if held.any():
                beside = [route_of[k] for k in (run.first - 1, run.last + 1) if 0 <= k < n]
                route_of[rows] = next((r for r in beside if r >= 0 and held[r]), np.flatnonzero(held)[0])
    pick = np.maximum(route_of, 0), np.arange(n)
    columns = (np.where(route_of >= 0, column[pick], np.nan) for column in (s, aside, turn))
    return Match(_runs(route_of, s), *columns)


def _choose(s: Array, distance: Array, enter_m: float) -> NDArray[np.intp]:
    """Choose a route (N,) for each sample: the one before while it is near, else the nearest."""
    nearest, least = distance.argmin(axis=0), distance.min(axis=0)
    chosen = np.where(least <= enter_m, nearest, -1)
    for k in range(1, len(chosen)):
        current = chosen[k - 1]
        goes_on = current >= 0 and distance[current, k] < np.inf and abs(s[current, k] - s[current, k - 1]) <= JUMP_M
        if goes_on and (distance[current, k] <= enter_m or least[k] > enter_m):
            chosen[k] = current
    return chosen


def _runs(route_of: NDArray[np.intp], s: Array) -> tuple[Run, ...]:
    """Cut samples where the route changes or its station jumps."""
    n = len(route_of)
    own = s[np.maximum(route_of, 0), np.arange(n)]
    changed = (np.diff(route_of) != 0) | ((np.abs(np.diff(own)) > JUMP_M) & (route_of[1:] >= 0))
    cuts = np.concatenate([[0], np.flatnonzero(changed) + 1, [n]])
    return tuple(Run(int(route_of[a]), int(a), int(b) - 1) for a, b in itertools.pairwise(cuts))


# Stations at which distances are taken.
STEP_M = 2.0
# Between the middles of neighboring lanes: from the narrowest of roadworks to the widest.
MIN_APART_M, MAX_APART_M = 2.2, 5.0
# Lanes of one road differ less in heading; ramps leave at 3 to 5 degrees and are apart soon.
PARALLEL_RAD = float(np.deg2rad(8.0))
# Lines that pass each other at a small angle are that near for less than this.
MIN_LENGTH_M = 8.0


@dataclass(frozen=True, eq=False)
class Beside:
    """A stretch of a route with another beside it."""

    route: int
    other: int
    s_m: Array  # `s_m`, `other_s_m`: (K,): stations on both; those of `other` fall where it leads the other way
    other_s_m: Array
    aside_m: Array  # (K,): of the other, to the left
    same_way: bool  # whether both lead the same way


def find_beside(lines: Sequence[Polyline]) -> list[Beside]:
    """Return for each polyline those next to it on both sides, stretch by stretch."""
    found = []
    for i, line in enumerate(lines):
        s = _stations(line, lines)
        points, heading = line.at(s)[:, :2], line.heading_at(s)
        candidates = []
        for j, other in enumerate(lines):
            if i == j or not line.is_near(other, MAX_APART_M):
                continue
            for same in (True, False):
                at = other.project(points, heading if same else heading + np.pi)
                apart = np.abs(at.aside_m)
                good = (
                    at.inside & (np.abs(at.turn_rad) <= PARALLEL_RAD) & (apart >= MIN_APART_M) & (apart <= MAX_APART_M)
                )
                aside = -at.aside_m if same else at.aside_m
                candidates.append((j, same, np.where(good, at.s_m, np.nan), np.where(good, aside, np.nan)))
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
        # Cut where one is missing or the other's station jumps.
        cut = (np.diff(rows) > 1) | (np.abs(np.diff(other_s[rows])) > 3 * STEP_M)
        runs = np.split(rows, np.flatnonzero(cut) + 1) if len(rows) else []
        long = [run for run in runs if s[run[-1]] - s[run[0]] >= MIN_LENGTH_M]
        found += [Beside(route, other, s[run], other_s[run], offset[run], same) for run in long]
    return found


# Width of a lane where none is measured: 3.5 m on rural roads (RAL 2012), 3.25 to 3.75 m elsewhere.
LANE_M = 3.5
# Free space beside the vehicle that a lane is made for, both sides together.
CLEARANCE_M = 0.8
# Wider strips are two lanes or a parking lane more.
MAX_LANE_M = 5.0
# A path that leaves a route within this distance of its end goes on where the other vehicle was last seen.
JOIN_M = 5.0
# Over this length a path that lengthens a route comes to its own offset from it: 2.5 degrees at most, as a driver steers.
BLEND_M = 20.0
# Between two routes that a vehicle drove one after the other, for the way from the middle of one to that of the next.
GAP_M = 8.0
# Center lines stay this close to every path on them, so that all lie within half of a lane of `LANE_M`.
KEEP_M = 1.6
# Stations at which offsets of paths are compared.
GRID_M = 2.0
# Standard deviation of the smoothing along the lane of the mean offset, which jumps by up to a meter where a vehicle appears.
SMOOTH_M = 8.0
# A path that comes back to a place after this distance, which is less than the smallest roundabout, is there a second time.
RETURN_M = 15.0
# Two-wheelers ride beside the middle of a lane by up to its width: nearer ones make no lane of their own.
BESIDE_M = 3.5


@dataclass(frozen=True, eq=False)
class Route:
    """A center line that vehicles follow."""

    line: Polyline
    width_m: Array  # (K,): at the stations `width_s_m` (K,), constant beyond
    width_s_m: Array  # (K,)
    # (2,) tuple of bool: whether start and end are where a vehicle was first or last seen, so that others may lengthen
    # it
    free: tuple[bool, bool] = (True, True)
    # (2,) tuple of float or None: stations between which markings make it; elsewhere its middle is that of the paths
    marked_m: tuple[float, float] | None = None
    left: str | None = None  # `left`, `right`: ids of the markings or borders beside it, there
    right: str | None = None
    confidence: float = 0.0  # that it is a lane in this direction, by its markings

    def width_at(self, s_m: Array) -> Array:
        """Return the width (N,) at stations (N,)."""
        return np.asarray(np.interp(s_m, self.width_s_m, self.width_m))


def merge_paths(paths: Sequence[DrivenPath], marked: Sequence[Route] = ()) -> list[Route]:
    """Return routes that hold all paths: those that markings make, and one wherever a path leaves the routes before.

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
        own = path.line.s_m[first : last + 1]
        if before >= 0 and _is_at_end(routes[before], found.s_m[first - 1]):
            # From as far aside as the path was at the end of the route before.
            route = routes[before]
            moved = path.line.offset(own, -found.aside_m[first - 1] * (1 - _ease((own - own[0]) / BLEND_M)))
            head = route.line.points_m[:-1] if route.line.length_m > s[1] else route.line.points_m
            line = Polyline.through(_forward(np.concatenate([head, moved])))
            routes[before] = replace(route, line=line, free=(route.free[0], free[1]))
        elif after >= 0 and _is_at_start(routes[after], found.s_m[last + 1]):
            route = routes[after]
            moved = path.line.offset(own, -found.aside_m[last + 1] * (1 - _ease((own[-1] - own) / BLEND_M)))
            line = Polyline.through(_forward(np.concatenate([moved, route.line.points_m[1:]])[::-1])[::-1])
            later = line.length_m - route.line.length_m
            marked = None if route.marked_m is None else (route.marked_m[0] + later, route.marked_m[1] + later)
            width_s_m, ends = route.width_s_m + later, (free[0], route.free[1])
            routes[after] = replace(route, line=line, width_s_m=width_s_m, marked_m=marked, free=ends)
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
    from scipy.ndimage import gaussian_filter1d

    # The median, as near to every path as `KEEP_M` demands; zero where there is none.
    held = np.where(np.isfinite(asides).any(axis=0), asides, 0.0)
    middle, low, high = np.nanmedian(held, axis=0), np.nanmin(held, axis=0), np.nanmax(held, axis=0)
    near = np.clip(middle, high - KEEP_M, np.maximum(low + KEEP_M, high - KEEP_M))
    middle = np.where(high - low > 2 * KEEP_M, (high + low) / 2, near)
    shift = gaussian_filter1d(middle, SMOOTH_M / GRID_M, mode="nearest")
    moved = route.line.offset(route.line.s_m, np.interp(route.line.s_m, grid, shift))
    return replace(route, line=Polyline.through(moved)) if np.any(shift) else route


# How far: through a junction of four lanes each way.
REACH_M = 30.0
# A vehicle that is turned more against the route is about to leave it, or has come from elsewhere.
MAX_KINK_RAD = float(np.deg2rad(12.0))


def continued(routes: Sequence[Route], path: DrivenPath, match: Match) -> DrivenPath:
    """Return a path with up to `REACH_M` of the routes on which it begins and ends."""
    first, last = match.runs[0], match.runs[-1]
    before = _along(routes, match, first, first.first, -1)
    after = _along(routes, match, last, last.last, 1)
    if not len(before) and not len(after):
        return path
    return replace(path, line=Polyline.through(np.concatenate([before, path.line.points_m, after])))


def _along(routes: Sequence[Route], match: Match, run: Run, k: int, sign: int) -> Array:
    """Points (N, 3) of the run's route before (-1) or after (1) sample k, eased from the path's offset to the middle."""
    if run.route < 0 or abs(match.turn_rad[k]) > MAX_KINK_RAD:
        return np.zeros((0, 3))
    line = routes[run.route].line
    s = match.s_m[k]
    room = min(REACH_M, s if sign < 0 else line.length_m - s)
    if room < SPACING_M:
        return np.zeros((0, 3))
    ahead = np.linspace(0.0, room, int(np.ceil(room / SPACING_M)) + 1)[1:]
    u = ahead / room
    slope = sign * np.tan(match.turn_rad[k])
    aside = match.aside_m[k] * (1 - u) ** 2 * (1 + 2 * u) + slope * room * u * (1 - u) ** 2
    points = line.offset(s + sign * ahead, aside)
    return points[::sign]
