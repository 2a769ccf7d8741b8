"""Edges of boxes in images."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Camera, box_lines

CAMERA = Camera("front", 640, 480, np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]), "ego", np.eye(4))


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
