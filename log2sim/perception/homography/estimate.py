"""Estimation of the image-to-ground homography of a camera from correspondences of many ticks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, apply_homography
from log2sim.perception.homography.baselines import fit_frames, ransac_skimage, sigma_from_sizes_m
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.homography.fit import HomographyFit, refused_fit, validated_fit
from log2sim.perception.homography.normalized import NormalizedCorrespondences
from log2sim.perception.homography.pitch_roll import PITCH_SIGMA_PX, fit_pitch_roll
from log2sim.perception.homography.ransac import (
    RANSAC_SCHEDULE,
    RANSAC_SCHEDULE_OF_A_FRAME,
    RansacRound,
    RansacSchedule,
    RobustFit,
    ransac,
)

STREAM_METHODS = ("time-aware", "calibrated")
FRAME_METHODS = ("min-frame", "per-frame", "per-frame-skimage", "straw-man")
METHODS = (*STREAM_METHODS, *FRAME_METHODS)
# Condition number of intrinsics beyond which they count as singular; a lens of 1e5 px has 1e5.
MAX_CONDITION = 1e12


@dataclass(frozen=True, eq=False)
class EstimationOptions:
    """How a homography is estimated.

    Attributes
    ----------
    method : str
        One of `METHODS`.
    K : (3, 3) float64 or None
        Intrinsics, px, which "calibrated" needs.
    pitch_roll : bool
        Fit pitch and roll of each tick on top of the stream's homography, with "time-aware" and "calibrated".
    hypotheses : int or None
        Samples of four to draw, for the stream or for each frame; None for as many as the data need.
    together : bool
        Whether the cameras of a rig are fitted together, see `rig_fit`.
    sigma_px, sigma_m : float
        Assumed standard deviations of pixels and of ground positions; they are estimated anew from the inliers, within a
        factor of 4.
    """

    method: str = "time-aware"
    K: Array | None = None
    pitch_roll: bool = False
    hypotheses: int | None = None
    together: bool = False
    sigma_px: float = 1.5
    sigma_m: float = 0.1

    def schedule(self, default: RansacSchedule) -> RansacSchedule:
        """Return the RANSAC schedule: the default one, or a single round of `hypotheses` samples."""
        if self.hypotheses is None:
            return default
        return (RansacRound(self.hypotheses, max(self.hypotheses // 8, 8), 0.0),)


def estimate_homography(
    correspondences: Correspondences, options: EstimationOptions | None = None, *, rng: np.random.Generator
) -> HomographyFit:
    """Estimate the homography of a camera stream.

    Parameters
    ----------
    correspondences : Correspondences
        Rows that are not finite are ignored.
    options : EstimationOptions, optional
    rng : numpy.random.Generator

    Raises
    ------
    ValueError
        For an unknown method, or when the method lacks its input: intrinsics for "calibrated", positions by average
        sizes for "straw-man".

    Notes
    -----
    "time-aware" draws one half of its samples from single frames, where correspondences share the camera's momentary
    pose, and one half from all frames. It scores each hypothesis over all frames and obstacles with a bounded loss of
    the whitened error, and refines the best over all of its inliers. "calibrated" does the same over the six parameters
    of the pose of a camera with known intrinsics. The others are baselines, see `baselines`.
    """
    options = options or EstimationOptions()
    _check_options(correspondences, options)
    uv, xy, sigma_m = correspondences.uv, correspondences.xy_ego, options.sigma_m
    if options.method == "straw-man":
        xy = np.asarray(correspondences.xy_by_size, dtype=np.float64)
        sigma_m = max(sigma_m, sigma_from_sizes_m(xy))
    ticks, number = np.unique(correspondences.tick, return_inverse=True)
    rows = np.flatnonzero(np.isfinite(uv[:, 0]) & np.isfinite(uv[:, 1]) & np.isfinite(xy[:, 0]) & np.isfinite(xy[:, 1]))
    if len(rows) < 4:
        return refused_fit(f"{len(rows)} correspondences, at least 4 are needed", len(uv), ticks)
    rows = rows[np.argsort(number[rows], kind="stable")]
    dense = np.unique(number[rows], return_inverse=True)[1]
    data = NormalizedCorrespondences.of(uv[rows], xy[rows], dense, options.sigma_px, sigma_m)
    if options.method in STREAM_METHODS:
        fit = _fit_stream(data, options, rng)
    else:
        estimate = partial(ransac, rng=rng, schedule=options.schedule(RANSAC_SCHEDULE_OF_A_FRAME))
        if options.method == "per-frame-skimage":
            estimate = partial(ransac_skimage, rng=rng, trials=options.hypotheses)
        fit = fit_frames(data, estimate, keep_all=options.method != "min-frame")
    fit = _of_all_rows(fit, correspondences.tick, rows, of_stream=options.method in STREAM_METHODS)
    if options.method == "straw-man" and fit.ok:
        offset = apply_homography(fit.ground_H_image, uv)[0] - correspondences.xy_ego
        distance = np.hypot(*offset[fit.inliers].T)
        error_m = float(np.nanmedian(distance)) if np.isfinite(distance).any() else float("nan")
        fit = replace(fit, error_m=error_m)
    return fit


def _check_options(correspondences: Correspondences, options: EstimationOptions) -> None:
    if options.method not in METHODS:
        raise ValueError(f"unknown method '{options.method}'; known: {', '.join(METHODS)}")
    shape = () if options.K is None else options.K.shape
    if options.method == "calibrated" and shape != (3, 3):
        raise ValueError(f"method 'calibrated' needs the intrinsics K (3, 3), got shape {shape}")
    sized = correspondences.xy_by_size
    if options.method == "straw-man" and (sized is None or np.shape(sized) != correspondences.uv.shape):
        raise ValueError("method 'straw-man' needs the ground positions by average sizes, xy_by_size (N, 2)")


def _fit_stream(data: NormalizedCorrespondences, options: EstimationOptions, rng: np.random.Generator) -> HomographyFit:
    """Fit one homography over all ticks, and if asked for pitch and roll of each tick."""
    image_K = None
    if options.method == "calibrated":
        K = np.asarray(options.K, dtype=np.float64)
        if not (np.isfinite(K).all() and np.linalg.cond(K) < MAX_CONDITION):
            return refused_fit("the intrinsics K are singular", data.image.shape[1])
        image_K = data.image_N_px @ K
    pitch_sigma = PITCH_SIGMA_PX * data.image_N_px[0, 0] if options.pitch_roll else 0.0
    schedule = options.schedule(RANSAC_SCHEDULE)
    robust = ransac(data, rng, pitch_sigma=pitch_sigma, image_K=image_K, schedule=schedule)
    if robust.h is None or not options.pitch_roll:
        return validated_fit(robust, image_K)
    moving = fit_pitch_roll(data, robust.h, image_K)
    warps = moving.warps[data.tick]
    fit = validated_fit(
        RobustFit(moving.image_H_ground, moving.data, moving.linear, warps, moving.effective_parameters), image_K
    )
    if not fit.ok:
        return fit
    return replace(fit, per_tick=data.to_ground_H_image(moving.warps @ moving.image_H_ground))


def _of_all_rows(
    fit: HomographyFit, tick: NDArray[np.int64], rows: NDArray[np.int64], *, of_stream: bool
) -> HomographyFit:
    """Convert a fit of `rows` into one of all correspondences, whose ticks are `tick` (N,).

    In `per_tick` a tick without usable rows gets NaN, or the homography of the stream for methods that have one.
    """
    ticks, number = np.unique(tick, return_inverse=True)
    inliers = np.zeros(len(tick), dtype=bool)
    inliers[rows] = fit.inliers
    per_tick = fit.per_tick
    if per_tick is not None:
        missing = fit.ground_H_image if of_stream else np.full((3, 3), np.nan)
        per_tick = np.repeat(missing[None], len(ticks), axis=0)
        per_tick[np.unique(number[rows])] = fit.per_tick
    return replace(fit, inliers=inliers, ticks=ticks, per_tick=per_tick)
