"""The ground under a rig: one plane by RANSAC over the correspondences of all cameras and ticks, and its tilt at each tick.

A ray of a calibrated camera passes over the ground position that it shows at a height, which is linear in the plane. So
correspondences of different cameras serve one hypothesis, three determine it, and all of them judge it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# 99 % quantile of chi-squared with 1 degree of freedom, at which the bounded loss is cut.
CHI2_1DOF_99 = 6.63
SAMPLES, JUDGED_BY_ALL, FIRST_ROWS = 400, 12, 500
# Of three positions: twice the area of their triangle, m2.
MIN_TRIANGLE_M2 = 10.0
# Steeper than any road (the steepest streets have a third).
MAX_SLOPE = 0.5
REFINEMENTS = 6
TILT_ROUNDS = 4
# Tilt of a body on its springs against the road, before it is estimated: about a degree at most.
TILT_SIGMA = 0.01


@dataclass(frozen=True, eq=False)
class HeightRows:
    """Heights of the ground at positions, by all cameras and ticks.

    Attributes
    ----------
    xy1 : (N, 3) float64
        Positions, m, rig frame, homogeneous.
    height, sigma : (N,) float64
        Heights and their standard deviations, m.
    tick : (N,) int64
        Ascending.
    """

    xy1: Array
    height: Array
    sigma: Array
    tick: NDArray[np.int64]

    def losses(self, planes: Array) -> Array:
        """Compute the bounded losses (K,) of planes (K, 3)."""
        squared = ((planes @ self.xy1.T - self.height) / self.sigma) ** 2
        return np.asarray(np.minimum(squared, CHI2_1DOF_99).mean(axis=1))

    def inlier_share(self, plane: Array) -> float:
        """Compute the share of rows that agree with a plane (3,)."""
        return float(np.mean(((self.xy1 @ plane - self.height) / self.sigma) ** 2 < CHI2_1DOF_99))

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> HeightRows:
        """Select rows."""
        return HeightRows(self.xy1[index], self.height[index], self.sigma[index], self.tick[index])


def find_plane(rows: HeightRows, rng: np.random.Generator, samples: int = SAMPLES) -> Array | None:
    """Find the plane (3,) that most rows agree with; None where no three rows span one.

    Notes
    -----
    As for a single camera, one half of the samples come from single ticks and one half from all, and hypotheses are judged
    over all cameras and ticks by a bounded loss (MSAC, Torr & Zisserman, 2000); then least squares over what agrees.
    """
    planes = _hypotheses(rows, rng, samples)
    if len(planes) == 0:
        return None
    if len(rows.tick) > 2 * FIRST_ROWS and len(planes) > JUDGED_BY_ALL:
        some = rows.take(np.sort(rng.permutation(len(rows.tick))[:FIRST_ROWS]))
        planes = planes[np.argsort(some.losses(planes), kind="stable")[:JUDGED_BY_ALL]]
    plane = planes[int(np.argmin(rows.losses(planes)))]
    for _ in range(REFINEMENTS):
        residual = (rows.height - rows.xy1 @ plane) / rows.sigma
        use = residual**2 < CHI2_1DOF_99
        weighted = rows.xy1[use] / rows.sigma[use, None]
        normal = weighted.T @ weighted
        if use.sum() < 3 or np.linalg.matrix_rank(normal) < 3:
            return None
        step = np.linalg.solve(normal, weighted.T @ residual[use])
        plane = plane + step
        if np.abs(step).max() < 1e-7:
            break
    return np.asarray(plane)


def _hypotheses(rows: HeightRows, rng: np.random.Generator, samples: int) -> Array:
    """Draw planes (K, 3) through three rows each, half of them from single ticks."""
    count, half = len(rows.tick), samples // 2
    if count < 3:
        return np.zeros((0, 3))
    start = np.searchsorted(rows.tick, rows.tick)
    end = np.searchsorted(rows.tick, rows.tick, side="right")
    drawn = rng.integers(count, size=half)
    of_tick = start[drawn] + (rng.random((3, half)) * (end - start)[drawn]).astype(np.int64)
    three = np.concatenate([of_tick, rng.integers(count, size=(3, samples - half))], axis=1).T
    matrices = rows.xy1[three]
    spread = np.abs(np.linalg.det(matrices)) > MIN_TRIANGLE_M2
    planes = np.linalg.solve(matrices[spread], rows.height[three[spread], None])[:, :, 0]
    return np.asarray(planes[np.hypot(planes[:, 0], planes[:, 1]) < MAX_SLOPE])


def tilt_of_ticks(rows: HeightRows, plane: Array) -> tuple[NDArray[np.int64], Array]:
    """Estimate the slopes of each tick's ground against the plane: ticks (T,), and slopes (T, 2).

    Notes
    -----
    The slopes have a zero-mean normal prior whose standard deviations are estimated from all ticks (empirical Bayes), so that a
    tick with few rows keeps the plane of all.
    """
    ticks, start = np.unique(rows.tick, return_index=True)
    number = np.searchsorted(ticks, rows.tick)
    sigma, tilt = np.full(2, TILT_SIGMA), np.zeros((len(ticks), 2))
    for _ in range(TILT_ROUNDS):
        residual = rows.height - rows.xy1 @ plane
        left = residual - (rows.xy1[:, :2] * tilt[number]).sum(axis=1)
        # A tilted tick is off as a whole: rows are judged against the middle of their tick's own noise.
        weight = ((left / rows.sigma) ** 2 < CHI2_1DOF_99) / rows.sigma**2
        x, y = rows.xy1[:, 0], rows.xy1[:, 1]
        sums = [np.add.reduceat(weight * v, start) for v in (x * x, x * y, y * y, x * residual, y * residual)]
        normal = np.stack([sums[0] + sigma[0] ** -2, sums[1], sums[1], sums[2] + sigma[1] ** -2], axis=-1)
        normal = normal.reshape(-1, 2, 2)
        tilt = np.linalg.solve(normal, np.stack(sums[3:], axis=-1)[:, :, None])[:, :, 0]
        variance = np.diagonal(np.linalg.inv(normal), axis1=1, axis2=2)
        sigma = np.sqrt(np.maximum((tilt**2 + variance).mean(axis=0), sigma**2 / 25))
    return ticks, tilt
