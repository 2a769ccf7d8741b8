"""Homographies of a camera with known intrinsics: six parameters of its pose over the ground instead of eight."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array


def nearest_poses(image_K: Array, h: Array) -> Array:
    """Of homographies (K, 3, 3), ground to normalized image, the nearest that a camera `image_K` (3, 3) can have.

    Two columns of its inverse times a homography are axes of the ground seen from the camera, so they have one length and
    stand at a right angle; those that are zero or parallel give NaN.
    """
    m = np.linalg.inv(image_K) @ h
    axes = m[:, :, :2]
    gram = axes.swapaxes(1, 2) @ axes
    # Inverse square root of a symmetric 2x2 matrix in closed form.
    root_of_area = np.sqrt(np.maximum(gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2, 0.0))
    total = np.sqrt(gram[:, 0, 0] + gram[:, 1, 1] + 2 * root_of_area)
    with np.errstate(divide="ignore", invalid="ignore"):
        adjugate = np.empty_like(gram)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = gram[:, 1, 1] + root_of_area, gram[:, 0, 0] + root_of_area
        adjugate[:, 0, 1] = adjugate[:, 1, 0] = -gram[:, 0, 1]
        square = axes @ (adjugate / (root_of_area * total)[:, None, None])
        scale = total / 2
        pose = np.concatenate([square, m[:, :, 2:] / scale[:, None, None]], axis=2)
    return np.asarray(image_K @ pose)


def tangent(image_K: Array, h: Array) -> Array:
    """Derivatives (9, 6) of a camera's homography (3, 3) by a small turn of the camera and by a shift of it."""
    pose = np.linalg.inv(image_K) @ h
    pose = pose / np.sqrt(np.linalg.norm(pose[:, 0]) * np.linalg.norm(pose[:, 1]))
    change = np.zeros((6, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        change[k, :, :2] = np.cross(axis, pose[:, :2].T).T
        change[3 + k, :, 2] = axis
    return np.asarray((image_K @ change).reshape(6, 9).T)


def unit_pose(image_K: Array, h: Array) -> Array:
    """The nearest pose's homography (3, 3), scaled so that its axes have length 1."""
    return np.asarray(nearest_poses(image_K, h[None])[0])
