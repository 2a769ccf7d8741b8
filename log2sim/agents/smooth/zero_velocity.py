"""Zero-velocity detection: spans of a track that one position explains as well as any motion does.

A test in the position domain, of the kind that inertial navigation calls zero-velocity detector (Skog, Handel, Nilsson and
Rantakokko, IEEE Trans. Biomed. Eng. 57, 2010): drift and scatter of a span are compared with what its noise allows.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.likelihood import MeasurementModel
from log2sim.geometry import Array

# Candidates are spans in which the smoothed speed stays below this, plus as many of its standard deviations.
CANDIDATE_MPS, CANDIDATE_SIGMAS = 0.4, 2.0
MIN_SPAN_S, MIN_OBSERVATIONS = 0.8, 4
# A drift is motion when it is this significant and faster than the outline of a standing object seems to move.
DRIFT_SIGMAS, MIN_DRIFT_MPS = 3.0, 0.05
SCATTER_SIGMAS = 3.0
MIN_WEIGHT = 0.25
# Standard deviation of the velocity at a standstill, and near the edges of a span, where it decays within the time that follows.
STANDSTILL_SIGMA_MPS = 0.005
EDGE_MPS, EDGE_S = 1.0, 0.4
# The first and the last quarter of a span are off its middle when it is this significant and this far.
END_SIGMAS, MIN_END_STEP_M = 2.5, 0.03
# An end is moving when a straight line at constant speed, this long, explains this share of its scatter.
MIN_EXPLAINED_SHARE, MIN_LINE_M, MIN_LINE_OBSERVATIONS = 0.85, 0.1, 4


def zero_velocity_sigma(
    knots_s: Array, measurement: MeasurementModel, weight: Array, state: Array, covariance: Array
) -> Array:
    """Detect standstill: standard deviation (K,) of the velocity in m/s around zero, infinite where the object moves.

    Parameters
    ----------
    knots_s : (K,) float64, s
    measurement : MeasurementModel
    weight : (n,) float64
        Weights of the observations.
    state : (K, 3, 2) float64
        Smoothed state without this constraint.
    covariance : (K, 6, 6) float64
    """
    speed = np.hypot(*state[:, 1].T)
    sigma = np.sqrt(np.trace(covariance[:, 2:4, 2:4], axis1=1, axis2=2) / 2)
    slow = speed < CANDIDATE_MPS + CANDIDATE_SIGMAS * sigma
    out = np.full(len(knots_s), np.inf)
    if not slow.any():
        return out
    edges = np.flatnonzero(np.diff(np.concatenate([[0], slow.astype(int), [0]])))
    for first, last in zip(edges[::2], edges[1::2] - 1):
        inside = np.flatnonzero((measurement.knot >= first) & (measurement.knot <= last) & (weight > MIN_WEIGHT))
        span = _trim_to_standstill(measurement, inside, speed[measurement.knot])
        if len(span):
            # A candidate that reaches the track's end stands until then.
            begin = first if first == 0 and span[0] == inside[0] else measurement.knot[span[0]]
            end = last if last == len(knots_s) - 1 and span[-1] == inside[-1] else measurement.knot[span[-1]]
            since = np.inf if begin == 0 else knots_s[begin : end + 1] - knots_s[begin]
            until = np.inf if end == len(knots_s) - 1 else knots_s[end] - knots_s[begin : end + 1]
            out[begin : end + 1] = STANDSTILL_SIGMA_MPS + EDGE_MPS * np.exp(-np.minimum(since, until) / EDGE_S)
    return out


def _trim_to_standstill(measurement: MeasurementModel, rows: NDArray[np.intp], speed: Array) -> NDArray[np.intp]:
    """Cut off the end that differs more until the remaining rows (m,) stand; none are left where they never do."""
    t, xy = measurement.observed.t_s, measurement.observed.xy
    information = 2.0 / np.trace(measurement.observed.r, axis1=1, axis2=2)
    begin, end = (rows[0], rows[-1]) if len(rows) else (0, 0)
    while len(rows) >= MIN_OBSERVATIONS and t[rows[-1]] - t[rows[0]] >= MIN_SPAN_S:
        first, last = _end_discrepancies(t[rows], xy[rows], information[rows])
        if max(first, last) < 1.0:
            # Where one end was cut off, the observations next to it are in doubt; one is enough where it covers the edge.
            step_s = (t[rows[-1]] - t[rows[0]]) / (len(rows) - 1)
            margin = max(len(rows) // 10, 1 if step_s > EDGE_S else 2)
            return rows[margin * (rows[0] > begin) : len(rows) - margin * (rows[-1] < end)]
        cut = max(len(rows) // 10, 1)
        if first == last:
            first, last = speed[rows[0]], speed[rows[-1]]
        rows = rows[cut:] if first > last else rows[:-cut]
    return rows[:0]


def _end_discrepancies(t: Array, xy: Array, information: Array) -> tuple[float, float]:
    """Distance of the first and the last quarter of positions from the middle half, relative to what noise allows.

    Both are the same where the positions drift or scatter too far as a whole.
    """
    weight = information / information.sum()
    time = t - weight @ t
    from_mean = xy - weight @ xy
    known = float(information @ time**2)
    drift = (information * time) @ from_mean / known
    scatter = float(information @ ((from_mean - time[:, None] * drift) ** 2).sum(axis=1))
    freedom = 2 * len(t) - 4
    # Where the positions scatter less than their covariances say, smaller steps are significant.
    noise_scale = min(1.0, np.sqrt(scatter / freedom))
    whole = max(
        scatter / (freedom + SCATTER_SIGMAS * np.sqrt(2 * freedom)),
        float(np.hypot(*drift)) / max(DRIFT_SIGMAS * noise_scale / np.sqrt(known), MIN_DRIFT_MPS),
    )
    if whole >= 1.0:
        return whole, whole
    quarter = max(len(t) // 4, 1 if len(t) < 6 else 2)
    parts = slice(quarter), slice(quarter, -quarter), slice(-quarter, None)
    sums = [float(information[part].sum()) for part in parts]
    means = [information[part] @ xy[part] / s for part, s in zip(parts, sums)]
    first, last = (
        max(
            float(np.hypot(*(means[k] - means[1])))
            / max(END_SIGMAS * noise_scale * np.sqrt(1 / sums[1] + 1 / sums[k]), MIN_END_STEP_M),
            _line_length(t[parts[k]], xy[parts[k]]) / MIN_LINE_M,
        )
        for k in (0, 2)
    )
    return first, last


def _line_length(t: Array, xy: Array) -> float:
    """Length in m of the straight line that positions follow at constant speed, 0 where they do not.

    Detects driving off even where the positions are far better than their covariances say.
    """
    if len(t) < MIN_LINE_OBSERVATIONS:
        return 0.0
    time, from_mean = t - t.mean(), xy - xy.mean(axis=0)
    slope = time @ from_mean / (time @ time)
    explained = float((slope @ slope) * (time @ time))
    on_line = explained > MIN_EXPLAINED_SHARE * float((from_mean**2).sum())
    return float(np.hypot(*slope) * (t[-1] - t[0])) if on_line else 0.0
