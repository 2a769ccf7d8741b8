"""Paths of many agents' boxes in flat tables, and who reaches into an agent's corridor."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import STANDSTILL_MPS, Trajectory
from log2sim.geometry import Array

TIME_STEP_S = 0.1  # linear interpolation errs by a h^2 / 8, a centimeter at 10 m/s2
SPACING_M = 1.0
EXTENSION_M = 120.0  # straight extension of a path beyond the end of the scenario: as far as a driver looks ahead
# Range about its last place in which an agent is searched on its path: so it stays on its branch where paths cross.
SEARCH_BACK_M, SEARCH_AHEAD_M = 5.0, 20.0

COARSE_STRIDE = 4  # rows between those of the first pass of a search


class Pose(NamedTuple):
    """Box centers relative to the origin of the table."""

    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array  # unwrapped
    speed_mps: Array  # signed
    distance_m: Array  # distance traveled since the begin of the trajectory


@dataclass(frozen=True, eq=False)
class PathProjection:
    """Points relative to the nearest places of a path."""

    ahead_m: Array  # of the point, from that place
    left_m: Array
    cos: Array  # direction of travel there
    sin: Array
    distance_m: Array  # along the path up to there
    t_s: Array  # time of the scenario there; NaN beyond its end


class PathTable:
    """Paths of A agents; positions are relative to `origin_m`, which keeps digits far from the map's origin."""

    def __init__(self, trajectories: Sequence[Trajectory]) -> None:
        self.origin_m = trajectories[0].origin_m if trajectories else (0.0, 0.0)
        self.begin_s = np.array([p.t_s[0] for p in trajectories], dtype=np.float64)
        self.end_s = np.array([p.t_s[-1] for p in trajectories], dtype=np.float64)
        tables = [_time_table(p, self.origin_m) for p in trajectories]
        marks = [_distance_table(t) for t in tables]
        # Numbers of rows of each table, and the first one of each after concatenation.
        self._rows, self.marks = (np.array([len(t) for t in c], dtype=np.intp) for c in (tables, marks))
        self._row0, self._mark0 = np.cumsum(self._rows) - self._rows, np.cumsum(self.marks) - self.marks
        self._poses = np.concatenate([np.zeros((0, 6)), *(t[:, 1:] for t in tables)])
        self._marks = np.concatenate([np.zeros((0, 5)), *marks])

    def at(self, agent: NDArray[np.intp], t_s: Array) -> Pose:
        """Return where agents are at times, broadcast together: held before their lifetime, straight on after it."""
        begin, end, rows = self.begin_s[agent], self.end_s[agent], self._rows[agent]
        step = np.where(rows > 1, (end - begin) / np.maximum(rows - 1, 1), 1.0)
        place = np.clip((t_s - begin) / step, 0.0, rows - 1)
        k = np.minimum(place.astype(np.intp), np.maximum(rows - 2, 0))
        low = self._poses[self._row0[agent] + k]
        high = self._poses[self._row0[agent] + np.minimum(k + 1, rows - 1)]
        x, y, z, yaw, speed, distance = np.moveaxis(low + (place - k)[..., None] * (high - low), -1, 0)
        beyond = np.maximum(t_s - end, 0.0) * speed
        return Pose(x + beyond * np.cos(yaw), y + beyond * np.sin(yaw), z, yaw, speed, distance + np.abs(beyond))

    def along(self, agent: NDArray[np.intp], distance_m: Array) -> tuple[Array, Array, Array, Array, Array]:
        """Return x, y, direction of travel as cos, sin, and the scenario's time at distances, broadcast together."""
        place = np.clip(distance_m / SPACING_M, 0.0, self.marks[agent] - 1)
        k = np.minimum(place.astype(np.intp), self.marks[agent] - 2)
        low, high = self._marks[self._mark0[agent] + k], self._marks[self._mark0[agent] + k + 1]
        x, y, cos, sin, t_s = np.moveaxis(low + (place - k)[..., None] * (high - low), -1, 0)
        return x, y, cos, sin, t_s

    def foot(self, agent: NDArray[np.intp], from_m: Array, reach_m: float, x_m: Array, y_m: Array) -> PathProjection:
        """Return the places within `reach_m` from `from_m` (P,) on the paths of agents (P,) that are nearest to points (P, H)."""
        first = np.clip((from_m / SPACING_M).astype(np.intp), 0, self.marks[agent] - 1)
        ahead = np.arange(0, int(reach_m / SPACING_M) + COARSE_STRIDE, COARSE_STRIDE)
        k = np.minimum(first[:, None] + ahead, self.marks[agent][:, None] - 1)
        near = self._marks[self._mark0[agent][:, None] + k, :2]
        # |a - b|^2 less |a|^2, which is the same for all b.
        square = (near**2).sum(axis=2)[:, None] - 2 * np.stack([x_m, y_m], axis=2) @ near.swapaxes(1, 2)
        k = np.take_along_axis(k, np.argmin(square, axis=2), axis=1)
        begin = self._mark0[agent][:, None]
        for _ in range(2):
            x, y, cos, sin, t_s = np.moveaxis(self._marks[begin + k], -1, 0)
            dx, dy = x_m - x, y_m - y
            forward = dx * cos + dy * sin
            moved = k + np.clip(np.rint(forward / SPACING_M), -COARSE_STRIDE, COARSE_STRIDE).astype(np.intp)
            moved = np.clip(moved, first[:, None], self.marks[agent][:, None] - 1)
            if np.array_equal(moved, k):
                break
            k = moved
        x, y, cos, sin, t_s = np.moveaxis(self._marks[begin + k], -1, 0)
        dx, dy = x_m - x, y_m - y
        return PathProjection(dx * cos + dy * sin, dy * cos - dx * sin, cos, sin, k * SPACING_M, t_s)

    def progress_near(self, agent: int, from_m: float, x_m: float, y_m: float) -> float:
        """Return how far along its path an agent at a place of the map is that was at `from_m` before; at least 0."""
        begin_m = max(from_m - SEARCH_BACK_M, 0.0)
        x, y = (np.array([[c - o]]) for c, o in zip((x_m, y_m), self.origin_m))
        foot = self.foot(np.array([agent]), np.array([begin_m]), from_m - begin_m + SEARCH_AHEAD_M, x, y)
        return max(float(foot.distance_m[0, 0] + foot.ahead_m[0, 0]), 0.0)

    def progress(self, agent: int, x_m: Array, y_m: Array) -> Array:
        """Return how far along its path an agent is at successive places (S,) of the map."""
        gone, out = 0.0, np.zeros(len(x_m))
        for k, (x, y) in enumerate(zip(x_m.tolist(), y_m.tolist())):
            out[k] = gone = self.progress_near(agent, gone, x, y)
        return out

    def times(self, agent: NDArray[np.intp], distance_m: Array) -> Array:
        """Return when the scenario was at distances along paths, broadcast together; its end for places beyond."""
        t_s = self.along(agent, distance_m)[4]
        return np.where(np.isnan(t_s), self.end_s[agent], t_s)


