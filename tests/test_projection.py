"""Points in images and in boxes, against the plain way: project everything, compare everything."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from worlds import camera_ahead

from log2sim.geometry import apply, inverse, project, rotation_from_rpy, transform
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

BROWN = {"distortion_model": "brown", "distortion": (-0.3, 0.1, 0.001, -0.002, -0.02)}
FISHEYE = {"distortion_model": "fisheye", "distortion": (0.02, -0.01, 0.003, 0.0)}


def some_points(count=4000, seed=0):
    return np.random.default_rng(seed).uniform([-60, -60, -3], [60, 60, 6], (count, 3)).astype(np.float32)


def view_of(**changes):
    camera = replace(camera_ahead(mount="map", at=(1.5, 0.2, 1.6)), **changes)
    turn = transform(rotation_from_rpy(0.02, -0.05, 0.7), [0.0, 0.0, 0.0])
    return View(camera, 0, turn @ camera.mount_T_cam)


@pytest.mark.parametrize("lens", [{}, BROWN, FISHEYE], ids=["pinhole", "brown", "fisheye"])
@pytest.mark.parametrize("far", [(0.0, 0.0, 0.0), (5e5, 5e6, 300.0)])
def test_a_camera_sees_what_projection_puts_into_its_image(lens, far):
    view, points = view_of(**lens), some_points()
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


@pytest.mark.parametrize("margin", [0.0, 0.15])
def test_points_in_boxes_are_those_that_plain_comparison_finds(margin):
    view = view_of()
    seen = project_points(view, np.zeros(3), np.ascontiguousarray(some_points(20000).T))
    rng = np.random.default_rng(1)
    corner = rng.uniform([-50, -50], [view.camera.width_px, view.camera.height_px], (40, 2))
    boxes = np.concatenate([corner, corner + rng.uniform(0, 400, (40, 2))], axis=1)
    boxes[3] = np.nan
    found = points_in_image_boxes(seen, boxes, margin)
    total = 0
    for (u0, v0, u1, v1), rows in zip(boxes, found, strict=True):
        wide, tall = margin * (u1 - u0), margin * (v1 - v0)
        plain = (seen.u >= u0 - wide) & (seen.u <= u1 + wide) & (seen.v >= v0 - tall) & (seen.v <= v1)
        assert rows.tolist() == np.flatnonzero(plain).tolist()
        total += len(rows)
    assert total > 1000
    assert len(found[3]) == 0


def test_nothing_in_sight_and_no_boxes():
    view = view_of()
    none = project_points(view, np.zeros(3), np.zeros((3, 0), dtype=np.float32))
    assert len(none.index) == 0
    assert [len(rows) for rows in points_in_image_boxes(none, np.array([[0.0, 0, 10, 10]]))] == [0]
    assert points_in_image_boxes(none, np.zeros((0, 4))) == []


def test_a_large_cloud_before_a_small_one_leaves_nothing_behind():
    view, small = view_of(), np.ascontiguousarray(some_points(300, seed=2).T)
    before = project_points(view, np.zeros(3), small)
    project_points(view, np.zeros(3), np.ascontiguousarray(some_points(5000, seed=3).T))
    after = project_points(view, np.zeros(3), small)
    np.testing.assert_array_equal(before.index, after.index)
    np.testing.assert_array_equal(before.u, after.u)
