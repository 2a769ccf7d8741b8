"""Smoothing: noisy positions of a track become a trajectory that a vehicle could have driven."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.agents.smooth.feasibility import broken_limits
from log2sim.agents.smooth.fixed_interval import Manner, smooth_interval
from log2sim.agents.smooth.heading import yaw_of_motion
from log2sim.agents.smooth.motion_prior import Observations
from log2sim.geometry import Array, wrap_angle

__all__ = ["SmoothedTrack", "smooth_track", "yaw_of_motion"]

# Slower than this, the curvature of a smoothed way is noise.
CURVATURE_SPEED_MPS = 1.5
LEAST_INLIER_WEIGHT = 0.25
# A gap longer than this is filled by a guess; jerk that traffic has, m2/s5.
GAP_S, GAP_JERK_DENSITY = 2.0, 0.05


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
    jerk_density: float | None = None,
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
    jerk_density : float, optional
        Spectral density of the jerk, m2/s5: how fast the acceleration may change. By default the most likely one, along
        and across the way separately unless `sideways`.
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
    # Covariances come from measurements, whose errors have heavier tails than they say.
    manner = Manner(
        jerk_density,
        sideways,
        yaw_hint_rad,
        scaled=sigma_m is None and covariance is None,
        wary=covariance is not None,
    )
    path = smooth_interval(Observations(t[use], xy[use] - origin, r), asked, manner)
    velocity, acceleration = path.state[:, 1], path.state[:, 2]
    speed = np.hypot(*velocity.T)
    turning = velocity[:, 0] * acceleration[:, 1] - velocity[:, 1] * acceleration[:, 0]
    curvature = np.divide(turning, speed**3, out=np.zeros_like(speed), where=speed > CURVATURE_SPEED_MPS)
    residual = np.full(len(t), np.nan)
    residual[use] = path.distance
    inlier = np.zeros(len(t), dtype=bool)
    inlier[use] = path.weight > LEAST_INLIER_WEIGHT
    return SmoothedTrack(
        t_s=asked,
        xy_m=path.state[:, 0] + origin,
        velocity_mps=velocity,
        acceleration_mps2=acceleration,
        yaw_rad=path.yaw_rad,
        curvature_1pm=curvature,
        covariance=_doubtful_in_gaps(
            path.covariance[:, :2, :2], asked, t[use][path.weight > LEAST_INLIER_WEIGHT], path.density
        ),
        residual_m=residual,
        inlier=inlier,
        flags=broken_limits(asked, acceleration, path.yaw_rad, curvature) if not sideways else (),
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


def _doubtful_in_gaps(covariance: Array, at_s: Array, seen_s: Array, density: tuple[float, float]) -> Array:
    """The covariances (T, 2, 2), wider where nothing was seen for long: how calmly something moved while it was seen tells
    little about what it did unseen, so there it may have moved as vehicles do.
    """
    factor = GAP_JERK_DENSITY / max(np.sqrt(density[0] * density[1]), 1e-12)
    gaps = np.flatnonzero(np.diff(seen_s) > GAP_S)
    if factor <= 1 or len(gaps) == 0:
        return covariance
    out = covariance.copy()
    for first, last in zip(seen_s[gaps].tolist(), seen_s[gaps + 1].tolist(), strict=True):
        rows = np.flatnonzero((at_s > first) & (at_s < last))
        if len(rows) == 0:
            continue
        before, after = covariance[max(rows[0] - 1, 0)], covariance[min(rows[-1] + 1, len(covariance) - 1)]
        share = ((at_s[rows] - first) / (last - first))[:, None, None]
        excess = covariance[rows] - (1 - share) * before - share * after
        # Only what the gap itself adds grows with the jerk.
        grows = np.trace(excess, axis1=1, axis2=2) > 0
        out[rows[grows]] += (factor - 1) * excess[grows]
    return out


def estimate_sigma(t: Array, xy: Array) -> float:
    """Standard deviation of the noise in m from third divided differences, which motion of constant acceleration lacks.

    Notes
    -----
    The median size makes it insensitive to outliers; a Gaussian's median absolute value is 0.6745 of its deviation.
    """
    if len(t) < 8:
        return 0.2
    rows = np.arange(len(t) - 3)[:, None] + np.arange(4)
    # Weights of the divided difference: the inverse products of each time's distances to the other three.
    apart = (t[rows][:, :, None] - t[rows][:, None, :]) / np.median(np.diff(t)) + np.eye(4)
    weights = 1.0 / apart.prod(axis=2)
    differences = np.einsum("nj,njk->nk", weights, xy[rows]) / np.linalg.norm(weights, axis=1, keepdims=True)
    return max(float(np.median(np.abs(differences))) / 0.6745, 1e-3)


def signed_speed(velocity_mps: Array, yaw_rad: Array) -> Array:
    """Speed (T,) along the heading, negative when reversing."""
    speed = np.hypot(*velocity_mps.T)
    course = np.arctan2(velocity_mps[:, 1], velocity_mps[:, 0])
    return np.where(np.abs(wrap_angle(course - yaw_rad)) > np.pi / 2, -speed, speed)
