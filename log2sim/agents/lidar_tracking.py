"""Following a track where no camera detects it: the LiDAR alone shows that it is still there, and where."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Obstacles
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception import box_fitting

MIN_POINTS = 8
MARGIN_M = 0.5
SHELL_M = 0.5
# More points right around the box than this share of those in it: the box sits on something larger.
MAX_SHELL_RATIO = 0.6
MAX_SHIFT_M = 0.8
MAX_MISSES = 2
# A box of which less than the rest of this share shows could be anywhere along it.
MAX_HIDDEN_SHARE = 0.7


@dataclass(frozen=True, eq=False)
class LidarMatch:
    """Where the LiDAR found a tracked box at a tick: `xy_m` (2,), its covariance (2, 2) and the time it was seen."""

    tick: int
    t_ns: int
    xy_m: Array
    covariance: Array
    points: int


def track_with_lidar(
    obstacles: Sequence[Obstacles | None],
    ticks: Sequence[int],
    t_ns: NDArray[np.int64],
    *,
    start_ns: int,
    xy_m: Array,
    velocity_mps: Array,
    yaw_rad: float,
    size_m: Array,
    bottom_m: float,
) -> list[LidarMatch]:
    """Look for a box at the ticks given, one after the other, from a known state at `start_ns`.

    The box moves with constant velocity, corrected at every sighting; the search ends after two ticks without one.
    """
    found: list[LidarMatch] = []
    position, velocity, last_ns, misses = np.array(xy_m, float), np.array(velocity_mps, float), start_ns, 0
    standing = not velocity.any()
    for tick in ticks:
        cloud = obstacles[tick]
        predicted = position + velocity * ((int(t_ns[tick]) - last_ns) / NS_PER_S)
        sighting = None if cloud is None else match_box(cloud, tick, predicted, yaw_rad, size_m, bottom_m)
        if sighting is None:
            misses += 1
            if misses >= MAX_MISSES and not standing:
                break
            continue
        misses = 0
        found.append(sighting)
        if standing:
            continue
        dt = (sighting.t_ns - last_ns) / NS_PER_S
        expected = position + velocity * dt
        correction = sighting.xy_m - expected
        if abs(dt) > 1e-3:
            velocity = velocity + 0.15 * correction / dt
            yaw_rad = _turned(yaw_rad, velocity)
        position, last_ns = expected + 0.6 * correction, sighting.t_ns
    return found


def match_box(
    cloud: Obstacles, tick: int, xy_m: Array, yaw_rad: float, size_m: Array, bottom_m: float
) -> LidarMatch | None:
    """Find a box of known size and yaw near a predicted center (2,); None where the points do not show it."""
    reach = float(np.hypot(*size_m[:2])) / 2 + MARGIN_M + SHELL_M
    x, y = (xy_m - cloud.origin[:2]).astype(np.float32)
    near = np.flatnonzero(np.abs(cloud.xyz[:, 0] - x) <= reach)
    near = near[np.abs(cloud.xyz[near, 1] - y) <= reach]
    z = cloud.xyz[near, 2] + np.float32(cloud.origin[2] - bottom_m)
    near = near[(z > 0.15) & (z < size_m[2] + 0.4)]
    if len(near) < MIN_POINTS:
        return None
    turned = box_fitting.rotate((cloud.xyz[near, :2] - np.array([x, y])).astype(np.float64), -yaw_rad)
    half = size_m[:2] / 2
    excess = (np.abs(turned) - half).max(axis=1)
    inside = excess <= MARGIN_M
    if inside.sum() < MIN_POINTS or (excess > MARGIN_M).sum() > MAX_SHELL_RATIO * inside.sum():
        return None
    low, high = np.quantile(turned[inside], 0.01, axis=0), np.quantile(turned[inside], 0.99, axis=0)
    if np.any(high - low > size_m[:2] + 0.6):
        return None
    sensor = box_fitting.rotate(cloud.sensor[:2].astype(np.float64) + cloud.origin[:2] - xy_m, -yaw_rad)
    center, sigma = box_fitting.complete_box(low, high, size_m[:2], sensor)
    slack = size_m[:2] - (high - low)
    if np.hypot(*center) > MAX_SHIFT_M or np.any(slack > MAX_HIDDEN_SHARE * np.maximum(size_m[:2], 1.0)):
        return None
    seen_s = float(cloud.t_s[near[inside]].mean())
    return LidarMatch(
        tick,
        cloud.stamp_ns + round(seen_s * NS_PER_S),
        box_fitting.rotate(center, yaw_rad) + xy_m,
        box_fitting.oriented_covariance(np.hypot(sigma, 2 * box_fitting.SENSOR_SIGMA_M), yaw_rad),
        int(inside.sum()),
    )


def _turned(yaw_rad: float, velocity: Array) -> float:
    """The yaw, drawn toward the course of what moves fast enough to have one."""
    speed = float(np.hypot(*velocity))
    if speed < 2.0:
        return yaw_rad
    course = box_fitting.align_to(float(np.arctan2(velocity[1], velocity[0])), yaw_rad, np.pi)
    return yaw_rad + 0.3 * float(np.arctan2(np.sin(course - yaw_rad), np.cos(course - yaw_rad)))
