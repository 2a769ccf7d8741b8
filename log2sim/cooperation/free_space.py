"""Where the vehicle's LiDAR saw through a place, nothing stands there, whatever a roadside unit says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.cooperation.structure import VehicleView
from log2sim.geometry import Array

# Bins of directions as wide as the gaps between the lines of LiDARs with few of them.
BIN_RAD = np.radians(2.0)
COLUMNS = round(2 * np.pi / BIN_RAD)
ROWS = round(np.pi / BIN_RAD)
# Ranges within this agree, with an error of the pose that is left and what is seen of a thing from another side.
AGREE_M = 1.0
MAX_SWEEPS, MAX_POINTS = 6, 3000
MIN_RANGE_M = 3.0


@dataclass(frozen=True)
class Visibility:
    """What the vehicle saw where a roadside unit sees upright things.

    Attributes
    ----------
    seen, seen_through : int
        Points with a return there, and with returns from behind alone.
    """

    seen: int
    seen_through: int

    @property
    def contradicting(self) -> float:
        """Share of points that the vehicle saw through."""
        looked_at = self.seen + self.seen_through
        return self.seen_through / looked_at if looked_at else 0.0


def look_through(view: VehicleView, upright_m: Array) -> Visibility:
    """Compare upright things of a unit, points (N, 3), m, with the ranges of the vehicle's sweeps."""
    upright = upright_m[:: max(len(upright_m) // MAX_POINTS, 1)]
    if len(upright) == 0:
        return Visibility(0, 0)
    seen = np.isfinite(cKDTree(view.xyz_m).query(upright, distance_upper_bound=AGREE_M)[0])
    through = np.zeros(len(upright), bool)
    chosen = np.unique(np.linspace(0, len(view.sensor_m) - 1, MAX_SWEEPS).round().astype(np.int64))
    for row in chosen.tolist():
        sensor = view.sensor_m[row]
        nearest = _nearest(view.xyz_m[view.sweep == row] - sensor)
        place, range_m = _bins(upright - sensor)
        through |= np.isfinite(nearest[place]) & (range_m > MIN_RANGE_M) & (nearest[place] > range_m + AGREE_M)
    return Visibility(int(seen.sum()), int((through & ~seen).sum()))


def _bins(off: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the bin (N,) of the directions of offsets (N, 3) and their lengths (N,)."""
    range_m = np.linalg.norm(off, axis=1)
    azimuth = np.arctan2(off[:, 1], off[:, 0])
    elevation = np.arcsin(np.clip(off[:, 2] / np.maximum(range_m, 1e-6), -1.0, 1.0))
    column = np.floor((azimuth + np.pi) / BIN_RAD).astype(np.int64) % COLUMNS
    row = np.clip(np.floor((elevation + np.pi / 2) / BIN_RAD).astype(np.int64), 0, ROWS - 1)
    return row * COLUMNS + column, range_m


def _nearest(off: Array) -> Array:
    """Return the nearest range of each bin and those beside it, infinite where there is none."""
    place, range_m = _bins(off)
    nearest = np.full(ROWS * COLUMNS, np.inf)
    np.minimum.at(nearest, place, range_m)
    grid = nearest.reshape(ROWS, COLUMNS)
    wide = np.minimum(np.minimum(grid, np.roll(grid, 1, axis=1)), np.roll(grid, -1, axis=1))
    out = wide.copy()
    out[1:] = np.minimum(out[1:], wide[:-1])
    out[:-1] = np.minimum(out[:-1], wide[1:])
    return out.ravel()
