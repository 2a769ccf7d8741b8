"""The height of the ground under a sweep, for slopes and crests, from the lowest points of every cell."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CELL_M = 1.0
REACH_M = 100.0
ROUNDS = 6
# A cell whose lowest point stands higher than this above the smooth surface holds an object, not ground; ditches and
# the falling edge of a slope may lie deeper.
ACCEPT_ABOVE_M = 0.2
ACCEPT_BELOW_M = 0.4
ON_GROUND_M = 0.2


@dataclass(frozen=True, eq=False)
class Ground:
    """Ground heights `z` (K, K) at cell centers of a grid around `center` (2,), all in the frame of the points."""

    center: Array
    z: Array

    def at(self, xy: NDArray[np.floating[Any]]) -> NDArray[np.float32]:
        """Height (N,) under positions (N, 2), bilinear, held constant beyond the grid's edge."""
        k = self.z.shape[0]
        (i, fi), (j, fj) = (self._cell(xy[:, axis], axis) for axis in range(2))
        z, corner = self.z.astype(np.float32).ravel(), i * k + j
        low = z[corner] * (1 - fj) + z[corner + 1] * fj
        high = z[corner + k] * (1 - fj) + z[corner + k + 1] * fj
        return low * (1 - fi) + high * fi

    def _cell(self, values: NDArray[np.floating[Any]], axis: int) -> tuple[NDArray[np.intp], NDArray[np.float32]]:
        """Index (N,) of the cell center below each coordinate (N,), and the share (N,) of the way to the next one."""
        k = self.z.shape[0]
        place = np.clip((values - self.center[axis]) / CELL_M + (k - 1) / 2, 0, k - 1.001)
        i = place.astype(np.intp)
        return i, (place - i).astype(np.float32)


def estimate_ground(xyz: NDArray[np.floating[Any]], center: Array, z_hint: float) -> Ground:
    """Estimate the ground under points (N, 3) within `REACH_M` of `center` (2,), near the height `z_hint` at the center.

    Notes
    -----
    A quadratic surface is fitted to the lowest point of every cell by iteratively reweighted least squares, anchored to
    the road under the ego; what the cells near it still differ by is smoothed and added. Without any point it is flat.
    """
    k = int(2 * REACH_M / CELL_M) + 1
    lowest = _lowest_points(xyz, center, k)
    axis = (np.arange(k) - (k - 1) / 2) * CELL_M
    x, y = np.meshgrid(axis, axis, indexing="ij")
    filled = np.isfinite(lowest)
    surface = np.full((k, k), z_hint)
    if filled.sum() >= 12:
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        surface = terms @ _fit_surface(terms[filled], lowest[filled], np.hypot(x, y)[filled], z_hint)
    lowest = np.where(filled, lowest, 0.0)
    residual = np.where(filled, lowest - surface, 0.0)
    for widened in (2.0, 1.0):
        on_ground = (residual < widened * ACCEPT_ABOVE_M) & (residual > -widened * ACCEPT_BELOW_M)
        weight = (filled & on_ground).astype(np.float64)
        total, blurred = _blur(weight), _blur(weight * residual)
        surface = surface + np.divide(blurred, total, out=np.zeros_like(total), where=total > 1e-6)
        residual = np.where(filled, lowest - surface, 0.0)
    return Ground(np.asarray(center, dtype=np.float64), surface)


def _blur(grid: Array) -> Array:
    """Gaussian mean (K, K) over two cells, and over eight with hardly any weight, for where the near ones are empty."""
    import cv2

    single = grid.astype(np.float32)
    near, far = (cv2.GaussianBlur(single, (8 * s + 1, 8 * s + 1), s, borderType=cv2.BORDER_CONSTANT) for s in (2, 8))
    return np.asarray(near + np.float32(1e-3) * far, dtype=np.float64)


def _lowest_points(xyz: NDArray[np.floating[Any]], center: Array, k: int) -> Array:
    """The second lowest height in every cell (K, K), so that one false return below the road does not count; inf if empty."""
    i, j = (np.floor((xyz[:, axis] - center[axis]) / CELL_M + k / 2).astype(np.int64) for axis in range(2))
    inside = (i >= 0) & (i < k) & (j >= 0) & (j < k)
    flat, z = (i * k + j)[inside], xyz[inside, 2].astype(np.float64)
    lowest = np.full(k * k, np.inf)
    np.minimum.at(lowest, flat, z)
    second = np.full(k * k, np.inf)
    above = z > lowest[flat]
    np.minimum.at(second, flat[above], z[above])
    # Reflections lie clearly below; ground that is merely rough differs by centimeters.
    reflected = np.isfinite(second) & (second > lowest + 0.3)
    return np.where(reflected, second, lowest).reshape(k, k)


def _fit_surface(terms: Array, z: Array, range_m: Array, z_hint: float) -> Array:
    """Coefficients (6,) of the quadratic surface: cells above it count ever less, the road under the ego holds it."""
    anchor = np.zeros((1, 6))
    anchor[0, 0] = 1.0
    nearness = 1.0 / (1.0 + (range_m / 25.0) ** 2)
    tolerance = 0.1 + 0.02 * range_m
    weight = nearness * (np.abs(z - z_hint) < 1.0 + 0.15 * range_m)
    prior = np.diag([0.0, 1.0, 1.0, 3e2, 3e2, 3e2])
    solution = np.array([z_hint, 0, 0, 0, 0, 0.0])
    for _ in range(ROUNDS):
        w = np.append(weight, 0.1 * max(weight.sum(), 1.0))
        a, b = np.vstack([terms, anchor]), np.append(z, z_hint)
        solution = np.linalg.solve((a * w[:, None]).T @ a + prior, (a * w[:, None]).T @ b)
        residual = z - terms @ solution
        scaled = np.where(residual > 0, residual / tolerance, residual / (2 * tolerance))
        weight = nearness / (1 + scaled**2) ** 2
    return solution
