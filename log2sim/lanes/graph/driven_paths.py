"""Paths that vehicles drove, in the direction of their headings, cut where they reverse."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from log2sim.datatypes import EGO, GROUP_OF, Agent, Scenario
from log2sim.geometry import Array
from log2sim.lanes.graph.polyline import SPACING_M, Polyline

REVERSAL_M = 0.1
"""A vehicle that moves back by less is settling; more begins a new path."""

MIN_PATH_M = 2.0
"""Shorter paths say nothing of a lane: half a car's length, as one moves when it parks."""

MIN_STEP_M = 0.01
"""Points closer than this along a path are merged: below the error of any position."""

STEP_M = 0.5
"""Greatest distance of points between waypoints."""

MAX_GAP_S = 60.0
"""Between waypoints farther apart in time nobody knows where an agent went: the trajectory is a guess that can overshoot."""

MAX_STEPS = 200
"""Points between two waypoints, which bounds what a jump in a trajectory costs."""

SMOOTH_M = 1.0
"""Standard deviation of the smoothing of observed paths along them: a curve of 6 m becomes 8 cm tighter, and no car turns in less."""

LEVEL_M = 8.0
"""Standard deviation of the smoothing of heights of observed agents: roads curve over tens of meters."""

VEHICLES_FIRST = ("car", "truck", "bus")
"""Categories whose paths make lanes; two-wheelers make some only where those have none."""


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """A stretch of an agent's path without a reversal.

    Attributes
    ----------
    agent : str
    line : Polyline
        Ground under the middle of the box, in the direction of the heading.
    width_m : float
        Of the agent.
    rank : int
        0 for the ego, 1 for vehicles, 2 for two-wheelers: in this order paths make lanes.
    confidence : float
        Of the agent.
    """

    agent: str
    line: Polyline
    width_m: float
    rank: int
    confidence: float

    def with_points(self, points_m: Array) -> DrivenPath:
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
