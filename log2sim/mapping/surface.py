"""The height of the ground on a raster: the lowest smooth surface of LiDAR points, filled between and around them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.geometry import Array
from log2sim.mapping.ground_points import GroundPoints
from log2sim.mapping.raster import Raster

ROUNDS = 5
# Noise of LiDAR ranges is 2 to 3 cm: points this far above the surface of their cell lie on something else ...
ABOVE_M = 0.05
# ... and this far below it are reflections, or the street beside the edge of a curb within the cell.
BELOW_M = 0.12
# Points at this range weigh half: their height errs with the pitch of the ego, 0.1 degrees or 3 cm there.
HALF_WEIGHT_RANGE_M = 15.0
# Points of a cell count as one of this many at most, so that a standing ego does not outweigh the neighbors.
FULL_WEIGHT = 4.0
# Ground this far from any point is not known but filled.
MAX_FILLED_M = 1.0
# What the path of the ego says of the ground beside it is smoothed over this long.
PATH_CELL_M, PATH_SMOOTHING_CELLS = 2.0, 1.5
# Ahead of the path its grade goes on, as it was over this long, for as far as cameras see the ground finely.
GRADE_BASE_M, EXTENSION_M = 5.0, 30
# Rings of a LiDAR are up to about a meter apart where pictures are still fine.
WARP_SMOOTHING_M = 0.6
UNKNOWN_WEIGHT = np.float32(0.05)


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of the ground.

    Attributes
    ----------
    raster : Raster
    z_m : (R, C) float32, m
        Above the height of reference, everywhere.
    known : (R, C) bool
        Where points are near.
    """

    raster: Raster
    z_m: NDArray[np.float32]
    known: NDArray[np.bool_]

    def smoothed(self) -> Surface:
        """Return the surface that pictures are laid on: cells of half the resolution, smoothed over `WARP_SMOOTHING_M`.

        Notes
        -----
        At a distance of ten times its height a camera moves what it shows by ten times an error of the height: the noise of
        single rings would bend straight lines.
        """
        coarse = self.raster.coarser(2)
        rows, columns = coarse.shape
        padding = ((0, 2 * rows - self.z_m.shape[0]), (0, 2 * columns - self.z_m.shape[1]))
        z, known = (np.pad(a, padding, mode="edge").astype(np.float32) for a in (self.z_m, self.known))
        trust = np.maximum(known, UNKNOWN_WEIGHT)
        weight, heavy = (cv2.resize(a, (columns, rows), interpolation=cv2.INTER_AREA) for a in (trust, trust * z))
        spread = WARP_SMOOTHING_M / coarse.resolution_m
        total, sums = (cv2.GaussianBlur(a, (0, 0), spread, borderType=cv2.BORDER_REPLICATE) for a in (weight, heavy))
        return Surface(coarse, np.asarray(sums / total, np.float32), np.asarray(weight > 0.5))


def estimate_surface(points: GroundPoints, raster: Raster, path: Array, z0_m: float) -> Surface:
    """Estimate the ground of a raster.

    Parameters
    ----------
    points : GroundPoints
    raster : Raster
    path : (K, 3) float64, m
        Places on the ground, map frame, which say how high it is where there are no points.
    z0_m : float
        Height of reference, m.
    """
    base = _base_of(path, raster, z0_m)
    cell = cells_of_points(points, raster)
    rest = points.z - base.ravel()[cell]
    near = 1 / (1 + (points.range_m / HALF_WEIGHT_RANGE_M) ** 2)
    sums = _trimmed_means(cell, rest, near.astype(np.float32), raster.shape[0] * raster.shape[1])
    raw_weight, raw_middle = (a.reshape(raster.shape).astype(np.float32) for a in sums)
    weight, middle = _smooth(np.minimum(raw_weight, FULL_WEIGHT), raw_middle)
    measured = weight > 0.05
    filled = fill(np.where(measured, middle, 0), measured.astype(np.float32))
    distance = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, 3)
    return Surface(raster, base + filled, distance * raster.resolution_m <= MAX_FILLED_M)


def cells_of_points(points: GroundPoints, raster: Raster) -> NDArray[np.int64]:
    """Return the number of the cell (N,) of points; the raster has the north-west corner of that of the points."""
    column, row = (
        (points.xy[:, k] / np.float32(raster.resolution_m)).astype(np.int32).clip(0, raster.shape[1 - k] - 1)
        for k in range(2)
    )
    cell = np.multiply(row, raster.shape[1], dtype=np.int64)
    cell += column
    return np.asarray(cell, dtype=np.int64)


