"""The homography stage: every camera's homography, and positions for obstacles without LiDAR points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.config import TopdownConfig
from log2sim.datatypes import TYPICAL_SIZE_M, Log, Measurements, Obstacles
from log2sim.geometry import Array, Camera, ground_homography, inverse, line_stamps_ns, rotation_from_rpy
from log2sim.perception.first_pass import Observations, base_poses
from log2sim.perception.homography.correspondences import Correspondences, feet_of_boxes, undistorted_pixels
from log2sim.perception.homography.estimate import (
    FOOT_SIGMA_PX,
    MAX_CONDITION,
    STREAM_METHODS,
    EstimationOptions,
    fit_camera,
)
from log2sim.perception.homography.fit import HomographyFit
from log2sim.perception.homography.place import place_obstacle, spanned_height_m
from log2sim.perception.homography.rig import SAMPLES, Rig, RigFit, fit_rig
from log2sim.perception.homography.slope import fit_slope, slope_homography
from log2sim.perception.lidar.measure import BORDER_PX
from log2sim.plan import HomographyScope, Plan

# A camera lower than this sees the ground under too flat an angle, m.
MIN_CAMERA_HEIGHT_M = 0.2
# Standard deviation of the angle between the wheels' plane under a vehicle and the ground that it sees: springs, and roads of
# changing grade. In two recorded drives that look flat it is 0.5 degrees.
TILT_SIGMA_RAD = np.deg2rad(0.5)
# Standard deviation of an edge of a box that something nearer covers, as a share of the side of the box: detectors complete what is hidden, or
# end the box where it begins.
HIDDEN_SHARE = 0.25
# A box with at least so many rays through it, of which fewer than this share end in it, is empty.
MIN_RAYS, MAX_STOPPED_SHARE = 5, 0.25
# Factor on the score of an obstacle with rays but no points on it: it may continue a track and hardly start one.
UNCONFIRMED_SCORE = 0.5
# Cameras of one pole are nearer to each other than an arm of its mast is long, horizontally.
MAX_POLE_M = 5.0
# Rays count as toward the obstacle between these shares of its height, clear of the ground and of its upper edge.
RAY_HEIGHT_SHARES = (0.2, 0.8)


@dataclass(frozen=True, eq=False)
class CameraHomography:
    """A camera's homography to the ground frame of the ego."""

    camera: Camera
    fit: HomographyFit
    # What it was fitted to, "calibration and flat ground" where a fit was refused, "none" where there is none
    source: str
    refusal: str = ""  # why the fit to the log was refused, "" otherwise
    rig: RigFit | None = None  # what it was fitted together with; None for a camera that was fitted apart


def fit_homographies(
    log: Log, observed: Observations, plan: Plan, config: TopdownConfig, *, rng: np.random.Generator
) -> dict[str, CameraHomography]:
    """Fit the cameras that need a homography, by the scope of the plan.

    A camera needs one when a detection of it has no LiDAR points, but a foot in the image. A refused fit is replaced by
    the calibration, and its reason kept.
    """
    if plan.homography is HomographyScope.NONE:
        return {}
    options = EstimationOptions(config.method, hypotheses=config.hypotheses or None)
    wanted, of_stream = set(plan.cameras), config.method in STREAM_METHODS
    if plan.homography is not HomographyScope.ALL_CAMERAS:
        rows = [(str(m.camera[k]), m.box_px[k]) for m in observed.measurements for k in np.flatnonzero(m.source == "")]
        wanted = {name for name, box_px in rows if _has_foot(log.cameras[name], box_px)}
    feet = {c: Correspondences.join(observed.feet.get(c, [])) for c in plan.cameras}
    ground = {c: Correspondences.join(observed.ground.get(c, [])) for c in plan.cameras}
    found, why_apart = dict[str, CameraHomography](), dict[str, str]()
    if wanted and config.rig == "together" and of_stream:
        rigs, why_apart = list_rigs(log, plan.cameras)
        for names in rigs:
            rig = Rig.of({c: log.cameras[c] for c in names}, log.ground_z_ego_m)
            fitted = fit_rig(rig, feet, ground, rng=rng, samples=options.hypotheses or SAMPLES)
            for c in names:
                fit = fitted.fits.get(c)
                if fit is not None and fit.ok:
                    source = f"obstacles and ground of {len(names)} cameras"
                    found[c] = CameraHomography(log.cameras[c], fit, source, "", fitted)
                else:
                    why_apart[c] = fitted.reason if fit is None else fit.reason
    for name in plan.cameras:
        if name in wanted and name not in found:
            camera = log.cameras[name]
            fit, source = fit_camera(feet[name], ground[name], replace(options, K=camera.K), rng=rng)
            refusal, calibrated = fit.reason, None if fit.ok else calibrated_homography(log, camera)
            if not fit.ok:
                fit, source = (fit, "none") if calibrated is None else (calibrated, "calibration and flat ground")
            source += f" (apart: {why_apart[name]})" if why_apart.get(name) else ""
            found[name] = CameraHomography(camera, fit, source, refusal)
    out = {name: found[name] for name in plan.cameras if name in wanted}
    for name, one in out.items() if of_stream else ():
        # A second plane of the road, by the feet of obstacles where they were many.
        stamps = {k: m.t_ns[m.camera == name] for k, m in enumerate(observed.measurements)}
        map_T_base = {k: base_poses(log, t_ns[:1])[0] for k, t_ns in stamps.items() if len(t_ns)}
        fit = fit_slope(one.fit, feet[name], one.camera.K, map_T_base)
        out[name] = replace(one, fit=fit)
    return out


