"""Polylines on the ground, paths that vehicles drove, and which routes they follow."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO, GROUP_OF, Agent, Scenario
from log2sim.geometry import Array, wrap_angle

# Of the vertices: on the tightest curve of a car (5 m) the middle of a chord is 6 mm off.
SPACING_M = 0.5
# Headings that differ by a radian count as much as so many meters when the nearest vertex is looked for.
TURN_M = 6.0
# Length of the chords whose intersections are computed: on a curve of 10 m they are 5 cm off, which only shifts a junction's
# edge.
CROSSING_STEP_M = 2.0
# Feet this far beyond an end are on the line: resampling moves ends by less.
INSIDE_M = 0.01
# Lines that meet at less than a degree run into each other, and where they do is not known.
MIN_SINE = 0.02


class Projection(NamedTuple):
    """Where points are relative to a polyline."""

    s_m: Array  # (N,): stations of the feet, beyond the ends where a point is before or after it
    aside_m: Array  # (N,): to the left
    turn_rad: Array  # (N,): headings of the points minus that of the line, in [-pi, pi)
    inside: NDArray[np.bool_]  # (N,): whether the foot is on the polyline


@dataclass(frozen=True, eq=False)
class Polyline:
    """A directed line."""

    points_m: Array  # (N, 3): vertices in the map frame, N >= 2, about `SPACING_M` apart, none twice in a row

    @classmethod
    def through(cls, points_m: Array, spacing_m: float = SPACING_M) -> Polyline:
        """Resample points (N, 3) at equal steps of at most `spacing_m`."""
        way = _way(points_m)
        kept = np.concatenate([[True], np.diff(np.maximum.accumulate(way)) > 1e-9])
        way, points = way[kept], points_m[kept]
        at = np.linspace(0.0, way[-1], max(int(np.ceil(way[-1] / spacing_m - 1e-9)), 1) + 1)
        return cls(np.column_stack([np.interp(at, way, column) for column in points.T]))

    @cached_property
    def s_m(self) -> Array:
        """Stations (N,) of the vertices."""
        return _way(self.points_m)

    @property
    def length_m(self) -> float:
        """Length on the ground plane."""
        return float(self.s_m[-1])

    @cached_property
    def heading_rad(self) -> Array:
        """Unwrapped headings (N,) at the vertices: of the circle through each and both its neighbors."""
        steps = np.diff(self.points_m[:, :2], axis=0)
        length = np.hypot(*steps.T)
        chord = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        if len(chord) == 1:
            return np.repeat(chord, 2)
        inner = (chord[:-1] * length[1:] + chord[1:] * length[:-1]) / (length[1:] + length[:-1])
        first, last = 2 * chord[0] - inner[0], 2 * chord[-1] - inner[-1]
        return np.concatenate([[first], inner, [last]])

    def at(self, s_m: Array) -> Array:
        """Return points (K, 3) at stations (K,); beyond the ends straight on."""
        s = np.asarray(s_m, dtype=np.float64)
        points = np.column_stack([np.interp(s, self.s_m, column) for column in self.points_m.T])
        beyond = s - np.clip(s, 0.0, self.length_m)
        heading = self.heading_at(s)
        points[:, 0] += beyond * np.cos(heading)
        points[:, 1] += beyond * np.sin(heading)
        return points

    def heading_at(self, s_m: Array) -> Array:
        """Return headings (K,) at stations (K,)."""
        return np.asarray(np.interp(s_m, self.s_m, self.heading_rad))

    def offset(self, s_m: Array, aside_m: Array) -> Array:
        """Return the points (K, 3) that lie `aside_m` (K,) to the left of stations (K,)."""
        points, heading = self.at(s_m), self.heading_at(s_m)
        points[:, 0] -= aside_m * np.sin(heading)
        points[:, 1] += aside_m * np.cos(heading)
        return points

    def part(self, first_m: float, last_m: float) -> Array:
        """Return the points (K, 3) from one station to another."""
        inner = self.s_m[(self.s_m > first_m + 1e-6) & (self.s_m < last_m - 1e-6)]
        return self.at(np.concatenate([[first_m], inner, [last_m]]))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(_features(self.points_m[:, :2], self.heading_rad))

    @cached_property
    def bounds_m(self) -> tuple[Array, Array]:
        """Least and greatest x, y."""
        return self.points_m[:, :2].min(axis=0), self.points_m[:, :2].max(axis=0)

    def is_near(self, other: Polyline, reach_m: float) -> bool:
        """Return whether another may be within a distance: the boxes around both are."""
        (low, high), (from_m, to_m) = self.bounds_m, other.bounds_m
        return not (np.any(from_m - reach_m > high) or np.any(to_m + reach_m < low))

    def project(self, xy_m: Array, heading_rad: Array) -> Projection:
        """Project points (N, 2) with headings (N,): of the parts nearby, on the one that leads their way."""
        near = self._tree.query(_features(xy_m, heading_rad))[1]
        s, aside = self._feet(near, xy_m)
        inside = (s >= -INSIDE_M) & (s <= self.length_m + INSIDE_M)
        turn = wrap_angle(heading_rad - self.heading_at(s))
        return Projection(s, aside, turn, inside)

    def _feet(self, near: NDArray[np.intp], xy_m: Array) -> tuple[Array, Array]:
        """Stations and offsets of points next to vertices (N,), on the two segments that meet there."""
        points, last = self.points_m[:, :2], len(self.points_m) - 1
        best_s, best_aside = np.zeros(len(xy_m)), np.full(len(xy_m), np.inf)
        best = np.full(len(xy_m), np.inf)
        for shift in (-1, 0):
            k = np.clip(near + shift, 0, last - 1)
            start, step = points[k], points[k + 1] - points[k]
            length = np.hypot(*step.T)
            unit = step / length[:, None]
            gap = xy_m - start
            along, aside = (gap * unit).sum(axis=1), unit[:, 0] * gap[:, 1] - unit[:, 1] * gap[:, 0]
            low, high = np.where(k == 0, -np.inf, 0.0), np.where(k == last - 1, np.inf, length)
            held = np.clip(along, low, high)
            distance = np.hypot(along - held, aside)
            better = distance < best
            best = np.where(better, distance, best)
            best_s = np.where(better, self.s_m[k] + held, best_s)
            best_aside = np.where(better, np.where(aside == 0, 0.0, np.copysign(distance, aside)), best_aside)
        return best_s, best_aside


def crossings(one: Polyline, two: Polyline) -> Array:
    """Return where two polylines, or one and itself, intersect: stations on both (K, 2), m."""
    low, high = (np.maximum(one.bounds_m[0], two.bounds_m[0]), np.minimum(one.bounds_m[1], two.bounds_m[1]))
    if np.any(low > high):
        return np.zeros((0, 2))
    (s, a), (t, b) = _chords(one), _chords(two)
    i, j = _near_chords(a, b)
    da, db, gap = np.diff(a, axis=0)[i], np.diff(b, axis=0)[j], b[j] - a[i]
    det = da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        f = (gap[:, 0] * db[:, 1] - gap[:, 1] * db[:, 0]) / det
        g = (gap[:, 0] * da[:, 1] - gap[:, 1] * da[:, 0]) / det
    sine = np.abs(det) / (np.hypot(*da.T) * np.hypot(*db.T))
    hit = (sine > MIN_SINE) & (f >= 0) & (f < 1) & (g >= 0) & (g < 1)
    found = np.column_stack([s[i] + f * np.diff(s)[i], t[j] + g * np.diff(t)[j]])[hit]
    return np.asarray(found[found[:, 0] < found[:, 1] - CROSSING_STEP_M] if one is two else found)


def _near_chords(a: Array, b: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return pairs of chords of two lines of points that are near enough to each other to intersect, in rising order."""
    from scipy.spatial import cKDTree

    trees = [cKDTree((points[:-1] + points[1:]) / 2) for points in (a, b)]
    reach = sum(float(np.hypot(*np.diff(points, axis=0).T).max()) for points in (a, b)) / 2
    near = trees[0].sparse_distance_matrix(trees[1], reach * (1 + 1e-9), output_type="ndarray")
    order = np.lexsort((near["j"], near["i"]))
    return near["i"][order], near["j"][order]


