"""Tracking in the map frame: forward assignment, stitching over occlusions, one category a track."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.track.forward import track_forward
from log2sim.track.stitch import category_of, stitch
from log2sim.types import Measurements, Track

__all__ = ["category_of", "track"]


def track(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    max_gap_s: float,
    min_hits: int,
) -> list[Track]:
    """Turn the measurements of T ticks into tracks, longest lives first by their start.

    Parameters
    ----------
    t_ns : (T,) int64
    birth_score : float
        Lowest score that can start a track.
    max_gap_s : float
        Longest occlusion that is bridged, s.
    min_hits : int
        Tracks with fewer measurements, after stitching, are taken for false alarms.
    """
    tracklets = track_forward(measurements, t_ns, birth_score=birth_score)
    tracks = []
    for t in tracklets:
        rows = Measurements.join([measurements[k].take([r]) for k, r in zip(t.ticks, t.rows)])
        tracks.append(Track(category_of(rows), np.array(t.ticks, dtype=np.int64), rows))
    joined = stitch(tracks, t_ns, max_gap_s=max_gap_s)
    kept = [t for t in joined if len(t) >= min_hits]
    return sorted(kept, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))
