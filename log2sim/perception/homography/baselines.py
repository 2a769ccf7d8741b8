"""Baselines that the time-aware homography is compared with (Bhardwaj & Kalra).

"per-frame" runs one RANSAC for each frame, "min-frame" keeps of all frames' homographies the one of least error over all
frames, and "straw-man" is "per-frame" with ground positions from average sizes instead of a LiDAR.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.geometry import Array
from log2sim.perception.homography.fit import HomographyFit, refused_fit, validated_fit
from log2sim.perception.homography.normalized import NormalizedCorrespondences, bounded_losses
from log2sim.perception.homography.ransac import RansacSchedule, RobustFit, ransac
from log2sim.perception.homography.refine import linearize

# Heights of cars differ by about a tenth (standard deviation), and so does a range derived from them.
SIZE_SIGMA_SHARE = 0.1


def fit_frames(
    data: NormalizedCorrespondences, rng: np.random.Generator, schedule: RansacSchedule, *, keep_all: bool
) -> HomographyFit:
    """Fit one homography a frame, then choose the one of least error over all frames.

    `keep_all` also returns those of the single frames as `per_tick`.
    """
    per_tick = np.full((len(data.start), 3, 3), np.nan)
    hypotheses: list[Array] = []
    for k, (start, count) in enumerate(zip(data.start, data.count)):
        if count < 4:
            continue
        robust = ransac(data.take(slice(start, start + count)), rng, schedule=schedule)
        fit = validated_fit(robust)
        if fit.ok and robust.h is not None:
            per_tick[k] = fit.ground_H_image
            hypotheses.append(robust.h)
    if not hypotheses:
        return refused_fit("no frame has correspondences that determine a homography", data.image.shape[1])
    best = hypotheses[int(np.argmin(bounded_losses(data, np.array(hypotheses))))]
    fit = validated_fit(RobustFit(best, data, linearize(data, best[None])))
    return replace(fit, per_tick=per_tick if keep_all and fit.ok else None)


def ground_from_sizes(uv_px: Array, height_px: Array, height_m: Array, K: Array, ego_T_cam: Array) -> Array:
    """Estimate ground positions of objects from their heights in the image and average heights.

    Parameters
    ----------
    uv_px : (N, 2) float64
        Undistorted foot points, px.
    height_px, height_m : (N,) float64
        Heights of the boxes, px, and of the objects, m.
    K : (3, 3) float64
    ego_T_cam : (4, 4) float64
        Pose of the camera.

    Returns
    -------
    (N, 2) float64
        Positions in the ego frame, m; NaN for boxes without height.
    """
    depth = K[1, 1] * height_m / np.where(height_px > 0, height_px, np.nan)
    rays = np.column_stack([(uv_px - K[:2, 2]) / K[[0, 1], [0, 1]], np.ones(len(uv_px))])
    return np.asarray((rays * depth[:, None]) @ ego_T_cam[:2, :3].T + ego_T_cam[:2, 3])


def sigma_from_sizes_m(xy_m: Array) -> float:
    """Estimate the standard deviation, m, of ground positions (N, 2) from average sizes.

    A tenth of the range, for which twice the spread of the positions stands: it does not depend on the origin.
    """
    known = xy_m[np.isfinite(xy_m).all(axis=1)]
    range_m = 2.0 * float(np.sqrt(known.var(axis=0).sum())) if len(known) else 0.0
    return SIZE_SIGMA_SHARE * range_m
