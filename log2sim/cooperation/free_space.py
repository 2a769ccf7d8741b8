"""Where the vehicle's LiDAR saw through a place, nothing stands there, whatever a roadside unit says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.cooperation.structure import VehicleView
from log2sim.geometry import Array

# Bins of directions as wide as the gaps between the lines of LiDARs with few of them.
BIN_RAD = np.radians(2.0)
COLUMNS = round(2 * np.pi / BIN_RAD)
ROWS = round(np.pi / BIN_RAD)
# Of upright things; on the ground, one place is like another.
MIN_HEIGHT_M, GROUND_CELL_M = 0.5, 2.0
# Ranges within this agree, with an error of the pose that is left and what is seen of a thing from another side.
AGREE_M = 1.0
MAX_SWEEPS = 6
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
        told = self.seen + self.seen_through
        return self.seen_through / told if told else 0.0


def look_through(view: VehicleView, road_m: Array) -> Visibility:
    """Compare points (N, 3) of a unit, m, that stand upright with the ranges of the vehicle's sweeps."""
    upright = road_m[_above_ground(road_m)]
    seen, through = np.zeros(len(upright), bool), np.zeros(len(upright), int)
    chosen = np.unique(np.linspace(0, len(view.sensor_m) - 1, MAX_SWEEPS).round().astype(np.int64))
    for row in chosen.tolist():
        sensor = view.sensor_m[row]
        nearest, farthest = _ranges(view.xyz_m[view.sweep == row] - sensor)
        place, range_m = _bins(upright - sensor)
        known = np.isfinite(nearest[place]) & (range_m > MIN_RANGE_M)
        here = (nearest[place] < range_m + AGREE_M) & (farthest[place] > range_m - AGREE_M)
        seen |= known & here
        through += known & (nearest[place] > range_m + AGREE_M)
    return Visibility(int(seen.sum()), int(((through > 0) & ~seen).sum()))


def _above_ground(xyz_m: Array) -> NDArray[np.bool_]:
    """Mark points (N, 3) that are higher than `MIN_HEIGHT_M` above the lowest around."""
    cell = np.floor(xyz_m[:, :2] / GROUND_CELL_M).astype(np.int64) + (1 << 20)
    _, place = np.unique((cell[:, 0] << 21) | cell[:, 1], return_inverse=True)
    lowest = np.full(int(place.max()) + 1 if len(place) else 0, np.inf)
    np.minimum.at(lowest, place, xyz_m[:, 2])
    floor = float(np.quantile(xyz_m[:, 2], 0.05)) if len(xyz_m) else 0.0
    # A wall seen from its foot up has the ground in its cell; one that is seen above a hedge has it not.
    return np.asarray(xyz_m[:, 2] > np.minimum(lowest[place], floor + 2.0) + MIN_HEIGHT_M)


def _bins(off: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the bin (N,) of the directions of offsets (N, 3) and their lengths (N,)."""
    range_m = np.linalg.norm(off, axis=1)
    azimuth = np.arctan2(off[:, 1], off[:, 0])
    elevation = np.arcsin(np.clip(off[:, 2] / np.maximum(range_m, 1e-6), -1.0, 1.0))
    column = np.floor((azimuth + np.pi) / BIN_RAD).astype(np.int64) % COLUMNS
    row = np.clip(np.floor((elevation + np.pi / 2) / BIN_RAD).astype(np.int64), 0, ROWS - 1)
    return row * COLUMNS + column, range_m


def _ranges(off: Array) -> tuple[Array, Array]:
    """Return the nearest and the farthest range of each bin and those beside it, infinite and 0 where there is none."""
    place, range_m = _bins(off)
    nearest, farthest = np.full(ROWS * COLUMNS, np.inf), np.zeros(ROWS * COLUMNS)
    np.minimum.at(nearest, place, range_m)
    np.maximum.at(farthest, place, range_m)
    grids = [nearest.reshape(ROWS, COLUMNS), farthest.reshape(ROWS, COLUMNS)]
    for k, (grid, choose, fill) in enumerate(zip(grids, (np.minimum, np.maximum), (np.inf, 0.0))):
        wide = choose(choose(grid, np.roll(grid, 1, axis=1)), np.roll(grid, -1, axis=1))
        up, down = np.full_like(wide, fill), np.full_like(wide, fill)
        up[1:], down[:-1] = wide[:-1], wide[1:]
        grids[k] = choose(choose(wide, up), down)
    return grids[0].ravel(), grids[1].ravel()
