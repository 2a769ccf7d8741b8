"""Registration of two patches of the ground: how far the picture of one lies from that of the other."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Structure coarser than this is shading, m. Structure finer than this is smoothed: a pixel of a camera of 1000 px focal length,
# 1.6 m above the road, covers 0.14 m along the line of sight 15 m away, and cameras of other focal lengths show it less sharp.
SHADING_M, BLUR_M = 0.5, 0.12
# Patches that lie farther apart than this are not compared.
MAX_OFFSET_M = 1.5
# Correlation of the registered patches. At its best offset, ground of other kinds of texture (waves, edges, noise) than that of
# the first patch has less than 0.7 in 99 of 100 cases, the same ground has more than 0.9 in 19 of 20.
MIN_CORRELATION = 0.8
# A second place at which patches fit nearly as well makes the first one ambiguous, as along an edge or a crosswalk.
MAX_SECOND_SHARE, SECOND_PEAK_M = 0.9, 0.3
ROUNDS = 8
# Share of the cells that have to be seen in both patches.
MIN_COMMON_SHARE = 0.5
# Errors of neighboring cells are correlated over the blur, so a patch says less than its number of cells, by this factor.
CORRELATION_FACTOR = 4 * np.pi

Gray = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Offset:
    """How far the picture of a second patch lies from that of a first.

    Attributes
    ----------
    offset_m : (2,) float64
        Along the rows and along the columns of the patches, m.
    covariance : (2, 2) float64
        m2.
    correlation : float
        Of the patches after the offset is undone.
    """

    offset_m: Array
    covariance: Array
    correlation: float


def register_patches(first: Gray, second: Gray, cell_m: float) -> Offset | None:
    """Find the offset of the picture in a second patch (R, C) from that in a first; NaN marks cells that are not seen.

    None where too little is seen in both, where patches do not resemble each other, or do so at several offsets.

    Notes
    -----
    Cross-correlation of band-passed patches finds the offset to a cell, Gauss-Newton on their difference (Lucas & Kanade, 1981)
    refines it. The spectrum is not whitened as in phase correlation: far from a camera it holds no fine structure.
    """
    seen = np.isfinite(first) & np.isfinite(second)
    if seen.mean() < MIN_COMMON_SHARE:
        return None
    a, b = (_band_pass(patch, cell_m) for patch in (first, second))
    window = _window(seen, cell_m)
    start = _coarse_offset(a * window, b * window, cell_m)
    return None if start is None else _refine(a, b, window, start, cell_m)


def _band_pass(patch: Gray, cell_m: float) -> Gray:
    known = np.isfinite(patch).astype(np.float32)
    filled = np.where(known > 0, patch, 0.0).astype(np.float32)

    def smooth(sigma_m: float) -> Gray:
        sigma = max(sigma_m / cell_m, 0.3)
        weight = cv2.GaussianBlur(known, (0, 0), sigma, borderType=cv2.BORDER_ISOLATED)
        return np.asarray(
            cv2.GaussianBlur(filled, (0, 0), sigma, borderType=cv2.BORDER_ISOLATED) / np.maximum(weight, 1e-3)
        )

    return np.asarray(smooth(BLUR_M) - smooth(SHADING_M), dtype=np.float32)


def _window(seen: NDArray[np.bool_], cell_m: float) -> Gray:
    """Weigh cells by their distance from the border of what is seen in both patches."""
    padded = cv2.copyMakeBorder(seen.astype(np.uint8), 1, 1, 1, 1, cv2.BORDER_CONSTANT, value=0)
    inside = cv2.distanceTransform(padded, cv2.DIST_L2, 3)[1:-1, 1:-1] * cell_m
    return np.asarray(np.clip(inside / SHADING_M, 0.0, 1.0), dtype=np.float32)


def _coarse_offset(a: Gray, b: Gray, cell_m: float) -> Array | None:
    """Find the offset (2,), cells, of the largest cross-correlation; None where it is not the only one."""
    rows, columns = (cv2.getOptimalDFTSize(2 * n) for n in a.shape)
    spectrum = np.fft.rfft2(b, (rows, columns)) * np.conj(np.fft.rfft2(a, (rows, columns)))
    surface = np.fft.irfft2(spectrum, (rows, columns))
    reach = [min(int(MAX_OFFSET_M / cell_m), n // 2) for n in a.shape]
    near = np.roll(surface, reach, axis=(0, 1))[: 2 * reach[0] + 1, : 2 * reach[1] + 1]
    row, column = np.unravel_index(int(np.argmax(near)), near.shape)
    peak = near[row, column]
    apart = int(SECOND_PEAK_M / cell_m)
    others = near.copy()
    others[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    if not peak > 0 or others.max() > MAX_SECOND_SHARE * peak:
        return None
    return np.array([row - reach[0], column - reach[1]], dtype=np.float64)


def _refine(a: Gray, b: Gray, window: Gray, start: Array, cell_m: float) -> Offset | None:
    offset, gain = start.copy(), 1.0
    normal, variance, correlation = np.zeros((2, 2)), np.inf, 0.0
    for _ in range(ROUNDS):
        shift = np.array([[1, 0, offset[1]], [0, 1, offset[0]]], dtype=np.float32)
        size = (a.shape[1], a.shape[0])
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        moved = cv2.warpAffine(b, shift, size, flags=flags)
        weight = cv2.warpAffine(window, shift, size, flags=flags) * window
        if weight.sum() < MIN_COMMON_SHARE * window.sum():
            return None
        total = float(weight.sum())
        am, bm = (x - float((weight * x).sum()) / total for x in (a, moved))
        energy = float((weight * am * am).sum()), float((weight * bm * bm).sum())
        if min(energy) <= 0:
            return None
        correlation = float((weight * am * bm).sum()) / np.sqrt(energy[0] * energy[1])
        gain = np.sqrt(energy[0] / energy[1])
        gradient = np.stack(np.gradient(gain * bm))
        difference = am - gain * bm
        normal = np.einsum("irc,jrc,rc->ij", gradient, gradient, weight)
        if np.linalg.cond(normal) > 1e4:
            return None
        step = np.linalg.solve(normal, np.einsum("irc,rc,rc->i", gradient, difference, weight))
        variance = float((weight * difference**2).sum()) / total
        offset += step
        if np.abs(step).max() < 1e-3:
            break
    if correlation < MIN_CORRELATION or np.abs(offset - start).max() > SECOND_PEAK_M / cell_m:
        return None
    cells = CORRELATION_FACTOR * (BLUR_M / cell_m) ** 2
    covariance = variance * max(cells, 1.0) * np.linalg.inv(normal) * cell_m**2
    return Offset(offset * cell_m, np.asarray(covariance, dtype=np.float64), correlation)
