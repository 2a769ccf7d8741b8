"""Points in images and in boxes, against the plain way: project everything, compare everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import brentq
from worlds import Solid, camera_ahead, scan

from log2sim.datatypes import Log
from log2sim.geometry import (
    PoseTrack,
    RollingShutter,
    apply,
    box_corners,
    inverse,
    project,
    rotation_from_rpy,
    transform,
)
from log2sim.perception.lidar import projection
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

BROWN = {"distortion_model": "brown", "distortion": (-0.3, 0.1, 0.001, -0.002, -0.02)}
FISHEYE = {"distortion_model": "fisheye", "distortion": (0.02, -0.01, 0.003, 0.0)}


def view_of(**changes):
    camera = replace(camera_ahead(mount="map", at=(1.5, 0.2, 1.6)), **changes)
    turn = transform(rotation_from_rpy(0.02, -0.05, 0.7), [0.0, 0.0, 0.0])
    return View(camera, 0, turn @ camera.mount_T_cam)


@pytest.mark.parametrize("lens", [{}, BROWN, FISHEYE], ids=["pinhole", "brown", "fisheye"])
@pytest.mark.parametrize("far", [(0.0, 0.0, 0.0), (5e5, 5e6, 300.0)])
def test_a_camera_sees_what_projection_puts_into_its_image(lens, far):
    view = view_of(**lens)
    points = np.random.default_rng(0).uniform([-60, -60, -3], [60, 60, 6], (4000, 3)).astype(np.float32)
    moved = View(view.camera, 0, transform(np.eye(3), far) @ view.map_T_cam)
    seen = project_points(moved, np.array(far), np.ascontiguousarray(points.T))
    in_cam = apply(inverse(view.map_T_cam), points.astype(np.float64))
    uv, inside = project(view.camera, in_cam)
    # Single precision: what lies within a hundredth of a pixel of the border may fall on either side.
    size = np.array([view.camera.width_px, view.camera.height_px])
    with np.errstate(invalid="ignore"):
        clear = inside & (np.minimum(uv, size - uv) > 0.01).all(axis=1)
    assert inside.sum() > 100
    assert (
        set(np.flatnonzero(clear))
        <= set(seen.index)
        <= set(np.flatnonzero(inside | ~np.isfinite(uv).all(axis=1) | ~clear))
    )
    np.testing.assert_allclose(np.stack([seen.u, seen.v], axis=1), uv[seen.index], atol=0.01)
    np.testing.assert_allclose(seen.depth, in_cam[seen.index, 2], rtol=1e-5, atol=1e-4)


READOUT_S = 0.05
T_NS = 10**18


def moving_log(lens, direction="right", mount="ego"):
    """A camera that looks to the side of an ego at 15 m/s on a curve, and reads its columns one after the other."""
    shutter = None if direction is None else RollingShutter(direction, READOUT_S)
    camera = replace(camera_ahead(mount=mount, at=(1.0, 0.8, 1.6), yaw_rad=np.pi / 2), rolling_shutter=shutter, **lens)
    t_s = np.linspace(-0.2, 0.2, 81)
    yaw = 0.3 + 0.5 * t_s
    position = np.array([400.0, -300.0, 20.0]) + np.outer(15.0 * t_s, [np.cos(0.3), np.sin(0.3), 0.0])
    poses = transform(rotation_from_rpy(0 * yaw, 0 * yaw, yaw), position)
    track = PoseTrack(T_NS + np.round(t_s * 1e9).astype(np.int64), poses)
    return Log("moving", "memory", {"front": camera}, {}, {}, ego=track)


def seen_by_lines(log, points):
    """Where points (N, 3) of the map are seen: the column that is read at t shows the point as the camera is at t."""
    camera, out = log.cameras["front"], []

    def at(point, t):
        pose = log.map_T_sensor("front", T_NS + round(t * 1e9))[0][0]
        return project(camera, apply(inverse(pose), point[None]))[0][0]

    for point in points:
        t = brentq(
            lambda t, p=point: at(p, t)[0] - (0.5 + t / READOUT_S) * camera.width_px, -READOUT_S, READOUT_S, xtol=1e-9
        )
        out.append(at(point, t))
    return np.array(out)


@pytest.mark.parametrize("lens", [{}, BROWN], ids=["pinhole", "brown"])
def test_a_box_in_an_image_read_column_by_column_holds_the_points_of_its_object(lens):
    log = moving_log(lens)
    map_T_ego = log.ego.at(T_NS)[0][0]
    seen, owner = scan([Solid((3.0, 7.0, 0.8))], azimuth_deg=(30.0, 120.0))
    on_car = apply(map_T_ego, seen[owner == 0][::40])
    uv = seen_by_lines(log, on_car)
    assert len(uv) > 50
    assert ((uv > 0) & (uv < [1200, 600])).all()
    box = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
    origin = map_T_ego[:3, 3]
    columns = np.ascontiguousarray((on_car - origin).T.astype(np.float32))
    view = projection.view_of(log, "front", T_NS)
    found = project_points(view, origin, columns)
    assert found.index.tolist() == list(range(len(on_car)))
    np.testing.assert_allclose(np.stack([found.u, found.v], axis=1), uv, atol=0.02)
    assert [len(rows) for rows in points_in_image_boxes(found, box[None] + [-0.1, -0.1, 0.1, 0.1])] == [len(on_car)]
    # The pose of the middle alone puts some of them beside the box.
    middle = project_points(replace(view, cam_T_map_at=None), origin, columns)
    assert np.abs(middle.u - found.u[middle.index]).max() > 10
    assert len(points_in_image_boxes(middle, box[None])[0]) < len(on_car)


def test_a_box_is_projected_by_the_pose_of_the_line_that_shows_its_middle():
    log = moving_log({})
    map_T_ego = log.ego.at(T_NS)[0][0]
    view = projection.view_of(log, "front", T_NS)
    local = np.array([[3.5, 9.0, 0.8], [-2.5, 12.0, 0.8], [1.0, -30.0, 0.8]])
    center, yaw = apply(map_T_ego, local), np.full(3, 0.2)
    size = np.tile([0.8, 0.6, 1.7], (3, 1))
    found = projection.project_boxes_in_view(view, center, size, yaw)
    assert found.valid.tolist() == [True, True, False]
    middle = projection.project_boxes_in_view(replace(view, cam_T_map_at=None), center, size, yaw)
    for i in range(2):
        corners = seen_by_lines(log, box_corners(center[i], size[i], yaw[i])[0])
        box = np.concatenate([corners.min(axis=0), corners.max(axis=0)])
        # A small box is seen within a few lines.
        assert found.box_px[i] == pytest.approx(box, abs=2.0)
        assert np.abs(middle.box_px[i] - box).max() > 5
