"""Wear of paint: patches in which it is missing, one pattern that repeats without seams."""

from __future__ import annotations

from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

NOISE_PX = 1024  # after which the pattern repeats
# Sizes in pixels of 4 cm and strengths: chips of paint, the width of a tire, and stretches on which it brakes.
PATCHES = ((2, 0.6), (8, 1.0), (64, 0.9))


def paint_left(
    seed: int, level: int, first: tuple[int, int], shape: tuple[int, int], worn: float
) -> NDArray[np.float32]:
    """Share of paint that is left in each pixel of a part of an endless surface, from 0 to 1.

    Parameters
    ----------
    level
        Pixels are 2**level times as large as the finest.
    first, shape
        Row and column of the first pixel at this level, and the number of rows and columns.
    worn
        Share of the surface on which paint is missing.
    """
    left = _left(seed, level, worn)
    rows, columns = ((f + np.arange(n)) % len(left) for f, n in zip(first, shape))
    return left.take(rows, axis=0).take(columns, axis=1)


@lru_cache(maxsize=24)
def _left(seed: int, level: int, worn: float) -> NDArray[np.float32]:
    if level:
        finer = _left(seed, level - 1, worn)
        return np.asarray(cv2.resize(finer, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), np.float32)
    return (_depth(seed) >= worn).astype(np.float32)


@lru_cache(maxsize=2)
def _depth(seed: int) -> NDArray[np.float32]:
    """Share of the surface (NOISE_PX, NOISE_PX) that wears off before each pixel does."""
    rng = np.random.default_rng([seed, 6])
    noise = np.zeros((NOISE_PX, NOISE_PX), np.float32)
    for size, strength in PATCHES:
        count = NOISE_PX // size
        coarse = np.pad(rng.normal(0, strength, (count, count)).astype(np.float32), 2, mode="wrap")
        wide = cv2.resize(coarse, None, fx=size, fy=size, interpolation=cv2.INTER_CUBIC)
        noise += wide[2 * size : -2 * size, 2 * size : -2 * size]
    rank = np.empty(noise.size, np.float32)
    rank[np.argsort(noise, axis=None, kind="stable")] = np.arange(noise.size, dtype=np.float32) / noise.size
    return rank.reshape(noise.shape)
