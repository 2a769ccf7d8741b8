"""The second pass: homographies from calibration and from data, and obstacles placed by them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import camera_ahead, outline_px, scan, standing

from log2sim.config import TopdownConfig
from log2sim.datatypes import TYPICAL_SIZE_M, Detections, Log, Measurements, Obstacles, Stream
from log2sim.geometry import (
    PoseTrack,
    RollingShutter,
    apply,
    apply_homography,
    inverse,
    line_stamps_ns,
    project,
    project_moving,
    rotation_from_rpy,
    transform,
)
from log2sim.perception.first_pass import Observations, base_poses
from log2sim.perception.homography.correspondences import Correspondences, feet_of_boxes
from log2sim.perception.homography.fit import ground_covariances
from log2sim.perception.homography_stage import (
    TILT_SIGMA_RAD,
    CameraHomography,
    calibrated_homography,
    fit_homographies,
    place_by_homography,
)
from log2sim.perception.lidar.projection import poses_around
from log2sim.plan import HomographyScope, Plan

T0_NS = 1_700_000_000_000_000_000
RNG_SEED = 5


def log_with(camera, *, far=(0.0, 0.0, 0.0), yaw=0.0, ground_z=0.0):
    """A log of five ticks whose ego stands still at a place in the map."""
    t = T0_NS + np.arange(5) * 100_000_000
    pose = transform(rotation_from_rpy(0, 0, yaw), np.array(far))
    ego = PoseTrack(t, np.repeat(pose[None], 5, axis=0))
    streams = {camera.name: Stream(camera.name, t, lambda i: None)}
    return Log("log", "test", {camera.name: camera}, {}, streams, ego, ground_z_ego_m=ground_z)


def tilted(pitch_rad=0.05, roll_rad=0.0, at=(1.5, 0.2, 1.6), **changes):
    camera = camera_ahead(mount="ego", at=at)
    turn = rotation_from_rpy(roll_rad, pitch_rad, 0.0)
    mount = transform(turn @ camera.mount_T_cam[:3, :3], camera.mount_T_cam[:3, 3])
    return replace(camera, mount_T_cam=mount, **changes)


def plan_with(scope=HomographyScope.CAMERAS_IN_NEED):
    return Plan(("front",), (), scope)


def unplaced(boxes_px, t_ns=T0_NS, category="car", camera="front"):
    """Rows of one frame without a position."""
    m = len(boxes_px)
    detections = Detections(np.asarray(boxes_px, float), np.full(m, 0.9), np.full(m, category, dtype="<U16"))
    return Measurements.unplaced(detections, t_ns=t_ns, camera=camera, sensor_m=np.zeros(3))


@pytest.mark.parametrize("ground_z", [0.0, -0.35])
@pytest.mark.parametrize(("pitch", "roll"), [(0.0, 0.0), (0.08, 0.03), (-0.04, -0.1)])
def test_the_calibrations_homography_undoes_the_projection_of_flat_ground(pitch, roll, ground_z):
    camera = tilted(pitch, roll)
    fit = calibrated_homography(log_with(camera, ground_z=ground_z), camera)
    rng = np.random.default_rng(0)
    ground = np.column_stack([rng.uniform(5, 60, 300), rng.uniform(-20, 20, 300), np.full(300, ground_z)])
    uv, seen = project(camera, apply(inverse(camera.mount_T_cam), ground))
    assert seen.sum() > 50
    xy, below = apply_homography(fit.ground_H_image, uv[seen])
    assert below.all()
    np.testing.assert_allclose(xy, ground[seen, :2], atol=1e-6)
    assert fit.ok
    assert np.isfinite(fit.condition)


def fit(log, seen, plan=None):
    rng = np.random.default_rng(RNG_SEED)
    return fit_homographies(log, seen, plan or plan_with(), TopdownConfig(), rng=rng)


def test_nothing_is_fitted_when_the_plan_leaves_it_out():
    seen = Observations(measurements=[unplaced([[1, 2, 3, 4]])])
    assert fit(log_with(tilted()), seen, plan_with(HomographyScope.NONE)) == {}


@pytest.mark.parametrize(("far", "yaw"), [((0, 0, 0), 0.0), ((5e5, 5e6, 80.0), 2.1), ((-40.0, 7, -3), -1.2)])
@pytest.mark.parametrize("category", ["car", "pedestrian"])
def test_an_obstacle_without_points_is_placed_where_its_foot_is(far, yaw, category):
    camera = tilted()
    log = log_with(camera, far=far, yaw=yaw)
    size = TYPICAL_SIZE_M[category]
    solid = standing(18.0, 3.0, 0.0, size)
    m = unplaced([outline_px(camera, camera.mount_T_cam, solid)], category=category)
    seen = Observations(measurements=[m], obstacles=[None])
    homographies = {"front": CameraHomography(camera, calibrated_homography(log, camera), "calibration")}
    row = place_by_homography(log, seen, homographies)[0]
    truth = apply(log.ego.map_T_ego[0], np.array([solid.center_m]))[0]
    error = (row.center_m[0] - truth)[:2]
    assert row.source.tolist() == ["topdown"]
    assert error @ np.linalg.solve(row.covariance[0], error) < 9.21
    # A person's feet are nearer to the middle than the sides of this block.
    assert np.hypot(*error) < 0.2 + 0.35 * (size[0] - size[1])
    assert row.center_m[0, 2] == pytest.approx(truth[2], abs=1e-6)
    assert row.bottom_m[0] == pytest.approx(truth[2] - size[2] / 2, abs=1e-6)
    assert np.isnan(row.low_m).all()  # nothing of its extents was observed
    # The rows of the first pass are left as they were.
    assert m.source.tolist() == [""]
    assert np.isnan(m.center_m).all()


def test_a_camera_far_from_the_origin_of_the_map_is_as_sure_of_the_ground():
    near = tilted(0.08)
    pose = near.mount_T_cam.copy()
    pose[:2, 3] += [800.0, -300.0]
    far = replace(near, mount_T_cam=pose)
    fits = [calibrated_homography(log_with(c), c) for c in (near, far)]
    uv = project(near, apply(inverse(near.mount_T_cam), [[20.0, 1.0, 0.0]]))[0]
    one, other = (ground_covariances(fit.ground_H_image, fit.covariance, uv)[0] for fit in fits)
    np.testing.assert_allclose(one, other, rtol=1e-4)
    range_m, height_m = 20.0 - near.mount_T_cam[0, 3], near.mount_T_cam[2, 3]
    assert np.sqrt(one[0, 0]) == pytest.approx(TILT_SIGMA_RAD * range_m**2 / height_m, rel=0.1)


def test_the_covariance_turns_with_the_ego():
    camera = tilted()
    box = outline_px(camera, camera.mount_T_cam, standing(30.0, 0.0))

    def covariance(yaw):
        log = log_with(camera, yaw=yaw)
        ground = {"front": CameraHomography(camera, calibrated_homography(log, camera), "calibration")}
        seen = Observations(measurements=[unplaced([box])], obstacles=[None])
        return place_by_homography(log, seen, ground)[0].covariance[0]

    along = covariance(0.0)
    assert along[0, 0] > 4 * along[1, 1]
    turn = rotation_from_rpy(0, 0, 1.1)[:2, :2]
    np.testing.assert_allclose(covariance(1.1), turn @ along @ turn.T, atol=1e-9)


def placed_where_rays_go(solids, at=(15.0, 1.0)):
    """A car's box at a place, and what `place_by_homography` makes of it where a LiDAR saw these solids."""
    camera = tilted(0.0)
    log = log_with(camera)
    car = standing(*at)
    box = outline_px(camera, log.map_T_sensor("front", T0_NS)[0][0], car)
    xyz, owner = scan(solids)
    above = xyz[(owner >= 0) & (xyz[:, 2] > 0.2)].astype(np.float32)
    cloud = Obstacles(T0_NS, np.zeros(3), above, np.zeros(len(above), np.float32), np.array([0, 0, 1.9], np.float32))
    ground = {"front": CameraHomography(camera, calibrated_homography(log, camera), "calibration")}
    seen = Observations(measurements=[unplaced([box])], obstacles=[cloud])
    return place_by_homography(log, seen, ground)[0]


