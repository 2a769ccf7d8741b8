"""Upright 3D boxes as a camera sees them: their boxes in the image and how far they are."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry.boxes import box_corners, points_in_box
from log2sim.geometry.camera import NEAREST_DEPTH_M, Camera, project
from log2sim.geometry.transforms import Array, inverse

# Corners as `box_corners` orders them: bottom 0-3, top 4-7, each counter-clockwise from the front left.
FACES = ((0, 1, 2, 3), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7))
NEAR_M = 2 * NEAREST_DEPTH_M
VIEW_MARGIN = 1.3  # lenses that bend inwards see a little more than a pinhole of the same size


@dataclass(frozen=True, eq=False)
class Projected:
    """Boxes in one image: `valid` (L,), `box_px` (L, 4) clipped to the image, `range_m` (L,).

    `range_m` is the distance of the nearest corner; rows that are not valid hold NaN.
    """

    valid: NDArray[np.bool_]
    box_px: Array
    range_m: Array


def project_boxes(center_m: Array, size_m: Array, yaw_rad: Array, camera: Camera, cam_T_map: Array) -> Projected:
    """Project upright boxes of the map frame, (L, 3), (L, 3), (L,), into a camera.

    Notes
    -----
    A box is clipped to the view before it is projected, so one that reaches behind the camera keeps its visible part. A
    box around the camera is the vehicle that carries it and is not valid.
    """
    count = len(center_m)
    box = np.full((count, 4), np.nan)
    valid, range_m = np.zeros(count, dtype=bool), np.full(count, np.nan)
    if not count:
        return Projected(valid, box, range_m)
    planes = view_planes(camera)
    limit = np.array([camera.width_px, camera.height_px], dtype=np.float64)
    camera_map = inverse(cam_T_map)[None, :3, 3]
    corners_cam = box_corners(center_m, size_m, yaw_rad) @ cam_T_map[:3, :3].T + cam_T_map[:3, 3]
    inside = corners_cam @ planes[:, :3].T + planes[:, 3] >= 0  # (L, 8, 5)
    for i in np.flatnonzero(np.all(inside.any(axis=1), axis=1)):
        if points_in_box(camera_map, center_m[i], size_m[i], float(yaw_rad[i]))[0]:
            continue
        vertices = corners_cam[i] if inside[i].all() else clip_box(corners_cam[i], planes)
        uv = project(camera, vertices)[0] if len(vertices) else np.zeros((0, 2))
        uv = np.clip(uv[np.isfinite(uv).all(axis=1)], 0, limit)
        if len(uv) >= 3 and np.all(np.ptp(uv, axis=0) > 0):
            valid[i] = True
            box[i] = np.concatenate([uv.min(axis=0), uv.max(axis=0)])
            range_m[i] = np.linalg.norm(corners_cam[i], axis=1).min()
    return Projected(valid, box, range_m)


def view_planes(camera: Camera) -> Array:
    """Planes (5, 4) n, d of the view in the cam frame: near, left, right, top, bottom; inside is n . x + d >= 0."""
    K = camera.K
    margin = VIEW_MARGIN if any(camera.distortion) else 1.0
    left, right = -margin * K[0, 2] / K[0, 0], margin * (camera.width_px - K[0, 2]) / K[0, 0]
    top, bottom = -margin * K[1, 2] / K[1, 1], margin * (camera.height_px - K[1, 2]) / K[1, 1]
    return np.array([
        [0, 0, 1, -NEAR_M], [1, 0, -left, 0], [-1, 0, right, 0], [0, 1, -top, 0], [0, -1, bottom, 0],
    ])  # fmt: skip


def clip_box(corners_cam: Array, planes: Array) -> Array:
    """Vertices (V, 3) of the part of a box, corners (8, 3), that lies inside all planes.

    Notes
    -----
    Sutherland-Hodgman on each face.
    """
    inside = corners_cam @ planes[:, :3].T + planes[:, 3] >= 0
    if inside.all():
        return corners_cam
    if not inside.any(axis=0).all():
        return np.zeros((0, 3))
    return np.concatenate([clip_polygon(corners_cam[list(face)], planes) for face in FACES])


def clip_polygon(polygon: Array, planes: Array) -> Array:
    """Part (V, 3) of a flat polygon that lies inside all planes."""
    for plane in planes:
        if not len(polygon):
            break
        side = polygon @ plane[:3] + plane[3]
        following, next_side = np.roll(polygon, -1, axis=0), np.roll(side, -1)
        kept = []
        for p, s, q, t in zip(polygon, side, following, next_side, strict=True):
            if s >= 0:
                kept.append(p)
            if (s >= 0) != (t >= 0):
                kept.append(p + (q - p) * (s / (s - t)))
        polygon = np.array(kept).reshape(-1, 3)
    return polygon
