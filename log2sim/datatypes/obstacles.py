"""Following a track where no camera detects it: the LiDAR alone shows that it is still there, and where."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array


@dataclass(frozen=True, eq=False)
class Obstacles:
    """Points above the ground at one tick: `xyz` (N, 3) float32 relative to `origin` (3,), their times `t_s` (N,) relative
    to `stamp_ns`, and `sensor` (3,) relative to `origin`.
    """

    stamp_ns: int
    origin: Array
    xyz: NDArray[np.float32]
    t_s: NDArray[np.float32]
    sensor: NDArray[np.float32]

    @cached_property
    def rays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
        """Azimuth (N,) rad in the map frame, distance over ground (N,) and slope (N,) of every point from the sensor."""
        x, y, z = (self.xyz - self.sensor).T
        reach = np.hypot(x, y)
        return np.arctan2(y, x), reach, z / np.maximum(reach, np.float32(1e-3))
