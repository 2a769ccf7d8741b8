"""Projection of points into images and back to rays, for pinhole cameras with and without lens distortion.

Models are OpenCV's: "brown" is Brown-Conrady with k1, k2, p1, p2, k3 and the rational k4..k6, "fisheye" is Kannala-Brandt.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.types import Camera

NEAREST_DEPTH_M = 0.1


def project(camera: Camera, points_cam: NDArray[np.floating[Any]]) -> tuple[Array, NDArray[np.bool_]]:
    """Project points (N, 3), m, cam frame.

    Returns
    -------
    uv_px : (N, 2) float64
        NaN where the point is not in front of the camera.
    valid : (N,) bool
        In front of the camera and inside the image.
    """
    points = np.asarray(points_cam)
    front = points[:, 2] > NEAREST_DEPTH_M
    uv = np.full((len(points), 2), np.nan)
    xy = points[front, :2] / points[front, 2:]
    seen = np.ones(len(xy), dtype=bool)
    if camera.distortion_model != "none":
        # Far outside the view a distortion polynomial folds back into the image; thrice the view is seen by no lens.
        half_view = 1.5 * np.array([camera.width_px / camera.K[0, 0], camera.height_px / camera.K[1, 1]])
        seen = np.all(np.abs(xy) <= half_view, axis=1)
    pixels = distort(camera, xy) @ camera.K[:2, :2].T + camera.K[:2, 2]
    uv[front] = np.where(seen[:, None], pixels, np.nan)
    with np.errstate(invalid="ignore"):
        inside = (uv[:, 0] >= 0) & (uv[:, 0] < camera.width_px) & (uv[:, 1] >= 0) & (uv[:, 1] < camera.height_px)
    return uv, inside


def distort(camera: Camera, xy: Array) -> Array:
    """Apply the lens to normalized image coordinates (N, 2)."""
    if camera.distortion_model == "none" or not any(camera.distortion):
        return xy
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    if camera.distortion_model == "fisheye":
        k1, k2, k3, k4 = _padded(camera.distortion, 4)
        r = np.sqrt(r2)
        angle = np.arctan(r)
        a2 = angle * angle
        bent = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
        scale = np.divide(bent, r, out=np.ones_like(r), where=r > 0)
        return xy * scale[:, None]
    k1, k2, p1, p2, k3, k4, k5, k6 = _padded(camera.distortion, 8)
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def undistort(camera: Camera, uv_px: Array) -> Array:
    """Normalized image coordinates (N, 2) of pixels (N, 2): rays are (x, y, 1) in the cam frame.

    Notes
    -----
    Fixed-point iteration x <- x + (target - distort(x)); 30 steps leave far less than 1e-6 px for lenses up to about
    120 degrees.
    """
    target = (np.asarray(uv_px, dtype=np.float64) - camera.K[:2, 2]) @ np.linalg.inv(camera.K[:2, :2]).T
    if camera.distortion_model == "none" or not any(camera.distortion):
        return target
    xy = target.copy()
    for _ in range(30):
        xy = xy + (target - distort(camera, xy))
    return xy


def _padded(coefficients: tuple[float, ...], count: int) -> tuple[float, ...]:
    return tuple(coefficients) + (0.0,) * (count - len(coefficients))
