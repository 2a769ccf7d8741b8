"""Markings of one picture: the horizon, and the course that lane lines share."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from painted_ground import Painter, dashes_of, line_of

from log2sim.datatypes import Marking
from log2sim.geometry import Camera, ground_homography
from log2sim.road.lane_picture import find_markings_in_picture, find_shape, find_vanishing_point, join_lines

OFFSETS = (-5.25, -1.75, 1.75, 5.25)


def picture() -> tuple[np.ndarray, Camera]:
    """Photograph a straight road from 1.5 m above it, 3 deg downwards."""
    painter = Painter((0.0, 70.0, -12.0, 12.0))
    for k, offset in enumerate(OFFSETS):
        line = line_of(lambda x, o=offset: o + 0 * x, 0, 70)
        painter.lines([line] if k in (0, 3) else dashes_of(line, 3, 6))
    ground = painter.ground(lidar=False)
    pitch = np.deg2rad(3.0)
    pose = np.eye(4)
    pose[:3, :3] = np.array([[0, -np.sin(pitch), np.cos(pitch)], [-1, 0, 0], [0, -np.cos(pitch), -np.sin(pitch)]])
    pose[2, 3] = 1.5
    focal = 640 / np.tan(np.deg2rad(30))
    K = np.array([[focal, 0, 639.5], [0, focal, 359.5], [0, 0, 1]])
    camera = Camera("front", 1280, 720, K, "ego", pose)
    cell_H_ground = np.array([[20, 0, -0.5], [0, -20, 12 * 20 - 0.5], [0, 0, 1]])
    cell_H_image = cell_H_ground @ ground_homography(camera, pose)
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    image = cv2.warpPerspective(
        ground.color_bgr,
        cell_H_image,
        (1280, 720),
        flags=flags,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=(200, 190, 180),
    )
    return image, camera


def test_a_known_camera_measures_lines_where_they_are() -> None:
    image, camera = picture()
    found = find_markings_in_picture(image, camera)
    assert np.allclose([line.offset_m for line in found.lane_lines], sorted(OFFSETS, reverse=True), atol=0.1)


@pytest.mark.slow
def test_an_unknown_camera_finds_the_horizon_and_the_lines() -> None:
    image, camera = picture()
    horizon = camera.K @ np.linalg.inv(camera.mount_T_cam[:3, :3]) @ np.array([1.0, 0, 0])
    point = find_vanishing_point(image, rng=np.random.default_rng(0))
    assert point is not None
    assert np.hypot(*(np.array(point) - horizon[:2] / horizon[2])) < 8
    found = find_markings_in_picture(image)
    assert np.allclose([line.offset_m for line in found.lane_lines], sorted(OFFSETS, reverse=True), atol=0.25)
    assert any("assumed" in note for note in found.notes)


def test_a_picture_of_nothing_has_no_horizon() -> None:
    rng = np.random.default_rng(0)
    image = rng.normal(120, 3, (360, 640, 3)).clip(0, 255).astype(np.uint8)
    found = find_markings_in_picture(image)
    assert found.markings == ()
    assert found.lane_lines == ()
    assert "horizon" in found.notes[0]


def test_what_does_not_follow_the_course_of_the_others_is_left_out() -> None:
    x = np.arange(5, 45, 0.5)
    course = 0.02 * x + 0.001 * x**2

    def line(name: str, y: np.ndarray) -> Marking:
        return Marking(name, "solid", np.column_stack([x, y, 0 * x]), 0.12)

    lines = [line("a", course + 1.8), line("b", course - 1.7), line("wall", 0.25 * x + 1)]
    found = find_shape(lines, np.ones(3))
    assert found is not None
    shape, member = found
    assert member == [0, 1]
    assert abs(shape.slope - 0.02) < 0.01
    assert abs(shape.bend - 0.001) < 2e-4
    joined = join_lines(lines[:2], shape, 2.0, 60.0)
    assert [round(one.offset_m, 1) for one in joined] == [1.8, -1.7]
    assert abs(joined[0].points_m[-1, 1] - (0.02 * 60 + 0.001 * 60**2 + 1.8)) < 0.5
