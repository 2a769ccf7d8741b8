"""Tracking in the map frame: forward assignment, stitching, one category a track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Measurements, Track
from log2sim.geometry import NS_PER_S, Array, period_of
from log2sim.tracking.forward import MAX_MISSES, track_forward
from log2sim.tracking.stitch import stitch

SWEEPS = ""
"""Represents the LiDARs among the cameras, as in the column `camera` of measurements."""


def mark_unrecorded(tracks: Sequence[Track], recorded: Mapping[str, NDArray[np.bool_]]) -> list[Track]:
    """Return tracks that know at which ticks none of the sensors that measured them recorded, and how often pictures were searched.

    `recorded`: (T,) each: whether a camera, or `SWEEPS` any LiDAR, recorded something usable at each tick.
    """
    marked = []
    for one in tracks:
        m = one.measurements
        by_camera = [recorded[name] for name in {str(c) for c in m.camera} - {SWEEPS} if name in recorded]
        in_sweeps = SWEEPS in recorded and np.isfinite(m.box_yaw_rad).any()
        by_any = [*by_camera, recorded[SWEEPS]] if in_sweeps else by_camera
        unrecorded = np.flatnonzero(~np.any(by_any, axis=0)) if by_any else np.zeros(0, dtype=np.int64)
        searched = float(np.any(by_camera, axis=0)[one.tick].mean()) if by_camera else 1.0
        marked.append(replace(one, unrecorded=unrecorded, searched=searched))
    return marked


def track(
    measurements: Sequence[Measurements],
    t_ns: NDArray[np.int64],
    *,
    birth_score: float,
    max_gap_s: float,
    min_life_s: float,
    whole_boxes: bool = False,
    flow_mps: Array | None = None,
) -> list[Track]:
    """Turn the measurements of T ticks into tracks, sorted by their first tick.

    `t_ns`: (T,). `birth_score`: lowest score that can start a track. `max_gap_s`: longest occlusion that is bridged, s.
    `whole_boxes`: whether the measurements come from a 3D detector: centers that do not move with the view, yaw along the
    motion. `flow_mps`: (T, 2): velocity of the ego, as others may drive. `min_life_s`: shorter tracks,
    after stitching, are dropped as false alarms, unless the log itself is as short.
    """
    everything = Measurements.join(measurements)
    count = [len(m) for m in measurements]
    tick, first_row = np.repeat(np.arange(len(count)), count), np.cumsum([0, *count])
    found = track_forward(measurements, t_ns, birth_score=birth_score, whole_boxes=whole_boxes, flow_mps=flow_mps)
    parts = [first_row[ticks] + rows for ticks, rows in found]
    if whole_boxes:
        # What the forward pass resumed after several misses is decided again by the motion on both sides of the gap. Centers of partial
        # views wander where an occlusion begins and ends, so that motions of one object disagree.
        gaps = [np.flatnonzero(np.diff(ticks) > MAX_MISSES) + 1 for ticks, _ in found]
        parts = [part for rows, cuts in zip(parts, gaps, strict=True) for part in np.split(rows, cuts)]
    least = min_hits(t_ns, min_life_s)
    tracks = [
        Track(category, tick[rows], everything.take(rows))
        for category, rows in stitch(everything, parts, max_gap_s=max_gap_s, whole_boxes=whole_boxes)
        if len(rows) >= least
    ]
    return sorted(tracks, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))


def min_hits(t_ns: NDArray[np.int64], min_life_s: float) -> int:
    """Return the number of measurements that a track needs: the ticks in `min_life_s`, 1 in a log of one or two ticks."""
    if len(t_ns) < 3:
        return 1
    return max(2, min(round(min_life_s / period_of(t_ns)), len(t_ns) // 2))


# Velocities are those of lines through the measurements within this time of each.
VELOCITY_WINDOW_S = 0.5


def velocities(track_: Track) -> Array:
    """Return the velocities (n, 2), m/s, of a track at its measurements: the slopes of lines through those around each."""
    t_s = (track_.measurements.t_ns - track_.measurements.t_ns[0]) / NS_PER_S
    xy, out = track_.measurements.center_m[:, :2], np.zeros((len(t_s), 2))
    first, last = (np.searchsorted(t_s, t_s + s * VELOCITY_WINDOW_S, side=d) for s, d in ((-1, "left"), (1, "right")))  # type: ignore[call-overload]
    for k, (begin, end) in enumerate(zip(first.tolist(), last.tolist())):
        t = t_s[begin:end] - t_s[begin:end].mean()
        if t @ t > 0:
            out[k] = t @ xy[begin:end] / (t @ t)
    return out
