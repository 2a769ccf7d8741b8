"""Homographies between the image and a horizontal ground plane.

A homography `ground_H_image` (3, 3) maps pixels (u, v, 1), free of lens distortion, to ground positions (x, y) in m. With
a third row that is positive below the horizon its sign tells which pixels see the ground.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry.camera import Camera
from log2sim.geometry.transforms import Array, inverse

MIN_CAMERA_HEIGHT_M = 1e-3


def ground_homography(camera: Camera, dst_T_cam: Array, ground_z_m: float = 0.0) -> Array:
    """Compute `ground_H_image` (3, 3) of the plane z = `ground_z_m` from a camera's calibration.

    Parameters
    ----------
    camera : Camera
        Its lens distortion does not enter: pixels are to be undistorted.
    dst_T_cam : (4, 4) float64
        Pose of the camera in the frame of the ground positions.
    ground_z_m : float
        Height of the ground in that frame, m.

    Returns
    -------
    (3, 3) float64
        Its third row, applied to a pixel, is the inverse depth of the ground seen there: positive below the horizon.

    Raises
    ------
    ValueError
        When the camera lies in the plane, which it then sees edge-on.
    """
    if abs(dst_T_cam[2, 3] - ground_z_m) < MIN_CAMERA_HEIGHT_M:
        raise ValueError(
            f"camera '{camera.name}' lies in the ground plane z = {ground_z_m:g} m and cannot look onto it"
        )
    cam_T_dst = inverse(np.asarray(dst_T_cam, dtype=np.float64))
    r, t = cam_T_dst[:3, :3], cam_T_dst[:3, 3]
    image_H_ground = camera.K @ np.column_stack([r[:, 0], r[:, 1], r[:, 2] * ground_z_m + t])
    return np.linalg.inv(image_H_ground).astype(np.float64)


def apply_homography(ground_H_image: Array, uv_px: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
    """Map pixels (N, 2) to the ground.

    Returns
    -------
    xy_m : (N, 2) float64
        Ground positions; NaN at and above the horizon.
    below : (N,) bool
        Whether the pixels lie below the horizon.
    """
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    below = q[:, 2] > 0
    return np.where(below[:, None], q[:, :2] / np.where(below, q[:, 2], 1.0)[:, None], np.nan), below


def homography_jacobian(ground_H_image: Array, uv_px: ArrayLike) -> Array:
    """Compute the derivatives (N, 2, 2) of ground positions by pixels (N, 2), m/px; unbounded at the horizon."""
    uv = np.asarray(uv_px, dtype=np.float64).reshape(-1, 2)
    q = uv @ ground_H_image[:, :2].T + ground_H_image[:, 2]
    xy = q[:, :2] / q[:, 2:]
    slope = ground_H_image[None, :2, :2] - xy[:, :, None] * ground_H_image[None, 2:, :2]
    return np.asarray(slope / q[:, 2, None, None])
