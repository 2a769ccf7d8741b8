"""A sample of a cloud's rays for tests of free space, ground included."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Rays
from log2sim.geometry import NS_PER_S
from log2sim.perception.lidar.azimuth_index import STEP_RAD, STEPS_PER_TURN
from log2sim.perception.lidar.cloud import MAX_OBSTACLE_HEIGHT_M, Cloud, CloudSensor

# One ray is kept of each cell of directions. At 50 m cells are 0.4 m wide: the side of a car has twenty.
CELL_RAD = np.deg2rad(0.5)
CELL_STEPS = round(CELL_RAD / STEP_RAD)
COLUMNS = STEPS_PER_TURN // CELL_STEPS + 1
# Cells from straight down to straight up, more than there are.
CELLS_PER_COLUMN = 1024
MAX_REACH_M = 70.0


def sample_rays(cloud: Cloud) -> Rays:
    """Take a ray of every cell of directions and every sensor of those that end within reach and below what hangs over the road.

    Notes
    -----
    Cells of directions, unlike voxels, keep the same share of the rays that hit something near and of those that pass it.
    Directions are those from the middle of the sensors of a viewpoint, which does for a sample.
    """
    if cloud.parts:
        return _join([sample_rays(part) for part in cloud.parts], cloud)
    index = cloud.azimuth_index
    point = np.flatnonzero((index.range_m[index.rank] < MAX_REACH_M) & (cloud.height < MAX_OBSTACLE_HEIGHT_M))
    row = index.rank[point]
    # The slope of a ray differs from its angle where it is steep: near the sensor, where rays are many.
    slope = np.clip(index.slope[row] / np.float32(CELL_RAD), -CELLS_PER_COLUMN // 2, CELLS_PER_COLUMN // 2 - 1)
    column = _sensor_of(cloud, point) * COLUMNS + index.azimuth[row] // CELL_STEPS
    cell = column * CELLS_PER_COLUMN + np.floor(slope).astype(np.int64) + CELLS_PER_COLUMN // 2
    # Written from the last to the first point, a cell holds its first one; cells without points are not read.
    first = np.empty(max(len(cloud.sensors), 1) * COLUMNS * CELLS_PER_COLUMN, dtype=np.int32)
    first[cell[::-1]] = point[::-1]
    kept = point[first[cell] == point]
    sensors = cloud.sensors or (CloudSensor(len(cloud.xyz), cloud.sensor.astype(np.float64), np.zeros(3)),)
    return Rays(
        cloud.xyz[kept],
        cloud.t_s[kept],
        _sensor_of(cloud, kept).astype(np.uint8),
        np.array([s.position for s in sensors], dtype=np.float32),
        np.array([s.velocity_mps for s in sensors], dtype=np.float32),
    )


def _join(parts: Sequence[Rays], cloud: Cloud) -> Rays:
    """Join the rays of the parts of a cloud; their sensors are numbered on."""
    before = np.cumsum([0, *(len(part.position) for part in parts)])
    late_s = [(part.stamp_ns - cloud.stamp_ns) / NS_PER_S for part in cloud.parts]
    return Rays(
        np.concatenate([part.end for part in parts]),
        np.concatenate([part.t_s + np.float32(late) for part, late in zip(parts, late_s)]),
        np.concatenate([part.sensor + np.uint8(first) for part, first in zip(parts, before)]),
        np.concatenate([part.position - np.float32(late) * part.velocity_mps for part, late in zip(parts, late_s)]),
        np.concatenate([part.velocity_mps for part in parts]),
    )


def _sensor_of(cloud: Cloud, point: NDArray[np.intp]) -> NDArray[np.int64]:
    """Return the number (n,) of the sensor that measured each point."""
    if len(cloud.sensors) < 2:
        return np.zeros(len(point), dtype=np.int64)
    return np.repeat(np.arange(len(cloud.sensors)), [sensor.points for sensor in cloud.sensors])[point]
