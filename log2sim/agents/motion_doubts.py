"""Doubts about the motion of an agent: too fast, backward fast or far, across its length, or far from its measurements."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.spans import spans_of
from log2sim.datatypes import GROUP_OF, MAX_SPEED_MPS, BoxEvidence, Doubt, Waypoints
from log2sim.geometry import Array, wrap_angle
from log2sim.tracking.gates import CHI2_2DOF_999

# Of slow vehicles one in five reverses, at 3 m/s one in a thousand (`heading.course.forward_log_odds`); out of a driveway or
# to a better parking space it is some car lengths.
MAX_REVERSING_MPS, MAX_REVERSING_M = 3.0, 20.0
# A speed counts as beyond a limit where it is by as many of its own standard deviations.
SIGNIFICANT_SIGMAS = 2.0
# A measurement is far from the trajectory beyond the 99.9 % quantile of chi-square with two degrees of freedom; one may be an
# outlier.
MIN_BESIDE = 2
# One measurement in twenty is an outlier; twice as many are more than that.
MIN_BESIDE_SHARE = 0.1
# No road vehicle is wider, mirrors included, so a longer side is its length (Directive 96/53/EC allows 2.6 m).
MAX_WIDTH_M = 2.7
# Above this speed a vehicle goes along its length, but for the slip angle, up to 30 degrees where it turns at full lock.
MIN_COURSE_MPS, MAX_SLIP_RAD, MIN_ACROSS = 1.5, np.deg2rad(45.0), 3


def motion_doubts(category: str, w: Waypoints) -> tuple[Doubt, ...]:
    """Doubt what moves faster than its category does, or reverses fast or far.

    Parameters
    ----------
    category : str
    w : Waypoints
        One at every tick.
    """
    margin = 0.0 if w.sigma_speed_mps is None else SIGNIFICANT_SIGMAS * w.sigma_speed_mps
    fast = np.abs(w.speed_mps) - margin > MAX_SPEED_MPS[category]
    doubts = _doubts(w, fast, "speed", lambda k: f"moves at {_most(w.speed_mps[k]):.0f} m/s {_when(w.t_s, k)}")
    if GROUP_OF[category] in ("vehicle", "two_wheeler"):
        doubts += _doubts(w, _reverses(w, -w.speed_mps - margin), "reversing", lambda k: _words_of_reversing(w, k))
    return doubts


def jump_doubts(t_s: Array, residual_m: Array, sigma_m: Array) -> tuple[Doubt, ...]:
    """Doubt a smoothed trajectory where several measurements in a row are far from it.

    Parameters
    ----------
    t_s : (n,) float64, s
        Times of the measurements.
    residual_m : (n,) float64, m
        Distances from the trajectory; NaN where not used.
    sigma_m : (n,) float64, m
        Standard deviations of the measurements, changing views included.
    """
    beside = np.nan_to_num(residual_m) > np.sqrt(CHI2_2DOF_999) * sigma_m
    doubts = []
    for rows in spans_of(beside) if beside.mean() >= MIN_BESIDE_SHARE else []:
        if len(rows) >= MIN_BESIDE:
            reason = f"measured up to {residual_m[rows].max():.1f} m off its path {_when(t_s, rows)}"
            doubts.append(Doubt("jump", reason, float(t_s[rows[0]]), float(t_s[rows[-1]])))
    return tuple(doubts)


def sideways_doubts(m: BoxEvidence, t_s: Array, heading_rad: Array, speed_mps: Array) -> tuple[Doubt, ...]:
    """Doubt a vehicle whose length was measured to lie across its way most of the time.

    Parameters
    ----------
    m : BoxEvidence
        n rows.
    t_s : (n,) float64, s
    heading_rad : (n,) float64
        Of the trajectory at these times.
    speed_mps : (n,) float64, m/s
        There.
    """
    has_box = np.isfinite(m.box_yaw_rad)
    axis = np.where(has_box, m.box_yaw_rad, m.yaw_rad)
    certain = (has_box | ((m.high_m - m.low_m)[:, 0] > MAX_WIDTH_M)) & (np.abs(speed_mps) > MIN_COURSE_MPS)
    across = certain & (np.abs(wrap_angle(2 * (axis - heading_rad))) / 2 > MAX_SLIP_RAD)
    rows = np.flatnonzero(across)
    if len(rows) < MIN_ACROSS or len(rows) <= certain.sum() / 2:
        return ()
    reason = f"slides across its length {_when(t_s, rows)}"
    return (Doubt("sideways", reason, float(t_s[rows[0]]), float(t_s[rows[-1]])),)


def _reverses(w: Waypoints, backward_mps: Array) -> NDArray[np.bool_]:
    """Return where (T,) an agent reverses too fast, or farther than anybody does."""
    backward = w.speed_mps < 0
    wrong = np.zeros(len(w), dtype=bool)
    for rows in spans_of(backward):
        covered = float(np.hypot(np.diff(w.x_m[rows]), np.diff(w.y_m[rows])).sum())
        wrong[rows] = bool((backward_mps[rows] > MAX_REVERSING_MPS).any()) or covered > MAX_REVERSING_M
    return wrong


def _doubts(
    w: Waypoints, holds: NDArray[np.bool_], flag: str, words: Callable[[NDArray[np.intp]], str]
) -> tuple[Doubt, ...]:
    """Make a doubt of each span in which something holds (T,)."""
    return tuple(Doubt(flag, words(k), float(w.t_s[k[0]]), float(w.t_s[k[-1]])) for k in spans_of(holds))


def _words_of_reversing(w: Waypoints, k: NDArray[np.intp]) -> str:
    return f"reverses at up to {_most(w.speed_mps[k]):.1f} m/s {_when(w.t_s, k)}"


def _most(speed_mps: Array) -> float:
    return float(np.abs(speed_mps).max())


def _when(t_s: Array, k: NDArray[np.intp]) -> str:
    first, last = f"{t_s[k[0]]:.1f}", f"{t_s[k[-1]]:.1f}"
    return f"at {first} s" if first == last else f"from {first} to {last} s"
