"""Candidates that are parts of one vehicle's life, which stood before it drove or after: it keeps its front."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.datatypes import Waypoints
from log2sim.geometry import Array
from log2sim.log_odds import log_odds_of, probability_of

# A vehicle whose track is lost is found again within this time, where it was; another one rarely takes its place that soon.
MAX_PAUSE_S, MAX_APART_M, MAX_TURNED_RAD = 3.0, 2.0, 0.3
SAME_VEHICLE = 0.95


def continued_log_odds(waypoints: Sequence[Waypoints], own: Array) -> Array:
    """Add to what is known of each of M candidates what is known of those that it continues, and that continue it.

    Parameters
    ----------
    waypoints : M Waypoints
    own : (M,) float64
        Log-odds that each points along its yaw, by what is known of it alone.
    """
    first = np.array([[w.t_s[0], w.x_m[0], w.y_m[0], w.yaw_rad[0]] for w in waypoints]).reshape(-1, 4)
    last = np.array([[w.t_s[-1], w.x_m[-1], w.y_m[-1], w.yaw_rad[-1]] for w in waypoints]).reshape(-1, 4)
    gap = first[None] - last[:, None]
    follows = (gap[..., 0] > 0) & (gap[..., 0] < MAX_PAUSE_S) & (np.hypot(gap[..., 1], gap[..., 2]) < MAX_APART_M)
    follows &= np.abs(np.sin(gap[..., 3])) < np.sin(MAX_TURNED_RAD)
    toward = np.where(np.cos(gap[..., 3]) > 0, 1.0, -1.0) * follows
    links = toward + toward.T
    # What is known of the other counts as far as it is the same vehicle.
    along = 0.5 + SAME_VEHICLE * (probability_of(own) - 0.5)
    return np.asarray(own + links @ log_odds_of(along))
