"""LiDAR points above the ground of one tick, kept for tracking and free-space tests."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.deferred import Deferred
from log2sim.datatypes.rays import Rays
from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Points above the ground at one tick, one a voxel; points and rays may be given as functions that read them.

    Attributes
    ----------
    stamp_ns : int
    origin : (3,) float64
        m, map frame.
    xyz : (N, 3) float32
        m, map axes, relative to `origin`.
    t_s : (N,) float32
        Times relative to `stamp_ns`.
    sensor : (3,) float32
        Position of the sensor relative to `origin`, mean over several; of viewpoints far from each other the first.
    free : Rays, optional
        A sample of all rays, those that end on the ground too: where they passed is nothing.
    viewpoints : (V, 3) float32, optional
        Positions of LiDARs far from each other relative to `origin`; None where all points are seen from `sensor`.
    seen_from : (N,) uint8, optional
        The viewpoint of each point.
    """

    stamp_ns: int
    origin: Array
    xyz: Deferred[NDArray[np.float32]] = Deferred()  # a descriptor
    t_s: Deferred[NDArray[np.float32]] = Deferred()  # a descriptor
    sensor: NDArray[np.float32]  # type: ignore[misc]  # those before it are descriptors, they have no default
    free: Deferred[Rays | None] = Deferred(None)  # a descriptor
    viewpoints: NDArray[np.float32] | None = None
    seen_from: Deferred[NDArray[np.uint8] | None] = Deferred(None)  # a descriptor

    def sensor_of(self, index: NDArray[np.intp]) -> NDArray[np.float32]:
        """Return the position (3,) of the sensor that sees most of the points at `index`."""
        if self.viewpoints is None or self.seen_from is None or not len(index):
            return self.sensor
        return np.asarray(self.viewpoints[np.bincount(self.seen_from[index]).argmax()])

    @cached_property
    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Azimuth (N,) rad in the map frame, horizontal distance (N,) m and slope (N,) of every point from the sensor."""
        x, y, z = (self.xyz - self.sensor).T
        reach = np.hypot(x, y)
        return np.arctan2(y, x), reach, z / np.maximum(reach, np.float32(1e-3))

    def near(self, xy: Array, reach_m: float) -> NDArray[np.intp]:
        """Return the indices (n,), rising, of the points in the square of `reach_m` to all four sides of a place (2,), map frame."""
        x, y = (xy - self.origin[:2]).astype(np.float32)
        near = np.flatnonzero(np.abs(self._x - x) <= reach_m)
        return np.asarray(near[np.abs(self.xyz[near, 1] - y) <= reach_m], dtype=np.intp)

    @cached_property
    def _x(self) -> NDArray[np.float32]:
        """The x of all points (N,) side by side, which many places are compared with."""
        return np.ascontiguousarray(self.xyz[:, 0])
