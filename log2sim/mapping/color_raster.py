"""Colors of the ground from many pictures: the finest view of a cell weighs most, exposures are balanced over the overlaps."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.mapping.ground_view import Image, sample_colors
from log2sim.mapping.picture_warp import Warp
from log2sim.mapping.raster import Raster

# Cells between those that are compared for the exposure.
STEP = 4
MIN_COMMON_CELLS = 100
# An exposure may differ from what is mapped so far by at most one stop.
MAX_LOG_GAIN = 0.7
# Finer pixels do not show more of a cell, but they are those of the nearest view.
MAX_SCALE = 4.0
# Darker values, of 255, say little about the exposure, and brighter ones are clipped.
DARKEST, BRIGHTEST = 10.0, 245.0
MIN_COMMON_OPACITY = 0.5


class ColorRaster:
    """Accumulate pictures that were warped onto a raster.

    Notes
    -----
    Weights are the fourth power of the pixels along a cell's edge, so that the nearest view decides and far ones only fill the
    rest. The gain of a picture is the median ratio of its colors to those mapped so far, after Brown and Lowe (2007), section
    6, but one picture after the other; without an overlap it is that of the last picture of its camera.
    """

    def __init__(self, raster: Raster) -> None:
        self.raster = raster
        self._sum = np.zeros((*raster.shape, 3), dtype=np.float32)
        self._weight = np.zeros(raster.shape, dtype=np.float32)
        self._opacity = np.zeros(raster.shape, dtype=np.uint8)
        self.gains: dict[str, list[Array]] = {}

    def add(self, camera: str, image: Image, warp: Warp, opacity: NDArray[np.float32]) -> None:
        """Add a picture of a camera with the opacity (r, c) of what it shows of the ground."""
        color = sample_colors(image, (warp.u, warp.v), warp.scale, opacity > 0)
        weight = opacity * np.minimum(warp.scale, MAX_SCALE) ** 4
        gain = self._gain(camera, color, weight, opacity, warp)
        place = (warp.rows, warp.columns)
        self._sum[place] += color * (weight[..., None] * gain.astype(np.float32))
        self._weight[place] += weight
        np.maximum(self._opacity[place], np.rint(255 * opacity).astype(np.uint8), out=self._opacity[place])

    def image(self) -> tuple[Image, Image]:
        """Return colors (R, C, 3) and opacity (R, C)."""
        seen = self._weight > 0
        color = np.empty((*self.raster.shape, 3), dtype=np.uint8)
        for k in range(3):  # by channel, so that no second array of floats is made of all
            mean = np.divide(self._sum[..., k], self._weight, out=np.zeros_like(self._weight), where=seen)
            color[..., k] = np.clip(np.rint(mean), 0, 255)
        return color, np.where(seen, np.maximum(self._opacity, 1), 0).astype(np.uint8)

    def _gain(
        self, camera: str, color: Image, weight: NDArray[np.float32], opacity: NDArray[np.float32], warp: Warp
    ) -> Array:
        """Gains (3,) of a picture's channels that fit it to what is mapped so far."""
        some = (slice(warp.rows.start, warp.rows.stop, STEP), slice(warp.columns.start, warp.columns.stop, STEP))
        own = color[::STEP, ::STEP].astype(np.float32)
        there, mapped = self._weight[some], self._sum[some]
        common = (opacity[::STEP, ::STEP] > MIN_COMMON_OPACITY) & (self._opacity[some] > 255 * MIN_COMMON_OPACITY)
        common &= np.all((own > DARKEST) & (own < BRIGHTEST), axis=2)
        common &= weight[::STEP, ::STEP] > 0
        last = self.gains.setdefault(camera, [])
        if np.count_nonzero(common) < MIN_COMMON_CELLS:
            gain = last[-1] if last else np.ones(3)
        else:
            ratio = (mapped[common] / there[common][:, None]) / own[common]
            gain = np.exp(np.clip(np.log(np.maximum(np.median(ratio, axis=0), 1e-3)), -MAX_LOG_GAIN, MAX_LOG_GAIN))
        last.append(np.asarray(gain, dtype=np.float64))
        return last[-1]


def sample_mask(mask: NDArray[np.uint8], warp: Warp, shrink: int) -> NDArray[np.bool_]:
    """Look up in a mask of a picture, `shrink` times smaller, what cells (r, c) of a warp show."""
    at_u, at_v = (a / shrink - np.float32(0.5) for a in (warp.u, warp.v))
    return np.asarray(cv2.remap(mask, at_u, at_v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT) > 0)
