"""Free space: the rays that pass through the place of an agent say that nothing is there.

Of the rays toward an agent, those that end before it say nothing, those that end in it support it, and those that go on
behind it contradict it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import Timeline
from log2sim.datatypes import Agent, Obstacles, Rays
from log2sim.geometry import NS_PER_S, Array

# The part of a box that is solid in every vehicle: above the wheels' gap, below the windows, as shares of its height; inside
# of its sides by the error of a box, at most by a share of its size.
LOWEST_SHARE, HIGHEST_SHARE = 0.25, 0.55
INSET_M, MAX_INSET_SHARE = 0.3, 0.25
# A ray that is to hit the solid part has to go through so much of it, at most this share of the width.
MIN_THROUGH_M, MAX_THROUGH_SHARE = 0.5, 0.4
# A ray that ends within this distance of the box is no evidence against it.
MARGIN_M = 0.3

# A cloud belongs to an agent's first and last tick though its stamp may lie outside of the agent's life.
MAX_LAG_S = 0.1
# Rays of a near agent are thousands; so many in its azimuths, of all heights, suffice for a share.
MAX_RAYS = 600


@dataclass(frozen=True, eq=False)
class RayCounts:
    """Rays toward the solid part of A agents at T ticks.

    Attributes
    ----------
    inside : (A, T) int64
        Those that end at the agent.
    through : (A, T) int64
        Those that go on behind it.
    before : (A, T) int64
        Those that end before it.
    """

    inside: NDArray[np.int64]
    through: NDArray[np.int64]
    before: NDArray[np.int64]


def count_rays(agents: Sequence[Agent], clouds: Sequence[Obstacles | None], timeline: Timeline) -> RayCounts:
    """Count the rays toward A agents in T clouds; 0 at ticks without a cloud or outside of an agent's life."""
    shape = (len(agents), len(clouds))
    counts = RayCounts(*(np.zeros(shape, dtype=np.int64) for _ in range(3)))
    boxes = _Boxes.of(agents, clouds, timeline)
    for tick, cloud in enumerate(clouds):
        if cloud is not None and cloud.free is not None and len(cloud.free) and boxes.present[:, tick].any():
            _count_at(tick, cloud, cloud.free, boxes, counts)
    return counts


@dataclass(frozen=True, eq=False)
class _Boxes:
    """Boxes of A agents at T ticks.

    Attributes
    ----------
    present : (A, T) bool
    center_m : (A, T, 3) float64
        At the stamp of the cloud.
    velocity_mps : (A, T, 2) float64
    yaw_rad : (A, T) float64
    size_m : (A, 3) float64
    """

    present: NDArray[np.bool_]
    center_m: Array
    velocity_mps: Array
    yaw_rad: Array
    size_m: Array

    @classmethod
    def of(cls, agents: Sequence[Agent], clouds: Sequence[Obstacles | None], timeline: Timeline) -> _Boxes:
        stamps = np.array([timeline.t_ns[k] if c is None else c.stamp_ns for k, c in enumerate(clouds)], dtype=np.int64)
        t_s = (stamps - timeline.t0_ns) / NS_PER_S
        at = [a.at(t_s, margin_s=MAX_LAG_S) for a in agents]
        speed = np.array([s.speed_mps for s in at])
        yaw = np.array([s.yaw_rad for s in at])
        return cls(
            present=np.array([s.valid for s in at]),
            center_m=np.stack([np.stack([s.x_m, s.y_m, s.z_m], axis=-1) for s in at]),
            velocity_mps=speed[..., None] * np.stack([np.cos(yaw), np.sin(yaw)], axis=-1),
            yaw_rad=yaw,
            size_m=np.array([a.size_m for a in agents]),
        )


def _count_at(tick: int, cloud: Obstacles, rays: Rays, boxes: _Boxes, counts: RayCounts) -> None:
    """Count the rays of one tick."""
    agent = np.flatnonzero(boxes.present[:, tick])
    center, velocity = boxes.center_m[agent, tick] - cloud.origin, boxes.velocity_mps[agent, tick]
    start = rays.start
    to = rays.end - start
    for sensor in range(len(rays.position)):
        own = np.flatnonzero(rays.sensor == sensor)
        view = _View.of(center - rays.position[sensor], velocity - rays.velocity_mps[sensor, :2], boxes.size_m[agent], rays.t_s)
        box, ray = _pairs(view, to[own])
        ray = own[ray]
        moved = start[ray] - center[box]
        moved[:, :2] -= velocity[box] * rays.t_s[ray, None]
        kind = classify_rays(moved, to[ray], boxes.yaw_rad[agent[box], tick], boxes.size_m[agent[box]])
        for k, column in enumerate((counts.inside, counts.through, counts.before)):
            column[:, tick] += np.bincount(agent[box[kind == k]], minlength=len(column))