def _trimmed_means(
    cell: NDArray[np.int64], z: NDArray[np.float32], near: NDArray[np.float32], count: int
) -> tuple[Array, Array]:
    """Means (count,) of the lowest heights that agree, and their weights, 0 where there are none.

    Notes
    -----
    From the mean of a cell down: in each round points too far above the last mean are left out, so that it sinks through grass
    and tires until it rests on points that are all within the noise.
    """
    heavy = near * z
    weight, mean = _means(cell, heavy, near, count)
    for k in range(ROUNDS):
        wide = 2.0 ** max(ROUNDS - 2 - k, 0)
        off = z - mean.astype(np.float32)[cell]
        kept = (off < wide * ABOVE_M) & (off > -wide * BELOW_M)
        weight, mean = _means(cell[kept], heavy[kept], near[kept], count)
    return weight, mean


def _means(
    cell: NDArray[np.int64], heavy: NDArray[np.float32], near: NDArray[np.float32], count: int
) -> tuple[Array, Array]:
    """Means (count,) of heights, of which `heavy` (N,) are the products with the weights `near` (N,)."""
    weight: Array = np.bincount(cell, near, count).astype(np.float64, copy=False)
    total: Array = np.bincount(cell, heavy, count).astype(np.float64, copy=False)
    return weight, np.divide(total, weight, out=np.zeros(count), where=weight > 0)


def _smooth(weight: NDArray[np.float32], z: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Smooth heights (R, C) by a Gaussian of one cell with their weights."""
    total, sums = (np.asarray(cv2.GaussianBlur(a, (5, 5), 1.0), np.float32) for a in (weight, weight * z))
    return total, np.divide(sums, total, out=np.zeros_like(sums), where=total > 0)


def fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill cells (R, C) without weight from those around them, smoothly; zeros where nothing has any.

    Notes
    -----
    Pull and push over a pyramid, Gortler et al., The Lumigraph (1996), section 3.4.2.
    """
    if min(values.shape) < 2:
        known = weight > 0
        mean = float(values[known].mean()) if known.any() else 0.0
        return np.where(known, values, np.float32(mean)).astype(np.float32)
    half = (-(-values.shape[1] // 2), -(-values.shape[0] // 2))
    low_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    low_sum = cv2.resize(weight * values, half, interpolation=cv2.INTER_AREA)
    low = np.divide(low_sum, low_weight, out=np.zeros_like(low_sum), where=low_weight > 0)
    below = fill(low, np.minimum(4 * low_weight, 1))
    around = cv2.resize(below, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    own = np.minimum(weight, 1)
    return np.asarray(own * values + (1 - own) * around, dtype=np.float32)


def _base_of(path: Array, raster: Raster, z0_m: float) -> NDArray[np.float32]:
    """Height (R, C) of the nearest places of a path, smoothed, above the height of reference; 0 without a path."""
    if not len(path):
        return np.zeros(raster.shape, dtype=np.float32)
    coarse = raster.coarser(max(round(PATH_CELL_M / raster.resolution_m), 1))
    rows, columns = np.mgrid[: coarse.shape[0], : coarse.shape[1]]
    path = _extended(path)
    _, nearest = cKDTree(path[:, :2]).query(coarse.xy_of(rows, columns).reshape(-1, 2))
    z = (path[nearest, 2] - z0_m).reshape(coarse.shape).astype(np.float32)
    z = cv2.GaussianBlur(z, (0, 0), PATH_SMOOTHING_CELLS, borderType=cv2.BORDER_REPLICATE)
    return upsample(z, round(coarse.resolution_m / raster.resolution_m), raster.shape)


def _extended(path: Array) -> Array:
    """Extend a path (K, 3) straight on at both ends, by `EXTENSION_M` with the grade of its last meters."""
    parts = [path]
    for end, inner in ((path[0], path), (path[-1], path[::-1])):
        far = np.hypot(*(inner[:, :2] - end[:2]).T) >= GRADE_BASE_M
        if far.any():
            step = (end - inner[int(np.argmax(far))]) / GRADE_BASE_M
            parts.append(end + np.arange(1, EXTENSION_M + 1)[:, None] * step)
    return np.concatenate(parts)


def upsample(values: NDArray[np.float32], factor: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Interpolate a coarse raster (r, c) or (r, c, K) bilinearly onto one with `factor` cells for each of its cells, along both axes."""
    scale, shift = 1 / factor, (0.5 / factor) - 0.5
    matrix = np.array([[scale, 0, shift], [0, scale, shift]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    warped = cv2.warpAffine(values, matrix, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(warped, dtype=np.float32)
