"""Static objects: which tracks do not move."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import GROUP_OF, Measurements, Track
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception import box_fitting
from log2sim.perception.box_completion import real_ends
from log2sim.tracking.motion import CENTER_SIGMA_M

# A mean velocity below this, or within its own uncertainty, is no motion. The drift is the velocity times the duration.
MAX_STATIC_SPEED_MPS = {"vehicle": 0.35, "two_wheeler": 0.3, "pedestrian": 0.2, "other": 0.35}
MAX_STATIC_DRIFT_M = {"vehicle": 1.2, "two_wheeler": 0.8, "pedestrian": 0.5, "other": 1.2}
SIGNIFICANT_SIGMAS, EXCLUDED_SIGMAS = 2.0, 3.0
SPREAD_QUANTILE = 0.9
# Error of an observed end: rounded corners, gaps between rays.
END_SIGMA_M = 0.25
# Tuning constant of Cauchy's weights with 95 % efficiency for normal errors (Holland & Welsch, 1977).
CAUCHY_SIGMAS = 2.385
REWEIGHTINGS = 5


def is_static(track: Track) -> bool:
    """Return whether a track never moves: its robust velocity and drift are within the errors that changing views cause.

    Notes
    -----
    While parts of a vehicle are hidden its center is uncertain, by meters for a long one. A vehicle whose center seems to
    move is static if its observed ends do not move and are accurate enough to exclude the motion of the center.
    """
    m, group = track.measurements, GROUP_OF[track.category]
    if len(m) < 3:
        return group == "vehicle"
    t = (m.t_ns - m.t_ns[0]) / NS_PER_S
    center = _motion_of_centers(t, m, CENTER_SIGMA_M[group])
    if _is_none(center, float(t[-1]), group):
        return True
    ends = _motion_of_ends(t, m) if group == "vehicle" else None
    if ends is None or not _is_none(ends, float(t[-1]), group):
        return False
    excess = float(np.hypot(*center.velocity) - np.hypot(*ends.velocity))
    return ends.sigma_mps < max(center.sigma_mps, excess / EXCLUDED_SIGMAS)


@dataclass(frozen=True, eq=False)
class _Motion:
    """Uniform motion fitted to the observations of a track.

    Attributes
    ----------
    velocity : (2,) float64
        In m/s, along any two axes.
    sigma_mps : float
        Its standard deviation.
    spread_m : float
        The `SPREAD_QUANTILE` of the distances from the mean position, less two standard deviations of each.
    """

    velocity: Array
    sigma_mps: float
    spread_m: float


def _is_none(motion: _Motion, span_s: float, group: str) -> bool:
    """Return whether a motion is too slow or too uncertain to count as one."""
    speed = float(np.hypot(*motion.velocity))
    drift = speed * span_s
    slow = (
        speed < max(MAX_STATIC_SPEED_MPS[group], SIGNIFICANT_SIGMAS * motion.sigma_mps) or drift < CENTER_SIGMA_M[group]
    )
    return bool(slow and drift < MAX_STATIC_DRIFT_M[group] and motion.spread_m < 1.5 * MAX_STATIC_DRIFT_M[group])


def _motion_of_centers(t: Array, m: Measurements, sigma_m: float) -> _Motion:
    """Fit the motion of box centers; `sigma_m` is the noise that changing views add."""
    xy = m.center_m[:, :2] - np.median(m.center_m[:, :2], axis=0)
    largest: Array = np.linalg.eigvalsh(m.covariance)[:, -1].astype(np.float64)
    center, velocity, sigma_mps = robust_line(t, xy, largest + sigma_m**2)
    # Within its covariance a center has not moved.
    spread = np.hypot(*(xy - center).T) - 2 * np.sqrt(largest)
    return _Motion(velocity, sigma_mps, float(np.quantile(spread, SPREAD_QUANTILE)))


def _motion_of_ends(t: Array, m: Measurements) -> _Motion | None:
    """Fit the motion of the observed ends; None unless both axes have one at most measurements."""
    rows = np.flatnonzero([len(c) > 0 for c in m.cluster])
    if len(rows) < 3:
        return None
    yaw, origin = float(m.yaw_rad[rows[np.argmax(m.points[rows])]]), m.center_m[rows[0], :2]
    both = [box_fitting.extents(m.cluster[k][:, :2] - origin, yaw) for k in rows.tolist()]
    ends = np.stack([np.stack(e, axis=1) for e in both])
    sensor = box_fitting.rotate(m.sensor_m[rows, :2] - origin, -yaw)
    real = real_ends(ends[..., 0], ends[..., 1], sensor, m.ends_visible[rows]) > 0
    # The end may lie between two points of the cluster.
    gap = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=1) / np.sqrt(m.points[rows])
    variance = END_SIGMA_M**2 + gap**2
    velocity, sigma, spread = np.zeros(2), np.zeros(2), np.zeros(2)
    for axis in range(2):
        if np.any(real[:, axis], axis=1).mean() <= 0.5:
            return None
        # A rigid object moves with both ends: if one is static, the other moves because more of the object becomes visible.
        slowest = np.inf
        for end in np.flatnonzero(real[:, axis].mean(axis=0) > 0.25):
            visible = np.flatnonzero(real[:, axis, end])
            mean, speed, sigma_mps = robust_line(t[rows[visible]], ends[visible, axis, end, None], variance[visible])
            if abs(speed[0]) < slowest:
                slowest = abs(float(speed[0]))
                velocity[axis], sigma[axis] = speed[0], sigma_mps
                excess_m = np.abs(ends[visible, axis, end] - mean[0]) - 2 * np.sqrt(variance[visible])
                spread[axis] = np.quantile(excess_m, SPREAD_QUANTILE)
    return _Motion(velocity, float(sigma.max()), float(spread.max()))


def robust_line(t: Array, xy: Array, variance: Array) -> tuple[Array, Array, float]:
    """Fit uniform motion to positions by weighted least squares that outliers move little.

    Parameters
    ----------
    t : (n,) float64, s
    xy : (n, d) float64, m
    variance : (n,) float64, m2
        Of a position in each direction.

    Returns
    -------
    center : (d,)
        The weighted mean of the positions.
    velocity : (d,)
        In m/s; zero where all times are the same.
    sigma_mps : float
        Standard deviation of the velocity in each direction, larger where positions scatter more than their variances say
        (Birge, 1932), infinite where all times are the same.

    Notes
    -----
    Iteratively reweighted by Cauchy's function of the residuals (Holland & Welsch, "Robust regression using iteratively
    reweighted least-squares", 1977).
    """
    weight, robust = 1.0 / variance, np.ones(len(t))
    for _ in range(REWEIGHTINGS):
        w = weight * robust
        mean_t, center = w @ t / w.sum(), w @ xy / w.sum()
        known = float(w @ (t - mean_t) ** 2)
        velocity = (w * (t - mean_t)) @ (xy - center) / known if known > 0 else np.zeros(xy.shape[1])
        residual = xy - center - (t - mean_t)[:, None] * velocity
        squared = weight * (residual**2).sum(axis=1)
        robust = 1.0 / (1.0 + squared / CAUCHY_SIGMAS**2)
    scatter = float(squared.mean()) / xy.shape[1]
    return center, velocity, (max(scatter, 1.0) / known) ** 0.5 if known > 0 else np.inf
