"""Colors of the ground from many pictures: the finest view of a cell weighs most, exposures are balanced over the overlaps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.mapping.ground_view import Image, sample_at
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

    def add(self, camera: str, image: Image, warp: Warp) -> None:
        """Add a picture of a camera, as far as a warp shows it."""
        color = sample_at(image, warp.u, warp.v, warp.scale).astype(np.float32)
        weight = warp.opacity * np.minimum(warp.scale, MAX_SCALE) ** 4
        cell = warp.rows * self.raster.shape[1] + warp.columns
        gain = self._gain(camera, color, weight, warp, cell)
        color *= weight[:, None] * gain.astype(np.float32)
        # Each cell is there once.
        self._sum.reshape(-1, 3)[cell] += color
        self._weight.reshape(-1)[cell] += weight
        opacity = self._opacity.reshape(-1)
        opacity[cell] = np.maximum(opacity[cell], np.rint(255 * warp.opacity).astype(np.uint8))

    def image(self) -> tuple[Image, Image]:
        """Return colors (R, C, 3) and opacity (R, C)."""
        seen = self._weight > 0
        color = np.empty((*self.raster.shape, 3), dtype=np.uint8)
        for k in range(3):  # by channel, so that no second array of floats is made of all
            mean = np.divide(self._sum[..., k], self._weight, out=np.zeros_like(self._weight), where=seen)
            color[..., k] = np.clip(np.rint(mean), 0, 255)
        return color, np.where(seen, np.maximum(self._opacity, 1), 0).astype(np.uint8)

    def _gain(
        self,
        camera: str,
        color: NDArray[np.float32],
        weight: NDArray[np.float32],
        warp: Warp,
        cell: NDArray[np.int64],
    ) -> Array:
        """Gains (3,) of a picture's channels that fit it to what is mapped so far."""
        some = np.flatnonzero(
            (warp.rows % STEP == 0) & (warp.columns % STEP == 0) & (warp.opacity > MIN_COMMON_OPACITY) & (weight > 0)
        )
        some = some[self._opacity.reshape(-1)[cell[some]] > 255 * MIN_COMMON_OPACITY]
        some = some[np.all((color[some] > DARKEST) & (color[some] < BRIGHTEST), axis=1)]
        last = self.gains.setdefault(camera, [])
        if len(some) < MIN_COMMON_CELLS:
            gain = last[-1] if last else np.ones(3)
        else:
            mapped = self._sum.reshape(-1, 3)[cell[some]] / self._weight.reshape(-1)[cell[some], None]
            ratio = mapped / color[some]
            gain = np.exp(np.clip(np.log(np.maximum(np.median(ratio, axis=0), 1e-3)), -MAX_LOG_GAIN, MAX_LOG_GAIN))
        last.append(np.asarray(gain, dtype=np.float64))
        return last[-1]