def _chords(line: Polyline) -> tuple[Array, Array]:
    """Stations (M,) and points (M, 2) about `CROSSING_STEP_M` apart."""
    s = np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / CROSSING_STEP_M)), 1) + 1)
    return s, line.at(s)[:, :2]


def _way(points_m: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points_m[:, :2], axis=0).T))])


def _features(xy_m: Array, heading_rad: Array) -> Array:
    return np.column_stack([xy_m, TURN_M * np.cos(heading_rad), TURN_M * np.sin(heading_rad)])


# A vehicle that moves back by less is settling; more begins a new path.
REVERSAL_M = 0.1
# Shorter paths say nothing of a lane: half a car's length, as one moves when it parks.
MIN_PATH_M = 2.0
# Points closer than this along a path are merged: below the error of any position.
MIN_STEP_M = 0.01
# Greatest distance of points between waypoints.
STEP_M = 0.5
# Between waypoints farther apart in time nobody knows where an agent went: the trajectory is a guess that can overshoot.
MAX_GAP_S = 60.0
# Points between two waypoints, which bounds what a jump in a trajectory costs.
MAX_STEPS = 200
# Standard deviation of the smoothing of observed paths along them: a curve of 6 m becomes 8 cm tighter, and no car turns in
# less.
SMOOTH_M = 1.0
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

    def replace_points(self, points_m: Array) -> DrivenPath:
        """Return the same path along other points (N, 3)."""
        return replace(self, line=Polyline.through(points_m))


