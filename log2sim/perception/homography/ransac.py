"""RANSAC with local optimization: one homography that most correspondences of a stream agree with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from log2sim.geometry import Array
from log2sim.perception.homography.hypotheses import best_hypotheses, draw_samples, solve_samples
from log2sim.perception.homography.normalized import (
    CHI2_2DOF_99,
    NormalizedCorrespondences,
    bounded_losses,
    squared_errors,
)
from log2sim.perception.homography.planar_pose import nearest_poses
from log2sim.perception.homography.refine import (
    Linearization,
    linearize,
    newton_step,
    noise_factors,
    refine,
    refine_many,
)


class RansacRound(NamedTuple):
    """One round of drawing, scoring and local optimization.

    Attributes
    ----------
    samples : int
        Samples of four correspondences to draw.
    scored : int
        How many of them are solved and scored.
    min_inlier_share : float
        Share of inliers below which the next round of a schedule runs.
    """

    samples: int
    scored: int
    min_inlier_share: float


RansacSchedule = tuple[RansacRound, ...]
RANSAC_SCHEDULE: RansacSchedule = (RansacRound(500, 64, 0.35), RansacRound(3000, 256, 0.0))
RANSAC_SCHEDULE_OF_A_FRAME: RansacSchedule = (RansacRound(120, 48, 0.5), RansacRound(500, 96, 0.0))
# Local optimization of the best hypotheses, on some rows, with gates that narrow from step to step.
OPTIMIZED_HYPOTHESES, OPTIMIZED_POSES = 3, 2
OPTIMIZATION_ROWS = 160
OPTIMIZATION_GATES = (4 * CHI2_2DOF_99, 1.5 * CHI2_2DOF_99)
# The pose nearest to a homography misses what the homography fits, most of all with few correspondences.
POSE_GATES = (100 * CHI2_2DOF_99, 16 * CHI2_2DOF_99, 4 * CHI2_2DOF_99, CHI2_2DOF_99)
# Rows beyond this squared error cannot become inliers in the final refinement.
REFINEMENT_GATE = 8 * CHI2_2DOF_99
NOISE_ROUNDS, FINAL_ROUNDS = 1, 2


@dataclass(frozen=True, eq=False)
class RobustFit:
    """A homography estimated from correspondences with outliers, in normalized units.

    Attributes
    ----------
    h : (3, 3) float64 or None
        Ground to image; None where no four correspondences determine a homography.
    data : NormalizedCorrespondences
        All correspondences, with the noise as estimated.
    linear : Linearization or None
        Errors of `h` on them.
    warps : (N, 3, 3) float64 or None
        Image homography of each correspondence's tick on top of `h`, see `pitch_roll`.
    effective_parameters : float
        Effective number of parameters of `warps`.
    """

    h: Array | None
    data: NormalizedCorrespondences
    linear: Linearization | None = None
    warps: Array | None = None
    effective_parameters: float = 0.0


def ransac(
    data: NormalizedCorrespondences,
    rng: np.random.Generator,
    *,
    pitch_sigma: float = 0.0,
    image_K: Array | None = None,
    schedule: RansacSchedule = RANSAC_SCHEDULE,
) -> RobustFit:
    """Estimate the homography of least bounded loss from samples of single ticks and of all ticks.

    Parameters
    ----------
    data : NormalizedCorrespondences
    rng : numpy.random.Generator
    pitch_sigma : float
        Standard deviation of an image shift along v that differs from tick to tick, normalized units. With it the
        result is not refined, which is left to the fit of pitch and roll.
    image_K : (3, 3) float64 or None
        Normalized intrinsics; with them the result is a pose of that camera.
    schedule : tuple of RansacRound

    Notes
    -----
    LO-RANSAC (Chum, Matas & Kittler, 2003) with the bounded loss of MSAC (Torr & Zisserman, 2000).
    """
    candidates = np.zeros((0, 3, 3))
    for samples, scored, min_inlier_share in schedule:
        rows = np.concatenate(
            [draw_samples(data, rng, samples // 2, across_ticks=across) for across in (False, True)], axis=1
        )
        hypotheses = solve_samples(data, rows, scored)
        if len(hypotheses):
            hypotheses = best_hypotheses(data, hypotheses, rng, pitch_sigma, OPTIMIZED_HYPOTHESES)
            optimized = _optimize_locally(data, hypotheses, rng, pitch_sigma, image_K)
            candidates = np.concatenate([candidates, optimized])
        if len(candidates):
            squared = squared_errors(data, candidates, pitch_sigma)
            best = int(np.argmin(np.minimum(squared, CHI2_2DOF_99).sum(axis=1)))
            candidates = candidates[[best]]
            if np.count_nonzero(squared[best] < CHI2_2DOF_99) > min_inlier_share * squared.shape[1]:
                break
    if len(candidates) == 0:
        return RobustFit(None, data)
    return RobustFit(candidates[0], data) if pitch_sigma else refine_with_noise(data, candidates[0], image_K)


def _optimize_locally(
    data: NormalizedCorrespondences, h: Array, rng: np.random.Generator, pitch_sigma: float, image_K: Array | None
) -> Array:
    """Take a few Gauss-Newton steps of hypotheses (K, 3, 3) on some of the rows."""
    rows = data.image.shape[1]
    part = data if rows <= 2 * OPTIMIZATION_ROWS else data.take(np.sort(rng.permutation(rows)[:OPTIMIZATION_ROWS]))
    part = replace(part, sigma_image=float(np.hypot(part.sigma_image, pitch_sigma)))
    h = refine_many(part, h, OPTIMIZATION_GATES)
    if image_K is None:
        return h
    poses = nearest_poses(image_K, h[np.argsort(bounded_losses(part, h), kind="stable")[:OPTIMIZED_POSES]])
    poses = poses[np.isfinite(poses).all(axis=(1, 2))]
    for gate in POSE_GATES if len(poses) else ():
        linear = linearize(part, poses)
        poses = np.array([newton_step(linear, pose, image_K, gate, k) for k, pose in enumerate(poses)])
    return poses


def refine_with_noise(data: NormalizedCorrespondences, h: Array, image_K: Array | None) -> RobustFit:
    """Refine `h` (3, 3) over all inliers, and estimate the noise from their errors."""
    # Leaving far outliers out saves half of the time where there are many.
    near = np.flatnonzero(squared_errors(data, h[None])[0] < REFINEMENT_GATE)
    if len(near) < 4:
        return RobustFit(h, data, linearize(data, h[None]))
    part, parameters = data.take(near), 8 if image_K is None else 6
    for _ in range(NOISE_ROUNDS):
        linear = linearize(part, h[None])
        h = newton_step(linear, h, image_K)
        part = part.with_noise(*noise_factors(part, linear, parameters))
    h = refine(part, h, FINAL_ROUNDS, image_K)
    data = replace(data, sigma_image=part.sigma_image, sigma_ground=part.sigma_ground)
    return RobustFit(h, data, linearize(data, h[None]))
