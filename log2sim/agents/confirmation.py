"""Which tracks are believed: what is there is detected most of the time, and surely."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Track
from log2sim.geometry import NS_PER_S, Array

# Share of ticks with a detection times the score of the best ones.
LEAST_CREDIT = 0.3
LEAST_CREDIT_OF_ODD_SHAPES = 0.6
HIDDEN_S = 1.0
SAME_MOMENT_S = 1e-3


def is_credible(track: Track, strongest: Array, *, typical: bool) -> bool:
    """Whether a track deserves belief, from the scores of its best detections; more is asked of untypical sizes."""
    return credit(track, strongest) >= (LEAST_CREDIT if typical else LEAST_CREDIT_OF_ODD_SHAPES)


def credit(track: Track, strongest: Array) -> float:
    """How much a track deserves belief, in [0, 1]: detected how often while it could be, times how surely.

    A gap longer than `HIDDEN_S` counts as being hidden, at the price of half of that time.
    """
    t = np.sort((track.measurements.t_ns - track.measurements.t_ns[0]) / NS_PER_S)
    # Frames that share a sweep measure at one moment, and that counts once.
    t = t[np.r_[True, np.diff(t) > SAME_MOMENT_S]]
    steps = np.diff(t)
    if len(steps) == 0:
        return float(strongest.mean())
    period = float(np.median(steps[steps <= np.median(steps)]))
    expected = 1 + float(np.where(steps > HIDDEN_S, HIDDEN_S / 2, steps).sum()) / max(period, 1e-3)
    return min(len(t) / expected, 1.0) * float(strongest.mean())
