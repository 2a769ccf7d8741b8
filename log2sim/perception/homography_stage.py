"""The second pass: every camera's homography, and a place for the obstacles that no LiDAR point fell on."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import TYPICAL_SIZE_M, Log, Measurements, Obstacles
from log2sim.geometry import Array, Camera, inverse, wrap_angle
from log2sim.perception.first_pass import Observations, base_pose
from log2sim.perception.fusion import fuse
from log2sim.perception.homography.correspondences import Correspondences, fit_camera, locate
from log2sim.perception.homography.estimate import HomographyFit, refused
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan
from log2sim.stage_clock import Costs

# So many rays that go on behind a place say that nothing stands there, unless a part of these as large as this stops.
MIN_RAYS, MOST_STOPPED = 5, 0.25
# What the LiDAR should have seen and did not is half as sure: it may continue a track and hardly start one.
UNCONFIRMED = 0.5


@dataclass(frozen=True, eq=False)
class CameraGround:
    """A camera's homography to the ground frame of the ego, and what it was learned from."""

    camera: Camera
    fit: HomographyFit
    source: str
    refusal: str = ""


def fit_cameras(
    log: Log,
    schedule: Schedule,
    seen: Observations,
    plan: Plan,
    method: str,
    rng: np.random.Generator,
    costs: Costs | None = None,
    *,
    hypotheses: int | None = None,
) -> tuple[Plan, dict[str, CameraGround]]:
    """Fit the cameras that need it; a refused fit falls back on the calibration, with its reason kept.

    A camera needs it when a detection of it has no LiDAR points, but a foot in the image; when a top-down picture is asked
    for, every one does.
    """
    if not plan.keeps("homography"):
        return plan, {}
    reason = next(s.reason for s in plan.steps if s.stage == "homography")
    wanted = _cameras_in_need(log, seen) if "picture" not in reason else set(plan.cameras)
    if not wanted:
        return plan.decided(
            "homography",
            False,
            "every detection has LiDAR points or no foot in the image, and no top-down picture is asked for",
        ), {}
    plan = plan.decided("homography", True, f"{reason}: {', '.join(c for c in plan.cameras if c in wanted)}")
    grounds, costs = {}, costs or Costs()
    for camera in (c for c in plan.cameras if c in wanted):
        with costs.piece("homography"):
            grounds[camera] = _fit_one(log, schedule, seen, camera, method, rng, hypotheses)
    return plan, grounds


def _cameras_in_need(log: Log, seen: Observations) -> set[str]:
    rows = [(str(m.camera[k]), m.box_px[k]) for m in seen.measurements for k in np.flatnonzero(m.source == "")]
    return {name for name, box_px in rows if _has_foot(log.cameras[name], box_px)}


def _has_foot(camera: Camera, box_px: Array) -> bool:
    """Whether an obstacle touches the ground in the image: a box that its lower border cuts has no foot there."""
    return bool(box_px[3] <= camera.height_px - 3)


def _fit_one(
    log: Log,
    schedule: Schedule,
    seen: Observations,
    name: str,
    method: str,
    rng: np.random.Generator,
    hypotheses: int | None,
) -> CameraGround:
    camera = log.cameras[name]
    feet, ground = Correspondences.join(seen.feet.get(name, [])), Correspondences.join(seen.ground.get(name, []))
    fit, source = fit_camera(feet, ground, method=method, rng=rng, K=camera.K, hypotheses=hypotheses)
    if fit.ok:
        return CameraGround(camera, fit, source)
    calibrated = calibrated_ground(log, camera)
    if calibrated is None:
        return CameraGround(camera, fit, "none", fit.reason)
    return CameraGround(camera, calibrated, "calibration and flat ground", fit.reason)


def calibrated_ground(log: Log, camera: Camera) -> HomographyFit | None:
    """The homography that the calibration gives for flat ground under the ego; None when the camera lies on it."""
    base_T_cam = camera.mount_T_cam
    cam_T_base = inverse(base_T_cam)
    height = base_T_cam[2, 3] - log.ground_z_ego_m
    if height < 0.2:
        return None
    image_H_ground = camera.K @ np.column_stack(
        [cam_T_base[:3, 0], cam_T_base[:3, 1], cam_T_base[:3, 2] * log.ground_z_ego_m + cam_T_base[:3, 3]]
    )
    if np.linalg.cond(image_H_ground) > 1e12:
        return None
    h = np.asarray(np.linalg.inv(image_H_ground), dtype=np.float64)
    h /= np.linalg.norm(h[2])
    # Depth of the ground point seen at a pixel is 1 / w of the inverse mapping, so w is positive where the ground is ahead.
    s = np.linalg.svd(h, compute_uv=False)
    return HomographyFit(True, "", h, refused("", 0).inliers, float("nan"), float(s[0] / s[-1]))


