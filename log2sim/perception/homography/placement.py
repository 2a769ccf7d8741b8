"""Ground position of an obstacle from its box in the image and the camera's homography."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import TYPICAL_SIZE_M
from log2sim.geometry import Array, Camera, apply_homography, homography_jacobian
from log2sim.perception.homography.camera_fit import FOOT_SIGMA_PX
from log2sim.perception.homography.correspondences import undistorted_pixels

# Beyond this range one pixel of a camera at car height is several meters.
MAX_RANGE_M = 60.0
# Standard deviation, m, of the ground itself and of where the nearest side of an obstacle is, along each axis.
GROUND_POSITION_SIGMA_M = 0.2


def place_obstacle(
    ground_H_image: Array, camera: Camera, box_px: Array, category: str, camera_xy: Array
) -> tuple[Array, Array] | None:
    """Place an obstacle by the middle of the lower edge of its box.

    Parameters
    ----------
    ground_H_image : (3, 3) float64
    camera : Camera
    box_px : (4,) float64
    category : str
        Its typical size is used.
    camera_xy : (2,) float64
        Position of the camera in the frame of the ground positions, m.

    Returns
    -------
    center : (2,) float64
        Center of the obstacle on the ground, m.
    covariance : (2, 2) float64
    or None
        Above the horizon and beyond 60 m.
    """
    uv = undistorted_pixels(camera, np.array([[(box_px[0] + box_px[2]) / 2, box_px[3]]]))
    xy, below = apply_homography(ground_H_image, uv)
    if not below[0] or np.hypot(*(xy[0] - camera_xy)) > MAX_RANGE_M:
        return None
    direction = (xy[0] - camera_xy) / np.hypot(*(xy[0] - camera_xy))
    length, width, _ = TYPICAL_SIZE_M[category]
    # The foot is on the nearest side. Half of the depth behind it depends on the heading, which is unknown: from half the
    # width to half the length.
    depth, depth_sigma = (length + width) / 4, (length - width) / 4
    slope = homography_jacobian(ground_H_image, uv)[0]
    covariance = FOOT_SIGMA_PX**2 * slope @ slope.T + np.eye(2) * GROUND_POSITION_SIGMA_M**2
    covariance = covariance + depth_sigma**2 * np.outer(direction, direction)
    return xy[0] + direction * depth, covariance


def spanned_height_m(ground_H_image: Array, camera: Camera, box_px: Array, base_T_cam: Array) -> float:
    """Return the height that a box (4,) spans above its foot, m; NaN where it is seen straight from above.

    The pose of the camera (4, 4) is that in the frame of the ground positions.
    """
    middle = (box_px[0] + box_px[2]) / 2
    uv = undistorted_pixels(camera, np.array([[middle, box_px[1]], [middle, box_px[3]]]))
    rays = np.column_stack([uv, np.ones(2)]) @ np.linalg.inv(camera.K).T @ base_T_cam[:3, :3].T
    across = np.hypot(rays[:, 0], rays[:, 1])
    if not across.all():
        return float("nan")
    foot_xy = apply_homography(ground_H_image, uv[1:])[0][0]
    return float(-np.diff(rays[:, 2] / across)[0] * np.hypot(*(foot_xy - base_T_cam[:2, 3])))
