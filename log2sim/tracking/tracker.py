"""Tracking in the map frame: forward assignment, stitching over occlusions, one category a track."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Measurements, Track
from log2sim.geometry import period_of
from log2sim.tracking.category import decide_category, gets_on_fast, voted_category
from log2sim.tracking.forward import track_forward
from log2sim.tracking.stitch import stitch


def track(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    max_gap_s: float,
    min_life_s: float,
    whole_boxes: bool = False,
) -> list[Track]:
    """Turn the measurements of T ticks into tracks, sorted by their first tick.

    Parameters
    ----------
    t_ns : (T,) int64
    birth_score : float
        Lowest score that can start a track.
    max_gap_s : float
        Longest occlusion that is bridged, s.
    whole_boxes : bool
        Whether the measurements come from a 3D detector: centers that do not move with the view, yaw along the motion.
    min_life_s : float
        Shorter tracks, after stitching, are dropped as false alarms, unless the log itself is as short.
    """
    tracklets = track_forward(measurements, t_ns, birth_score=birth_score, whole_boxes=whole_boxes)
    everything = Measurements.join(measurements)
    first_row = np.cumsum([0, *(len(m) for m in measurements)])
    tracks = []
    for t in tracklets:
        rows = everything.take(first_row[t.ticks] + t.rows)
        category = voted_category(rows)
        # A rider who was taken for a pedestrian before an occlusion may be seen to ride after it.
        rides = category == "pedestrian" and not whole_boxes and gets_on_fast(rows)
        tracks.append(Track("cyclist" if rides else category, t.ticks, rows))
    joined = stitch(tracks, t_ns, max_gap_s=max_gap_s, whole_boxes=whole_boxes)
    required = min_hits(t_ns, min_life_s)
    kept = [t for t in joined if len(t) >= required]
    if not whole_boxes:
        kept = [replace(t, category=decide_category(t.measurements)) for t in kept]
    return sorted(kept, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))


def min_hits(t_ns: NDArray[np.int64], min_life_s: float) -> int:
    """Return the number of measurements that a track needs: the ticks in `min_life_s`, 1 in a log of one or two ticks."""
    if len(t_ns) < 3:
        return 1
    return max(2, min(round(min_life_s / period_of(t_ns)), len(t_ns) // 2))
