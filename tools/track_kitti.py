"""Runs log2sim's tracker on 3D boxes of the KITTI tracking benchmark and writes results in its format.

    python tools/track_kitti.py --detections DIR [--detections DIR ...] --calib DIR [--ego-motion DIR] [--online] --out DIR
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from kitti_boxes import Boxes, read_detections, write_tracks
from kitti_map import PERIOD_NS, View, from_map, hidden_share, read_view, to_measurements
from numpy.typing import NDArray

from log2sim.errors import Log2SimError
from log2sim.geometry import Array, wrap_angle
from log2sim.track import track
from log2sim.track.forward import ForwardTracker
from log2sim.track.path import smooth_paths

# A track that was seen often is believed more, up to so many times.
FULL_HITS = 10
# What is hidden by more than this from the camera has no label, unless the detector is as sure as this.
HIDDEN_SHARE, SURE_SCORE = 0.7, 5.0
COAST_S, COAST_HITS, COAST_HIDDEN = 0.25, 5, 0.3
MAX_GAP_S = 3.0
FILL_HIDDEN = 0.6

Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Rows:
    """Boxes of tracks, by frame: `frame`, `number` of the track, `source` row of the detection, -1 where only predicted,
    `last` row of the detection that tells size, height and heading, `xy_m` (N, 2) in the map, `score` (N,).
    """

    frame: Index
    number: Index
    source: Index
    last: Index
    xy_m: Array
    score: Array


def track_online(boxes: Boxes, view: View) -> Boxes:
    """Tracks of detections, sorted by frame, of one category; what is said of a frame depends on no later one."""
    measurements = to_measurements(boxes, view)
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    tracker = ForwardTracker(birth_score=0.0, whole_boxes=True)
    last_row = np.zeros(len(boxes), dtype=np.int64)  # of every track, by number
    parts: list[tuple[Index, Index, Index, Index, Array]] = []
    for frame, found in enumerate(measurements):
        rows, numbers = tracker.step(found, frame * PERIOD_NS)
        source = rows + first[frame]
        last_row[numbers] = source
        age_s = (frame * PERIOD_NS - tracker.seen_ns) * 1e-9
        coasting = np.flatnonzero((age_s > 0) & (age_s <= COAST_S) & (tracker.hits >= COAST_HITS))
        number = np.concatenate([numbers, tracker.number[coasting]])
        parts.append((
            np.full(len(number), frame), number, np.concatenate([source, np.full(len(coasting), -1)]), last_row[number],
            tracker.mean[coasting, :2],
        ))  # fmt: skip
    frame, number, source, last, predicted = (np.concatenate(c) for c in zip(*parts))
    xy = np.concatenate([m.center_m for m in measurements])[last, :2]
    xy[source < 0] = predicted
    rows = Rows(frame, number, source, last, xy, _running_score(number, source, boxes.score))
    return _written(rows, boxes, view, np.concatenate([m.center_m for m in measurements]), np.concatenate([m.yaw_rad for m in measurements]), COAST_HIDDEN)


def _running_score(number: Index, source: Index, score: Array) -> Array:
    """Confidence (N,) in a track at each of its rows, from those up to it: mean score, raised by the logarithm of their count."""
    order = np.argsort(number, kind="stable")
    n, s = number[order], source[order]
    value = np.where(s >= 0, score[s], 0.0)
    hit = (s >= 0).astype(np.float64)
    begin = np.flatnonzero(np.r_[True, np.diff(n) != 0])
    group = np.cumsum(np.r_[True, np.diff(n) != 0]) - 1 if len(n) else np.zeros(0, dtype=np.int64)
    total, count = np.cumsum(value), np.cumsum(hit)
    total = total - (total[begin] - value[begin])[group]
    count = count - (count[begin] - hit[begin])[group]
    out = np.empty(len(n))
    out[order] = total / count + np.log(np.minimum(count, FULL_HITS))
    return out


def track_offline(boxes: Boxes, view: View) -> Boxes:
    """Tracks of detections, sorted by frame, of one category: stitched over occlusions, gaps filled, smoothed backward."""
    measurements = to_measurements(boxes, view)
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    t_ns = np.arange(len(measurements), dtype=np.int64) * PERIOD_NS
    # The box of a detection says which row it was: nothing else is carried along.
    numbered = _numbered(measurements, first)
    tracks = track(numbered, t_ns, birth_score=0.0, max_gap_s=MAX_GAP_S, min_life_s=0.0, whole_boxes=True)
    paths = smooth_paths(tracks, t_ns, whole_boxes=True)
    sources = np.concatenate([t.measurements.points for t in tracks])
    offset = np.cumsum([0, *(len(t) for t in tracks)])
    source = np.where(paths.row >= 0, sources[np.minimum(offset[paths.track] + paths.row, len(sources) - 1)], -1)
    at = np.flatnonzero(source >= 0)
    last = source[at][np.searchsorted(at, np.arange(len(source)), side="right") - 1]
    center = np.concatenate([m.center_m for m in measurements])
    yaw = np.concatenate([m.yaw_rad for m in measurements])
    mean = np.bincount(paths.track[at], weights=boxes.score[source[at]]) / np.bincount(paths.track[at])
    score = mean + np.log(np.minimum(np.bincount(paths.track[at]), FULL_HITS))
    xy = np.where((source >= 0)[:, None], center[last, :2], paths.mean[:, :2])
    order = np.lexsort([paths.track, paths.tick])
    rows = Rows(*(c[order] for c in (paths.tick, paths.track, source, last, xy, score[paths.track])))
    return _written(rows, boxes, view, center, yaw, FILL_HIDDEN)


def _numbered(measurements, first):
    import dataclasses
    return [dataclasses.replace(m, points=first[k] + np.arange(len(m))) for k, m in enumerate(measurements)]


def _written(rows: Rows, boxes: Boxes, view: View, center: Array, yaw: Array, hidden_limit: float) -> Boxes:
    out = boxes.take(rows.last)
    columns = {**vars(out), "frame": rows.frame, "track_id": rows.number, "score": rows.score}
    made = np.flatnonzero(rows.source < 0)
    if len(made):
        at = np.column_stack([rows.xy_m[made], center[rows.last[made], 2]])
        fresh = from_map(at, boxes.size_hwl_m[rows.last[made]][:, ::-1], yaw[rows.last[made]], rows.frame[made], view)
        for name, value in fresh.items():
            column = columns[name].copy()
            column[made] = value
            columns[name] = column
    out = Boxes(**columns)
    inside = np.isfinite(out.box_px).all(axis=1)
    out, source = out.take(inside), rows.source[inside]
    hidden = hidden_share(out, len(view.map_T_cam))
    raw = np.where(source >= 0, boxes.score[source], -np.inf)
    keep = np.where(source >= 0, (hidden <= HIDDEN_SHARE) | (raw >= SURE_SCORE), hidden <= hidden_limit)
    return out.take(keep)
