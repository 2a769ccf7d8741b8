"""Pedestrians and riders of the KITTI benchmark: a detector that has one of them often reports the other one in the same place."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from kitti.boxes import Boxes
from kitti.confidence import MISSED_SCORE
from kitti.map import PERIOD_NS
from kitti.rows import Index, Mask, Rows, end_rows, first_of_run, last_of_run, neighbors, sum_so_far
from kitti.scene import same_frame
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.stitch import MAX_PEDESTRIAN_SPEED_MPS

PEDESTRIAN, RIDER = "Pedestrian", "Cyclist"
SAME_OBJECT_M = 0.6
# Of labeled people the log-odds to be a rider are the score of the rider less that of the pedestrian and this; where a detector
# reports one of them alone the other one counts as missed.
RIDER_LEAD = 1.0
# What moved this far has a speed. Log-odds to be a rider: some 0.85 of those who walk and 0.1 of those who ride do so at 0.5 to
# 2 m/s, and 0.02 and 0.85 faster than people run.
MOVED_M, WALKING_MPS, WALKS, RIDES = 1.0, (0.5, 2.0), -2.0, 4.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """Detections of a sequence, in places with a pedestrian and a rider only one of them first.

    Attributes
    ----------
    boxes : Boxes
        N detections for the tracker, sorted by frame, then the others of their pairs, sorted by frame as well.
    count : int
        N.
    other : (N,) int64
        Row of the other one of the pair, -1 for none.
    rider : (N,) float64
        How much rather it is a rider than a pedestrian, in units of a score.
    """

    boxes: Boxes
    count: int
    other: Index
    rider: Array

    @property
    def tracked(self) -> Boxes:
        """The detections for the tracker (N,)."""
        return self.boxes.take(slice(0, self.count))


def find_pairs(boxes: Boxes) -> Pairs:
    """Pair each pedestrian with the nearest rider in its place; the likelier one is tracked."""
    boxes = boxes.take(np.argsort(boxes.frame, kind="stable"))
    pedestrian, rider = (np.flatnonzero(boxes.category == c) for c in (PEDESTRIAN, RIDER))
    i, j = same_frame(boxes.take(pedestrian), boxes.take(rider), reach_m=False)
    i, j = pedestrian[i], rider[j]
    apart_m = np.hypot(*(boxes.bottom_m[i] - boxes.bottom_m[j])[:, [0, 2]].T)
    order = np.flatnonzero(apart_m < SAME_OBJECT_M)
    order = order[np.argsort(apart_m[order], kind="stable")]
    pair = np.full(len(boxes), -1, dtype=np.int64)
    for a, b in zip(i[order].tolist(), j[order].tolist()):
        if pair[a] < 0 and pair[b] < 0:
            pair[a], pair[b] = b, a
    opposite = np.where(pair >= 0, boxes.score[pair], MISSED_SCORE)
    lead = np.where(boxes.category == RIDER, 1, -1) * (boxes.score - opposite) - RIDER_LEAD
    second = (pair >= 0) & np.where(boxes.category == RIDER, lead <= 0, lead > 0)
    first, second = np.flatnonzero(~second), np.flatnonzero(second)
    place = np.empty(len(boxes), dtype=np.int64)
    place[np.concatenate([first, second])] = np.arange(len(boxes))
    other = np.where(pair[first] >= 0, place[pair[first]], -1)
    return Pairs(boxes.take(np.concatenate([first, second])), len(first), other, lead[first])


def decide_people(rows: Rows, pairs: Pairs, places_m: Array | None, *, online: bool) -> Rows:
    """Rows by track and frame; those of people have the category of their track, and size and heading of a box of it.

    Online both are decided at every row from those up to it. `places_m` are the centers of the detections in the map, None
    where nothing stands in it.
    """
    rows = rows.take(np.lexsort([rows.frame, rows.track]))
    seen = rows.source >= 0
    source = np.maximum(rows.source, 0)
    begin = first_of_run(rows.track)
    end = np.arange(len(begin)) if online else last_of_run(begin)
    mean = sum_so_far(np.where(seen, pairs.rider[source], 0.0), begin)[end] / sum_so_far(seen, begin)[end]
    lead = mean if places_m is None else mean + _by_speed(rows, places_m, online=online)
    person = np.isin(pairs.boxes.category[rows.model], (PEDESTRIAN, RIDER))
    category = np.where(person, np.where(lead > 0, RIDER, PEDESTRIAN), rows.category)
    # A pair gives the box of the right category; where there is none, the nearest one of the track does.
    switched = seen & (pairs.boxes.category[source] != category) & (pairs.other[source] >= 0)
    source = np.where(switched, pairs.other[source], rows.source)
    right = seen & (pairs.boxes.category[source] == category)
    nearest, known = _nearest(right, rows, online=online)
    model = np.where(person & known, source[nearest], np.where(switched, source, rows.model))
    return replace(rows, source=source, model=model, category=category.astype("<U16"))


def _by_speed(rows: Rows, places_m: Array, *, online: bool) -> Array:
    """Log-odds (N,) of riders by the speed of their tracks."""
    first, last = end_rows(rows, online=online)
    moved_m = np.hypot(*(places_m[rows.source[last]] - places_m[rows.source[first]])[:, :2].T)
    seconds = (rows.frame[last] - rows.frame[first]) * PERIOD_NS / NS_PER_S
    speed = np.divide(moved_m, seconds, out=np.zeros(len(moved_m)), where=(seconds > 0) & (moved_m > MOVED_M))
    walks = (speed >= WALKING_MPS[0]) & (speed <= WALKING_MPS[1])
    return np.where(speed > MAX_PEDESTRIAN_SPEED_MPS, RIDES, np.where(walks, WALKS, 0.0))


def _nearest(right: Mask, rows: Rows, *, online: bool) -> tuple[Index, Mask]:
    """Nearest of the rows `right` (N,) of the same track, online the last one, and whether there is one."""
    before, after = (np.clip(k, 0, len(right) - 1) for k in neighbors(right, rows.track))
    sooner = np.abs(rows.frame - rows.frame[before]) <= np.abs(rows.frame[after] - rows.frame)
    nearest = before if online else np.where(sooner, before, after)
    known = right[nearest] & (rows.track[nearest] == rows.track)
    return nearest, known & ((nearest <= np.arange(len(nearest))) | (not online))
