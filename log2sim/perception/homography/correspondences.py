"""The top-down view: where on the ground an image point lies, learned from the log itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Measurements
from log2sim.geometry import Array, Camera, undistort
from log2sim.perception.homography.estimate import (
    HomographyFit,
    apply_homography,
    estimate_homography,
    ground_from_sizes,
    jacobian,
    refused,
)

__all__ = ["Correspondences", "HomographyFit", "estimate_homography", "fit_camera", "jitter_m", "locate"]

FOOT_SIGMA_PX = 4.0
GROUND_SIGMA_PX = 1.0
GROUND_SIGMA_M = 0.1
FARTHEST_M = 60.0
ENOUGH_FEET = 80
# Where the jitter of a homography is measured: straight ahead on the ground.
PROBED_M = np.array([[10.0, 0.0], [20.0, 0.0], [40.0, 0.0]])


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Pixels `uv` (N, 2), free of distortion, their ground positions `xy_ego` (N, 2) and `tick` (N,), of one camera.

    `xy_by_size` (N, 2) is where average sizes put them without a LiDAR, NaN where there is no object to tell it.
    """

    uv: Array
    xy_ego: Array
    tick: NDArray[np.int64]
    xy_by_size: Array | None = None

    @classmethod
    def join(cls, parts: Sequence[Correspondences]) -> Correspondences:
        if not parts:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
        sized = [np.full((len(p.uv), 2), np.nan) if p.xy_by_size is None else p.xy_by_size for p in parts]
        uv, xy, tick = (np.concatenate([getattr(p, k) for p in parts]) for k in ("uv", "xy_ego", "tick"))
        return cls(uv, xy, tick, np.concatenate(sized))


def pinhole(camera: Camera, uv: Array) -> Array:
    """Pixels (N, 2) as a lens without distortion would give them."""
    return undistort(camera, uv) @ camera.K[:2, :2].T + camera.K[:2, 2]


def foot_points(camera: Camera, measured: Measurements, ego_T_map: Array, tick: int) -> Correspondences:
    """Where obstacles touch the ground: middle of the box's lower side, and the ground below the nearest of their points."""
    kept = np.array([len(c) > 0 for c in measured.cluster], dtype=bool)
    good = (measured.source == "lidar") & ~measured.truncated & (measured.points >= 20) & kept
    rows = np.flatnonzero(good & (measured.camera == camera.name))
    uv, xy = [], []
    for k in rows:
        sensor, cluster = measured.sensor_m[k, :2], measured.cluster[k][:, :2]
        away = measured.center_m[k, :2] - sensor
        away /= np.hypot(*away)
        nearest = np.quantile((cluster - sensor) @ away, 0.05)
        foot = np.append(sensor + away * nearest, measured.center_m[k, 2] - measured.size_m[k, 2] / 2)
        box = measured.box_px[k]
        xy.append((ego_T_map[:3, :3] @ foot + ego_T_map[:3, 3])[:2])
        uv.append([(box[0] + box[2]) / 2, box[3]])
    if not rows.size:
        return Correspondences.join([])
    feet, boxes = pinhole(camera, np.array(uv)), measured.box_px[rows]
    height_m = np.array([TYPICAL_SIZE_M[str(c)][2] for c in measured.category[rows]])
    ego_T_cam = camera.mount_T_cam if camera.mount == "ego" else ego_T_map @ camera.mount_T_cam
    by_size = ground_from_sizes(feet, boxes[:, 3] - boxes[:, 1], height_m, camera.K, ego_T_cam)
    return Correspondences(feet, np.array(xy), np.full(len(rows), tick, dtype=np.int64), by_size)


def fit_camera(
    feet: Correspondences,
    ground: Correspondences,
    *,
    method: str,
    rng: np.random.Generator,
    K: Array | None = None,
    hypotheses: int | None = None,
) -> tuple[HomographyFit, str]:
    """The homography of one camera, and what it was learned from.

    Obstacles come first; where there are too few of them or they do not determine it (cars of one lane are collinear),
    LiDAR ground points join them. "straw-man" has no LiDAR and so the obstacles alone; "calibrated" needs `K` (3, 3).
    """
    fit_to = partial(estimate_homography, method=method, rng=rng, hypotheses=hypotheses)
    if method == "straw-man":
        by_size = np.full((len(feet.uv), 2), np.nan) if feet.xy_by_size is None else feet.xy_by_size
        fit = fit_to(feet.uv, feet.xy_ego, feet.tick, sigma_px=FOOT_SIGMA_PX, xy_by_size_m=by_size)
        return fit, "obstacles of average size" if fit.ok else "none"
    if len(feet.uv) >= ENOUGH_FEET:
        fit = fit_to(feet.uv, feet.xy_ego, feet.tick, K=K, sigma_px=FOOT_SIGMA_PX, sigma_m=2 * GROUND_SIGMA_M)
        if fit.ok and fit.condition < 30:
            return fit, "obstacles"
    both = Correspondences.join([feet, ground])
    if len(both.uv) < 4:
        return refused(f"{len(both.uv)} correspondences in the whole log, at least 4 are needed", len(both.uv)), "none"
    fit = fit_to(both.uv, both.xy_ego, both.tick, K=K, sigma_px=GROUND_SIGMA_PX, sigma_m=GROUND_SIGMA_M)
    return fit, "obstacles and ground points"


def locate(
    fit: HomographyFit, camera: Camera, box_px: Array, category: str, cam_ground_ego: Array
) -> tuple[Array, Array] | None:
    """Ground position (2,) and covariance (2, 2) of an obstacle's center in the ego frame, from its box alone.

    `cam_ground_ego` (2,) is where the camera stands. Returns None above the horizon and beyond 60 m, where a pixel is
    many meters.
    """
    uv = pinhole(camera, np.array([[(box_px[0] + box_px[2]) / 2, box_px[3]]]))
    xy, below = apply_homography(fit.ground_H_image, uv)
    if not below[0] or np.hypot(*(xy[0] - cam_ground_ego)) > FARTHEST_M:
        return None
    away = (xy[0] - cam_ground_ego) / np.hypot(*(xy[0] - cam_ground_ego))
    length, width, _ = TYPICAL_SIZE_M[category]
    # The foot is the near side; how deep the object is depends on its heading, which nobody knows here.
    depth, spread = (length + width) / 4, (length - width) / 4
    slope = jacobian(fit.ground_H_image, uv)[0]
    covariance = FOOT_SIGMA_PX**2 * slope @ slope.T + np.eye(2) * 0.2**2 + spread**2 * np.outer(away, away)
    return xy[0] + away * depth, covariance


def jitter_m(fit: HomographyFit) -> float:
    """Median distance in m by which ground points 10, 20 and 40 m ahead move from one tick to the next; 0 for one stream.

    NaN when nothing was fitted.
    """
    if not fit.ok:
        return float("nan")
    if fit.per_tick is None:
        return 0.0
    known = fit.per_tick[np.isfinite(fit.per_tick).all(axis=(1, 2))]
    image_H_ground = np.linalg.inv(fit.ground_H_image)
    image = PROBED_M @ image_H_ground[:, :2].T + image_H_ground[:, 2]
    uv = image[:, :2] / image[:, 2:]
    places = np.array([apply_homography(h, uv)[0] for h in known])
    if len(places) < 2:
        return float("nan")
    return float(np.nanmedian(np.hypot(*np.moveaxis(np.diff(places, axis=0), -1, 0))))