def scenario_times_of_distance(trajectory: Trajectory, t_s: Array, x_m: Array, y_m: Array) -> Array:
    """Return when the scenario had traveled the distance that an agent on its path has, (S,).

    An agent that keeps to its path but not to its times takes its height and its errors from there.
    """
    table = _time_table(trajectory, trajectory.origin_m)
    gone = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x_m), np.diff(y_m)))])
    start = float(np.interp(t_s[0], table[:, 0], table[:, 6]))
    at_s = np.interp(start + gone, table[:, 6], table[:, 0])
    return np.asarray(np.maximum(np.minimum(at_s, t_s), trajectory.t_s[0]))


def _time_table(trajectory: Trajectory, origin_m: tuple[float, float]) -> Array:
    """Return rows (K, 7) evenly spaced over a lifetime: time, then the columns of `Pose`."""
    begin, end = trajectory.t_s[0], trajectory.t_s[-1]
    count = int(np.ceil((end - begin) / TIME_STEP_S)) + 1 if end > begin else 1
    t_s = np.linspace(begin, end, count)
    x, y, yaw, speed = trajectory.relative(t_s)
    step = np.hypot(np.diff(x), np.diff(y))
    if count > 1:
        step = np.where(step < STANDSTILL_MPS * (t_s[1] - t_s[0]), 0.0, step)
    distance = np.concatenate([[0.0], np.cumsum(step)])
    dx, dy = trajectory.origin_m[0] - origin_m[0], trajectory.origin_m[1] - origin_m[1]
    return np.stack([t_s, x + dx, y + dy, trajectory.heights(t_s), yaw, speed, distance], axis=1)


def _distance_table(table: Array) -> Array:
    """Return rows (K, 5) every `SPACING_M` of a path: x, y, direction of travel as cos, sin, and time."""
    t_s, x, y, _, yaw, speed, distance = table.T
    whole = np.arange(int(distance[-1] / SPACING_M) + 1) * SPACING_M
    moved = np.concatenate([[True], np.diff(distance) > 0])
    x, y, t = (np.interp(whole, distance[moved], c[moved]) for c in (x, y, t_s))
    if len(whole) > 1:
        dx, dy = np.gradient(x), np.gradient(y)
        length = np.hypot(dx, dy)
        cos = np.divide(dx, length, out=np.ones_like(dx), where=length > 0)
        sin = np.divide(dy, length, out=np.zeros_like(dy), where=length > 0)
    else:
        heading = yaw[0] if speed.sum() >= 0 else yaw[0] + np.pi
        cos, sin = np.array([np.cos(heading)]), np.array([np.sin(heading)])
    on = np.arange(1, int(EXTENSION_M / SPACING_M) + 1) * SPACING_M
    ends = x[-1] + on * cos[-1], y[-1] + on * sin[-1], *(np.full(len(on), v) for v in (cos[-1], sin[-1], np.nan))
    return np.concatenate([np.stack([x, y, cos, sin, t], axis=1), np.stack(ends, axis=1)])


