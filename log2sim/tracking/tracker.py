"""Tracking in the map frame: forward assignment, stitching, one category a track."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
<<<<<<< HEAD
from functools import partial
from typing import Any
=======
>>>>>>> main

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Measurements, Track
from log2sim.geometry import NS_PER_S, Array, period_of
from log2sim.tracking.forward import track_forward
from log2sim.tracking.stitch import decide_category, stitch

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
    motion. `flow_mps`: (T, 2): velocity of the ego, as others may drive. `min_life_s`: shorter tracks, after stitching, are dropped as false alarms, unless the log itself is as short.
    """
    everything = Measurements.join(measurements)
    first_row = np.cumsum([0, *(len(m) for m in measurements)])
    tracks = []
    for ticks, rows in track_forward(
        measurements, t_ns, birth_score=birth_score, whole_boxes=whole_boxes, flow_mps=flow_mps
    ):
        found = everything.take(first_row[ticks] + rows)
        tracks.append(Track(decide_category(found, whole_boxes=whole_boxes), ticks, found))
    tracks = stitch(tracks, t_ns, max_gap_s=max_gap_s, whole_boxes=whole_boxes)
    kept = [t for t in tracks if len(t) >= min_hits(t_ns, min_life_s)]
    return sorted(kept, key=lambda t: (int(t.tick[0]), float(t.measurements.center_m[0, 0])))


def min_hits(t_ns: NDArray[np.int64], min_life_s: float) -> int:
    """Return the number of measurements that a track needs: the ticks in `min_life_s`, 1 in a log of one or two ticks."""
    if len(t_ns) < 3:
        return 1
    return max(2, min(round(min_life_s / period_of(t_ns)), len(t_ns) // 2))


# Velocities are those of lines through the measurements within this time of each.
VELOCITY_WINDOW_S = 0.5
<<<<<<< HEAD
# Standard deviation of where the road's sensors are after registration, m.
POSE_SIGMA_M = 0.1
# Tracks of one object may both be seen at so many of the ticks at which another track of it is, by a mistake of either tracker.
MAX_SHARED_TICKS = 1


def track_ends(
    ends: Sequence[Sequence[Measurements]], t_ns: NDArray[np.int64], config: TrackConfig, flow_mps: Array | None = None
) -> list[Track]:
    """Track the measurements of each end on their own and merge the tracks.

    `ends`: of each end, by tick; those of a single one are tracked and no more. `t_ns`: (T,). `config`, `flow_mps`: as for `track`; what
    both ends have of an object counts as its life.
    """
    max_gap_s, min_life_s = config.max_gap_s, config.min_life_s
    follow = partial(track, t_ns=t_ns, birth_score=config.birth_score, max_gap_s=max_gap_s, flow_mps=flow_mps)
    if len(ends) == 1:
        return follow(ends[0], min_life_s=min_life_s)
    tracks: list[Track] = []
    for measurements in ends:
        found = follow(measurements, min_life_s=0.0)
        tracks = merge_tracks(tracks, found) if tracks else found
    return _long_enough(stitch(tracks, t_ns, max_gap_s=max_gap_s), t_ns, min_life_s)


def merge_tracks(a: Sequence[Track], b: Sequence[Track]) -> list[Track]:
    """Merge the tracks of two ends that are the same objects; the others stay as they are.

    Pairs are taken in the order of how well they agree. Several tracks of one end may belong to one of the other, which followed
    the object through a gap.
    """
    tracks, velocity = [*a, *b], [velocities(t) for t in (*a, *b)]
    costs = {
        (i, j): cost
        for i in range(len(a))
        for j in range(len(a), len(tracks))
        if (cost := compare(tracks[i], tracks[j], velocity[i], velocity[j])) is not None
    }
    owner, members = list(range(len(tracks))), {k: [k] for k in range(len(tracks))}
    for i, j in sorted(costs, key=lambda pair: costs[pair]):
        one, other = owner[i], owner[j]
        if one != other and _can_join(members[one], members[other], tracks, len(a)):
            for k in members[other]:
                owner[k] = one
            members[one] += members.pop(other)
    return [_merge([tracks[k] for k in group], [velocity[k] for k in group]) for group in members.values()]


def _can_join(one: Sequence[int], other: Sequence[int], tracks: Sequence[Track], of_first: int) -> bool:
    """Return whether neither end, the first of which has so many of the tracks, sees two of them at the same ticks."""
    for first_end in (True, False):
        mine, theirs = ([tracks[k].tick for k in group if (k < of_first) == first_end] for group in (one, other))
        if mine and theirs and len(np.intersect1d(np.concatenate(mine), np.concatenate(theirs))) > MAX_SHARED_TICKS:
            return False
    return True


def compare(one: Track, other: Track, velocity: Array, velocity_other: Array) -> float | None:
    """Return the median squared Mahalanobis distance of two tracks at their common ticks, less for many; None if they differ.

    `velocity`, `velocity_other`: (n, 2), (m, 2): velocities of the tracks at their measurements, m/s.
    """
    groups = GROUP_OF[one.category], GROUP_OF[other.category]
    if groups[0] != groups[1] and groups not in RELATED:
        return None
    if one.tick[0] > other.tick[-1] or other.tick[0] > one.tick[-1]:
        return None
    _, i, j = np.intersect1d(one.tick, other.tick, assume_unique=True, return_indices=True)
    if not len(i):
        return None
    m, n = one.measurements.take(i), other.measurements.take(j)
    group = np.full(len(i), groups[0])
    late_s = ((m.t_ns - n.t_ns) / NS_PER_S)[:, None]
    away = n.center_m[:, :2] + late_s * velocity_other[j] - m.center_m[:, :2]
    c = measurement_noise(m.covariance + n.covariance, group) + POSE_SIGMA_M**2 * np.eye(2)
    squared = np.einsum("ni,ni->n", away, np.linalg.solve(c, away[..., None])[..., 0])
    middle = float(np.median(squared))
    # They go together: an object that only passes the other is as near for a moment.
    parted = away + np.median(late_s) * (velocity[i] - velocity_other[j])
    if middle > CHI2_2DOF_99 or float(np.median(np.hypot(*parted.T))) > _reach(m, n):
        return None
    return middle - float(np.log(len(i)))


def _reach(m: Measurements, n: Measurements) -> float:
    """Return how far apart the centers of one object can be, m: half of both boxes, or what the errors allow without boxes."""
    lengths = np.concatenate([m.box_size_m[:, 0], n.box_size_m[:, 0]])
    return float(np.nanmedian(lengths)) if np.isfinite(lengths).any() else np.inf
=======
>>>>>>> main


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