@dataclass(frozen=True, eq=False)
class _View:
    """Directions from a sensor in which M boxes may be.

    Attributes
    ----------
    azimuth : (M, 2) float64
        First and last, the first in [-2 pi, pi).
    slope : (M, 2) float64
        Least and greatest height over distance of the solid part.
    """

    azimuth: Array
    slope: Array

    @classmethod
    def of(cls, to_center: Array, velocity_mps: Array, size_m: Array, t_s: Array) -> _View:
        """Bound the directions to boxes at (M, 3) from the sensor, moving by (M, 2) relative to it; none around the sensor itself."""
        distance = np.hypot(to_center[:, 0], to_center[:, 1])
        reach = np.hypot(size_m[:, 0], size_m[:, 1]) / 2 + np.hypot(*velocity_mps.T) * float(np.abs(t_s).max())
        outside = distance > reach
        half = np.where(outside, np.arcsin(np.minimum(reach / np.maximum(distance, reach), 1.0)), 0.0)
        middle = np.arctan2(to_center[:, 1], to_center[:, 0])
        z = to_center[:, 2:] + size_m[:, 2:] * (np.array([LOWEST_SHARE, HIGHEST_SHARE]) - 0.5)
        near = np.maximum(distance - reach, MIN_THROUGH_M)
        slope = np.stack([z / near[:, None], z / (distance + reach)[:, None]])
        return cls(np.stack([middle - half, middle + half], axis=1), np.stack([slope.min(axis=(0, 2)), slope.max(axis=(0, 2))], axis=1))


def _pairs(view: _View, to: Array) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair boxes with the rays (K, 3) that may meet them, at most `MAX_RAYS` in the azimuths of each: indices of both."""
    azimuth = np.arctan2(to[:, 1], to[:, 0])
    slope = to[:, 2] / np.hypot(to[:, 0], to[:, 1])
    order = np.argsort(azimuth)
    turns = np.concatenate([azimuth[order] - 2 * np.pi, azimuth[order], azimuth[order] + 2 * np.pi])
    first, last = np.searchsorted(turns, view.azimuth[:, 0]), np.searchsorted(turns, view.azimuth[:, 1])
    step = -(-(last - first) // MAX_RAYS)
    count = -(-(last - first) // np.maximum(step, 1))
    box = np.repeat(np.arange(len(count)), count)
    rank = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    ray = order[(first[box] + rank * step[box]) % len(order)]
    level = (slope[ray] >= view.slope[box, 0]) & (slope[ray] <= view.slope[box, 1])
    return box[level], ray[level]


def classify_rays(start: Array, to: Array, yaw_rad: Array, size_m: Array) -> NDArray[np.int64]:
    """Tell for each of n rays whether it ends in a box (0), goes on behind it (1), ends before it (2), or does not meet it (3).

    Parameters
    ----------
    start : (n, 3) float64, m
        Relative to the center of the box.
    to : (n, 3) float64, m
        From the start to the end.
    yaw_rad : (n,) float64
        Of the box.
    size_m : (n, 3) float64
    """
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    origin = np.stack([c * start[:, 0] + s * start[:, 1], c * start[:, 1] - s * start[:, 0], start[:, 2]], axis=1)
    step = np.stack([c * to[:, 0] + s * to[:, 1], c * to[:, 1] - s * to[:, 0], to[:, 2]], axis=1)
    inset = np.minimum(INSET_M, MAX_INSET_SHARE * size_m[:, :2])
    half = size_m[:, :2] / 2 - inset
    low = np.column_stack([-half, (LOWEST_SHARE - 0.5) * size_m[:, 2]])
    high = np.column_stack([half, (HIGHEST_SHARE - 0.5) * size_m[:, 2]])
    with np.errstate(divide="ignore", invalid="ignore"):
        a, b = (low - origin) / step, (high - origin) / step
    enter = np.fmax.reduce(np.minimum(a, b), axis=1)
    leave = np.fmin.reduce(np.maximum(a, b), axis=1)
    length = np.linalg.norm(step, axis=1)
    meets = (leave - enter) * length >= np.minimum(MIN_THROUGH_M, MAX_THROUGH_SHARE * size_m[:, 1])
    meets &= enter > 0
    kind = np.full(len(start), 3)
    kind[meets] = 0
    margin = MARGIN_M + inset.max(axis=1)
    kind[meets & ((1 - leave) * length > margin)] = 1
    kind[meets & ((enter - 1) * length > margin)] = 2
    return kind