def collect_paths(scenario: Scenario) -> list[DrivenPath]:
    """Return the paths of all vehicles of a scenario that are `MIN_PATH_M` long: the ego's first, then long before short."""
    found = [path for agent in scenario.agents if not agent.static for path in _paths_of(agent)]
    return sorted(found, key=lambda p: (p.rank, -round(p.line.length_m, 2), p.agent))


def _paths_of(agent: Agent) -> list[DrivenPath]:
    group = GROUP_OF[agent.category]
    if group not in ("vehicle", "two_wheeler") or len(agent.waypoints) < 2:
        return []
    rank = 0 if agent.id == EGO else 1 if agent.category in VEHICLES_FIRST else 2
    lines = [Polyline.through(points) for points in directed_paths(agent)]
    lines = lines if rank == 0 else [_smoothed(line) for line in lines]
    return [
        DrivenPath(agent.id, line, agent.size_m[1], rank, agent.confidence)
        for line in lines
        if line.length_m >= MIN_PATH_M
    ]


def _smoothed(line: Polyline) -> Polyline:
    """Smooth a path, which is that of a box observed from afar; its ends stay."""
    from scipy.ndimage import gaussian_filter1d

    points = line.points_m.copy()
    for columns, sigma_m in ((slice(0, 2), SMOOTH_M), (slice(2, 3), LEVEL_M)):
        pad = min(int(4 * sigma_m / SPACING_M), len(points) - 1)
        if pad:
            before, after = 2 * points[:1] - points[pad:0:-1], 2 * points[-1:] - points[-2 : -pad - 2 : -1]
            padded = np.concatenate([before, points, after])[:, columns]
            points[:, columns] = gaussian_filter1d(padded, sigma_m / SPACING_M, axis=0, mode="nearest")[pad:-pad]
    return Polyline.through(points)


def directed_paths(agent: Agent) -> list[Array]:
    """Return the stretches (N, 3) of an agent's path between its reversals; none for one that stands."""
    points, yaw, jump = _dense(agent)
    found = []
    for rows in np.split(np.arange(len(points)), np.flatnonzero(jump) + 1):
        progress = _progress(points[rows], yaw[rows])
        for first, last, sign in _monotone_stretches(progress):
            stretch = rows[first : last + 1][::sign]
            kept = _forward_rows(points[stretch], yaw[stretch])
            if len(kept) > 1:
                found.append(points[stretch[kept]])
    return found


def _forward_rows(points: Array, yaw: Array) -> list[int]:
    """Return the rows of points (N, 3) that lie ahead of the ones before, by more than aside: no wheel rolls sideways."""
    kept = [0]
    for k in range(1, len(points)):
        dx, dy = (points[k] - points[kept[-1]])[:2]
        c, s = np.cos(yaw[k]), np.sin(yaw[k])
        ahead, aside = dx * c + dy * s, dy * c - dx * s
        if ahead >= MIN_STEP_M and ahead >= abs(aside):
            kept.append(k)
    return kept


