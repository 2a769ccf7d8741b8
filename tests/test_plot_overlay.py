"""Boxes and points on camera images."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.geometry import Camera, box_lines
from log2sim.visualization.plot.overlay import draw_overlay

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), "ego", np.eye(4))
CAM_T_EGO = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""A camera at the ego's origin that looks forward."""


def corners_cam(x0: float, x1: float) -> np.ndarray:
    """A box of 2 m x 2 m across that reaches from depth x0 to x1, in the order of `box_corners` seen by the camera."""
    across = [(-1, x1), (-1, x0), (1, x0), (1, x1)]
    return np.array([(u, v, z) for v in (1, -1) for u, z in across], dtype=float)


def test_corners_land_where_the_pinhole_puts_them() -> None:
    lines = box_lines(CAMERA, corners_cam(10.0, 20.0)).reshape(-1, 2)
    # 500 px * 1 m / 10 m = 50 px and half of it at 20 m.
    expected = {(320 + s * d, 240 + t * d) for d in (50, 25) for s in (-1, 1) for t in (-1, 1)}
    assert {tuple(np.round(p, 9)) for p in lines} == {(float(u), float(v)) for u, v in expected}


def test_a_box_beside_the_camera_is_cut_at_the_near_plane() -> None:
    lines = box_lines(CAMERA, corners_cam(-5.0, 10.0))
    assert np.isfinite(lines).all()
    assert len(lines) == 10  # four edges far ahead, four along, the crossed-out front
    assert len(box_lines(CAMERA, corners_cam(-9.0, -3.0))) == 0


def test_a_box_out_of_sight_draws_nothing() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    out = draw_overlay(
        image, CAMERA, CAM_T_EGO, center_m=[[-10, 0, 0]], size_m=[[4, 2, 2]], yaw_rad=[0.0], labels=["car"]
    )
    assert not out.any()


def test_boxes_labels_and_2d_boxes_are_drawn_on_a_copy() -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    boxes = {"center_m": [[12, 0, 0], [30, 3, 0]], "size_m": [[4, 2, 2], [4, 2, 2]], "yaw_rad": [0.3, 0.0]}
    out = draw_overlay(image, CAMERA, CAM_T_EGO, **boxes, labels=["a", "ü"], box_px=[[10, 10, 50, 60]])
    assert not image.any()
    assert (out[10, 30] > 200).all()
    assert out[200:280, 250:390].any()


@pytest.mark.parametrize(("depth_m", "hot"), [(2.5, 2), (55.0, 0)])
def test_near_points_are_red_and_far_points_blue(depth_m: float, hot: int) -> None:
    image = np.zeros((480, 640, 3), dtype=np.uint8)
    out = draw_overlay(image, CAMERA, CAM_T_EGO, points_map=np.array([[depth_m, 0, 0], [-3.0, 0, 0]]))
    assert np.argmax(out[240, 320]) == hot
    assert out[240, 320].any()
