"""Errors that all ticks of an agent share, which no average over its ticks makes smaller, in its standard deviations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline
from log2sim.agents.confidence.evidence import Evidence, seen_share, yaw_at_measurements
from log2sim.agents.confidence.weights import POSITION_VARIANCE, SPEED_VARIANCE, YAW_VARIANCE
from log2sim.datatypes import Waypoints
from log2sim.geometry import Array

Terms = Mapping[str, Array]


def with_systematic_errors(
    candidate: AgentCandidate, evidence: Evidence, confidence: float, timeline: Timeline
) -> Waypoints:
    """Return the waypoints of a candidate with larger standard deviations.

    Notes
    -----
    A variance is a sum of terms, each a reason for an error, times weights that fit synthetic logs
    (`tools/fit_confidence.py`). Smoothing and fits take the errors of ticks as independent; but a box that is laid against the
    wrong end, or has a wrong length, is off by as much at every tick.
    """
    w, size_m = candidate.agent.waypoints, candidate.agent.size_m
    share = seen_share(candidate, yaw_at_measurements(candidate, timeline))
    position = sigma_of(position_terms(w, size_m, share, evidence, confidence), POSITION_VARIANCE)
    yaw = None if w.sigma_yaw_rad is None else sigma_of(yaw_terms(w, confidence), YAW_VARIANCE)
    speed = None if w.sigma_speed_mps is None else sigma_of(speed_terms(w, evidence, confidence), SPEED_VARIANCE)
    return replace(w, sigma_xy_m=position, sigma_yaw_rad=yaw, sigma_speed_mps=speed)


def sigma_of(terms: Terms, weights: Mapping[str, float]) -> Array:
    """Return the standard deviations (T,) whose squares are the weighted sums of terms (T,)."""
    return np.asarray(np.sqrt(np.sum([weights[name] * values for name, values in terms.items()], axis=0)))


def position_terms(
    w: Waypoints, size_m: tuple[float, float, float], seen: Array, evidence: Evidence, confidence: float
) -> dict[str, Array]:
    """Return the reasons for errors of position at the waypoints (T,), m2 but for their weights.

    - given: what smoothing or the fit says;
    - given_moving: errors of neighboring ticks are alike, and smoothing averages them;
    - hidden: a box is laid against one end, and the part of its length that was never seen is on either side of the points;
    - range: the spacing of rays and errors of the pose grow with the distance;
    - wrong: an agent that is probably wrong is farther off, mostly by up to half its length.
    """
    ones = np.ones(len(w))
    length = size_m[0]
    range_m = 20.0 * np.exp(evidence.range)
    return {
        "given": w.sigma_xy_m**2,
        "given_moving": evidence.moving * w.sigma_xy_m**2,
        "hidden": ((1 - seen[0]) * length) ** 2 * ones,
        "range": (range_m / 10.0) ** 2 * ones,
        "wrong": _wrong_weight(confidence) * length**2 * ones,
    }


def yaw_terms(w: Waypoints, confidence: float) -> dict[str, Array]:
    """Return the reasons for errors of yaw at the waypoints (T,), rad2 but for their weights.

    - given: what smoothing or the fit says;
    - wrong: the axis of an agent that is probably wrong may be off by any angle.
    """
    given = np.zeros(len(w)) if w.sigma_yaw_rad is None else w.sigma_yaw_rad
    ones = np.ones(len(w))
    return {
        "given": given**2,
        "wrong": _wrong_weight(confidence) * ones,
    }


def speed_terms(w: Waypoints, evidence: Evidence, confidence: float) -> dict[str, Array]:
    """Return the reasons for errors of speed at the waypoints (T,), m2/s2 but for their weights.

    - given: what smoothing says;
    - standing: a standing agent that is probably wrong may move;
    - moving: a moving agent that is probably wrong may stand, or move at another speed.
    """
    given = np.zeros(len(w)) if w.sigma_speed_mps is None else w.sigma_speed_mps
    ones = np.ones(len(w))
    return {
        "given": given**2,
        "standing": (1 - evidence.moving) * _wrong_weight(confidence) * ones,
        "moving": evidence.moving * _wrong_weight(confidence) * (1.0 + np.abs(w.speed_mps)) ** 2,
    }


def _wrong_weight(confidence: float) -> float:
    """Return the weight of the errors of a wrong agent: the more probably an agent is wrong, the larger its errors are, too."""
    return (1 - confidence) ** 2
