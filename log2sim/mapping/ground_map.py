"""A map of the ground: color, height and LiDAR intensity on one north-up raster of the map frame."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array
from log2sim.mapping.raster import Extent, Raster


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
        Of LiDAR returns relative to the road at their range: 0.2 where they are as usual there, 1 from five times as strong
        on; NaN where there are none.
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

    def around(self, cells: NDArray[np.bool_]) -> GroundMap:
        """Return the part of the map around all cells of a mask (R, C); one cell where there are none."""
        spans = []
        for axis in (1, 0):
            found = np.flatnonzero(cells.any(axis=axis))
            spans.append(slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 1))
        (rows, columns), d = spans, self.resolution_m
        x0, _, _, y1 = self.extent_m
        extent = (x0 + columns.start * d, x0 + columns.stop * d, y1 - rows.stop * d, y1 - rows.start * d)
        part = (rows, columns)
        return GroundMap(
            self.color_bgr[part].copy(),
            self.alpha[part].copy(),
            self.height_m[part].copy(),
            self.intensity[part].copy(),
            d,
            extent,
            self.notes,
        )

    def cells_of(self, xy: ArrayLike) -> tuple[Array, Array]:
        """Return rows and columns (N,), fractional, of positions (N, 2), m; whole numbers are centers of cells."""
        return self.raster.cells_of(xy)

    def xy_of(self, rows: ArrayLike, columns: ArrayLike) -> Array:
        """Return positions (..., 2), m, of rows and columns (...), which may be fractional."""
        return self.raster.xy_of(rows, columns)