# Times (H,) ahead at which others are predicted: a car that crosses at 20 m/s moves by its length in between.
HORIZON_S = np.arange(0.0, 3.01, 0.25)


class Prediction(NamedTuple):
    """Boxes of agents (P,) at the times of the horizon (H,), relative to the origin of the path table; all (P, H)."""

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array


class SweptCorridor(NamedTuple):
    """The corridors that agents (P,) will sweep."""

    agent: NDArray[np.intp]  # (P,) whose path
    distance_m: Array  # (P,) present distance along it
    length_m: Array  # (P,)
    width_m: Array  # (P,)
    pace_mps: Array  # (P,)
    progress_m: Array  # (P, H) how far they intend to go from here until the times of the horizon
    reach_m: float  # look-ahead distance


class SafetyMargins(NamedTuple):
    """Margins that are kept to other agents."""

    side_m: float  # on both sides of the corridor
    crossing_m: float  # before a crossing agent, as a distance
    crossing_s: float  # and as a time
    behind_m: float  # how far behind the agent's progress another center still counts as ahead


class Leaders(NamedTuple):
    """What agents (P,) have to keep clear of."""

    gap_m: Array  # (P,) from the front bumper; inf without a leader
    speed_mps: Array  # (P,) of the leader, along the path
    ahead_s: Array  # (P,) when it is in the corridor; 0 if it is now
    own_t_s: Array  # (P,) the scenario's time of the agent at that place


def leaders(
    paths: PathTable, corridor: SweptCorridor, boxes: Prediction, size_m: Array, margins: SafetyMargins
) -> Leaders:
    """Find for each pair what the agent has to keep clear of in the other's box, of `size_m` (P, 3), now or within the horizon.

    A box that is in the corridor and will stay there is followed. A crossing box counts if the agent, at its intended
    progress, comes near it while it is in the corridor. Boxes whose center is behind that of the agent never count. For a
    box that moves along the path while it enters, the gap is reduced by its motion until then, so a cut-in is a leader.
    Cost: P H reach / 4 distances.
    """
    c = corridor
    foot = paths.foot(c.agent, c.distance_m, c.reach_m, boxes.x_m, boxes.y_m)
    cos, sin = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
    turn_cos, turn_sin = cos * foot.cos + sin * foot.sin, sin * foot.cos - cos * foot.sin
    half_length, half_width = size_m[:, :1] / 2, size_m[:, 1:2] / 2
    within = c.width_m[:, None] / 2 + margins.side_m
    center = foot.distance_m + foot.ahead_m - c.distance_m[:, None]
    inside = np.abs(foot.left_m) < within + half_length * np.abs(turn_sin) + half_width * np.abs(turn_cos)
    ahead = center > c.progress_m - margins.behind_m
    # A box that is once behind within the corridor approaches from behind: the other driver is responsible.
    inside &= ahead & ~np.logical_or.accumulate(inside & ~ahead, axis=1)
    gap = center + _nearest_edge(foot.left_m, turn_cos, turn_sin, half_length, half_width, within)
    gap -= c.length_m[:, None] / 2

    stays = inside[:, 0] & inside[:, -1]
    met = inside & (gap <= c.progress_m + margins.crossing_m + margins.crossing_s * c.pace_mps[:, None])
    first = np.where(stays, 0, np.argmax(met, axis=1))
    row = np.arange(len(first))
    ahead_s, speed = HORIZON_S[first], (boxes.speed_mps * turn_cos)[row, first]
    now = gap[row, first] - np.maximum(speed, 0.0) * ahead_s
    gap_m, own_t_s = np.where(stays | met.any(axis=1), now, np.inf), foot.t_s[row, first]
    return Leaders(gap_m, speed, ahead_s, np.where(np.isnan(own_t_s), np.inf, own_t_s))


def _nearest_edge(left: Array, cos: Array, sin: Array, half_length: Array, half_width: Array, within: Array) -> Array:
    """Return how far ahead of their center (so negative) rectangles begin within the corridor |y| < `within`, in m.

    `left` is the lateral position of the center, `cos`, `sin` the relative heading. The rearmost corner counts if it is
    inside, else the point where the edge that leads inward from there enters.
    """
    forward, upward = np.where(cos >= 0, 1.0, -1.0), np.where(sin >= 0, 1.0, -1.0)
    corner_x = -(np.abs(cos) * half_length + np.abs(sin) * half_width)
    corner_y = left - forward * sin * half_length + upward * cos * half_width
    beside = np.maximum(np.abs(corner_y) - within, 0.0)
    # Two edges meet in the corner: the long side leads to the left where forward and upward agree, the short one to the right.
    long_side = (forward == upward) == (corner_y < 0)
    across = np.where(long_side, np.abs(sin), np.abs(cos))
    ahead = np.where(long_side, np.abs(cos), np.abs(sin))
    slope = np.divide(ahead, across, out=np.zeros_like(across), where=(across > 0) & (beside > 0))
    return np.asarray(corner_x + beside * slope)


# A driven agent this near to its path in the scenario, and pointing along it, is expected to stay on it.
ON_PATH_M, ON_PATH_COS = 1.5, 0.9
