"""Boxes: corners of upright 3D boxes, points inside them, overlap of image boxes."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry.transforms import Array


def box_corners_bev(xy_m: ArrayLike, length_m: ArrayLike, width_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Compute the corners (M, 4, 2) of oriented rectangles.

    Counter-clockwise from the front left: front left, rear left, rear right, front right.

    Parameters
    ----------
    xy_m : (2,) or (M, 2), m
        Centers.
    length_m, width_m, yaw_rad : scalar or (M,)
    """
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
    return np.asarray(np.einsum("mij,mkj->mki", rotation, local) + xy[:, None])


def box_corners(center_m: ArrayLike, size_m: ArrayLike, yaw_rad: ArrayLike) -> Array:
    """Compute the corners (M, 8, 3), m, of upright boxes: the bottom four, then the top four, in `box_corners_bev`'s order.

    Parameters
    ----------
    center_m, size_m : (3,) or (M, 3), m
        Size is length, width, height.
    yaw_rad : scalar or (M,)
    """
    center, size = np.atleast_2d(np.asarray(center_m, float)), np.atleast_2d(np.asarray(size_m, float))
    bev = box_corners_bev(center[:, :2], size[:, 0], size[:, 1], yaw_rad)
    half_height = size[:, 2, None, None] / 2
    bottom = np.concatenate([bev, np.broadcast_to(center[:, None, 2:] - half_height, (len(center), 4, 1))], -1)
    top = np.concatenate([bev, np.broadcast_to(center[:, None, 2:] + half_height, (len(center), 4, 1))], -1)
    return np.concatenate([bottom, top], axis=1)


def points_in_box(
    points: Array, center_m: Array, size_m: Array, yaw_rad: float, margin_m: float = 0.0
) -> NDArray[np.bool_]:
    """Mark (N,) the points (N, 3) inside one upright box with center (3,) and size (3,) length, width, height."""
    d = points - center_m
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    half = np.asarray(size_m) / 2 + margin_m
    along, across = d[:, 0] * c + d[:, 1] * s, -d[:, 0] * s + d[:, 1] * c
    return np.asarray((np.abs(along) <= half[0]) & (np.abs(across) <= half[1]) & (np.abs(d[:, 2]) <= half[2]))


def box_iou(a_px: ArrayLike, b_px: ArrayLike) -> Array:
    """Compute the IoU (A, B) of axis-aligned image boxes (A, 4), (B, 4), u0, v0, u1, v1 in px; 0 where both are empty."""
    a, b = np.asarray(a_px, dtype=np.float64).reshape(-1, 1, 4), np.asarray(b_px, dtype=np.float64).reshape(1, -1, 4)
    overlap = np.clip(np.minimum(a[..., 2:], b[..., 2:]) - np.maximum(a[..., :2], b[..., :2]), 0, None).prod(-1)
    area_a, area_b = (
        np.clip(a[..., 2:] - a[..., :2], 0, None).prod(-1),
        np.clip(b[..., 2:] - b[..., :2], 0, None).prod(-1),
    )
    union = area_a + area_b - overlap
    return np.asarray(np.divide(overlap, union, out=np.zeros_like(union), where=union > 0))
