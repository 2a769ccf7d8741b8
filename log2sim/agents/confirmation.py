"""Confirmation of tracks: an object that exists is detected at most ticks and with high scores."""

from __future__ import annotations

import numpy as np

from log2sim.datatypes import Track
from log2sim.geometry import NS_PER_S, Array

# Limits of `track_confidence`; a track whose size is unlikely for its category needs more evidence.
MIN_TRACK_CONFIDENCE = 0.3
MIN_TRACK_CONFIDENCE_UNLIKELY_SIZE = 0.6
HIDDEN_S = 1.0
SAME_MOMENT_S = 1e-3


def is_confirmed(track: Track, strongest: Array, *, typical: bool) -> bool:
    """Return whether the confidence of a track suffices.

    Parameters
    ----------
    track : Track
    strongest : (K,) float64
        Scores of the best detections of the track.
    typical : bool
        Whether the size is likely for the category; an unlikely size needs a higher confidence.
    """
    return track_confidence(track, strongest) >= (
        MIN_TRACK_CONFIDENCE if typical else MIN_TRACK_CONFIDENCE_UNLIKELY_SIZE
    )


def track_confidence(track: Track, strongest: Array) -> float:
    """Return the confidence of a track in [0, 1]: its detection rate times the mean score (K,) of its best detections.

    A gap longer than `HIDDEN_S` counts as an occlusion: half of `HIDDEN_S` of it enters the detection rate.
    """
    t = np.sort((track.measurements.t_ns - track.measurements.t_ns[0]) / NS_PER_S)
    # Frames that share a sweep measure at the same time, which counts once.
    t = t[np.r_[True, np.diff(t) > SAME_MOMENT_S]]
    steps = np.diff(t)
    if len(steps) == 0:
        return float(strongest.mean())
    period = float(np.median(steps[steps <= np.median(steps)]))
    expected = 1 + float(np.where(steps > HIDDEN_S, HIDDEN_S / 2, steps).sum()) / max(period, 1e-3)
    return min(len(t) / expected, 1.0) * float(strongest.mean())
