"""Colors, LiDAR intensities and heights of a map of the ground, as logarithms where ratios count."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap

# Added to pixel values before the logarithm: what noise and rounding of a dark picture amount to.
DARK_LEVEL = 4.0
# Returns of asphalt are as weak as 1 % to 10 %: keeps the logarithm of the weakest from ruling.
DARK_INTENSITY = 0.02

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]


def log_color(bgr: NDArray[np.uint8]) -> tuple[Layer, Layer]:
    """Compute brightness and yellowness (...,) of colors (..., 3), as logarithms of ratios of pixel values."""
    b, g, r = (bgr[..., k].astype(np.float32) + np.float32(DARK_LEVEL) for k in range(3))
    bright = np.log((r + g) * np.float32(0.5))
    return bright, np.log(np.minimum(r, g) / b)


def log_intensity(intensity: NDArray[np.floating]) -> Layer:
    """Compute logarithms (...,) of intensities in [0, 1]; NaN where LiDAR saw nothing."""
    return np.asarray(np.log(np.maximum(intensity, 0) + np.float32(DARK_INTENSITY)), np.float32)


def coarse_means(values: Layer, valid: Mask, factor: int) -> tuple[Layer, Layer]:
    """Average valid values (R, C) in squares of `factor` cells along an edge; the second result is the share that is valid."""
    size = (values.shape[1] // factor, values.shape[0] // factor)
    share = np.asarray(cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    total = cv2.resize(np.where(valid, values, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.divide(total, share, out=np.zeros_like(share), where=share > 0), share


def high_pass(values: Layer, valid: Layer, around: int) -> Layer:
    """Subtract the mean within some cells to all sides, so that what was not seen (0 now) looks like its surroundings."""
    size = (2 * around + 1,) * 2
    share = cv2.blur(valid, size)
    mean = np.divide(cv2.blur(values * valid, size), share, out=np.zeros_like(values), where=share > 1e-6)
    return np.asarray(np.where(valid > 0, values - mean, 0), np.float32)


@dataclass(frozen=True, eq=False)
class Samples:
    """What a map holds at points."""

    bright: Layer  # `bright`, `yellow`: (...,): logarithms; NaN where no camera saw the ground
    yellow: Layer
    intensity: Layer  # (...,): logarithm of LiDAR intensity; NaN where it saw nothing

    @property
    def paint(self) -> Layer:
        """What stands out where there is white or yellow paint."""
        return self.bright + self.yellow


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
