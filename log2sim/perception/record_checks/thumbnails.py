"""Small copies of pictures, what they show, and how much they differ."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Cells along the longer side. A cell of a camera for vehicles covers about a hundred pixels, whose noise averages out.
CELLS = 128
# The last reduction averages at least this many by this many values, rounded to whole gray levels by those before it.
FINE_FACTOR = 4
# Of the differences of all cells the 95 % quantile tells whether two pictures differ: stamps written into a picture and few
# moving objects do not change it, noise of every cell does.
CHANGE_QUANTILE = 0.95
# Cells of a coarser copy along each side of a fine one, for what is larger than noise.
COARSE_FACTOR = 4
# Of sums over independent noise the variance falls with the number of cells, within a factor of 2 by chance and by the
# blocks of 8 pixels in which JPEG codes.
MAX_NOISE_RATIO = 2.0
# Standard deviation of rounding to 8 bits; a street in fog that hides everything beyond 15 m has more structure.
MIN_STRUCTURE_LEVELS = 0.29
# One cell of thousands is this many standard deviations off once in 10^5 pictures of noise; a lamp at night is more.
OUTSTANDING_SIGMAS = 6.0
MIN_OUTSTANDING_LEVELS = 4.0
# Coefficients of the Laplacian, whose sum of squares scales its variance on independent noise.
LAPLACIAN_NORM = 20.0

Thumbnail = NDArray[np.float32]


def shrink(image: NDArray[np.uint8]) -> Thumbnail:
    """Return the gray means of the cells of an image (H, W, 3) BGR: (h, w) float32, levels from 0 to 255."""
    # Halving is many times as fast as any other reduction; what it rounds averages out in the last one.
    while max(image.shape) >= 2 * FINE_FACTOR * CELLS:
        height, width = (n - n % 2 for n in image.shape[:2])
        image = cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)  # type: ignore[assignment]
    height, width = image.shape[:2]
    scale = min(CELLS / max(height, width), 1.0)
    cells = (max(round(width * scale), 1), max(round(height * scale), 1))
    gray = cv2.cvtColor(image, cv2.COLOR_BGR2GRAY).astype(np.float32)
    return np.asarray(cv2.resize(gray, cells, interpolation=cv2.INTER_AREA))


def measure_change(before: Thumbnail, after: Thumbnail) -> float:
    """Return by how many gray levels two pictures differ: the 95 % quantile over the cells."""
    return quantile_of_change(np.abs(after - before))


def quantile_of_change(change: NDArray[np.float32]) -> float:
    """Return the quantile of changes of cells that tells whether two pictures differ, levels; 0 without cells."""
    values = change.ravel()
    if not len(values):
        return 0.0
    k = int(CHANGE_QUANTILE * (len(values) - 1))
    return float(np.partition(values, k)[k])


def changed_share(before: Thumbnail, after: Thumbnail) -> float:
    """Return the share of the cells that changed at all, by however little."""
    return float((before != after).mean())


def shows_nothing(thumbnail: Thumbnail) -> bool:
    """Return whether a picture holds nothing but noise and a smooth shade: black, of one color, saturated, or covered.

    Notes
    -----
    What a scene shows is as strong in a coarse copy as in a fine one, since images of scenes have the same contrast at every
    scale (Field, J. Opt. Soc. Am. A 4, 1987); independent noise falls with the number of cells averaged. Second
    differences leave out the shade of a covered lens. A scene at night has at least one cell that stands out, a lamp.
    """
    coarse = _averaged(thumbnail)
    if min(coarse.shape) < 3:
        return bool(np.ptp(thumbnail) < MIN_STRUCTURE_LEVELS)
    fine_detail, coarse_detail = _second_differences(thumbnail), _second_differences(coarse)
    noise = float((fine_detail**2).mean()) / COARSE_FACTOR**2
    if float((coarse_detail**2).mean()) > max(MAX_NOISE_RATIO * noise, MIN_STRUCTURE_LEVELS**2):
        return False
    size = np.abs(fine_detail)
    sigma = float(np.median(size)) / 0.6745
    return bool(size.max() <= OUTSTANDING_SIGMAS * sigma + MIN_OUTSTANDING_LEVELS)


def _averaged(thumbnail: Thumbnail) -> Thumbnail:
    height, width = (n - n % COARSE_FACTOR for n in thumbnail.shape)
    blocks = thumbnail[:height, :width].reshape(
        height // COARSE_FACTOR, COARSE_FACTOR, width // COARSE_FACTOR, COARSE_FACTOR
    )
    return np.asarray(blocks.mean(axis=(1, 3)))


def _second_differences(thumbnail: Thumbnail) -> Array:
    """Return the Laplacian at the inner cells, scaled to the standard deviation of independent noise."""
    inner = thumbnail[1:-1, 1:-1]
    around = thumbnail[:-2, 1:-1] + thumbnail[2:, 1:-1] + thumbnail[1:-1, :-2] + thumbnail[1:-1, 2:]
    return np.asarray((around - 4 * inner) / np.sqrt(LAPLACIAN_NORM), dtype=np.float64)
