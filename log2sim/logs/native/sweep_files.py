"""Sweeps of a native log folder, a file each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Sweep
from log2sim.geometry import Array
from log2sim.logs.sweeps import read_sweep


@dataclass(frozen=True, eq=False)
class SweepFiles:
    """Sweeps of one LiDAR.

    Attributes
    ----------
    files : list of Path
    t_ns : (F,) int64
        Absolute stamps.
    frame : {"lidar", "map"}
        Of the points.
    offset : (3,) float64, m
        What is taken off coordinates of the map.
    compensated_ns : (F,) int64 or None
        Stamps of compensation, as `log2sim.datatypes.Sweep` has them.
    """

    files: list[Path]
    t_ns: NDArray[np.int64]
    frame: Literal["lidar", "map"]
    offset: Array
    compensated_ns: NDArray[np.int64] | None

    def read(self, i: int) -> Sweep:
        """Read sweep `i`; points in the map frame are shifted by the map's offset."""
        sweep = read_sweep(self.files[i], int(self.t_ns[i]), self.frame)
        if self.compensated_ns is not None:
            return replace(sweep, compensated_ns=int(self.compensated_ns[i]))
        if self.frame == "map" and self.offset.any():
            return replace(sweep, xyz_m=sweep.xyz_m.astype(np.float64) - self.offset)
        return sweep
