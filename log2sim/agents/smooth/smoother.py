"""Smoothing: noisy positions of a track become a trajectory that a vehicle could have driven."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.agents.smooth.fixed_interval import MIN_WEIGHT, smooth_interval
from log2sim.agents.smooth.motion_model import MotionModel, broken_limits, speed_sigma
from log2sim.agents.smooth.quadratic import NoisyPositions
from log2sim.datatypes import Finding
from log2sim.geometry import Array, wrap_angle

# Below this speed the curvature of a smoothed path is noise.
MIN_CURVATURE_SPEED_MPS = 1.5


@dataclass(frozen=True, eq=False)
class SmoothedTrack:
    """A smoothed trajectory."""

    t_s: Array  # (T,), s: the asked times
    xy_m: Array  # (T, 2), m
    velocity_mps: Array  # (T, 2), m/s
    acceleration_mps2: Array  # (T, 2), m/s2
    yaw_rad: Array  # (T,), rad
    curvature_1pm: Array  # (T,), 1/m: 0 below 1.5 m/s
    covariance: Array  # (T, 2, 2), m2: of the position
    residual_m: Array  # (n,), m: distance of each observation from the trajectory; NaN where it was not used
    inlier: NDArray[np.bool_]  # (n,)
    sigma_yaw_rad: Array  # `sigma_yaw_rad`, `sigma_speed_mps`: (T,): one standard deviation of heading and speed
    sigma_speed_mps: Array
    broken: tuple[Finding, ...]  # limits that the motion breaks


def smooth_track(
    t_s: ArrayLike,
    xy_m: ArrayLike,
    *,
    sigma_m: ArrayLike | None = None,
    covariance: Array | None = None,
    at_s: ArrayLike | None = None,
    motion: MotionModel | None = None,
) -> SmoothedTrack:
    """Smooth positions over a fixed interval, rejecting outliers.

    `t_s`: (n,), s, strictly increasing. `xy_m`: (n, 2), m; rows that are not finite are not used. `sigma_m`: of all or (n,):
    standard deviation of the positions; or `covariance`: (n, 2, 2): covariance of the positions, m2. Given by measurements, whose
    errors are correlated over time and have heavier tails than Gaussian ones. `at_s`: (T,): times of the result, by default
    `t_s`. `motion`: by default a vehicle whose most likely jerk densities along and across the path are estimated.

    Raises `ValueError` for stamps that do not increase, shapes that do not fit, or no row to use.
    """
    motion = MotionModel() if motion is None else motion
    t, xy = np.asarray(t_s, dtype=np.float64), np.asarray(xy_m, dtype=np.float64)
    if t.ndim != 1 or xy.shape != (len(t), 2):
        raise ValueError(f"t_s must be (n,) and xy_m (n, 2), got {t.shape} and {xy.shape}")
    if np.any(np.diff(t) <= 0):
        raise ValueError(f"t_s must increase strictly; it does not at index {int(np.argmax(np.diff(t) <= 0)) + 1}")
    use = np.isfinite(xy).all(axis=1)
    if not use.any():
        raise ValueError("no valid position to smooth")
    if covariance is not None:
        r = np.asarray(covariance, dtype=np.float64)[use]
    else:
        sigma = np.asarray(sigma_m, dtype=np.float64)
        sigma = sigma[use] if sigma.ndim else np.full(int(use.sum()), float(sigma))
        if np.any(~np.isfinite(sigma) | (sigma <= 0)):
            raise ValueError("sigma_m must be positive and finite")
        r = sigma[:, None, None] ** 2 * np.eye(2)
    asked = t if at_s is None else np.asarray(at_s, dtype=np.float64)
    # Far from the origin the normal equations would lose digits, so everything is relative to the first position.
    origin = xy[use][0]
    path = smooth_interval(NoisyPositions(t[use], xy[use] - origin, r, covariance is not None), asked, motion)
    velocity, acceleration = path.state[:, 1], path.state[:, 2]
    speed = np.hypot(*velocity.T)
    fast = speed > MIN_CURVATURE_SPEED_MPS
    cross = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    curvature = np.divide(cross, speed**3, out=np.zeros_like(speed), where=fast)
    residual, inlier = np.full(len(t), np.nan), np.zeros(len(t), dtype=bool)
    residual[use], inlier[use] = path.residual_m, path.weight > MIN_WEIGHT
    broken: tuple[Finding, ...] = ()
    if not motion.holonomic:
        sigma = np.sqrt(np.trace(path.covariance[:, 4:, 4:], axis1=1, axis2=2) / 2)
        of_curvature = np.divide(sigma, speed**2, out=np.zeros_like(speed), where=fast)
        sigmas = {"acceleration": sigma, "lateral_acceleration": sigma, "curvature": of_curvature}
        broken = broken_limits(asked, acceleration, path.yaw_rad, curvature, sigmas)
    return SmoothedTrack(
        t_s=asked,
        xy_m=path.state[:, 0] + origin,
        velocity_mps=velocity,
        acceleration_mps2=acceleration,
        yaw_rad=path.yaw_rad,
        curvature_1pm=curvature,
        covariance=path.covariance[:, :2, :2],
        residual_m=residual,
        inlier=inlier,
        sigma_yaw_rad=path.sigma_yaw_rad,
        sigma_speed_mps=speed_sigma(path.yaw_rad, path.covariance[:, 2:4, 2:4]),
        broken=broken,
    )


def signed_speed(velocity_mps: Array, yaw_rad: Array) -> Array:
    """Speed (T,) along the heading, negative when reversing."""
    speed = np.hypot(*velocity_mps.T)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    return np.asarray(np.where(np.abs(wrap_angle(course - yaw_rad)) > np.pi / 2, -speed, speed))