def locate_the_rest(
    log: Log, schedule: Schedule, seen: Observations, homographies: Mapping[str, CameraGround], *, across: bool = True
) -> list[Measurements]:
    """Measurements of all ticks, those without LiDAR points placed by their camera's homography where it is able to.

    `across` says whether several cameras may have seen the same, see `fuse`.
    """
    ticks = zip(seen.measurements, seen.obstacles, strict=True)
    return [_locate_tick(log, m, o, homographies, across) for m, o in ticks]


def _locate_tick(
    log: Log, m: Measurements, obstacles: Obstacles | None, homographies: Mapping[str, CameraGround], across: bool
) -> Measurements:
    missing = np.flatnonzero(m.source == "")
    if len(missing) == 0:
        return m
    columns: dict[str, Any] = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in vars(m).items()}
    stands: dict[tuple[str, int], tuple[Array, Array]] = {}
    for k in missing:
        ground = homographies.get(str(m.camera[k]))
        if ground is None or not ground.fit.ok or not _has_foot(ground.camera, m.box_px[k]):
            continue
        frame = (ground.camera.name, int(m.t_ns[k]))
        if frame not in stands:
            base = base_pose(log, frame[1])
            stands[frame] = base, _stand(log, ground.camera, base, frame[1])
        base, stand = stands[frame]
        placed = locate(ground.fit, ground.camera, m.box_px[k], str(m.category[k]), stand)
        if placed is None:
            continue
        if obstacles is not None:
            beyond, stopped = rays_at(obstacles, base, placed, log.ground_z_ego_m, str(m.category[k]))
            if beyond >= MIN_RAYS and stopped < MOST_STOPPED * beyond:
                continue
            if beyond + stopped >= MIN_RAYS:
                columns["score"][k] *= UNCONFIRMED
        _write(columns, int(k), placed, base, log.ground_z_ego_m, str(m.category[k]))
    placed_rows = Measurements(**columns)
    return fuse(placed_rows, across=across)


def rays_at(
    obstacles: Obstacles, base: Array, placed: tuple[Array, Array], ground_z: float, category: str
) -> tuple[int, int]:
    """How many rays toward an object of a category, placed at (2,), (2, 2) in the frame `base` (4, 4), went on, and stopped."""
    xy, covariance = placed
    _, width, height = TYPICAL_SIZE_M[category]
    foot = base[:3, :3] @ np.array([xy[0], xy[1], ground_z]) + base[:3, 3] - obstacles.origin - obstacles.sensor
    range_m = float(np.hypot(*foot[:2]))
    sigma_m = float(np.sqrt(xy @ covariance @ xy) / max(np.hypot(*xy), 1e-6))
    azimuth, reach, slope = obstacles.rays
    turned = wrap_angle(azimuth - np.arctan2(foot[1], foot[0]))
    z_there = slope * range_m - foot[2]
    toward = (np.abs(turned) * range_m < width / 2) & (z_there > 0.2 * height) & (z_there < 0.8 * height)
    beyond = int((toward & (reach > range_m + width + 2 * sigma_m)).sum())
    return beyond, int(toward.sum()) - beyond


def _stand(log: Log, camera: Camera, base: Array, t_ns: int) -> Array:
    """Where a camera stands (2,) in the ground frame."""
    map_T_cam, _ = log.map_T_sensor(camera.name, t_ns)
    return np.asarray((inverse(base) @ map_T_cam[0])[:2, 3], dtype=np.float64)


def _write(
    columns: dict[str, Any], k: int, placed: tuple[Array, Array], base: Array, ground_z: float, category: str
) -> None:
    xy, covariance = placed
    length, width, height = TYPICAL_SIZE_M[category]
    foot = base[:3, :3] @ np.array([xy[0], xy[1], ground_z]) + base[:3, 3]
    columns["center_m"][k] = foot + np.array([0, 0, height / 2])
    columns["size_m"][k] = length, width, height
    columns["covariance"][k] = base[:2, :2] @ covariance @ base[:2, :2].T
    columns["source"][k] = "topdown"
