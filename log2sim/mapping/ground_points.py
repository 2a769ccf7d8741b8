"""Points of sweeps that lie on the ground, gathered over a log, and those above it that hide it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Sweep
from log2sim.geometry import Array
from log2sim.mapping.raster import Raster
from log2sim.perception.lidar.cloud import MAX_OBSTACLE_HEIGHT_M, cloud_origin, sweep_to_map
from log2sim.perception.lidar.ground import estimate_ground

# With 29 bytes each, 350 MB.
MAX_POINTS = 12_000_000
# Farther away rings are meters apart and points hit the road at less than 3 degrees.
REACH_M = 45.0
# Curbs and banks are within this of the smooth ground of a single sweep; so are tires, which lower points of other sweeps replace.
NEAR_GROUND_M = 0.4
# What is higher hides the ground behind it.
MIN_HIDING_HEIGHT_M = 0.3
# Points that fill what is below the lowest beam are this far apart.
FILL_STEP_M = 0.1
# Directions around the LiDAR of which each has a lowest return: as wide as neighboring points of a LiDAR are apart at most.
AZIMUTH_BINS = 720
# Points above the ground that are kept of a sweep: about one a degree in both directions.
MAX_HIDING_POINTS = 20_000
# Beams of LiDARs are at least 0.1 degrees apart; in between, the ego's pitch moves points of one beam from bin to bin.
ELEVATION_BIN_RAD = np.radians(0.2)
ELEVATION_BINS = 900


@dataclass(frozen=True, eq=False)
class GroundPoints:
    """Points near the ground, N of all sweeps.

    Attributes
    ----------
    xy : (N, 2) float32, m
        From the north-west corner of the raster: east, south.
    z : (N,) float32, m
        From the height of reference.
    range_m : (N,) float32, m
        From the sensor.
    intensity : (N,) float32
        NaN where unknown.
    beam : (N,) int16
        Number of the elevation from the sensor, from straight down in steps of `ELEVATION_BIN_RAD`.
    lidar : (N,) int8
        Number of the LiDAR.
    """

    xy: NDArray[np.float32]
    z: NDArray[np.float32]
    range_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    beam: NDArray[np.int16]
    lidar: NDArray[np.int8]


@dataclass(frozen=True, eq=False)
class PreparedSweep:
    """What is taken of one sweep.

    Attributes
    ----------
    stamp_ns : int
    hiding : (H, 3) float64
        Points above the ground, m, map frame.
    columns : tuple of arrays
        Those of `GroundPoints`.
    """

    stamp_ns: int
    hiding: Array
    columns: tuple[NDArray[np.generic], ...]


class PointCollector:
    """Gather the points near the ground of chosen sweeps.

    Parameters
    ----------
    log : Log
    raster : Raster
        Points outside of it are dropped.
    sweeps : int
        How many will come, which says how many points of each are kept.
    z0_m : float
        Height of reference, m, map frame.

    Attributes
    ----------
    hiding : dict of int to (H, 3) float64
        Points above the ground, m, map frame, by stamp of the sweep.
    """

    def __init__(self, log: Log, raster: Raster, sweeps: int, z0_m: float) -> None:
        self._log, self._raster, self._z0_m = log, raster, z0_m
        self._most = MAX_POINTS // max(sweeps, 1)
        self._lidars = list(log.lidars)
        self._parts: list[tuple[NDArray[np.generic], ...]] = []
        self.hiding: dict[int, Array] = {}

    def add(self, lidar: str, sweep: Sweep, hidden: NDArray[np.uint8]) -> None:
        """Take a sweep; points in cells of the raster at which `hidden` (R, C) is not 0 are left out."""
        self.take(self.prepare(lidar, sweep, hidden))

    def take(self, prepared: PreparedSweep | None) -> None:
        """Take what `prepare` made of a sweep."""
        if prepared is not None:
            before = self.hiding.get(prepared.stamp_ns, np.zeros((0, 3)))
            self.hiding[prepared.stamp_ns] = np.concatenate([before, prepared.hiding])
            self._parts.append(prepared.columns)

    def prepare(self, lidar: str, sweep: Sweep, hidden: NDArray[np.uint8]) -> PreparedSweep | None:
        """Find the points of a sweep as for `add`, for `take`; several threads may do so at once. None where no pose is known."""
        mapped = sweep_to_map(self._log, lidar, sweep, compensate=True)
        if mapped is None or not len(mapped[0]):
            return None
        xyz, t_s = mapped
        middle_ns = sweep.stamp_ns + round(float(t_s.mean(dtype=np.float64)) * 1e9)
        map_T_lidar, known = self._log.map_T_sensor(lidar, middle_ns)
        sensor = map_T_lidar[0, :3, 3] if known[0] else np.asarray(xyz.mean(axis=0))
        origin = np.array([sensor[0], sensor[1], cloud_origin(self._log, sweep.stamp_ns)[1]])
        local = (xyz - origin).astype(np.float32)
        ground = estimate_ground(local, np.zeros(2), 0.0)
        within = np.flatnonzero(np.hypot(local[:, 0], local[:, 1]) < REACH_M)
        unseen = _lowest(xyz[within] - sensor)
        local = local[within]
        height = local[:, 2] - ground.at(local[:, :2])
        above = within[(height > MIN_HIDING_HEIGHT_M) & (height < MAX_OBSTACLE_HEIGHT_M)]
        above = above[:: max(len(above) // MAX_HIDING_POINTS, 1)]
        standing = unseen & (height > MIN_HIDING_HEIGHT_M) & (height < MAX_OBSTACLE_HEIGHT_M)
        hiding = np.concatenate([xyz[above], _down_to_ground(xyz[within[standing]], height[standing])])
        near = within[np.abs(height) < NEAR_GROUND_M]
        near = near[:: -(-len(near) // self._most)] if len(near) > self._most else near
        cell, inside = self._raster.index_of(xyz[near, :2])
        near = near[inside & (hidden.ravel()[cell] == 0)]
        away = (xyz[near] - sensor) @ (map_T_lidar[0, :3, :3] if known[0] else np.eye(3))
        range_m = np.linalg.norm(away, axis=1)
        usable = range_m > 0
        beam = (np.arcsin(np.clip(away[usable, 2] / range_m[usable], -1, 1)) + np.pi / 2) / ELEVATION_BIN_RAD
        near, x0, y1 = near[usable], self._raster.extent_m[0], self._raster.extent_m[3]
        unknown = np.full(len(near), np.nan, np.float32)
        columns = (
            np.stack([xyz[near, 0] - x0, y1 - xyz[near, 1]], axis=1).astype(np.float32),
            (xyz[near, 2] - self._z0_m).astype(np.float32),
            range_m[usable].astype(np.float32),
            unknown if sweep.intensity is None else sweep.intensity[near],
            np.minimum(beam, ELEVATION_BINS - 1).astype(np.int16),
            np.full(len(near), self._lidars.index(lidar), np.int8),
        )  # fmt: skip
        return PreparedSweep(sweep.stamp_ns, hiding, columns)

    def points(self) -> GroundPoints:
        """Join what was gathered."""
        empty = (
            np.zeros((0, 2), np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32), np.zeros(0, np.float32),
            np.zeros(0, np.int16), np.zeros(0, np.int8),
        )  # fmt: skip
        parts, self._parts = [empty, *self._parts], []
        return GroundPoints(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _lowest(away: Array) -> NDArray[np.bool_]:
    """Mark the lowest return of each direction around a LiDAR, of points (N, 3), m, from it: none shows what is below it."""
    level = np.hypot(away[:, 0], away[:, 1])
    slope = np.divide(away[:, 2], level, out=np.full(len(away), np.inf), where=level > 0)
    turn = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5
    direction = np.minimum((turn * AZIMUTH_BINS).astype(np.int64), AZIMUTH_BINS - 1)
    least = np.full(AZIMUTH_BINS, np.inf)
    np.minimum.at(least, direction, slope)
    return np.asarray((slope <= least[direction]) & np.isfinite(slope))


def _down_to_ground(xyz: Array, height_m: NDArray[np.float32]) -> Array:
    """Return points (F, 3) every `FILL_STEP_M` between points (N, 3), m, and the ground that far below them."""
    count = np.ceil(height_m / FILL_STEP_M).astype(np.int64)
    below = np.repeat(xyz, count, axis=0)
    first = np.repeat(np.cumsum(count) - count, count)
    below[:, 2] -= FILL_STEP_M * (np.arange(len(below)) - first + 1)
    return np.asarray(below, dtype=np.float64)
