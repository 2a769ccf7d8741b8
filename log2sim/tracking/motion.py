"""The motion model of the tracker: constant velocity in the map plane, many tracks at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# Standard deviations of the initial velocity and of the change of the velocity in 1 s, by group. A bicycle without a rider
# stands, but for those whose rider the detector missed.
FIRST_SPEED_MPS = {"vehicle": 8.0, "two_wheeler": 4.0, "pedestrian": 1.5, "other": 3.0, "bicycle": 1.0}
ACCELERATION_MPS2 = {"vehicle": 2.5, "two_wheeler": 1.5, "pedestrian": 1.0, "other": 1.5}
# A vehicle moves along its axis: lateral share of the initial velocity.
ACROSS_SHARE = {"vehicle": 0.4, "two_wheeler": 0.4, "pedestrian": 1.0, "other": 1.0, "bicycle": 0.4}
# Displacement of the box center when other sides of the object become visible.
CENTER_SIGMA_M = {"vehicle": 0.35, "two_wheeler": 0.2, "pedestrian": 0.15, "other": 0.35}

_DIAGONAL, _PLACE, _SPEED = np.arange(4), np.arange(2), np.arange(2, 4)


def predict(mean: Array, covariance: Array, dt_s: Array | float, acceleration: Array) -> tuple[Array, Array]:
    """Carry states (A, 4) x, y, vx, vy with covariances (A, 4, 4) forward; `acceleration` (A,) is the process noise."""
    dt = np.asarray(dt_s, dtype=np.float64)
    if dt.ndim and len(dt) and (dt == dt[0]).all():
        dt = dt[0]
    # One step for all where they go equally far, which they do but for gaps.
    step, noise = np.zeros((*dt.shape, 4, 4)), np.zeros((*dt.shape, 4, 4))
    span = np.abs(dt)
    step[..., _DIAGONAL, _DIAGONAL] = 1.0
    step[..., _PLACE, _SPEED] = dt[..., None]
    noise[..., _PLACE, _PLACE] = (span**3 / 3)[..., None]
    noise[..., _PLACE, _SPEED] = noise[..., _SPEED, _PLACE] = (span * dt / 2)[..., None]
    noise[..., _SPEED, _SPEED] = span[..., None]
    noise = noise * (acceleration**2)[:, None, None]
    return (step @ mean[:, :, None])[..., 0], step @ covariance @ np.swapaxes(step, -1, -2) + noise


def innovation(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Return squared Mahalanobis distances and log-determinants, both (A, M), of measurements (M, 2) against states (A, 4).

    `age_s` (M,) is when each was measured relative to the states: a sweep sees an object before or after the tick. Where all are
    0 the states may be places alone, (A, 2) with (A, 2, 2).
    """
    p = covariance[:, None]
    dx, dy = xy[:, 0] - mean[:, :1], xy[:, 1] - mean[:, 1:2]
    s_xx, s_xy, s_yy = p[..., 0, 0] + r[:, 0, 0], p[..., 0, 1] + r[:, 0, 1], p[..., 1, 1] + r[:, 1, 1]
    if np.any(age_s):
        dx, dy = dx - age_s * mean[:, 2:3], dy - age_s * mean[:, 3:4]
        s_xx = s_xx + age_s * (2 * p[..., 0, 2] + age_s * p[..., 2, 2])
        s_xy = s_xy + age_s * (p[..., 0, 3] + p[..., 1, 2] + age_s * p[..., 2, 3])
        s_yy = s_yy + age_s * (2 * p[..., 1, 3] + age_s * p[..., 3, 3])
    determinant = s_xx * s_yy - s_xy * s_xy
    return (s_yy * dx * dx - 2 * s_xy * dx * dy + s_xx * dy * dy) / determinant, np.log(determinant)


def update(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Kalman update of states (A, 4) by one measurement each (A, 2); Joseph's form, so covariances stay positive."""
    h = np.zeros((len(mean), 2, 4))
    h[:, 0, 0] = h[:, 1, 1] = 1.0
    h[:, 0, 2] = h[:, 1, 3] = age_s
    reach = h @ covariance
    gain = np.swapaxes(np.linalg.solve(reach @ np.swapaxes(h, 1, 2) + r, reach), 1, 2)
    rest = np.eye(4) - gain @ h
    mean = mean + (gain @ (xy[:, :, None] - h @ mean[:, :, None]))[..., 0]
    return mean, rest @ covariance @ np.swapaxes(rest, 1, 2) + gain @ r @ np.swapaxes(gain, 1, 2)


def measurement_noise(covariance: Array, groups: NDArray[Any], *, whole_boxes: bool = False) -> Array:
    """Return the noise (M, 2, 2) of box centers: the sensor's, and for partial views that of the changing view."""
    if whole_boxes:
        return covariance
    extra = np.array([CENTER_SIGMA_M[g] for g in groups.tolist()])
    return covariance + (extra**2)[:, None, None] * np.eye(2)


def first_velocity(axis_rad: Array, groups: NDArray[Any]) -> Array:
    """Return the initial covariance (M, 2, 2) of velocities; along an axis, where one is known, it is larger than across.

    `axis_rad` (M,) is the direction of the length, up to half turns, NaN where unknown.
    """
    along = np.array([FIRST_SPEED_MPS[g] for g in groups.tolist()])
    known = np.isfinite(axis_rad)
    across = along * np.where(known, np.array([ACROSS_SHARE[g] for g in groups.tolist()]), 1.0)
    angle = np.where(known, axis_rad, 0.0)
    axis = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    excess = (along**2 - across**2)[:, None, None] * axis[:, :, None] * axis[:, None, :]
    return np.asarray((across**2)[:, None, None] * np.eye(2) + excess)
