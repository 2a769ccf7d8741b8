"""The homography stage: every camera's homography, and positions for obstacles without LiDAR points."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.config import TopdownConfig
from log2sim.datatypes import TYPICAL_SIZE_M, Log, Measurements, Obstacles
from log2sim.geometry import Array, Camera, ground_homography, inverse, line_stamps_ns
from log2sim.perception.first_pass import Observations, base_poses
from log2sim.perception.homography.correspondences import Correspondences, feet_of_boxes, undistorted_pixels
from log2sim.perception.homography.estimate import (
    FOOT_SIGMA_M,
    FOOT_SIGMA_PX,
    MAX_CONDITION,
    STREAM_METHODS,
    EstimationOptions,
    fit_camera,
    place_obstacle,
    spanned_height_m,
)
from log2sim.perception.homography.fit import HomographyFit, RoadSlope, refused_fit
from log2sim.perception.homography.rig import SAMPLES, Rig
from log2sim.perception.homography.rig_fit import RigFit, fit_rig
from log2sim.perception.homography.slope import fit_slope, slope_homography
from log2sim.perception.lidar.measure import BORDER_PX
from log2sim.plan import HomographyScope, Plan

# A camera lower than this sees the ground under too flat an angle, m.
MIN_CAMERA_HEIGHT_M = 0.2
# Free-space test: with at least this many rays through the box and fewer than this share of them ending in it, the box
# is empty.
MIN_RAYS, MAX_STOPPED_SHARE = 5, 0.25
# Factor on the score of an obstacle where the LiDAR has rays but no points on it: it may continue a track and hardly
# start one.
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
    wanted = set(plan.cameras) if plan.homography is HomographyScope.ALL_CAMERAS else _cameras_in_need(log, observed)
    joins = bool(wanted) and config.rig == "together" and config.method in STREAM_METHODS
    together, why_apart = _fit_together(log, observed, plan, options, rng) if joins else ({}, {})
    apart = {c: _fit_one(log, observed, c, options, rng) for c in plan.cameras if c in wanted and c not in together}
    apart = {
        c: replace(g, source=f"{g.source} (apart: {why_apart[c]})") if why_apart.get(c) else g for c, g in apart.items()
    }
    found = {c: together[c] if c in together else apart[c] for c in plan.cameras if c in wanted}
    return {c: _with_slope(log, observed, g) for c, g in found.items()} if config.method in STREAM_METHODS else found


def _with_slope(log: Log, observed: Observations, ground: CameraHomography) -> CameraHomography:
    """Fit a second plane of the road to what the homography of a camera was fitted to, the feet of obstacles where they were many."""
    name = ground.camera.name
    stamps = {k: m.t_ns[m.camera == name] for k, m in enumerate(observed.measurements)}
    map_T_base = {k: base_poses(log, t_ns[:1])[0] for k, t_ns in stamps.items() if len(t_ns)}
    feet = Correspondences.join(observed.feet.get(name, []))
    fit = fit_slope(ground.fit, feet, ground.camera.K, map_T_base, FOOT_SIGMA_PX, FOOT_SIGMA_M)
    return replace(ground, fit=fit)


def _fit_together(
    log: Log, observed: Observations, plan: Plan, options: EstimationOptions, rng: np.random.Generator
) -> tuple[dict[str, CameraHomography], dict[str, str]]:
    """Fit the cameras of each rig together; returns their homographies, and why the others are fitted apart, by camera."""
    found = {}
    rigs, why_apart = list_rigs(log, plan.cameras)
    for names in rigs:
        rig = Rig.of({c: log.cameras[c] for c in names}, log.ground_z_ego_m)
        feet, ground = (
            {c: Correspondences.join(o.get(c, [])) for c in names} for o in (observed.feet, observed.ground)
        )
        fitted = fit_rig(rig, feet, ground, rng=rng, samples=options.hypotheses or SAMPLES)
        for c in names:
            fit = fitted.fits.get(c)
            if fit is not None and fit.ok:
                found[c] = CameraHomography(
                    log.cameras[c], fit, f"obstacles and ground of {len(names)} cameras", "", fitted
                )
            else:
                why_apart[c] = fitted.reason if fit is None else fit.reason
    return found, why_apart


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
            own = [rig for rig in rigs if _in_one_place(log.cameras[rig[0]], camera)]
            if not own:
                rigs.append([])
            (own or rigs[-1:])[0].append(name)
    left_out |= {rig[0]: "no other camera is in its place" for rig in rigs if len(rig) == 1}
    return [rig for rig in rigs if len(rig) > 1], left_out


def _in_one_place(a: Camera, b: Camera) -> bool:
    """Return whether two cameras are on one vehicle or on one pole."""
    return a.mount == "ego" or float(np.hypot(*(a.mount_T_cam - b.mount_T_cam)[:2, 3])) < MAX_POLE_M


def _cameras_in_need(log: Log, observed: Observations) -> set[str]:
    rows = [(str(m.camera[k]), m.box_px[k]) for m in observed.measurements for k in np.flatnonzero(m.source == "")]
    return {name for name, box_px in rows if _has_foot(log.cameras[name], box_px)}


def _has_foot(camera: Camera, box_px: Array) -> bool:
    """Return whether the obstacle in a box (4,) touches the ground inside the image."""
    return bool(box_px[3] <= camera.height_px - BORDER_PX)


def _fit_one(
    log: Log, observed: Observations, name: str, options: EstimationOptions, rng: np.random.Generator
) -> CameraHomography:
    camera = log.cameras[name]
    feet = Correspondences.join(observed.feet.get(name, []))
    ground = Correspondences.join(observed.ground.get(name, []))
    fit, source = fit_camera(feet, ground, replace(options, K=camera.K), rng=rng)
    if fit.ok:
        return CameraHomography(camera, fit, source)
    calibrated = calibrated_homography(log, camera)
    if calibrated is None:
        return CameraHomography(camera, fit, "none", fit.reason)
    return CameraHomography(camera, calibrated, "calibration and flat ground", fit.reason)


def calibrated_homography(log: Log, camera: Camera) -> HomographyFit | None:
    """Make the homography of flat ground under the ego from the calibration; None for a camera near the ground."""
    if camera.mount_T_cam[2, 3] - log.ground_z_ego_m < MIN_CAMERA_HEIGHT_M:
        return None
    try:
        h = ground_homography(camera, camera.mount_T_cam, log.ground_z_ego_m)
    except np.linalg.LinAlgError:
        return None
    if np.linalg.cond(h) > MAX_CONDITION:
        return None
    h /= np.linalg.norm(h[2])
    s = np.linalg.svd(h, compute_uv=False)
    return HomographyFit(True, "", h, refused_fit("", 0).inliers, float("nan"), float(s[0] / s[-1]))


def place_by_homography(
    log: Log, observed: Observations, homographies: Mapping[str, CameraHomography]
) -> list[Measurements]:
    """Place the measurements without LiDAR points by their camera's homography, where it is able to, at every tick."""
    out = []
    for tick, (m, obstacles) in enumerate(zip(observed.measurements, observed.obstacles, strict=True)):
        fits = {name: homography.fit for name, homography in homographies.items()}
        found = {
            name: (h, f.covariance_at(tick), f.slope) for name, f in fits.items() if (h := f.at_tick(tick)) is not None
        }
        out.append(_place_tick(log, m, obstacles, found))
    return out