def list_rigs(log: Log, cameras: Sequence[str]) -> tuple[list[list[str]], dict[str, str]]:
    """List the cameras that see one ground: those of the ego, and those of each place at the road.

    Returns `rigs`; `left_out`: why a camera belongs to none.
    """
    left_out: dict[str, str] = {}
    rigs: list[list[str]] = []
    for name in cameras:
        camera = log.cameras[name]
        if calibrated_homography(log, camera) is None:
            left_out[name] = "its mount does not say how high above the ground it is"
        elif (camera.mount == "ego") == (log.ego is None):
            left_out[name] = "it does not move with the ground positions"
        else:
            # On the vehicle, or on one pole.
            apart_m = [log.cameras[rig[0]].mount_T_cam[:2, 3] - camera.mount_T_cam[:2, 3] for rig in rigs]
            own = [rig for rig, a in zip(rigs, apart_m) if camera.mount == "ego" or np.hypot(*a) < MAX_POLE_M]
            if not own:
                rigs.append([])
            (own or rigs[-1:])[0].append(name)
    left_out |= {rig[0]: "no other camera is in its place" for rig in rigs if len(rig) == 1}
    return [rig for rig in rigs if len(rig) > 1], left_out


def _has_foot(camera: Camera, box_px: Array) -> bool:
    """Return whether the obstacle in a box (4,) touches the ground inside the image."""
    return bool(box_px[3] <= camera.height_px - BORDER_PX)


def calibrated_homography(log: Log, camera: Camera) -> HomographyFit | None:
    """Make the homography of flat ground under the ego from the calibration; None for a camera near the ground."""
    if camera.mount_T_cam[2, 3] - log.ground_z_ego_m < MIN_CAMERA_HEIGHT_M:
        return None
    # As it is, and tilted by a standard deviation about either axis of the ground below the camera, whose place may be far from the
    # origin of the map.
    tilts = [np.eye(3), rotation_from_rpy(TILT_SIGMA_RAD, 0.0, 0.0), rotation_from_rpy(0.0, TILT_SIGMA_RAD, 0.0)]
    found = []
    for tilt in tilts:
        pose = camera.mount_T_cam.copy()
        pose[:3, :3] = tilt @ pose[:3, :3]
        try:
            h = ground_homography(camera, pose, log.ground_z_ego_m)
        except np.linalg.LinAlgError:
            return None
        if np.linalg.cond(h) > MAX_CONDITION:
            return None
        found.append(h / np.linalg.norm(h[2]))
    h = found[0]
    by_tilt = np.array([f - h for f in found[1:]]).reshape(2, 9)
    s, no_rows = np.linalg.svd(h, compute_uv=False), np.zeros(0, dtype=bool)
    return HomographyFit(True, "", h, no_rows, float("nan"), float(s[0] / s[-1]), covariance=by_tilt.T @ by_tilt)