def _dense(agent: Agent) -> tuple[Array, Array, Array]:
    """Ground points (N, 3) and unwrapped headings (N,) along a trajectory, and where it jumps (N - 1,)."""
    w = agent.waypoints
    steps = np.hypot(np.diff(w.x_m), np.diff(w.y_m))
    unknown = agent.trajectory.discontinuous | (np.diff(w.t_s) > MAX_GAP_S)
    parts = np.where(unknown, 1, np.clip(np.ceil(steps / STEP_M), 1, MAX_STEPS)).astype(int)
    t = np.concatenate(
        [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(w.t_s, w.t_s[1:], parts)] + [w.t_s[-1:]]
    )
    state = agent.trajectory.at(t)
    points = np.column_stack([state.x_m, state.y_m, state.z_m - agent.size_m[2] / 2])
    ends = np.cumsum(parts) - 1
    jump = np.zeros(len(t) - 1, dtype=bool)
    jump[ends[unknown]] = True
    return points, np.unwrap(state.yaw_rad), jump


def _progress(points: Array, yaw: Array) -> Array:
    """Return the distance (N,) traveled along the heading, which decreases in reverse."""
    mean = (yaw[1:] + yaw[:-1]) / 2
    step = np.diff(points[:, :2], axis=0)
    return np.concatenate([[0.0], np.cumsum(step[:, 0] * np.cos(mean) + step[:, 1] * np.sin(mean))])


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
    route_of = _choose(s, np.where(stay, np.abs(aside), np.inf), enter_m)
    runs = _runs(route_of, s)
    runs = _absorb(runs, route_of, stay, s)
    pick = np.maximum(route_of, 0), np.arange(n)
    on = route_of >= 0
    if not len(routes):
        return Match(runs, *(np.full(n, np.nan) for _ in range(3)))
    return Match(runs, *(np.where(on, column[pick], np.nan) for column in (s, aside, turn)))


def _choose(s: Array, distance: Array, enter_m: float) -> NDArray[np.intp]:
    """Choose a route (N,) for each sample: the one before while it is near, else the nearest."""
    n = distance.shape[1]
    chosen = np.full(n, -1)
    if not len(distance):
        return chosen
    nearest = distance.argmin(axis=0)
    least = distance[nearest, np.arange(n)]
    current = -1
    for k in range(n):
        if current >= 0:
            goes_on = distance[current, k] < np.inf and abs(s[current, k] - s[current, k - 1]) <= JUMP_M
            if goes_on and (distance[current, k] <= enter_m or least[k] > enter_m):
                chosen[k] = current
                continue
        current = int(nearest[k]) if least[k] <= enter_m else -1
        chosen[k] = current
    return chosen


def _runs(route_of: NDArray[np.intp], s: Array) -> tuple[Run, ...]:
    """Cut samples where the route changes or its station jumps."""
    n = len(route_of)
    changed = np.diff(route_of) != 0
    if len(s):
        own = s[np.maximum(route_of, 0), np.arange(n)]
        changed |= (np.abs(np.diff(own)) > JUMP_M) & (route_of[1:] >= 0)
    cuts = np.concatenate([[0], np.flatnonzero(changed) + 1, [n]])
    return tuple(Run(int(route_of[a]), int(a), int(b) - 1) for a, b in itertools.pairwise(cuts))


def _absorb(runs: tuple[Run, ...], route_of: NDArray[np.intp], stay: NDArray[np.bool_], s: Array) -> tuple[Run, ...]:
    """Put stretches that were never far from one route on it; `route_of` is changed in place."""
    for run in runs:
        if run.route >= 0 or not len(stay):
            continue
        rows = slice(run.first, run.last + 1)
        level = (np.abs(np.diff(s[:, rows], axis=1)) <= JUMP_M).all(axis=1)
        held = np.asarray(stay[:, rows].all(axis=1) & level)
        if held.any():
            beside = [route_of[k] for k in (run.first - 1, run.last + 1) if 0 <= k < len(route_of)]
            best = next((r for r in beside if r >= 0 and held[r]), int(np.flatnonzero(held)[0]))
            route_of[rows] = best
    return _runs(route_of, s)
