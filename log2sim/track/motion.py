"""The motion model of the tracker: constant velocity in the map plane, many tracks at once."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

# How fast an object of a group can be when it is first seen, and how fast its velocity may change (standard deviations).
FIRST_SPEED_MPS = {"vehicle": 8.0, "two_wheeler": 4.0, "pedestrian": 1.5, "other": 3.0}
ACCELERATION_MPS2 = {"vehicle": 2.5, "two_wheeler": 1.5, "pedestrian": 1.0, "other": 1.5}
# What a box center moves by when other sides of the object come into view.
CENTER_SIGMA_M = {"vehicle": 0.35, "two_wheeler": 0.2, "pedestrian": 0.15, "other": 0.35}


def predict(mean: Array, covariance: Array, dt_s: Array | float, acceleration: Array) -> tuple[Array, Array]:
    """Carry states (A, 4) x, y, vx, vy with covariances (A, 4, 4) forward; `acceleration` (A,) is the process noise."""
    dt = np.broadcast_to(np.asarray(dt_s, dtype=np.float64), len(mean))
    step = np.tile(np.eye(4), (len(mean), 1, 1))
    step[:, 0, 2] = step[:, 1, 3] = dt
    span, density = np.abs(dt), acceleration**2
    noise = np.zeros((len(mean), 4, 4))
    for k in range(2):
        noise[:, k, k] = density * span**3 / 3
        noise[:, k, k + 2] = noise[:, k + 2, k] = density * span * dt / 2
        noise[:, k + 2, k + 2] = density * span
    return np.einsum("aij,aj->ai", step, mean), step @ covariance @ np.swapaxes(step, 1, 2) + noise


def innovation(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Squared Mahalanobis distance and log-determinant, both (A, M), of measurements (M, 2) against states (A, 4).

    `age_s` (M,) is when each was measured relative to the states: a sweep sees an object before or after the tick.
    """
    place = mean[:, None, :2] + age_s[None, :, None] * mean[:, None, 2:]
    h_p = covariance[:, None, :2, :] + age_s[None, :, None, None] * covariance[:, None, 2:, :]
    s = h_p[..., :2] + age_s[None, :, None, None] * h_p[..., 2:] + r[None]
    d = xy[None] - place
    determinant = s[..., 0, 0] * s[..., 1, 1] - s[..., 0, 1] ** 2
    squared = s[..., 1, 1] * d[..., 0] ** 2 - 2 * s[..., 0, 1] * d[..., 0] * d[..., 1] + s[..., 0, 0] * d[..., 1] ** 2
    return squared / determinant, np.log(determinant)


def update(mean: Array, covariance: Array, xy: Array, r: Array, age_s: Array) -> tuple[Array, Array]:
    """Kalman update of states (A, 4) by one measurement each (A, 2); Joseph's form, so covariances stay positive."""
    h = np.zeros((len(mean), 2, 4))
    h[:, 0, 0] = h[:, 1, 1] = 1.0
    h[:, 0, 2] = h[:, 1, 3] = age_s
    s = h @ covariance @ np.swapaxes(h, 1, 2) + r
    gain = np.swapaxes(np.linalg.solve(s, h @ covariance), 1, 2)
    rest = np.eye(4) - gain @ h
    mean = mean + np.einsum("aij,aj->ai", gain, xy - np.einsum("aij,aj->ai", h, mean))
    return mean, rest @ covariance @ np.swapaxes(rest, 1, 2) + gain @ r @ np.swapaxes(gain, 1, 2)


def measurement_noise(covariance: Array, groups: NDArray[Any]) -> Array:
    """Noise (M, 2, 2) of box centers: the sensor's and what changing views add."""
    extra = np.array([CENTER_SIGMA_M[str(g)] for g in groups])
    return covariance + extra[:, None, None] ** 2 * np.eye(2)
