"""Rigid transforms, quaternions, poses over time and oriented boxes.

Transforms are named `dst_T_src` (4x4, float64) so that inner frames cancel: `map_T_cam = map_T_ego @ ego_T_cam`.
Frames: map (local ENU), ego (ISO 8855: x forward, y left, z up), cam (x right, y down, z forward). Quaternions are
scalar-first, yaw is counter-clockwise from +x in [-pi, pi).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry.transforms import Array


def box_corners_bev(xy_m: ArrayLike, length_m: ArrayLike, width_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Corners (M, 4, 2) of oriented rectangles: front-left, rear-left, rear-right, front-right (counter-clockwise)."""
    xy, length, width, yaw = (np.asarray(a, dtype=np.float64) for a in (xy_m, length_m, width_m, yaw_rad))
    xy = np.atleast_2d(xy)
    m = len(xy)
    half_l, half_w = np.broadcast_to(length, m) / 2, np.broadcast_to(width, m) / 2
    yaw = np.broadcast_to(yaw, m)
    local = np.stack(
        [
            np.stack([half_l, half_w], -1),
            np.stack([-half_l, half_w], -1),
            np.stack([-half_l, -half_w], -1),
            np.stack([half_l, -half_w], -1),
        ],
        axis=1,
    )
    c, s = np.cos(yaw), np.sin(yaw)
    rotation = np.stack([np.stack([c, -s], -1), np.stack([s, c], -1)], axis=1)
    return np.einsum("mij,mkj->mki", rotation, local) + xy[:, None]


def box_corners(center_m: ArrayLike, size_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Corners (M, 8, 3) of upright boxes: the four of the bottom, then the four of the top, as `box_corners_bev`."""
    center, size = np.atleast_2d(np.asarray(center_m, float)), np.atleast_2d(np.asarray(size_m, float))
    bev = box_corners_bev(center[:, :2], size[:, 0], size[:, 1], yaw_rad)
    half_height = size[:, 2, None, None] / 2
    bottom = np.concatenate([bev, np.broadcast_to(center[:, None, 2:] - half_height, (len(center), 4, 1))], -1)
    top = np.concatenate([bev, np.broadcast_to(center[:, None, 2:] + half_height, (len(center), 4, 1))], -1)
    return np.concatenate([bottom, top], axis=1)


def points_in_box(
    points: Array, center_m: Array, size_m: Array, yaw_rad: float, margin_m: float = 0.0
) -> NDArray[np.bool_]:
    """Mask (N,) of points (N, 3) inside one upright box (center (3,), size (3,) length, width, height)."""
    d = points - center_m
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    half = np.asarray(size_m) / 2 + margin_m
    along, across = d[:, 0] * c + d[:, 1] * s, -d[:, 0] * s + d[:, 1] * c
    return (np.abs(along) <= half[0]) & (np.abs(across) <= half[1]) & (np.abs(d[:, 2]) <= half[2])


def box_iou(a_px: ArrayLike, b_px: ArrayLike) -> Array:
    """IoU (A, B) of axis-aligned image boxes (A, 4), (B, 4) as u0, v0, u1, v1 in px; 0 where both are empty."""
    a, b = np.asarray(a_px, dtype=np.float64).reshape(-1, 1, 4), np.asarray(b_px, dtype=np.float64).reshape(1, -1, 4)
    overlap = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0, None).prod(-1)
    area_a, area_b = (
        np.clip(a[..., 2:] - a[..., :2], 0, None).prod(-1),
        np.clip(b[..., 2:] - b[..., :2], 0, None).prod(-1),
    )
    union = area_a + area_b - overlap
    return np.divide(overlap, union, out=np.zeros_like(union), where=union > 0)


def bev_iou(a: ArrayLike, b: ArrayLike) -> float:
    """IoU of two oriented rectangles given as corners (4, 2), counter-clockwise, in m.

    Notes
    -----
    Sutherland-Hodgman clipping of one convex polygon by the other, then the shoelace formula.
    """
    poly = [np.asarray(p, float) for p in np.asarray(a, float)]
    clip = np.asarray(b, float)
    for k in range(len(clip)):
        p, edge = clip[k], clip[(k + 1) % len(clip)] - clip[k]
        if not poly:
            return 0.0
        side = [edge[0] * (q[1] - p[1]) - edge[1] * (q[0] - p[0]) for q in poly]
        kept: list[Array] = []
        for i in range(len(poly)):
            j = (i + 1) % len(poly)
            if side[i] >= 0:
                kept.append(poly[i])
            if (side[i] >= 0) != (side[j] >= 0):
                kept.append(poly[i] + (poly[j] - poly[i]) * (side[i] / (side[i] - side[j])))
        poly = kept
    overlap = polygon_area(np.array(poly)) if len(poly) >= 3 else 0.0
    union = polygon_area(np.asarray(a, float)) + polygon_area(clip) - overlap
    return overlap / union if union > 0 else 0.0


def polygon_area(corners: Array) -> float:
    """Area of a simple polygon (K, 2), shoelace formula, about its first corner so that far origins cost no digits."""
    d = corners - corners[0]
    x, y = d[:, 0], d[:, 1]
    return float(abs(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1))) / 2)