FAR_WALL = standing(22.0, 0.0, 0.0, (0.5, 80.0, 4.0))


def test_what_the_lidar_looks_through_is_not_placed():
    assert placed_where_rays_go([FAR_WALL]).source.tolist() == [""]


# A camera that turns while it reads its lines.


def turning_log(readout_s):
    """An ego that drives slalom at 6 m/s; turns that stay the same a homography would absorb."""
    t = T0_NS + np.arange(-1, 82) * 50_000_000
    s = (t - T0_NS) / 1e9
    yaw, places = 0.3 * np.sin(np.pi * s), np.column_stack([6.0 * s, np.zeros((len(t), 2))])
    ego = PoseTrack(t, np.array([transform(rotation_from_rpy(0, 0, y), p) for y, p in zip(yaw, places)]))
    shutter = RollingShutter("down", readout_s) if readout_s else None
    camera = tilted(0.06, rolling_shutter=shutter)
    return Log("log", "test", {"front": camera}, {}, {"front": Stream("front", t[1:-1:2], lambda i: None)}, ego)


def seen_in_lines(log, t_ns, posts_xy):
    """Boxes (N, 4) of people who stand at places (N, 2) of the ego frame at the stamp, and their feet in the map (N, 3)."""
    camera = log.cameras["front"]
    moving = replace(camera, rolling_shutter=RollingShutter("down", 0.06))
    ray = posts_xy - camera.mount_T_cam[:2, 3]
    aside = TYPICAL_SIZE_M["pedestrian"][0] / 2 * np.column_stack([-ray[:, 1], ray[:, 0]]) / np.hypot(*ray.T)[:, None]
    uv, places = [], []
    for xy in (posts_xy, posts_xy + aside, posts_xy - aside):
        places.append(apply(log.ego.at(t_ns)[0][0], np.column_stack([xy, np.zeros(len(xy))])))
        found, _, valid = project_moving(moving, places[-1], poses_around(log, "front", int(t_ns)))
        uv.append(np.where(valid[:, None], found, np.nan))
    foot, left, right = uv
    tall = TYPICAL_SIZE_M["pedestrian"][2] * camera.K[1, 1] / ray[:, 0]
    box_px = np.column_stack([left[:, 0], foot[:, 1] - tall, right[:, 0], foot[:, 1]])
    valid = np.isfinite(box_px).all(axis=1)
    return box_px[valid], places[0][valid]