def place_by_homography(
    log: Log, observed: Observations, homographies: Mapping[str, CameraHomography]
) -> list[Measurements]:
    """Place the measurements without LiDAR points by their camera's homography, where it is able to, at every tick."""
    out, ground_z_m = [], log.ground_z_ego_m
    for tick, (m, obstacles) in enumerate(zip(observed.measurements, observed.obstacles, strict=True)):
        missing = np.flatnonzero(m.source == "")
        columns: dict[str, Any] = vars(m)
        if len(missing):
            columns = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in columns.items()}
        poses: dict[tuple[str, int], tuple[Array, Array]] = {}
        for k in missing.tolist():
            name, box_px, category = str(m.camera[k]), m.box_px[k], str(m.category[k])
            fit = homographies[name].fit if name in homographies and name in log.cameras else None
            h = None if fit is None else fit.at_tick(tick)
            if fit is None or h is None or not _has_foot(log.cameras[name], box_px):
                continue
            camera, foot_px = log.cameras[name], feet_of_boxes(box_px[None])
            # Seen in its line of a rolling shutter from where the camera was then.
            frame = name, int(line_stamps_ns(camera, int(m.t_ns[k]), foot_px)[0])
            if frame not in poses:
                map_T_base = base_poses(log, np.array(frame[1:]))[0]
                on_map = camera.mount == "map" and log.ego is not None
                poses[frame] = map_T_base, inverse(map_T_base) @ camera.mount_T_cam if on_map else camera.mount_T_cam
            (map_T_base, base_T_cam), uncertainty = poses[frame], fit.covariance_at(tick)
            if fit.slope is not None:
                bent = slope_homography(fit.slope, h, camera.K, map_T_base, undistorted_pixels(camera, foot_px)[0])
                if bent is not None:
                    h, by_slope = bent
                    uncertainty = np.outer(by_slope, by_slope) + (0.0 if uncertainty is None else uncertainty)
            placed = place_obstacle(h, camera, box_px, category, base_T_cam, uncertainty, edge_sigmas(m, k, camera))
            if placed is None:
                continue
            if obstacles is not None:
                beyond, stopped = count_rays(obstacles, map_T_base, placed, ground_z_m, category)
                if beyond >= MIN_RAYS and stopped < MAX_STOPPED_SHARE * beyond:
                    continue
                if beyond + stopped >= MIN_RAYS:
                    columns["score"][k] *= UNCONFIRMED_SCORE
            xy, covariance = placed
            foot = map_T_base[:3, :3] @ np.array([xy[0], xy[1], ground_z_m]) + map_T_base[:3, 3]
            columns["center_m"][k] = foot + np.array([0, 0, TYPICAL_SIZE_M[category][2] / 2])
            columns["bottom_m"][k], columns["source"][k] = foot[2], "topdown"
            columns["covariance"][k] = map_T_base[:2, :2] @ covariance @ map_T_base[:2, :2].T
            columns["height_px_m"][k] = spanned_height_m(h, camera, box_px, base_T_cam)
        out.append(Measurements(**columns) if len(missing) else m)
    return out


def edge_sigmas(m: Measurements, k: int, camera: Camera) -> Array:
    """Return the standard deviations (4,), px, of the edges of a box: left, top, right, bottom.

    Infinite where the box ends with the image. The box of what is nearer reaches further down; where it holds the middle of an edge the
    obstacle goes on behind it.
    """
    box = m.box_px[k]
    x, y = (box[0] + box[2]) / 2, (box[1] + box[3]) / 2
    others = m.box_px[(m.camera == m.camera[k]) & (m.t_ns == m.t_ns[k]) & (m.box_px[:, 3] > box[3])]
    middles = np.array([[box[0], y], [x, box[1]], [box[2], y], [x, box[3]]])
    covered = np.any(np.all((others[:, None, :2] < middles) & (others[:, None, 2:] > middles), axis=2), axis=0)
    sigma = np.hypot(FOOT_SIGMA_PX, np.where(covered, HIDDEN_SHARE * np.tile(box[2:] - box[:2], 2), 0.0))
    last = np.array([camera.width_px, camera.height_px]) - 1 - BORDER_PX
    return np.where(np.append(box[:2] < BORDER_PX, box[2:] > last), np.inf, sigma)


def count_rays(
    obstacles: Obstacles, map_T_base: Array, placed: tuple[Array, Array], ground_z_m: float, category: str
) -> tuple[int, int]:
    """Count the LiDAR rays toward an obstacle that went on behind it, and those that ended before or in it.

    `placed` is its position (2,) and covariance (2, 2) in the frame whose pose is `map_T_base` (4, 4).
    """
    xy, covariance = placed
    _, width, height = TYPICAL_SIZE_M[category]
    foot = map_T_base[:3, :3] @ np.array([xy[0], xy[1], ground_z_m]) + map_T_base[:3, 3]
    foot = foot - obstacles.origin - obstacles.sensor
    range_m = float(np.hypot(*foot[:2]))
    sigma_m = float(np.sqrt(xy @ covariance @ xy) / max(np.hypot(*xy), 1e-6))
    azimuth, reach, slope = obstacles.rays
    turned, reached = np.abs(azimuth - np.arctan2(foot[1], foot[0])), width / 2 / max(range_m, 1e-6)
    near = np.flatnonzero((turned < reached) | (turned > 2 * np.pi - reached))
    z_there = slope[near] * range_m - foot[2]
    low, high = RAY_HEIGHT_SHARES
    toward = near[(z_there > low * height) & (z_there < high * height)]
    beyond = int((reach[toward] > range_m + width + 2 * sigma_m).sum())
    return beyond, len(toward) - beyond
