"""Rows of tracks on the KITTI tracking benchmark: the detections of every track and the boxes predicted where it was not detected."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from kitti.boxes import Boxes
from kitti.map import PERIOD_NS
from kitti.paths import smooth_paths
from log2sim.datatypes import Measurements
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.forward import ForwardTracker
from log2sim.tracking.tracker import track

# Gaps up to this are bridged offline.
MAX_GAP_S = 2.0
# Offline, tracks of at least so many detections with this mean score (a logit) are carried on by so many frames at both ends.
EXTENDED_HITS, EXTENDED_SCORE, EXTENDED_FRAMES = 3, 2.0, 20
# Online, tracks of at least so many detections are carried on while they are not seen.
COAST_HITS = 3

# Sums are exact in units of one in so many.
SCALE = 1e9

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rows:
    """Boxes of tracks (N,).

    Attributes
    ----------
    frame : (N,) int64
    track : (N,) int64
    source : (N,) int64
        Row of the detection, -1 where the box is only predicted.
    model : (N,) int64
        Row of the detection that tells size, height and heading.
    xy_m : (N, 2) float64
        Center in the map.
    category : (N,) str
    """

    frame: Index
    track: Index
    source: Index
    model: Index
    xy_m: Array
    category: NDArray[np.str_]

    def take(self, index: NDArray[np.generic]) -> Rows:
        """The rows at `index`."""
        return Rows(*(column[index] for column in vars(self).values()))


def rows_online(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """What the tracker says frame by frame, from that frame and those before it."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    tracker = ForwardTracker(birth_score=0.0, period_s=PERIOD_NS / NS_PER_S, whole_boxes=True)
    latest = np.zeros(len(boxes), dtype=np.int64)  # row of the last detection, by track
    parts: list[tuple[Index, Index, Index, Index, Array]] = []
    for frame, found in enumerate(measurements):
        now_ns = frame * PERIOD_NS
        taken, number = tracker.step(found, now_ns)
        source = first[frame] + taken
        latest[number] = source
        coasting = np.flatnonzero((tracker.seen_ns < now_ns) & (tracker.hits >= COAST_HITS))
        number = np.concatenate([number, tracker.number[coasting]])
        source = np.concatenate([source, np.full(len(coasting), -1)])
        parts.append((np.full(len(number), frame), number, source, latest[number], tracker.mean[coasting, :2]))
    frames, number, source, model, predicted = (np.concatenate(c) for c in zip(*parts))
    xy = Measurements.join(measurements).center_m[model, :2]
    xy[source < 0] = predicted
    return Rows(frames, number, source, model, xy, boxes.category[model])


def first_of_run(number: Index) -> Index:
    """Index (N,) of the first row of the run of equal numbers that each row is in."""
    fresh = np.r_[True, np.diff(number) != 0][: len(number)]
    return np.flatnonzero(fresh)[np.cumsum(fresh) - 1] if len(number) else np.zeros(0, dtype=np.int64)


def last_of_run(begin: Index) -> Index:
    """Index (N,) of the last row of each run, from that of its first row, `begin` (N,)."""
    return np.r_[np.unique(begin)[1:], len(begin)][np.cumsum(begin == np.arange(len(begin))) - 1] - 1


def sum_so_far(values: NDArray[np.generic], begin: Index) -> Array:
    """Sums (N,) from the first row of a run, `begin` (N,), to each of its rows."""
    total = exact_sums(values)
    return np.asarray((total[1:] - total[begin]) / SCALE)


def exact_sums(values: NDArray[np.generic]) -> Index:
    """Sums (N + 1,) of all values (N,) before each place, in units of 1 / `SCALE`.

    Whole numbers: differences of sums would otherwise depend, in the last digit, on what was summed before.
    """
    return np.r_[0, np.cumsum(np.round(np.asarray(values, dtype=np.float64) * SCALE).astype(np.int64))]


def rows_offline(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """Stitched tracks on their smoothed paths, with the gaps and some frames before and after them."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    t_ns = np.arange(len(measurements), dtype=np.int64) * PERIOD_NS
    # The tracker does not read how many points there were, so the row of a detection travels in their place.
    marked = [replace(m, points=first[k] + np.arange(len(m))) for k, m in enumerate(measurements)]
    tracks = track(marked, t_ns, birth_score=0.0, max_gap_s=MAX_GAP_S, min_life_s=0.0, whole_boxes=True)
    rows_of = [t.measurements.points for t in tracks]
    extended = np.array([len(r) >= EXTENDED_HITS and boxes.score[r].mean() >= EXTENDED_SCORE for r in rows_of])
    paths = smooth_paths(tracks, t_ns, whole_boxes=True, beyond=np.where(extended, EXTENDED_FRAMES, 0))
    seen = paths.row >= 0
    source = np.full(len(seen), -1, dtype=np.int64)
    source[seen] = np.concatenate(rows_of)
    category = np.array([boxes.category[r][t.measurements.category == t.category][0] for r, t in zip(rows_of, tracks)])
    # What is not seen looks like the nearest detection.
    before, after = neighbors(seen, paths.track)
    nearest = np.where(paths.tick - paths.tick[before] <= paths.tick[after] - paths.tick, before, after)
    return Rows(paths.tick, paths.track, source, source[nearest], paths.mean[:, :2], category[paths.track])


def neighbors(seen: Mask, track: Index) -> tuple[Index, Index]:
    """Rows (N,) of the last detection up to each row and of the first one from it on, rows sorted by track and frame.

    Beyond the ends of a track both are the detection at that end.
    """
    at = np.arange(len(seen))
    before = np.maximum.accumulate(np.where(seen, at, -1))
    after = np.minimum.accumulate(np.where(seen, at, len(seen))[::-1])[::-1]
    no_before = (before < 0) | (track[before] != track)
    no_after = after == len(seen)
    no_after |= track[np.where(no_after, 0, after)] != track
    return np.where(no_before, after, before), np.where(no_after, before, after)


def end_rows(rows: Rows, *, online: bool) -> tuple[Index, Index]:
    """Rows (N,) of the first and the last detection of the track of each row, online of the last one so far."""
    before, after = neighbors(rows.source >= 0, rows.track)
    begin = first_of_run(rows.track)
    return after[begin], before if online else before[last_of_run(begin)]