@pytest.mark.parametrize(("told", "limit_m"), [(True, (0.0, 0.023)), (False, (0.025, 1.0))], ids=["told", "not told"])
def test_a_camera_that_turns_while_it_reads_its_lines_places_obstacles_where_they_are(told, limit_m):
    log, rng = turning_log(0.06 if told else 0.0), np.random.default_rng(2)
    camera, seen = log.cameras["front"], Observations(measurements=[], obstacles=[])
    errors = []
    for tick, t_ns in enumerate(log.streams["front"].t_ns):
        posts = np.column_stack([rng.uniform(6, 40, 14), rng.uniform(-0.6, 0.6, 14)])
        posts[:, 1] *= posts[:, 0]
        box_px, feet = seen_in_lines(log, t_ns, posts)
        ego_T_map = inverse(base_poses(log, line_stamps_ns(camera, int(t_ns), feet_of_boxes(box_px))))
        xy = ((ego_T_map[:, :3, :3] @ feet[:, :, None])[:, :, 0] + ego_T_map[:, :3, 3])[:, :2]
        one = np.full(len(xy), tick)
        seen.feet.setdefault("front", []).append(Correspondences(feet_of_boxes(box_px), xy, one))
        seen.measurements.append(unplaced(box_px, int(t_ns), "pedestrian"))
        seen.obstacles.append(None)
        errors.append(feet)
    grounds = fit(log, seen)
    assert grounds["front"].source == "obstacles"
    for k, rows in enumerate(place_by_homography(log, seen, grounds)):
        placed = rows.source == "topdown"
        away = rows.center_m[placed, :2] - errors[k][placed, :2]
        ray = rows.center_m[placed, :2] - log.map_T_sensor("front", rows.t_ns[0])[0][0][:2, 3]
        # A turn moves obstacles across the rays.
        errors[k] = np.abs(away[:, 0] * ray[:, 1] - away[:, 1] * ray[:, 0]) / np.hypot(*ray.T)
    assert limit_m[0] < np.median(np.concatenate(errors)) < limit_m[1]
