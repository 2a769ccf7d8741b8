"""A map of the ground: color, height and LiDAR intensity on one north-up raster of the map frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array

# With color, height and intensity a map of this size has 430 MB, and 1.2 GB while it is made.
MAX_CELLS = 36_000_000
# OpenCV warps rasters of at most this many cells along an edge.
MAX_EDGE_CELLS = 32_766

Extent = tuple[float, float, float, float]


@dataclass(frozen=True, eq=False)
class GroundMap:
    """North-up raster of the ground in the map frame; R rows from north to south, C columns from west to east.

    Attributes
    ----------
    color_bgr : (R, C, 3) uint8
        Black where no camera saw the ground.
    alpha : (R, C) uint8
        How well a camera saw it, 0 where none did.
    height_m : (R, C) float32, m
        Of the ground in the map frame; NaN where no LiDAR saw it nearby.
    intensity : (R, C) float32
        Of LiDAR returns relative to the road around them: 0.2 where they are as usual for their range, 1 from five times as
        strong on; NaN where there are none.
    resolution_m : float, m
        Edge of a cell.
    extent_m : (float, float, float, float)
        x0, x1, y0, y1 of the outer edges, m.
    notes : tuple of str
        What could not be mapped, and why.
    """

    color_bgr: NDArray[np.uint8]
    alpha: NDArray[np.uint8]
    height_m: NDArray[np.float32]
    intensity: NDArray[np.float32]
    resolution_m: float
    extent_m: Extent
    notes: tuple[str, ...] = ()

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        return self.alpha.shape[0], self.alpha.shape[1]

    @property
    def image_bgr(self) -> NDArray[np.uint8]:
        """The colors (R, C, 3), as the background of plots is called."""
        return self.color_bgr

    @property
    def coverage(self) -> NDArray[np.bool_]:
        """Mask (R, C) of the cells that a camera saw."""
        return self.alpha > 0

    def cells_of(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Return rows and columns (N,), fractional, of positions (N, 2), m; whole numbers are centers of cells."""
        at = np.atleast_2d(np.asarray(xy, dtype=np.float64))
        x0, _, _, y1 = self.extent_m
        return (y1 - at[:, 1]) / self.resolution_m - 0.5, (at[:, 0] - x0) / self.resolution_m - 0.5

    def xy_of(self, rows: ArrayLike, columns: ArrayLike) -> Array:
        """Return positions (N, 2), m, of rows and columns (N,), which may be fractional."""
        x0, _, _, y1 = self.extent_m
        r, c = np.broadcast_arrays(np.asarray(rows, dtype=np.float64), np.asarray(columns, dtype=np.float64))
        return np.stack([x0 + (c + 0.5) * self.resolution_m, y1 - (r + 0.5) * self.resolution_m], axis=-1)


def raster_of(extent_m: Extent, resolution_m: float) -> tuple[tuple[int, int], Extent]:
    """Return rows and columns of a raster that covers an extent, and the extent of these; the north-west corner stays.

    Raises
    ------
    ConfigError
        For an extent without area, and one of more than `MAX_CELLS` cells.
    """
    x0, x1, y0, y1 = extent_m
    if not (np.all(np.isfinite(extent_m)) and x1 > x0 and y1 > y0 and resolution_m > 0):
        raise ConfigError(f"bird's-eye view: extent {extent_m} at {resolution_m} m a cell has no area")
    rows, columns = round(np.ceil((y1 - y0) / resolution_m - 1e-6)), round(np.ceil((x1 - x0) / resolution_m - 1e-6))
    if rows * columns > MAX_CELLS or max(rows, columns) > MAX_EDGE_CELLS:
        raise ConfigError(
            f"bird's-eye view: {columns} x {rows} cells, more than the {MAX_CELLS} allowed ({MAX_EDGE_CELLS} an edge); "
            f"choose a resolution coarser than {resolution_m:g} m or a smaller extent"
        )
    return (rows, columns), (x0, x0 + columns * resolution_m, y1 - rows * resolution_m, y1)
