"""Small motions as twists: a translation (3,), m, and a rotation vector (3,), rad, in the frame that moves."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import (
    NS_PER_S,
    Array,
    PoseTrack,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    transform,
)

# Velocities are those of a second: errors of GNSS and IMU make those of shorter times useless, and vehicles speed up and turn
# for longer.
MOTION_SPAN_NS = 500_000_000


def exp_of(twist: Array) -> Array:
    """Compute the transform (4, 4) of a twist (6,): the translation as it stands, and the rotation.

    The bend of the path, which the exponential map has, is of second order; `log_of` is the inverse.
    """
    angle = float(np.linalg.norm(twist[3:]))
    half = 0.5 * np.sinc(angle / (2 * np.pi))
    q = np.concatenate([[np.cos(angle / 2)], half * twist[3:]])
    return transform(rotation_from_quaternion(q), twist[:3])


def log_of(motion: Array) -> Array:
    """Compute the twists (..., 6) of transforms (..., 4, 4)."""
    q = quaternion_from_rotation(motion[..., :3, :3])
    sine = np.linalg.norm(q[..., 1:], axis=-1, keepdims=True)
    turned = sine > 1e-12
    factor = np.where(turned, 2 * np.arctan2(sine, q[..., :1]) / np.where(turned, sine, 1.0), 2.0)
    return np.concatenate([motion[..., :3, 3], factor * q[..., 1:]], axis=-1)


def cross_matrix(v: Array) -> Array:
    """Return the matrices (..., 3, 3) by which vectors (..., 3) are crossed with others."""
    out = np.zeros((*v.shape, 3))
    for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
        out[..., j, i], out[..., i, j] = v[..., k], -v[..., k]
    return out


def adjoint_of(dst_T_src: Array) -> Array:
    """Compute the matrices (..., 6, 6) that take twists in the frame `src` to those in `dst`, for transforms (..., 4, 4)."""
    rotation = dst_T_src[..., :3, :3]
    out = np.zeros((*dst_T_src.shape[:-2], 6, 6))
    out[..., :3, :3] = out[..., 3:, 3:] = rotation
    out[..., :3, 3:] = cross_matrix(dst_T_src[..., :3, 3]) @ rotation
    return out


def velocities_at(track: PoseTrack, t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
    """Compute how the ego moves at stamps (K,), by poses `MOTION_SPAN_NS` before and after.

    Returns
    -------
    velocity : (K, 6) float64, m/s and rad/s
        Twists in the ego's frame.
    known : (K,) bool
        Whether these poses are known.
    """
    (before, known), (at, is_known), (after, will_be_known) = (
        track.at(t_ns + shift) for shift in (-MOTION_SPAN_NS, 0, MOTION_SPAN_NS)
    )
    ego_T_map = inverse(at)
    velocity = (log_of(ego_T_map @ after) - log_of(ego_T_map @ before)) / (2 * MOTION_SPAN_NS / NS_PER_S)
    return velocity, known & is_known & will_be_known
