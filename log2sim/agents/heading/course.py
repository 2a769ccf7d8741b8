"""What motion says about the front of a vehicle: it drives forward, but maneuvers slowly in reverse."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Waypoints
from log2sim.geometry import Array

# Log-odds that an object moves forward: of slow ones, one in five reverses, at 3 m/s one in a thousand.
FORWARD_LOG_ODDS, FORWARD_LOG_ODDS_PER_MPS, MAX_FORWARD_LOG_ODDS = 1.4, 2.0, 9.0
# A way shorter than so many standard deviations of its ends may be noise.
CERTAIN_SIGMAS = 4.0


def forward_log_odds(speed_mps: float) -> float:
    """Return the log-odds, in nats, that something that moves at a speed, at least 0, moves forward."""
    return FORWARD_LOG_ODDS + FORWARD_LOG_ODDS_PER_MPS * speed_mps


def course_log_odds(w: Waypoints, length_m: float) -> float:
    """Return the log-odds that the front of a vehicle is where its yaw points, by the ways that it drives either way.

    Notes
    -----
    The center of a standing vehicle seems to move by up to its length while more and more of it comes into view.
    """
    step_s = np.gradient(w.t_s) if len(w.t_s) > 1 else np.zeros(1)
    certain_m = max(length_m, CERTAIN_SIGMAS * float(np.median(w.sigma_xy_m)))
    return _one_way(np.maximum(w.speed_mps, 0.0), step_s, certain_m) - _one_way(
        np.maximum(-w.speed_mps, 0.0), step_s, certain_m
    )


def _one_way(speed_mps: Array, step_s: Array, certain_m: float) -> float:
    """Return the log-odds for the direction in which something drives at speeds (T,), 0 at other times."""
    distance_m, time_s = float(speed_mps @ step_s), float(step_s[speed_mps > 0].sum())
    if time_s <= 0:
        return 0.0
    return min(forward_log_odds(distance_m / time_s), MAX_FORWARD_LOG_ODDS) * min(distance_m / certain_m, 1.0)
