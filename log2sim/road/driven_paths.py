"""Paths that vehicles drove, and which routes they follow."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
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
    for columns, sigma_m in ((slice(0, 2), SMOOTH_M), (slice(2, 3), LEVEL_M)):
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
    parts = np.where(unknown, 1, np.clip(np.ceil(steps / STEP_M), 1, MAX_STEPS)).astype(int)
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
