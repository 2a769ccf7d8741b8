"""Rays of the LiDARs of one tick: where they passed and where they ended."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, eq=False)
class Rays:
    """A sample of the rays of one tick that ended on the ground or on an obstacle, evenly spread over directions.

    Positions are in m, map axes, relative to the origin of the cloud.

    Attributes
    ----------
    end : (K, 3) float32
        The points that they hit.
    t_s : (K,) float32
        Times relative to the stamp of the cloud.
    sensor : (K,) uint8
        Number of the LiDAR.
    position : (S, 3) float32
        Of the LiDARs at the stamp of the cloud.
    velocity_mps : (S, 3) float32
        Of the LiDARs.
    """

    end: NDArray[np.float32]
    t_s: NDArray[np.float32]
    sensor: NDArray[np.uint8]
    position: NDArray[np.float32]
    velocity_mps: NDArray[np.float32]

    def __len__(self) -> int:
        """Return the number of rays."""
        return len(self.end)

    @property
    def start(self) -> NDArray[np.float32]:
        """Where their LiDARs were (K, 3) when they sent them."""
        return np.asarray(self.position[self.sensor] + self.velocity_mps[self.sensor] * self.t_s[:, None])
