"""A map of the ground: color, height and LiDAR intensity on one north-up raster."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array

# While it is filled a map takes 46 bytes a cell, with this many 1.1 GB.
MAX_CELLS = 24_000_000
# OpenCV warps rasters of at most this many cells along an edge.
MAX_EDGE_CELLS = 32_766

Extent = tuple[float, float, float, float]


@dataclass(frozen=True)
class Raster:
    """Cells of a north-up raster: R rows from north to south, C columns from west to east."""

    extent_m: Extent  # (float, float, float, float): x0, x1, y0, y1 of the outer edges, m, map frame
    resolution_m: float  # edge of a cell
    shape: tuple[int, int]  # (int, int): rows and columns

    @classmethod
    def covering(cls, extent_m: Extent, resolution_m: float) -> Raster:
        """Make the raster that covers an extent (x0, x1, y0, y1), m; its north-west corner stays.

        Raises `ConfigError` for an extent without area, and one of more than `MAX_CELLS` cells.
        """
        x0, x1, y0, y1 = extent_m
        if not (np.all(np.isfinite(extent_m)) and x1 > x0 and y1 > y0 and resolution_m > 0):
            raise ConfigError(f"bird's-eye view: extent {extent_m} at {resolution_m} m a cell has no area")
        rows, columns = (round(np.ceil(size / resolution_m - 1e-6)) for size in (y1 - y0, x1 - x0))
        if rows * columns > MAX_CELLS or max(rows, columns) > MAX_EDGE_CELLS:
            raise ConfigError(
                f"bird's-eye view: {columns} x {rows} cells, more than the {MAX_CELLS} allowed ({MAX_EDGE_CELLS} an edge); "
                f"choose a resolution coarser than {resolution_m:g} m or a smaller extent"
            )
        return cls((x0, x0 + columns * resolution_m, y1 - rows * resolution_m, y1), resolution_m, (rows, columns))

    def coarser(self, factor: int) -> Raster:
        """Return the raster of cells `factor` times as long from the same north-west corner, which covers this one."""
        rows, columns = (-(-n // factor) for n in self.shape)
        d, (x0, _, _, y1) = self.resolution_m * factor, self.extent_m
        return Raster((x0, x0 + columns * d, y1 - rows * d, y1), d, (rows, columns))

    def cells_of(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Return rows and columns (N,), fractional, of positions (N, 2), m; whole numbers are centers of cells."""
        at = np.atleast_2d(np.asarray(xy, dtype=np.float64))
        x0, _, _, y1 = self.extent_m
        return (y1 - at[:, 1]) / self.resolution_m - 0.5, (at[:, 0] - x0) / self.resolution_m - 0.5

    def xy_of(self, rows: ArrayLike, columns: ArrayLike) -> Array:
        """Return positions (..., 2), m, of rows and columns (...), which may be fractional."""
        x0, _, _, y1 = self.extent_m
        r, c = np.broadcast_arrays(np.asarray(rows, dtype=np.float64), np.asarray(columns, dtype=np.float64))
        return np.stack([x0 + (c + 0.5) * self.resolution_m, y1 - (r + 0.5) * self.resolution_m], axis=-1)

    def index_of(self, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
        """Return the number of the cell (N,), row by row, that each position (N, 2) is in, and whether it is in one."""
        x0, _, _, y1 = self.extent_m
        row = np.floor((y1 - xy[:, 1]) / self.resolution_m).astype(np.int64)
        column = np.floor((xy[:, 0] - x0) / self.resolution_m).astype(np.int64)
        inside = (row >= 0) & (row < self.shape[0]) & (column >= 0) & (column < self.shape[1])
        return np.where(inside, row * self.shape[1] + column, 0), inside


def coarsened_cell_m(extent_m: Extent, wanted_m: float) -> float:
    """Return the edge of cells, m, with which an extent has at most `MAX_CELLS`: the one wanted, or one coarser in whole cm."""
    width, height = extent_m[1] - extent_m[0], extent_m[3] - extent_m[2]
    least = max(math.sqrt((width + 1) * (height + 1) / MAX_CELLS), max(width, height) / (MAX_EDGE_CELLS - 1))
    return wanted_m if least <= wanted_m else math.ceil(100 * least) / 100


@dataclass(frozen=True, eq=False)
class GroundMap:
    """North-up raster of the ground in the map frame; R rows from north to south, C columns from west to east."""

    color_bgr: NDArray[np.uint8]  # (R, C, 3): black where no camera saw the ground
    alpha: NDArray[np.uint8]  # (R, C): how well a camera saw it, 0 where none did
    height_m: NDArray[np.float32]  # (R, C): of the ground; NaN where no LiDAR saw it nearby
    # (R, C): of LiDAR returns relative to the road at their range: 0.2 where they are as usual there, 1 from five times as strong
    # on; NaN where there are none
    intensity: NDArray[np.float32]
    resolution_m: float  # edge of a cell
    extent_m: Extent  # x0, x1, y0, y1 of the outer edges, m
    notes: tuple[str, ...] = ()  # what could not be mapped, and why

    @property
    def raster(self) -> Raster:
        """The cells."""
        return Raster(self.extent_m, self.resolution_m, (self.alpha.shape[0], self.alpha.shape[1]))

    @property
    def image_bgr(self) -> NDArray[np.uint8]:
        """The colors (R, C, 3), as the background of plots is called."""
        return self.color_bgr

    @property
    def coverage(self) -> NDArray[np.bool_]:
        """Mask (R, C) of the cells that a camera saw."""
        return self.alpha > 0

    @cached_property
    def has_color(self) -> bool:
        """Whether a camera saw any of it."""
        return bool(self.alpha.any())

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask (R, C) of the cells of which anything is known."""
        return self.coverage | np.isfinite(self.height_m) | np.isfinite(self.intensity)

    def as_picture(self) -> GroundMap:
        """Return the map with a picture of the intensities in place of colors where no camera saw any of it; else itself."""
        known = np.isfinite(self.intensity)
        if self.has_color or not known.any():
            return self
        gray = np.rint(255 * np.clip(np.nan_to_num(self.intensity), 0.0, 1.0)).astype(np.uint8)
        return replace(self, color_bgr=np.dstack([gray] * 3), alpha=np.where(known, 255, 0).astype(np.uint8))

    def around(self, cells: NDArray[np.bool_]) -> GroundMap:
        """Return the part of the map around all cells of a mask (R, C); one cell where there are none."""
        spans = []
        for axis in (1, 0):
            found = np.flatnonzero(cells.any(axis=axis))
            spans.append(slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1))
        (rows, columns), d = spans, self.resolution_m
        x0, _, _, y1 = self.extent_m
        extent = (x0 + columns.start * d, x0 + columns.stop * d, y1 - rows.stop * d, y1 - rows.start * d)
        color, alpha = (layer[rows, columns].copy() for layer in (self.color_bgr, self.alpha))
        height, intensity = (layer[rows, columns].copy() for layer in (self.height_m, self.intensity))
        return GroundMap(color, alpha, height, intensity, d, extent, self.notes)


AROUND_M = 0.25


def at_height(ground: GroundMap, xy: Array) -> Array:
    """Put points (N, 2) on the ground: (N, 3), m. Where the height is unknown it is that of the nearest point, or 0."""
    reach = max(1, round(AROUND_M / ground.resolution_m))
    rows = ((ground.extent_m[3] - xy[:, 1]) / ground.resolution_m).astype(int)
    columns = ((xy[:, 0] - ground.extent_m[0]) / ground.resolution_m).astype(int)
    z = np.full(len(xy), np.nan)
    for k, (r, c) in enumerate(zip(rows, columns)):
        part = ground.height_m[max(r - reach, 0) : max(r + reach + 1, 0), max(c - reach, 0) : max(c + reach + 1, 0)]
        known = part[np.isfinite(part)]
        if known.size:
            z[k] = np.median(known)
    known = np.isfinite(z)
    if not known.any():
        everywhere = ground.height_m[::20, ::20]
        level = float(np.nanmedian(everywhere)) if np.isfinite(everywhere).any() else 0.0
        return np.column_stack([xy, np.full(len(xy), level)])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return np.column_stack([xy, np.interp(s, s[known], z[known])])
