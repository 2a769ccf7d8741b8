"""RANSAC with local optimization: one homography that most correspondences of a stream agree with."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import CHI2_2DOF_99, Array
from log2sim.perception.homography.normalized import (
    Linearization,
    NormalizedCorrespondences,
    bounded_losses,
    linearize,
    nearest_poses,
    newton_step,
    noise_factors,
    refine,
    refine_many,
    squared_errors,
)

# No three of four points may be collinear: twice the area of their smallest triangle, for data of spread 1.
MIN_TRIANGLE_AREA = 1e-7
# Rows that all hypotheses are scored on before the better ones are scored on all rows.
PRESCORE_ROWS = 80
# A homography through four noisy points misses the other points by more than the noise, so hypotheses are scored with
# standard deviations this much larger.
MINIMAL_SAMPLE_SIGMA_SCALE = 2.0


def draw_samples(
    data: NormalizedCorrespondences, rng: np.random.Generator, count: int, *, across_ticks: bool
) -> NDArray[np.int64]:
    """Draw rows (4, count), each sample from one tick or, with `across_ticks`, from all; rows may repeat."""
    rows, chance = data.image.shape[1], rng.random((4, count))
    if across_ticks:
        return np.asarray((chance * rows).astype(np.int64))
    # Larger ticks hold more samples of four, so a tick is drawn in proportion to its size.
    which = data.tick[(rng.random(count) * rows).astype(np.int64)]
    return np.asarray(data.start[which] + (chance * data.count[which]).astype(np.int64))


def solve_samples(data: NormalizedCorrespondences, rows: NDArray[np.int64], max_hypotheses: int) -> Array:
    """Solve for homographies (K, 3, 3), ground to image, through four correspondences each (4, count).

    Samples with three collinear points and samples with a point behind the camera are left out. Of the rest the
    `max_hypotheses` samples of the largest spread are kept.

    Notes
    -----
    Three points are a basis in which the fourth has coordinates that are areas of triangles, so the homography between
    two such bases needs no decomposition (Hartley & Zisserman, Multiple View Geometry, 2004, section 2.3).
    """
    in_image, on_ground = _triangle_areas(data.image[:, rows]), _triangle_areas(data.ground[:2, rows])
    min_image, min_ground = (np.abs(a).min(axis=0) for a in (in_image, on_ground))
    # The depths of the four points have one sign if the signs of the areas agree, or disagree, for all triangles.
    agree = (in_image * on_ground > 0).sum(axis=0)
    spread = min_image * min_ground
    one_side = (agree == 0) | (agree == 4)
    usable = np.flatnonzero(one_side & (min_image > MIN_TRIANGLE_AREA) & (min_ground > MIN_TRIANGLE_AREA))
    if len(usable) > max_hypotheses:
        usable = usable[np.argpartition(-spread[usable], max_hypotheses)[:max_hypotheses]]
    depth = np.abs(in_image[:3, usable] / on_ground[:3, usable]) * np.sign(on_ground[3, usable])
    columns = np.empty((len(usable), 3, 3))
    columns[:, :2] = (data.image[:, rows[:3, usable]] * depth).transpose(2, 0, 1)
    columns[:, 2] = depth.T
    ground, adjugate = data.ground[:2, rows[:3, usable]], np.empty((len(usable), 3, 3))
    for k in range(3):
        (ax, bx), (ay, by) = ground[:, [(k + 1) % 3, (k + 2) % 3]]
        adjugate[:, k, 0], adjugate[:, k, 1], adjugate[:, k, 2] = ay - by, bx - ax, ax * by - ay * bx
    return np.asarray(columns @ adjugate, dtype=np.float64)


def _triangle_areas(points: Array) -> Array:
    """Compute twice the signed areas (4, count) of the triangles of points (2, 4, count).

    In rows 0 to 2 the fourth point replaces one of the first three; row 3 is the triangle of the first three.
    """
    ax, bx, cx = points[0, 1:] - points[0, 0]
    ay, by, cy = points[1, 1:] - points[1, 0]
    ab, ac, bc = ax * by - ay * bx, ax * cy - ay * cx, bx * cy - by * cx
    return np.stack([ab - ac + bc, -bc, ac, ab])


class RansacRound(NamedTuple):
    """One round of drawing, scoring and local optimization."""

    samples: int  # samples of four correspondences to draw
    scored: int  # how many of them are solved and scored
    min_inlier_share: float  # share of inliers below which the next round of a schedule runs


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
    """A homography estimated from correspondences with outliers, in normalized units."""

    h: Array | None  # (3, 3): ground to image; None where no four correspondences determine a homography
    data: NormalizedCorrespondences  # all correspondences, with the noise as estimated
    linear: Linearization | None = None  # errors of `h` on them
    # (N, 3, 3): image homography of each correspondence's tick on top of `h`, see `pitch_roll`
    warps: Array | None = None
    effective_parameters: float = 0.0  # effective number of parameters of `warps`


def ransac(
    data: NormalizedCorrespondences,
    rng: np.random.Generator,
    *,
    pitch_sigma: float = 0.0,
    image_K: Array | None = None,
    schedule: RansacSchedule = RANSAC_SCHEDULE,
) -> RobustFit:
    """Estimate the homography of least bounded loss from samples of single ticks and of all ticks.

    `pitch_sigma`: standard deviation of an image shift along v that differs from tick to tick, normalized units. With it
    the result is not refined, which is left to the fit of pitch and roll. `image_K`: (3, 3): normalized intrinsics; with
    them the result is a pose of that camera.

    Notes
    -----
    LO-RANSAC (Chum, Matas & Kittler, 2003) with the bounded loss of MSAC (Torr & Zisserman, 2000).
    """
    candidates, count = np.zeros((0, 3, 3)), data.image.shape[1]
    for samples, scored, min_inlier_share in schedule:
        rows = np.concatenate(
            [draw_samples(data, rng, samples // 2, across_ticks=across) for across in (False, True)], axis=1
        )
        h = solve_samples(data, rows, scored)
        if len(h):
            # Only the best on some rows are scored on all.
            if count > 2 * PRESCORE_ROWS and len(h) > 2 * OPTIMIZED_HYPOTHESES:
                some = data.coarse(np.sort(rng.permutation(count)[:PRESCORE_ROWS]), MINIMAL_SAMPLE_SIGMA_SCALE)
                h = h[np.argsort(bounded_losses(some, h, pitch_sigma), kind="stable")[: 2 * OPTIMIZED_HYPOTHESES]]
            loss = bounded_losses(data.coarse(slice(None), MINIMAL_SAMPLE_SIGMA_SCALE), h, pitch_sigma)
            h = h[np.argsort(loss, kind="stable")[:OPTIMIZED_HYPOTHESES]]
            # A few Gauss-Newton steps on some of the rows.
            few = count <= 2 * OPTIMIZATION_ROWS
            part = data if few else data.take(np.sort(rng.permutation(count)[:OPTIMIZATION_ROWS]))
            part = replace(part, sigma_image=float(np.hypot(part.sigma_image, pitch_sigma)))
            h = refine_many(part, h, OPTIMIZATION_GATES)
            if image_K is not None:
                h = nearest_poses(image_K, h[np.argsort(bounded_losses(part, h), kind="stable")[:OPTIMIZED_POSES]])
                h = h[np.isfinite(h).all(axis=(1, 2))]
                for gate in POSE_GATES if len(h) else ():
                    linear = linearize(part, h)
                    h = np.array([newton_step(linear, pose, image_K, gate, k) for k, pose in enumerate(h)])
            candidates = np.concatenate([candidates, h])
        if len(candidates):
            squared = squared_errors(data, candidates, pitch_sigma)
            best = int(np.argmin(np.minimum(squared, CHI2_2DOF_99).sum(axis=1)))
            candidates = candidates[[best]]
            if np.count_nonzero(squared[best] < CHI2_2DOF_99) > min_inlier_share * squared.shape[1]:
                break
    if len(candidates) == 0:
        return RobustFit(None, data)
    best_h: Array = candidates[0]
    if pitch_sigma:
        return RobustFit(best_h, data)
    # Refined over all inliers, whose errors tell the noise. Leaving far outliers out saves half of the time where there are many.
    near = np.flatnonzero(squared_errors(data, best_h[None])[0] < REFINEMENT_GATE)
    if len(near) >= 4:
        part, parameters = data.take(near), 8 if image_K is None else 6
        for _ in range(NOISE_ROUNDS):
            linear = linearize(part, best_h[None])
            best_h = newton_step(linear, best_h, image_K)
            part = part.scale_noise(*noise_factors(part, linear, parameters))
        best_h = refine(part, best_h, FINAL_ROUNDS, image_K)
        data = replace(data, sigma_image=part.sigma_image, sigma_ground=part.sigma_ground)
    return RobustFit(best_h, data, linearize(data, best_h[None]))
