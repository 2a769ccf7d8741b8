"""What is compared with its surroundings to find paint: color as logarithms, so that a contrast is a ratio, and LiDAR intensity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.mapping.ground_map import GroundMap

# Lines are 0.1 m wide at least (Vienna Convention; MUTCD 3A.06; RMS), so they fill such cells.
COARSE_M = 0.1
# Added to pixel values before the logarithm: what noise and rounding of a dark picture amount to.
DARK_LEVEL = 4.0
# Yellow paint on concrete is hardly brighter than it but much more yellow; half the weight, as blue is noisier.
YELLOW_WEIGHT = 1.0
# Returns of asphalt are as weak as 1 % to 10 %: keeps the logarithm of the weakest from ruling.
DARK_INTENSITY = 0.02
TILE_CELLS = 1024

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CoarseTile:
    """Part of a map in cells of about `COARSE_M`, with margins that neighboring tiles repeat.

    Attributes
    ----------
    paint : (R, C) float32
        Logarithm of brightness, plus that of yellowness.
    peak, dip : (R, C) float32
        The same of the brightest and the darkest cell of the map in each: lines, and gaps between a line and a curb, that are
        as narrow as a coarse cell seldom fill one.
    seen : (R, C) float32
        Share of each cell that a camera saw.
    intensity : (R, C) float32
        Logarithm of LiDAR intensity.
    hit : (R, C) float32
        1 where LiDAR saw the ground.
    core : (slice, slice)
        Rows and columns without the margins.
    origin : (int, int)
        Row and column of the coarse map at which the tile begins.
    """

    paint: Layer
    peak: Layer
    dip: Layer
    seen: Layer
    intensity: Layer
    hit: Layer
    core: tuple[slice, slice]
    origin: tuple[int, int]


def coarse_factor(ground: GroundMap) -> int:
    """Count the cells of a map along the edge of a coarse one."""
    return max(1, round(COARSE_M / ground.resolution_m))


def log_color(bgr: NDArray[np.uint8]) -> tuple[Layer, Layer]:
    """Compute brightness and yellowness (...,) of colors (..., 3), as logarithms of ratios of pixel values."""
    b, g, r = (bgr[..., k].astype(np.float32) + np.float32(DARK_LEVEL) for k in range(3))
    bright = np.log((r + g) * np.float32(0.5))
    return bright, np.log(np.minimum(r, g) / b)


def log_paint(bgr: NDArray[np.uint8]) -> Layer:
    """Compute what stands out where there is white or yellow paint, (...,) of colors (..., 3)."""
    bright, yellow = log_color(bgr)
    return np.asarray(bright + np.float32(YELLOW_WEIGHT) * yellow, np.float32)


def log_intensity(intensity: NDArray[np.floating]) -> Layer:
    """Compute logarithms (...,) of intensities in [0, 1]; NaN where LiDAR saw nothing."""
    return np.asarray(np.log(np.maximum(intensity, 0) + np.float32(DARK_INTENSITY)), np.float32)


def iterate_tiles(ground: GroundMap, margin_cells: int) -> Iterator[CoarseTile]:
    """Yield the parts of a map that some sensor saw."""
    factor = coarse_factor(ground)
    rows, columns = (size // factor for size in ground.alpha.shape)
    for r in range(0, rows, TILE_CELLS):
        for c in range(0, columns, TILE_CELLS):
            r0, r1 = max(r - margin_cells, 0), min(r + TILE_CELLS + margin_cells, rows)
            c0, c1 = max(c - margin_cells, 0), min(c + TILE_CELLS + margin_cells, columns)
            fine = (slice(r0 * factor, r1 * factor), slice(c0 * factor, c1 * factor))
            core = (slice(r - r0, min(r + TILE_CELLS, rows) - r0), slice(c - c0, min(c + TILE_CELLS, columns) - c0))
            alpha, hit = ground.alpha[fine] > 0, np.isfinite(ground.intensity[fine])
            by_camera, by_lidar = alpha.any(), hit.any()
            if by_camera or by_lidar:
                nothing = np.zeros((r1 - r0, c1 - c0), np.float32)
                paint, seen, peak, dip, intensity, share = (nothing,) * 6
                if by_camera:
                    values = log_paint(ground.color_bgr[fine])
                    paint, seen = _coarse(values, alpha, factor)
                    peak, dip = _extremes(values, alpha, factor)
                if by_lidar:
                    intensity, share = _coarse(log_intensity(ground.intensity[fine]), hit, factor)
                yield CoarseTile(paint, peak, dip, seen, intensity, (share > 0).astype(np.float32), core, (r0, c0))


def _coarse(values: Layer, valid: Mask, factor: int) -> tuple[Layer, Layer]:
    """Average valid values in squares of cells; the second result is the share that is valid."""
    size = (values.shape[1] // factor, values.shape[0] // factor)
    share = np.asarray(cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    total = cv2.resize(np.where(valid, values, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.divide(total, share, out=np.zeros_like(share), where=share > 0), share


def _extremes(values: Layer, valid: Mask, factor: int) -> tuple[Layer, Layer]:
    """Take the largest and the least valid value in squares of cells, 0 where there is none."""
    corners = [(slice(i, None, factor), slice(j, None, factor)) for i in range(factor) for j in range(factor)]
    high = np.max([np.where(valid[c], values[c], -np.inf) for c in corners], axis=0)
    low = np.min([np.where(valid[c], values[c], np.inf) for c in corners], axis=0)
    known = np.isfinite(high)
    return np.where(known, high, 0).astype(np.float32), np.where(known, low, 0).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Samples:
    """What a map holds at points.

    Attributes
    ----------
    bright, yellow : (...,) float32
        Logarithms; NaN where no camera saw the ground.
    intensity : (...,) float32
        Logarithm of LiDAR intensity; NaN where it saw nothing.
    """

    bright: Layer
    yellow: Layer
    intensity: Layer

    @property
    def paint(self) -> Layer:
        """What stands out where there is white or yellow paint."""
        return np.asarray(self.bright + np.float32(YELLOW_WEIGHT) * self.yellow, np.float32)


def sample(ground: GroundMap, x: Array, y: Array) -> Samples:
    """Sample a map at points (N, M) of the map frame: colors between cells, the others at the nearest cell."""
    u = ((x - ground.extent_m[0]) / ground.resolution_m - 0.5).astype(np.float32)
    v = ((ground.extent_m[3] - y) / ground.resolution_m - 0.5).astype(np.float32)
    rows, columns = np.rint(v).astype(np.int32), np.rint(u).astype(np.int32)
    inside = (rows >= 0) & (rows < ground.alpha.shape[0]) & (columns >= 0) & (columns < ground.alpha.shape[1])
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    intensity = np.where(inside, ground.intensity[rows, columns], np.nan)
    if not ground.has_color:
        unseen = np.full(u.shape, np.nan, np.float32)
        return Samples(unseen, unseen, log_intensity(intensity))
    color = np.asarray(cv2.remap(ground.color_bgr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    bright, yellow = log_color(color)
    hidden = ~inside | (ground.alpha[rows, columns] == 0)
    bright[hidden] = np.nan
    yellow[hidden] = np.nan
    return Samples(bright, yellow, log_intensity(intensity))
