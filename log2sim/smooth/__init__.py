"""Smoothing: noisy positions of a track become a trajectory that a vehicle could have driven."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.geometry import Array, wrap_angle
from log2sim.smooth.interval import Observations, smooth_interval
from log2sim.smooth.yaw import yaw_of_motion

__all__ = ["SmoothedTrack", "smooth_track", "yaw_of_motion"]

# Waymax (Gulino et al., 2023) calls a vehicle's motion infeasible beyond these.
MAX_ACCELERATION_MPS2 = 10.4
MAX_CURVATURE_1PM = 0.3
CURVATURE_SPEED_MPS = 1.5


@dataclass(frozen=True, eq=False)
class SmoothedTrack:
    """A trajectory at asked times (T,): `xy_m` (T, 2), `velocity_mps` (T, 2), `acceleration_mps2` (T, 2), `yaw_rad` (T,),
    `curvature_1pm` (T,) (0 where slower than 1.5 m/s), `covariance` (T, 2, 2) of the position, `residual_m` (n,) of the
    observations, `inlier` (n,) bool, and `flags`, the names of the limits that the motion breaks.
    """

    t_s: Array
    xy_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    yaw_rad: Array
    curvature_1pm: Array
    covariance: Array
    residual_m: Array
    inlier: NDArray[np.bool_]
    flags: tuple[str, ...]


def smooth_track(
    t_s: ArrayLike,
    xy_m: ArrayLike,
    valid: ArrayLike | None = None,
    *,
    sigma_m: ArrayLike | None = None,
    covariance: Array | None = None,
    at_s: ArrayLike | None = None,
    jerk_density: float = 4.0,
    sideways: bool = False,
    yaw_hint_rad: float | None = None,
) -> SmoothedTrack:
    """Smooth positions over a fixed interval, rejecting outliers.

    Parameters
    ----------
    t_s : (n,) float64, s, strictly increasing
    xy_m : (n, 2) float64, m
    valid : (n,) bool, optional
        Rows to use; rows that are not finite are never used.
    sigma_m : float or (n,), optional
        Standard deviation of the positions; estimated from their third differences when neither it nor `covariance`
        is given.
    covariance : (n, 2, 2), optional
        Covariance of the positions, m2.
    at_s : (T,), optional
        Times of the result, by default `t_s`.
    jerk_density : float
        Spectral density of the jerk, m2/s5: how fast the acceleration may change.
    sideways : bool
        True for pedestrians, who may turn on the spot.
    yaw_hint_rad : float, optional
        Heading where the motion does not tell one.

    Raises
    ------
    ValueError
        For stamps that do not increase, shapes that do not fit or no valid row.
    """
    t, xy = np.asarray(t_s, dtype=np.float64), np.asarray(xy_m, dtype=np.float64)
    if t.ndim != 1 or xy.shape != (len(t), 2):
        raise ValueError(f"t_s must be (n,) and xy_m (n, 2), got {t.shape} and {xy.shape}")
    if np.any(np.diff(t) <= 0):
        raise ValueError(f"t_s must increase strictly; it does not at index {int(np.argmax(np.diff(t) <= 0)) + 1}")
    use = np.isfinite(xy).all(axis=1) & (np.ones(len(t), bool) if valid is None else np.asarray(valid, dtype=bool))
    if not use.any():
        raise ValueError("no valid position to smooth")
    r = _covariances(t[use], xy[use], sigma_m, covariance, use)
    asked = t if at_s is None else np.asarray(at_s, dtype=np.float64)
    # Far from the origin the normal equations would lose digits, so everything is relative to the first position.
    origin = xy[use][0]
    state, position_covariance, distance, weight = smooth_interval(
        Observations(t[use], xy[use] - origin, r), asked, jerk_density
    )
    velocity, acceleration = state[:, 2:4], state[:, 4:6]
    speed = np.hypot(*velocity.T)
    turning = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    moving = speed > CURVATURE_SPEED_MPS
    curvature = np.divide(turning, speed**3, out=np.zeros_like(speed), where=moving)
    residual = np.full(len(t), np.nan)
    residual[use] = distance
    inlier = np.zeros(len(t), dtype=bool)
    inlier[use] = weight > 0.25
    return SmoothedTrack(
        t_s=asked,
        xy_m=state[:, :2] + origin,
        velocity_mps=velocity,
        acceleration_mps2=acceleration,
        yaw_rad=yaw_of_motion(state[:, :2], velocity, hint_rad=yaw_hint_rad, sideways=sideways),
        curvature_1pm=curvature,
        covariance=position_covariance,
        residual_m=residual,
        inlier=inlier,
        flags=_flags(acceleration, curvature, sideways=sideways),
    )


def _covariances(t: Array, xy: Array, sigma_m: ArrayLike | None, covariance: Array | None, use: NDArray[Any]) -> Array:
    if covariance is not None:
        return np.asarray(covariance, dtype=np.float64)[use]
    if sigma_m is None:
        sigma_m = estimate_sigma(t, xy)
    sigma = np.asarray(sigma_m, dtype=np.float64)
    sigma = sigma[use] if sigma.ndim else np.full(len(t), float(sigma))
    if np.any(~np.isfinite(sigma) | (sigma <= 0)):
        raise ValueError("sigma_m must be positive and finite")
    return sigma[:, None, None] ** 2 * np.eye(2)


def estimate_sigma(t: Array, xy: Array) -> float:
    """Standard deviation of the noise in m from third divided differences, which motion of constant acceleration lacks.

    Notes
    -----
    The median size makes it insensitive to outliers; a Gaussian's median absolute value is 0.6745 of its deviation.
    """
    if len(t) < 8:
        return 0.2
    weights = np.ones((len(t) - 3, 4))
    for j in range(4):
        for m in range(4):
            if m != j:
                weights[:, j] /= (t[j : len(t) - 3 + j] - t[m : len(t) - 3 + m]) / np.median(np.diff(t))
    rows = np.arange(len(t) - 3)[:, None] + np.arange(4)
    differences = np.einsum("nj,njk->nk", weights, xy[rows]) / np.linalg.norm(weights, axis=1, keepdims=True)
    return max(float(np.median(np.abs(differences))) / 0.6745, 1e-3)


def _flags(acceleration: Array, curvature: Array, *, sideways: bool) -> tuple[str, ...]:
    flags = []
    if np.hypot(*acceleration.T).max() > MAX_ACCELERATION_MPS2:
        flags.append("acceleration")
    if not sideways and np.abs(curvature).max() > MAX_CURVATURE_1PM:
        flags.append("curvature")
    return tuple(flags)


def signed_speed(velocity_mps: Array, yaw_rad: Array) -> Array:
    """Speed (T,) along the heading, negative when reversing."""
    speed = np.hypot(*velocity_mps.T)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    return np.where(np.abs(wrap_angle(course - yaw_rad)) > np.pi / 2, -speed, speed)
