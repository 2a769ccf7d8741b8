"""Where an object stands: spans of its track that one place explains as well as any motion does."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.likelihood import Readings
from log2sim.geometry import Array

# Spans in which the smoothed speed stays below this, give or take its noise, are looked at.
CANDIDATE_MPS, CANDIDATE_SIGMAS = 0.4, 2.0
LEAST_SPAN_S, LEAST_READINGS = 0.8, 6
# A drift is believed when it is this significant and faster than what stands seems to move as its outline changes.
DRIFT_SIGMAS, LEAST_DRIFT_MPS = 3.0, 0.05
SCATTER_SIGMAS = 3.0
LEAST_WEIGHT = 0.25
# What stands moves by less than the first; what comes to a halt does so within the time that follows.
STANDING_MPS = 0.005
EDGE_MPS, EDGE_S = 1.0, 0.4
END_SIGMAS, LEAST_STEP_M = 2.5, 0.03
# Ends that explain this share of their scatter by going straight for so long are moving.
STEADY_SHARE, LEAST_WAY_M, LEAST_STEADY = 0.85, 0.1, 4


def standing_tolerance(knots_s: Array, readings: Readings, weight: Array, state: Array, covariance: Array) -> Array:
    """Speed (K,) in m/s that an object may have that stands at a knot, infinite where it does not stand.

    Given its state (K, 3, 2) and covariance (K, 6, 6).
    """
    speed = np.hypot(*state[:, 1].T)
    sigma = np.sqrt(np.trace(covariance[:, 2:4, 2:4], axis1=1, axis2=2) / 2)
    slow = speed < CANDIDATE_MPS + CANDIDATE_SIGMAS * sigma
    tolerance = np.full(len(knots_s), np.inf)
    if not slow.any():
        return tolerance
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2] - 1):
        inside = np.flatnonzero((readings.place >= first) & (readings.place <= last) & (weight > LEAST_WEIGHT))
        span = _longest_standing(readings, inside, speed[readings.place])
        if len(span):
            # A candidate that reaches the track's end stands until then.
            begin = first if first == 0 and span[0] == inside[0] else readings.place[span[0]]
            end = last if last == len(knots_s) - 1 and span[-1] == inside[-1] else readings.place[span[-1]]
            since = np.inf if begin == 0 else knots_s[begin : end + 1] - knots_s[begin]
            until = np.inf if end == len(knots_s) - 1 else knots_s[end] - knots_s[begin : end + 1]
            tolerance[begin : end + 1] = STANDING_MPS + EDGE_MPS * np.exp(-np.minimum(since, until) / EDGE_S)
    return tolerance


def _longest_standing(readings: Readings, rows: NDArray[np.intp], speed: Array) -> NDArray[np.intp]:
    """Rows (m,) left when the end that differs more is cut off until the rest stands; none where it never does."""
    t, xy = readings.observed.t_s, readings.observed.xy
    information = 2.0 / np.trace(readings.observed.r, axis1=1, axis2=2)
    begin, end = (rows[0], rows[-1]) if len(rows) else (0, 0)
    while len(rows) >= LEAST_READINGS and t[rows[-1]] - t[rows[0]] >= LEAST_SPAN_S:
        first, last = _strangeness(t[rows], xy[rows], information[rows])
        if max(first, last) < 1.0:
            # Where one end had to go, what is next to it is in doubt.
            margin = max(len(rows) // 10, 2)
            return rows[margin * (rows[0] > begin) : len(rows) - margin * (rows[-1] < end)]
        cut = max(len(rows) // 10, 1)
        if first == last:
            first, last = speed[rows[0]], speed[rows[-1]]
        rows = rows[cut:] if first > last else rows[:-cut]
    return rows[:0]


def _strangeness(t: Array, xy: Array, information: Array) -> tuple[float, float]:
    """How far the first and the last quarter of positions lie from the middle half, in what noise allows.

    Both are the same where the positions drift or scatter too far as a whole.
    """
    weight = information / information.sum()
    time = t - weight @ t
    from_mean = xy - weight @ xy
    known = float(information @ time**2)
    drift = (information * time) @ from_mean / known
    scatter = float(information @ ((from_mean - time[:, None] * drift) ** 2).sum(axis=1))
    freedom = 2 * len(t) - 4
    # Where the positions scatter less than was said, smaller steps are seen.
    sharper = min(1.0, np.sqrt(scatter / freedom))
    whole = max(
        scatter / (freedom + SCATTER_SIGMAS * np.sqrt(2 * freedom)),
        float(np.hypot(*drift)) / max(DRIFT_SIGMAS * sharper / np.sqrt(known), LEAST_DRIFT_MPS),
    )
    if whole >= 1.0:
        return whole, whole
    quarter = max(len(t) // 4, LEAST_READINGS // 3)
    parts = slice(quarter), slice(quarter, -quarter), slice(-quarter, None)
    sums = [float(information[part].sum()) for part in parts]
    means = [information[part] @ xy[part] / s for part, s in zip(parts, sums)]
    first, last = (
        max(
            float(np.hypot(*(means[k] - means[1])))
            / max(END_SIGMAS * sharper * np.sqrt(1 / sums[1] + 1 / sums[k]), LEAST_STEP_M),
            _steady_way(t[parts[k]], xy[parts[k]]) / LEAST_WAY_M,
        )
        for k in (0, 2)
    )
    return first, last


def _steady_way(t: Array, xy: Array) -> float:
    """Length of the straight line that positions follow at constant speed, 0 where they do not.

    What drives off is seen by this even where the positions are far better than said.
    """
    if len(t) < LEAST_STEADY:
        return 0.0
    time, from_mean = t - t.mean(), xy - xy.mean(axis=0)
    slope = time @ from_mean / (time @ time)
    explained = float((slope @ slope) * (time @ time))
    return float(np.hypot(*slope) * (t[-1] - t[0])) if explained > STEADY_SHARE * float((from_mean**2).sum()) else 0.0
