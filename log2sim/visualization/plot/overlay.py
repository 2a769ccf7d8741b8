"""3D boxes and LiDAR points on a camera image, to see whether calibration, boxes and stamps agree."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array, Camera, apply, box_corners, box_lines, project

FAR_M = 25.0
"""Boxes farther than this get thin lines, so that rows of parked cars stay readable."""


def draw_overlay(
    image_bgr: NDArray[np.uint8],
    camera: Camera,
    cam_T_map: Array,
    *,
    center_m: ArrayLike | None = None,
    size_m: ArrayLike | None = None,
    yaw_rad: ArrayLike | None = None,
    colors_bgr: Sequence[tuple[int, int, int]] | None = None,
    labels: Sequence[str] | None = None,
    points_map: NDArray[np.floating[Any]] | None = None,
    box_px: ArrayLike | None = None,
    depth_range_m: tuple[float, float] = (2.0, 60.0),
) -> NDArray[np.uint8]:
    """Draw boxes and points into a copy of an image.

    Parameters
    ----------
    image_bgr : (H, W, 3) uint8
    cam_T_map : (4, 4)
    center_m, size_m, yaw_rad : (M, 3), (M, 3), (M,)
        Upright 3D boxes, m and rad, map frame; size is length, width, height. The front is crossed out.
    colors_bgr, labels : M each
    points_map : (N, 3) m, map frame
        Colored by depth, red near and blue far over `depth_range_m`.
    box_px : (L, 4)
        2D boxes u0, v0, u1, v1, drawn white.

    Returns
    -------
    (H, W, 3) uint8
    """
    out = np.ascontiguousarray(image_bgr).copy()
    if points_map is not None and len(points_map):
        _draw_points(out, camera, apply(cam_T_map, points_map), depth_range_m)
    thickness = max(1, round(camera.width_px / 1000))
    for u0, v0, u1, v1 in np.asarray(box_px if box_px is not None else np.zeros((0, 4)), dtype=np.float64):
        cv2.rectangle(out, _pixel((u0, v0)), _pixel((u1, v1)), (255, 255, 255), thickness, cv2.LINE_AA)
    if center_m is None or size_m is None or yaw_rad is None:
        return out
    corners = box_corners(center_m, size_m, yaw_rad)
    depth = np.array([apply(cam_T_map, c)[:, 2].mean() for c in corners])
    for k in np.argsort(-depth):
        color = colors_bgr[k] if colors_bgr is not None else (80, 220, 60)
        seen = box_lines(camera, apply(cam_T_map, corners[k]))
        for a, b in seen:
            cv2.line(out, _pixel(a), _pixel(b), color, thickness if depth[k] < FAR_M else 1, cv2.LINE_AA)
        if labels is not None and len(seen) and np.ptp(seen[..., 1]) > camera.height_px / 40:
            _write(out, labels[k], seen.reshape(-1, 2).min(axis=0), color, camera.width_px / 1800)
    return out


def _draw_points(out: NDArray[np.uint8], camera: Camera, points_cam: Array, depth_range_m: tuple[float, float]) -> None:
    """Far points first; every point a disk whose size falls with depth."""
    uv, valid = project(camera, points_cam)
    uv, depth = uv[valid], points_cam[valid, 2]
    near, far = np.log(depth_range_m)
    shade = 1 - np.clip((np.log(np.maximum(depth, depth_range_m[0])) - near) / (far - near), 0, 1)
    colors = cv2.applyColorMap(np.rint(255 * shade).astype(np.uint8).reshape(-1, 1), cv2.COLORMAP_TURBO).reshape(-1, 3)
    radius = np.clip(np.rint(camera.width_px / 110 / np.maximum(depth, 1.0)), 1, 4).astype(int)
    for k in np.argsort(-depth):
        cv2.circle(out, _pixel(uv[k]), int(radius[k]), colors[k].tolist(), -1)


def _write(out: NDArray[np.uint8], text: str, corner: Array, color: tuple[int, int, int], scale: float) -> None:
    at = _pixel((corner[0], max(corner[1] - 6, 14)))
    plain = "".join(c if 32 <= ord(c) < 127 else "?" for c in text)
    scale = max(0.4, 0.6 * scale)
    for ink, width in (((20, 20, 20), 3), (color, 1)):
        cv2.putText(out, plain, at, cv2.FONT_HERSHEY_SIMPLEX, scale, ink, width, cv2.LINE_AA)


def _pixel(uv: ArrayLike) -> tuple[int, int]:
    # OpenCV draws with 16-bit fixed point inside; far ends are harmless as long as they fit an int.
    u, v = np.clip(np.rint(np.asarray(uv, dtype=np.float64)), -30000, 30000)
    return int(u), int(v)
