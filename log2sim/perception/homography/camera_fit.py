"""Choice of the correspondences that a camera's homography is fitted to: obstacles first, then LiDAR ground points."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.geometry import Array
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.estimate import STREAM_METHODS, EstimationOptions, estimate_homography
from log2sim.perception.homography.fit import HomographyFit, PitchRoll, refused_fit
from log2sim.perception.homography.stabilization import (
    MIN_SIGNIFICANCE_SIGMA,
    HeldOutErrors,
    angle_sigmas_deg,
    held_out_errors,
    stabilized,
    stabilizing_warps,
    two_folds,
)

# A detector's box ends this far from the true foot point (standard deviation).
FOOT_SIGMA_PX = 4.0
# Pixels of LiDAR ground points, off by calibration and timing, and heights of the road's crown and of curbs.
GROUND_SIGMA_PX = 1.0
GROUND_SIGMA_M = 0.1
# Ground positions of foot points: the ground, and the nearest side of an obstacle.
FOOT_SIGMA_M = 0.2
# Fewer foot points, or worse conditioned ones, are joined by LiDAR ground points.
MIN_FEET = 80
MAX_FEET_CONDITION = 30.0
# Image homographies nearer to the identity are rounding: the camera does not move.
MIN_WARP = 1e-9
# Fewer foot points do not tell whether pitch and roll from ground points place obstacles better.
MIN_TESTED_FEET = 40


def fit_camera(
    feet: Correspondences, ground: Correspondences, options: EstimationOptions, *, rng: np.random.Generator
) -> tuple[HomographyFit, str]:
    """Fit the homography of one camera, with pitch and roll of each tick if they lower held-out errors.

    Foot points of obstacles are taken alone if they suffice. Where they are too few or do not determine the homography
    (cars of one lane are collinear), LiDAR ground points join them. "straw-man" has no LiDAR and so the obstacles alone.

    Parameters
    ----------
    feet, ground : Correspondences
        Of obstacles and of LiDAR ground points.
    options : EstimationOptions
        Its standard deviations are replaced by those of these correspondences; `pitch_roll` is decided by the data.
    rng : numpy.random.Generator

    Returns
    -------
    fit : HomographyFit
    source : str
        What it was fitted to, "none" where nothing was.
    """
    options = replace(options, pitch_roll=False)
    fit, source = _fit_fixed(feet, ground, options, rng)
    if options.method not in STREAM_METHODS or (len(ground) < 4 and len(feet) < MIN_FEET):
        return fit, source
    feet, ground = _finite(feet), _finite(ground)
    rng = rng.spawn(1)[0]
    tested = _test_ground(fit, feet, ground, options, rng)
    if tested is None or not tested[1].per_tick:
        of_feet = _test_feet(feet, options, rng)
        tested = of_feet if tested is None or (of_feet is not None and of_feet[1].per_tick) else tested
    if tested is None or not tested[1].per_tick:
        return replace(fit, pitch_roll=None if tested is None else tested[1]), source
    moving, pitch_roll = tested
    stable, source = _fit_fixed(stabilized(feet, moving), stabilized(ground, moving), options, rng)
    if not stable.ok:
        return fit, source
    per_tick = _scaled(stable.ground_H_image @ stabilizing_warps(moving))
    return replace(stable, ticks=moving.ticks, per_tick=per_tick, pitch_roll=pitch_roll), source


def _fit_fixed(
    feet: Correspondences, ground: Correspondences, options: EstimationOptions, rng: np.random.Generator
) -> tuple[HomographyFit, str]:
    """Fit one homography to foot points, joined by ground points where they do not suffice; returns it and its source."""
    of_feet = replace(options, sigma_px=FOOT_SIGMA_PX)
    if options.method == "straw-man":
        if feet.xy_by_size is None:
            feet = replace(feet, xy_by_size=np.full((len(feet), 2), np.nan))
        fit = estimate_homography(feet, replace(of_feet, K=None), rng=rng)
        return fit, "obstacles of average size" if fit.ok else "none"
    if len(feet) >= MIN_FEET:
        fit = estimate_homography(feet, replace(of_feet, sigma_m=FOOT_SIGMA_M), rng=rng)
        if fit.ok and fit.condition < MAX_FEET_CONDITION:
            return fit, "obstacles"
    both = Correspondences.join([feet, ground])
    if len(both) < 4:
        return refused_fit(f"{len(both)} correspondences in the whole log, at least 4 are needed", len(both)), "none"
    of_ground = replace(options, sigma_px=GROUND_SIGMA_PX, sigma_m=GROUND_SIGMA_M)
    return estimate_homography(both, of_ground, rng=rng), "obstacles and ground points"


def _test_ground(
    fit: HomographyFit,
    feet: Correspondences,
    ground: Correspondences,
    options: EstimationOptions,
    rng: np.random.Generator,
) -> tuple[HomographyFit, PitchRoll] | None:
    """Estimate the angles from ground points and test them on the foot points; None where there are too few."""
    if len(ground) < 4 or len(feet) < MIN_TESTED_FEET:
        return None
    of_ground = replace(options, pitch_roll=True, sigma_px=GROUND_SIGMA_PX, sigma_m=GROUND_SIGMA_M)
    moving = estimate_homography(ground, of_ground, rng=rng)
    if not moving.ok:
        return None
    stable_feet = stabilized(feet, moving)
    stable = _fit_fixed(stable_feet, stabilized(ground, moving), options, rng)[0]
    errors = held_out_errors((fit, feet), (stable, stable_feet), FOOT_SIGMA_PX, FOOT_SIGMA_M)
    return moving, _decide(errors, moving, "ground points", options)


def _test_feet(
    feet: Correspondences, options: EstimationOptions, rng: np.random.Generator
) -> tuple[HomographyFit, PitchRoll] | None:
    """Estimate the angles from one half of the foot points and test them on the other; None where there are too few."""
    if len(feet) < MIN_FEET:
        return None
    fixed_options = replace(options, sigma_px=FOOT_SIGMA_PX, sigma_m=FOOT_SIGMA_M)
    moving_options = replace(fixed_options, pitch_roll=True)
    errors = []
    for training, test in two_folds(feet):
        moving = estimate_homography(training, moving_options, rng=rng)
        if not moving.ok:
            return None
        fixed = estimate_homography(training, fixed_options, rng=rng)
        stable = estimate_homography(stabilized(training, moving), fixed_options, rng=rng)
        errors.append(held_out_errors((fixed, test), (stable, stabilized(test, moving)), FOOT_SIGMA_PX, FOOT_SIGMA_M))
    moving = estimate_homography(feet, moving_options, rng=rng)
    if not moving.ok:
        return None
    return moving, _decide(HeldOutErrors.join(errors), moving, "obstacles", options)


def _decide(errors: HeldOutErrors, moving: HomographyFit, source: str, options: EstimationOptions) -> PitchRoll:
    """Accept or refuse the angles by the held-out errors."""
    pitches = np.abs(stabilizing_warps(moving) - np.eye(3)).max() > MIN_WARP
    significance = errors.significance() if pitches else 0.0
    sigmas_deg = (float("nan"), float("nan")) if options.K is None else angle_sigmas_deg(moving, options.K)
    before, after = np.median(errors.distance_px, axis=1).tolist()
    return PitchRoll(significance > MIN_SIGNIFICANCE_SIGMA, source, *sigmas_deg, (before, after), significance)


def _finite(correspondences: Correspondences) -> Correspondences:
    """Select the rows whose pixels and positions are finite."""
    values = np.column_stack([correspondences.uv, correspondences.xy_ego])
    return correspondences.take(np.isfinite(values).all(axis=1))


def _scaled(h: Array) -> Array:
    """Scale homographies (T, 3, 3) so that their third rows are unit vectors."""
    return np.asarray(h / np.linalg.norm(h[:, 2], axis=1)[:, None, None])
