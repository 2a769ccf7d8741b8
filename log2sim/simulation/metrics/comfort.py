"""Ride comfort: acceleration and jerk of the box center, smoothed as a body feels them."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from log2sim.geometry import Array

ACCEL_WINDOW_S = 0.75
JERK_WINDOW_S = 1.5
"""Lengths of the fits. Shorter ones show the steps of the controller and the noise of the scenario."""

MIN_ROWS = 5
"""Fewest rows of a window: a cubic with one degree of freedom left. With sparse rows the windows are longer."""

LIMITS = {
    "lon_accel_max_mps2": 2.40,
    "lon_decel_max_mps2": 4.05,
    "lat_accel_max_mps2": 4.89,
    "lon_jerk_max_mps3": 4.13,
    "jerk_max_mps3": 8.37,
    "yaw_rate_max_radps": 0.95,
    "yaw_accel_max_radps2": 1.93,
}
"""Comfort limits of nuPlan's planning benchmark (Karnchanachari et al., 2024), derived from human drivers."""


def comfort(t_s: Array, x_m: Array, y_m: Array, yaw_rad: Array) -> dict[str, float | bool] | None:
    """Compute greatest and RMS acceleration, jerk and yaw rates, and whether all are within `LIMITS`.

    Parameters
    ----------
    t_s, x_m, y_m, yaw_rad : (S,) float64, s, m and rad
        Evenly spaced box centers without discontinuities.

    Returns
    -------
    dict or None
        None for fewer than five rows.

    Notes
    -----
    Derivatives of cubics fitted to the positions in a sliding window (Savitzky and Golay, 1964): longitudinal along the
    heading, lateral across it, both of the box center. Changes faster than the window are damped.
    """
    if len(t_s) < MIN_ROWS:
        return None
    spacing_s = round((t_s[-1] - t_s[0]) / (len(t_s) - 1), 9)  # as times are stored, and the same for all agents
    ax, ay = (_derivative(c, 2, ACCEL_WINDOW_S, spacing_s) for c in (x_m, y_m))
    jx, jy = (_derivative(c, 3, JERK_WINDOW_S, spacing_s) for c in (x_m, y_m))
    yaw = np.unwrap(yaw_rad)
    yaw_rate, yaw_accel = (_derivative(yaw, order, ACCEL_WINDOW_S, spacing_s) for order in (1, 2))
    cos, sin = np.cos(yaw), np.sin(yaw)
    lon_accel, lat_accel, lon_jerk = ax * cos + ay * sin, ay * cos - ax * sin, jx * cos + jy * sin
    out = {
        "lon_accel_max_mps2": max(float(lon_accel.max()), 0.0),
        "lon_decel_max_mps2": max(float(-lon_accel.min()), 0.0),
        "lon_accel_rms_mps2": _rms(lon_accel),
        "lat_accel_max_mps2": float(np.abs(lat_accel).max()),
        "lat_accel_rms_mps2": _rms(lat_accel),
        "lon_jerk_max_mps3": float(np.abs(lon_jerk).max()),
        "lon_jerk_rms_mps3": _rms(lon_jerk),
        "jerk_max_mps3": float(np.hypot(jx, jy).max()),
        "yaw_rate_max_radps": float(np.abs(yaw_rate).max()),
        "yaw_accel_max_radps2": float(np.abs(yaw_accel).max()),
    }
    rounded: dict[str, float | bool] = {k: round(v, 4) for k, v in out.items()}
    rounded["comfortable"] = all(out[k] <= limit for k, limit in LIMITS.items())
    return rounded


def _derivative(values: Array, order: int, window_s: float, spacing_s: float) -> Array:
    """Return the derivative (S,) of cubics fitted to a window around each row; near an end, of the window at the end."""
    longest = len(values) - (len(values) + 1) % 2
    half = min(max(round(window_s / spacing_s / 2), MIN_ROWS // 2), longest // 2)
    weights = _weights(half, order, spacing_s)
    values = values - values[0]  # far map offsets would cost digits
    return np.concatenate(
        [
            weights[:half] @ values[: 2 * half + 1],
            np.correlate(values, weights[half], mode="valid"),
            weights[half + 1 :] @ values[-2 * half - 1 :],
        ]
    )


@lru_cache(maxsize=64)
def _weights(half: int, order: int, spacing_s: float) -> Array:
    """Return weights (W, W) of the values of a window of W = 2 half + 1 rows in the derivative at each of its rows."""
    at_s = np.arange(-half, half + 1) * spacing_s
    fit = np.linalg.pinv(np.vander(at_s, 4, increasing=True))
    return sum(
        (math.perm(k, order) * np.outer(at_s ** (k - order), fit[k]) for k in range(order, 4)),
        start=np.zeros((len(at_s), len(at_s))),
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))