def _place_tick(
    log: Log,
    m: Measurements,
    obstacles: Obstacles | None,
    homographies: Mapping[str, tuple[Array, Array | None, RoadSlope | None]],
) -> Measurements:
    missing = np.flatnonzero(m.source == "")
    if len(missing) == 0:
        return m
    columns: dict[str, Any] = {k: v.copy() if isinstance(v, np.ndarray) else v for k, v in vars(m).items()}
    poses: dict[tuple[str, int], tuple[Array, Array]] = {}
    for k in missing:
        camera = log.cameras.get(str(m.camera[k]))
        if camera is None or camera.name not in homographies or not _has_foot(camera, m.box_px[k]):
            continue
        # Seen in its line of a rolling shutter from where the camera was then.
        frame = camera.name, int(line_stamps_ns(camera, int(m.t_ns[k]), feet_of_boxes(m.box_px[[k]]))[0])
        if frame not in poses:
            map_T_base = base_poses(log, np.array(frame[1:]))[0]
            on_map = camera.mount == "map" and log.ego is not None
            poses[frame] = map_T_base, inverse(map_T_base) @ camera.mount_T_cam if on_map else camera.mount_T_cam
        (map_T_base, base_T_cam), (h, uncertainty, slope) = poses[frame], homographies[camera.name]
        if slope is not None:
            foot_px = undistorted_pixels(camera, feet_of_boxes(m.box_px[[k]]))[0]
            bent = slope_homography(slope, h, camera.K, map_T_base, foot_px)
            if bent is not None:
                h, by_slope = bent
                uncertainty = np.outer(by_slope, by_slope) + (0.0 if uncertainty is None else uncertainty)
        placed = place_obstacle(h, camera, m.box_px[k], str(m.category[k]), base_T_cam[:2, 3], uncertainty)
        if placed is None:
            continue
        if obstacles is not None:
            beyond, stopped = count_rays(obstacles, map_T_base, placed, log.ground_z_ego_m, str(m.category[k]))
            if beyond >= MIN_RAYS and stopped < MAX_STOPPED_SHARE * beyond:
                continue
            if beyond + stopped >= MIN_RAYS:
                columns["score"][k] *= UNCONFIRMED_SCORE
        xy, covariance = placed
        foot = map_T_base[:3, :3] @ np.array([xy[0], xy[1], log.ground_z_ego_m]) + map_T_base[:3, 3]
        columns["center_m"][k] = foot + np.array([0, 0, TYPICAL_SIZE_M[str(m.category[k])][2] / 2])
        columns["bottom_m"][k], columns["source"][k] = foot[2], "topdown"
        columns["covariance"][k] = map_T_base[:2, :2] @ covariance @ map_T_base[:2, :2].T
        columns["height_px_m"][k] = spanned_height_m(h, camera, m.box_px[k], base_T_cam)
    return Measurements(**columns)


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
