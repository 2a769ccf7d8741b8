"""Estimation of the homography of a camera, which correspondences it is fitted to, and places of obstacles by it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from log2sim.geometry import Array, apply_homography
from log2sim.perception.homography.correspondences import (
    SIZE_SIGMA_SHARE,
    Correspondences,
    fit_frames,
    ransac_skimage,
)
from log2sim.perception.homography.fit import (
    RANSAC_SCHEDULE,
    RANSAC_SCHEDULE_OF_A_FRAME,
    HomographyFit,
    PitchRoll,
    RansacSchedule,
    ransac,
    refused_fit,
    validated_fit,
)
from log2sim.perception.homography.normalized import NormalizedCorrespondences, first_of_each, scaled
from log2sim.perception.homography.pitch_roll import (
    PITCH_SIGMA_PX,
    HeldOutErrors,
    fit_pitch_roll,
    held_out_errors,
    stabilized,
    stabilizing_warps,
)

STREAM_METHODS = ("time-aware", "calibrated")
FRAME_METHODS = ("min-frame", "per-frame", "per-frame-skimage", "straw-man")
METHODS = (*STREAM_METHODS, *FRAME_METHODS)
# Condition number beyond which intrinsics and calibrated homographies count as singular; a lens of 1e5 px has 1e5.
MAX_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class EstimationOptions:
    """How a homography is estimated."""

    method: str = "time-aware"  # one of `METHODS`
    K: Array | None = None  # (3, 3): intrinsics, px, which "calibrated" needs
    # Fit pitch and roll of each tick on top of the stream's homography, with "time-aware" and "calibrated"
    pitch_roll: bool = False
    # Samples of four to draw, for the stream or for each frame; None for as many as the data need
    hypotheses: int | None = None
    # Standard deviations of pixels and of ground positions, estimated anew from the inliers within a factor of 4
    sigma_px: float = 1.5
    sigma_m: float = 0.1

    def schedule(self, default: RansacSchedule) -> RansacSchedule:
        """Return the RANSAC schedule: the default one, or a single round of `hypotheses` samples."""
        if self.hypotheses is None:
            return default
        return ((self.hypotheses, max(self.hypotheses // 8, 8), 0.0),)


def estimate_homography(
    correspondences: Correspondences, options: EstimationOptions | None = None, *, rng: np.random.Generator
) -> HomographyFit:
    """Estimate the homography of a camera stream.

    `correspondences`: rows that are not finite are ignored.

    Raises `ValueError` for an unknown method, or when the method lacks its input: intrinsics for "calibrated", positions by
    average sizes for "straw-man".

    "time-aware" draws one half of its samples from single frames, where correspondences share the camera's momentary
    pose, and one half from all frames. It scores each hypothesis over all frames and obstacles with a bounded loss of
    the whitened error, and refines the best over all of its inliers. "calibrated" does the same over the six parameters
    of the pose of a camera with known intrinsics. The others are baselines, see `correspondences`.
    """
    options = options or EstimationOptions()
    method, of_stream = options.method, options.method in STREAM_METHODS
    if method not in METHODS:
        raise ValueError(f"unknown method '{method}'; known: {', '.join(METHODS)}")
    uv, xy, sigma_m = correspondences.uv, correspondences.xy_ego, options.sigma_m
    shape = () if options.K is None else options.K.shape
    if method == "calibrated" and shape != (3, 3):
        raise ValueError(f"method 'calibrated' needs the intrinsics K (3, 3), got shape {shape}")
    if method == "straw-man":
        if correspondences.xy_by_size is None or correspondences.xy_by_size.shape != uv.shape:
            raise ValueError("method 'straw-man' needs the ground positions by average sizes, xy_by_size (N, 2)")
        xy = np.asarray(correspondences.xy_by_size, dtype=np.float64)
        # Off by a tenth of the range, for which twice the spread of the positions stands: it does not depend on the origin.
        known = xy[np.isfinite(xy).all(axis=1)]
        range_m = 2.0 * float(np.sqrt(known.var(axis=0).sum())) if len(known) else 0.0
        sigma_m = max(sigma_m, SIZE_SIGMA_SHARE * range_m)
    order, finite = np.argsort(correspondences.tick, kind="stable"), np.isfinite(uv) & np.isfinite(xy)
    tick = correspondences.tick[order]
    ticks, rows = tick[first_of_each(tick)], order[(finite[:, 0] & finite[:, 1])[order]]
    if len(rows) < 4:
        return refused_fit(f"{len(rows)} correspondences, at least 4 are needed", len(uv), ticks)
    tick = correspondences.tick[rows]
    data = NormalizedCorrespondences.of(uv[rows], xy[rows], tick, options.sigma_px, sigma_m)
    if of_stream:
        image_K = None
        if method == "calibrated":
            K = np.asarray(options.K, dtype=np.float64)
            if not (np.isfinite(K).all() and np.linalg.cond(K) < MAX_CONDITION):
                return refused_fit("the intrinsics K are singular", len(uv), ticks)
            image_K = data.image_N_px @ K
        schedule, drawn_from = options.schedule(RANSAC_SCHEDULE), data
        if options.pitch_roll:
            moving_sigma = float(np.hypot(data.sigma_image, PITCH_SIGMA_PX * data.image_N_px[0, 0]))
            drawn_from = replace(data, sigma_image=moving_sigma)
        robust = ransac(drawn_from, rng, image_K=image_K, schedule=schedule, refined=not options.pitch_roll)
        if robust.linear is None or not options.pitch_roll:
            fit = validated_fit(robust, image_K)
        else:
            moving, warps, tick_sigmas = fit_pitch_roll(data, robust.linear.h, image_K)
            fit = validated_fit(moving, image_K)
            if fit.ok and moving.linear is not None:
                tick_sigmas = fit.ground_H_image @ np.linalg.inv(data.image_N_px) @ tick_sigmas @ data.image_N_px
                fit = replace(fit, per_tick=data.to_ground_H_image(warps @ moving.linear.h), tick_sigmas=tick_sigmas)
    else:
        estimate = partial(ransac, rng=rng, schedule=options.schedule(RANSAC_SCHEDULE_OF_A_FRAME))
        if method == "per-frame-skimage":
            estimate = partial(ransac_skimage, rng=rng, trials=options.hypotheses)
        fit = fit_frames(data, estimate, keep_all=method != "min-frame")
    # From the rows that were used to all. A tick without any gets NaN, or the homography of the stream where there is one, and
    # may have any angle that other ticks have.
    inliers, of_ticks = np.zeros(len(uv), dtype=bool), np.searchsorted(ticks, tick[data.start])
    inliers[rows] = fit.inliers
    per_tick, sigmas = fit.per_tick, fit.tick_sigmas
    if per_tick is not None:
        per_tick = np.repeat((fit.ground_H_image if of_stream else np.full((3, 3), np.nan))[None], len(ticks), axis=0)
        per_tick[of_ticks] = fit.per_tick
    if sigmas is not None:
        sigmas = np.repeat(sigmas[[np.abs(sigmas).sum(axis=(1, 2, 3)).argmax()]], len(ticks), axis=0)
        sigmas[of_ticks] = fit.tick_sigmas
    fit = replace(fit, inliers=inliers, ticks=ticks, per_tick=per_tick, tick_sigmas=sigmas)
    if method == "straw-man" and fit.ok:
        offset = apply_homography(fit.ground_H_image, uv)[0] - correspondences.xy_ego
        distance = np.hypot(*offset[fit.inliers].T)
        error_m = float(np.nanmedian(distance)) if np.isfinite(distance).any() else float("nan")
        fit = replace(fit, error_m=error_m)
    return fit


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
# Distance in the image, as a share of the focal length, at which the roll of a warp is read.
ROLL_ARM = 0.2
# Fewer foot points do not tell whether pitch and roll from ground points place obstacles better.
MIN_TESTED_FEET = 40


def fit_camera(
    feet: Correspondences, ground: Correspondences, options: EstimationOptions, *, rng: np.random.Generator
) -> tuple[HomographyFit, str]:
    """Fit the homography of one camera, with pitch and roll of each tick if they lower held-out errors.

    Foot points of obstacles are taken alone if they suffice. Where they are too few or do not determine the homography
    (cars of one lane are collinear), LiDAR ground points join them. "straw-man" has no LiDAR and so the obstacles alone.

    `feet`, `ground`: of obstacles and of LiDAR ground points. `options`: its standard deviations are replaced by those of
    these correspondences; `pitch_roll` is decided by the data.

    Returns `fit`; `source`: what it was fitted to, "none" where nothing was.
    """
    options = replace(options, pitch_roll=False)
    fit, source = _fit_fixed(feet, ground, options, rng)
    if options.method not in STREAM_METHODS or (len(ground) < 4 and len(feet) < MIN_FEET):
        return fit, source
    feet, ground = (c.take(np.isfinite(np.column_stack([c.uv, c.xy_ego])).all(axis=1)) for c in (feet, ground))
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
    per_tick = scaled(stable.ground_H_image @ stabilizing_warps(moving))
    tick_sigmas = stable.ground_H_image @ np.linalg.inv(moving.ground_H_image) @ moving.tick_sigmas
    fit = replace(stable, ticks=moving.ticks, per_tick=per_tick, tick_sigmas=tick_sigmas, pitch_roll=pitch_roll)
    return fit, source


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
    # One half of every tick's correspondences in turn is fitted to, and held against the other half.
    order = np.argsort(feet.tick, kind="stable")
    rank = np.arange(len(feet)) - np.searchsorted(feet.tick[order], feet.tick[order])
    halves, errors = [feet.take(order[rank % 2 == k]) for k in range(2)], []
    for training, test in (halves, halves[::-1]):
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
    pitches = bool(np.abs(stabilizing_warps(moving) - np.eye(3)).max() > MIN_WARP)
    pitch_deg = roll_deg = float("nan")
    if options.K is not None:  # how they vary over the ticks
        K, center = options.K, options.K[:2, 2]
        points = np.column_stack([[*center, 1.0], [center[0] + ROLL_ARM * K[0, 0], center[1], 1.0]])
        q = np.linalg.inv(stabilizing_warps(moving)) @ points
        uv = q[:, :2] / q[:, 2:]
        du, dv = (uv[:, :, 1] - uv[:, :, 0]).T
        pitch_deg = float(np.degrees(np.arctan((uv[:, 1, 0] - center[1]) / K[1, 1]).std()))
        roll_deg = float(np.degrees(np.arctan2(dv, du).std()))
    return errors.decide(source, (pitch_deg, roll_deg), moves=pitches)
