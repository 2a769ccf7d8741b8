"""Ground height under a cloud, on slopes and crests too, from the lowest points of every grid cell."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CELL_M = 1.0
REACH_M = 100.0
ROUNDS = 6
# A cell whose lowest point is higher than this above the smooth surface contains an object; ditches and falling edges of
# slopes may be deeper.
ACCEPT_ABOVE_M = 0.2
ACCEPT_BELOW_M = 0.4
ON_GROUND_M = 0.2


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground heights on a grid.

    Attributes
    ----------
    center : (2,) float64
        m, middle of the grid, in the frame of the points.
    z : (K, K) float64
        m, heights at the cell centers, first axis along x.
    """

    center: Array
    z: Array

    def at(self, xy: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Interpolate the height (N,) under positions (N, 2) bilinearly; constant beyond the grid's edge."""
        k = self.z.shape[0]
        (i, fi), (j, fj) = (self._cell(xy[:, axis], axis) for axis in range(2))
        z, corner = self.z.astype(np.float32).ravel(), i * k + j
        low, high = z.take(corner), z.take(corner + k)
        low += (z.take(corner + 1) - low) * fj
        high += (z.take(corner + k + 1) - high) * fj
        return np.asarray(low + (high - low) * fi)

    def _cell(self, values: NDArray[np.floating[Any]], axis: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Find the cell center below each coordinate (N,): its index (N,) and the fraction (N,) toward the next one."""
        k = self.z.shape[0]
        place = (values - values.dtype.type(self.center[axis])).astype(np.float32)
        place *= np.float32(1 / CELL_M)
        place += np.float32((k - 1) / 2)
        np.clip(place, 0, np.float32(k - 1.001), out=place)
        i = place.astype(np.intp)
        place -= i
        return i, place


def estimate_ground(xyz: NDArray[np.floating[Any]], center: Array, z_hint: float) -> Ground:
    """Estimate the ground under points (N, 3) within `REACH_M` of `center` (2,).

    Parameters
    ----------
    xyz : (N, 3) float, m
    center : (2,) float64, m
        In the frame of the points.
    z_hint : float
        Expected height at the center, m. Without any point the ground is flat at this height.

    Notes
    -----
    A quadratic surface is fitted to the lowest point of every cell by iteratively reweighted least squares, with
    `z_hint` as an anchor; the smoothed residuals of cells near that surface are added.
    """
    k = int(2 * REACH_M / CELL_M) + 1
    lowest = _lowest_points(xyz, center, k)
    terms, range_m = _terms(k)
    filled = np.isfinite(lowest)
    surface = np.full((k, k), z_hint)
    if filled.sum() >= 12:
        surface = terms @ _fit_surface(terms[filled], lowest[filled], range_m[filled], z_hint)
    lowest = np.where(filled, lowest, 0.0)
    residual = np.where(filled, lowest - surface, 0.0)
    for widened in (2.0, 1.0):
        on_ground = (residual < widened * ACCEPT_ABOVE_M) & (residual > -widened * ACCEPT_BELOW_M)
        weight = (filled & on_ground).astype(np.float64)
        total, blurred = _blur(weight), _blur(weight * residual)
        surface = surface + np.divide(blurred, total, out=np.zeros_like(total), where=total > 1e-6)
        residual = np.where(filled, lowest - surface, 0.0)
    return Ground(np.asarray(center, dtype=np.float64), surface)


@lru_cache(maxsize=1)
def _terms(k: int) -> tuple[Array, Array]:
    """Return the terms (K, K, 6) of a quadratic surface at the cells of a grid, and their distance (K, K), m, from its middle."""
    axis = (np.arange(k) - (k - 1) / 2) * CELL_M
    x, y = np.meshgrid(axis, axis, indexing="ij")
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1), np.hypot(x, y)


def _blur(grid: Array) -> Array:
    """Smooth a grid (K, K) by a Gaussian of two cells, plus one of eight cells with weight 1e-3 to fill empty areas."""
    import cv2

    single = grid.astype(np.float32)
    near, far = (cv2.GaussianBlur(single, (8 * s + 1, 8 * s + 1), s, borderType=cv2.BORDER_CONSTANT) for s in (2, 8))
    return np.asarray(near + np.float32(1e-3) * far, dtype=np.float64)


def _lowest_points(xyz: NDArray[np.floating[Any]], center: Array, k: int) -> Array:
    """Find the lowest height in every cell (K, K), without single false returns below the road; inf if empty."""
    kind = xyz.dtype.type
    i, j = ((xyz[:, axis] - kind(center[axis])) * kind(1 / CELL_M) + kind(k / 2) for axis in range(2))
    inside = np.flatnonzero((i >= 0) & (i < k) & (j >= 0) & (j < k))
    flat = i.take(inside).astype(np.int32) * k + j.take(inside).astype(np.int32)
    z = xyz[:, 2].take(inside).astype(np.float64)
    lowest = np.full(k * k, np.inf)
    np.minimum.at(lowest, flat, z)
    second = np.full(k * k, np.inf)
    above = np.flatnonzero(z > lowest.take(flat))
    np.minimum.at(second, flat.take(above), z.take(above))
    # Mirror reflections are decimeters below the road; roughness is centimeters.
    reflected = np.isfinite(second) & (second > lowest + 0.3)
    return np.where(reflected, second, lowest).reshape(k, k)


def _fit_surface(terms: Array, z: Array, range_m: Array, z_hint: float) -> Array:
    """Fit the coefficients (6,) of a quadratic surface robustly; cells above it lose weight twice as fast as those below."""
    nearness = 1.0 / (1.0 + (range_m / 25.0) ** 2)
    tolerance = 0.1 + 0.02 * range_m
    weight = nearness * (np.abs(z - z_hint) < 1.0 + 0.15 * range_m)
    prior = np.diag([0.0, 1.0, 1.0, 3e2, 3e2, 3e2])
    solution = np.array([z_hint, 0, 0, 0, 0, 0.0])
    for _ in range(ROUNDS):
        # The anchor has a tenth of the weight of all cells, and only a constant term.
        anchor = 0.1 * max(float(weight.sum()), 1.0)
        weighted = terms * weight[:, None]
        normal, right = weighted.T @ terms + prior, weighted.T @ z
        normal[0, 0] += anchor
        right[0] += anchor * z_hint
        solution = np.linalg.solve(normal, right)
        residual = z - terms @ solution
        scaled = np.where(residual > 0, residual, residual / 2) / tolerance
        weight = nearness / (1 + scaled**2) ** 2
    return solution
