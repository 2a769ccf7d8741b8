"""Grain, stains and patches of painted surfaces: one noise that repeats without seams."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

NOISE_PX = 1024  # after which the noise repeats
SIGMA = 0.015  # standard deviation of the finest grain
PATCHES = ((8, 0.8), (32, 1.3), (256, 1.7))  # sizes in pixels and their strengths relative to the grain's


def grain(seed: int, level: int, first: tuple[int, int], shape: tuple[int, int]) -> NDArray[np.float32]:
    """Factors of brightness around 1 for a part of an endless surface.

    Parameters
    ----------
    level
        Pixels are 2**level times as large as the finest.
    first, shape
        Row and column of the first pixel at this level, and the number of rows and columns.
    """
    noise = _noise(seed, level)
    rows, columns = ((f + np.arange(n)) % len(noise) for f, n in zip(first, shape))
    return noise.take(rows, axis=0).take(columns, axis=1)


@lru_cache(maxsize=16)
def _noise(seed: int, level: int) -> NDArray[np.float32]:
    if level:
        finer = _noise(seed, level - 1)
        return np.asarray(cv2.resize(finer, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)
    rng = np.random.default_rng([seed, 3])
    shade = rng.standard_normal((NOISE_PX, NOISE_PX), dtype=np.float32) * np.float32(SIGMA)
    for size, share in PATCHES:
        count = NOISE_PX // size
        coarse = np.pad(rng.normal(0, share * SIGMA, (count, count)).astype(np.float32), 2, mode="wrap")
        wide = cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)
        shade += wide[2 * size : -2 * size, 2 * size : -2 * size]
    return np.asarray(1 + shade, np.float32)
