"""Tracking by LiDAR alone at ticks without a detection: a box of known size is matched against the points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Obstacles
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.box_completion import SENSOR_SIGMA_M, complete_box, facing_ends, oriented_covariance
from log2sim.perception.box_fitting import align_to, quantile_of_sorted, rotate
from log2sim.perception.prefetch import OBSTACLE_REACH_M

MIN_POINTS = 8
# Points up to this far outside the predicted box count as its own; a shell of this width around them is compared with it.
MARGIN_M = 0.5
SHELL_M = 0.5
# With more points in the shell, relative to those in the box, the box is a part of a larger structure.
MAX_SHELL_RATIO = 0.6
# Largest distance of a match from its prediction.
MAX_SHIFT_M = 0.8
MAX_MISSES = 2
# A match is rejected when a larger share of the box's length or width is unobserved: its position along that axis is
# undetermined.
MAX_HIDDEN_SHARE = 0.7
# Gains of the constant-velocity filter.
POSITION_GAIN, VELOCITY_GAIN, YAW_GAIN = 0.6, 0.15, 0.3
# Slower objects keep their yaw.
MIN_COURSE_SPEED_MPS = 2.0


@dataclass(frozen=True, eq=False)
class LidarMatch:
    """A tracked box found in the LiDAR points of a tick.

    Attributes
    ----------
    tick : int
    t_ns : int
        Mean time of its points.
    xy_m : (2,) float64
        Center, map frame.
    covariance : (2, 2) float64
        Of the center, m2.
    points : int
    """

    tick: int
    t_ns: int
    xy_m: Array
    covariance: Array
    points: int


@dataclass(frozen=True, eq=False)
class BoxState:
    """A box of known size and its motion at one time, in the map frame.

    Attributes
    ----------
    t_ns : int
    xy_m : (2,) float64
        Center.
    velocity_mps : (2,) float64
        Zero for a static box, which is expected at the same position at every tick.
    yaw_rad : float
    size_m : (3,) float64
        Length, width, height.
    bottom_m : float
        Height of its bottom face.
    """

    t_ns: int
    xy_m: Array
    velocity_mps: Array
    yaw_rad: float
    size_m: Array
    bottom_m: float


def track_with_lidar(
    obstacles: Sequence[Obstacles | None], ticks: Sequence[int], t_ns: NDArray[np.int64], start: BoxState
) -> list[LidarMatch]:
    """Match a box at the given ticks, one after the other, from a known state.

    A moving box is predicted with constant velocity, corrected at every match, and lost after `MAX_MISSES` ticks without a
    match in a row.

    Parameters
    ----------
    obstacles : T clouds, None at ticks without LiDAR
    ticks : sequence of int
        Forward or backward in time from the state.
    t_ns : (T,) int64
        Stamps of all ticks.
    start : BoxState
    """
    matches: list[LidarMatch] = []
    state, misses, is_static = start, 0, not start.velocity_mps.any()
    for tick in ticks:
        cloud = obstacles[tick]
        predicted = state.xy_m + state.velocity_mps * ((int(t_ns[tick]) - state.t_ns) / NS_PER_S)
        reached = cloud is not None and float(np.hypot(*(predicted - cloud.origin[:2]))) <= reach_of(state.size_m)
        match = match_box(cloud, tick, replace(state, xy_m=predicted)) if cloud is not None and reached else None
        if match is None:
            misses += 1
            if misses >= MAX_MISSES and not is_static:
                break
            continue
        misses = 0
        matches.append(match)
        if not is_static:
            state = _corrected(state, match)
    return matches


def match_standing(
    obstacles: Sequence[Obstacles | None], boxes: Sequence[BoxState], known: Sequence[NDArray[np.int64]]
) -> list[list[LidarMatch]]:
    """Match boxes that stand at all ticks but those at which each is `known`; returns the matches of each.

    Every cloud is looked at once, and only for the boxes that its points reach: a long log has many of both.
    """
    matches: list[list[LidarMatch]] = [[] for _ in boxes]
    if not boxes:
        return matches
    place = np.array([box.xy_m for box in boxes])
    reach = np.array([reach_of(box.size_m) for box in boxes])
    measured = [set(ticks.tolist()) for ticks in known]
    for tick, cloud in enumerate(obstacles):
        if cloud is None:
            continue
        for k in np.flatnonzero(np.hypot(*(place - cloud.origin[:2]).T) <= reach).tolist():
            match = None if tick in measured[k] else match_box(cloud, tick, boxes[k])
            if match is not None:
                matches[k].append(match)
    return matches


def reach_of(size_m: Array) -> float:
    """Return how far from the origin of a cloud, m, a box may be to have points of it near."""
    return OBSTACLE_REACH_M + _reach_around(size_m)


def _reach_around(size_m: Array) -> float:
    """Return how far from the center of a box, m, points are looked at."""
    return float(np.hypot(*size_m[:2])) / 2 + MARGIN_M + SHELL_M


def _corrected(state: BoxState, match: LidarMatch) -> BoxState:
    """Return the state at the time of a match, corrected toward it."""
    dt_s = (match.t_ns - state.t_ns) / NS_PER_S
    expected = state.xy_m + state.velocity_mps * dt_s
    innovation = match.xy_m - expected
    velocity, yaw_rad = state.velocity_mps, state.yaw_rad
    if abs(dt_s) > 1e-3:
        velocity = velocity + VELOCITY_GAIN * innovation / dt_s
        yaw_rad = _turned(yaw_rad, velocity)
    position = expected + POSITION_GAIN * innovation
    return replace(state, t_ns=match.t_ns, xy_m=position, velocity_mps=velocity, yaw_rad=yaw_rad)


def match_box(cloud: Obstacles, tick: int, box: BoxState) -> LidarMatch | None:
    """Match a predicted box against the points of a tick; None where they do not determine its position."""
    size, yaw_rad = box.size_m, box.yaw_rad
    x, y = (box.xy_m - cloud.origin[:2]).astype(np.float32)
    near = cloud.near(box.xy_m, _reach_around(size))
    z = cloud.xyz[near, 2] + np.float32(cloud.origin[2] - box.bottom_m)
    near = near[(z > 0.15) & (z < size[2] + 0.4)]
    if len(near) < MIN_POINTS:
        return None
    local = rotate((cloud.xyz[near, :2] - np.array([x, y])).astype(np.float64), -yaw_rad)
    outside_m = (np.abs(local) - size[:2] / 2).max(axis=1)
    inside = outside_m <= MARGIN_M
    if inside.sum() < MIN_POINTS or (outside_m > MARGIN_M).sum() > MAX_SHELL_RATIO * inside.sum():
        return None
    ordered = np.sort(local[inside], axis=0)
    low, high = quantile_of_sorted(ordered, 0.01), quantile_of_sorted(ordered, 0.99)
    if np.any(high - low > size[:2] + 0.6):
        return None
    sensor = rotate(cloud.sensor_of(near[inside])[:2].astype(np.float64) + cloud.origin[:2] - box.xy_m, -yaw_rad)
    center, sigma = complete_box(low, high, size[:2], facing_ends(low, high, sensor))
    hidden = size[:2] - (high - low)
    if np.hypot(*center) > MAX_SHIFT_M or np.any(hidden > MAX_HIDDEN_SHARE * np.maximum(size[:2], 1.0)):
        return None
    mean_s = float(cloud.t_s[near[inside]].mean())
    return LidarMatch(
        tick,
        cloud.stamp_ns + round(mean_s * NS_PER_S),
        rotate(center, yaw_rad) + box.xy_m,
        oriented_covariance(np.hypot(sigma, 2 * SENSOR_SIGMA_M), yaw_rad),
        int(inside.sum()),
    )


def _turned(yaw_rad: float, velocity: Array) -> float:
    """Turn a yaw toward the course of a velocity (2,), up to half turns, if it is fast enough."""
    speed = float(np.hypot(*velocity))
    if speed < MIN_COURSE_SPEED_MPS:
        return yaw_rad
    course = align_to(float(np.arctan2(velocity[1], velocity[0])), yaw_rad, np.pi)
    return yaw_rad + YAW_GAIN * float(np.arctan2(np.sin(course - yaw_rad), np.cos(course - yaw_rad)))
