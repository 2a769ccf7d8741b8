"""Homographies of a camera with known intrinsics: six parameters of its pose over the ground instead of eight."""

from __future__ import annotations

import numpy as np

from log2sim.geometry import Array


def nearest_poses(image_K: Array, h: Array) -> Array:
    """Find the nearest homographies (K, 3, 3), ground to normalized image, that a camera `image_K` (3, 3) can have.

    The first two columns of `inv(image_K) @ h` are the ground axes in the camera frame, so they must be orthogonal and
    of equal length. Columns that are zero or parallel give NaN.

    Notes
    -----
    The polar factor of these two columns is the nearest such matrix in the Frobenius norm (Zhang, 2000, appendix C).
    """
    m = np.linalg.inv(image_K) @ h
    axes = m[:, :, :2]
    gram = axes.swapaxes(1, 2) @ axes
    # Inverse square root of a symmetric 2x2 matrix in closed form.
    root_of_determinant = np.sqrt(np.maximum(gram[:, 0, 0] * gram[:, 1, 1] - gram[:, 0, 1] ** 2, 0.0))
    total = np.sqrt(gram[:, 0, 0] + gram[:, 1, 1] + 2 * root_of_determinant)
    with np.errstate(divide="ignore", invalid="ignore"):
        adjugate = np.empty_like(gram)
        adjugate[:, 0, 0], adjugate[:, 1, 1] = gram[:, 1, 1] + root_of_determinant, gram[:, 0, 0] + root_of_determinant
        adjugate[:, 0, 1] = adjugate[:, 1, 0] = -gram[:, 0, 1]
        orthogonal = axes @ (adjugate / (root_of_determinant * total)[:, None, None])
        scale = total / 2
        pose = np.concatenate([orthogonal, m[:, :, 2:] / scale[:, None, None]], axis=2)
    return np.asarray(image_K @ pose)


def pose_tangent(image_K: Array, h: Array) -> Array:
    """Compute the derivatives (9, 6) of a camera's homography (3, 3) by small rotations and shifts of the camera."""
    pose = np.linalg.inv(image_K) @ h
    pose = pose / np.sqrt(np.linalg.norm(pose[:, 0]) * np.linalg.norm(pose[:, 1]))
    change = np.zeros((6, 3, 3))
    for k, axis in enumerate(np.eye(3)):
        change[k, :, :2] = np.cross(axis, pose[:, :2].T).T
        change[3 + k, :, 2] = axis
    return np.asarray((image_K @ change).reshape(6, 9).T)


def nearest_unit_pose(image_K: Array, h: Array) -> Array:
    """Project a homography (3, 3) onto those of a camera `image_K`, scaled so that the ground axes have length 1."""
    return np.asarray(nearest_poses(image_K, h[None])[0])
