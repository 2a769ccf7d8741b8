"""Markings of one picture: the horizon, and the course that lane lines share."""

from __future__ import annotations

import cv2
import numpy as np
from painted_ground import Painter, dashes_of, line_of

from log2sim.geometry import Camera, ground_homography
from log2sim.road.lane_picture import find_markings_in_picture

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
