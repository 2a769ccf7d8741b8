"""Which boxes of tracks are told on the KITTI tracking benchmark, and with which score."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kitti.boxes import (
    PERIOD_NS,
    Boxes,
    Index,
    Mask,
    View,
    from_map,
    is_small,
    overlap_3d,
    project,
    same_frame,
)
from kitti.tracks import (
    SCALE,
    Rows,
    end_rows,
    exact_sums,
    first_of_run,
    last_of_run,
    neighbors,
    smooth_shapes,
    sum_so_far,
)
from log2sim.datatypes import Measurements
from log2sim.geometry import NS_PER_S, Array, choose_pairs
from log2sim.tracking.tracker import MAX_PEDESTRIAN_SPEED_MPS

# Log-odds that a box of a car lies on a labeled one, of detected and of predicted boxes, with all frames at hand and with those
# so far: logistic regression by `bench.py kitti --fit` on sequences 0000, 0002, 0004, 0005, 0007, 0009 and 0011, all of the part on
# which the benchmark's validation does not run.
SEEN = {"constant": -9.24, "score": 0.24, "near_score": 0.98, "near_share": 2.99, "height": -5.01}
PREDICTED = {"constant": -6.06, "near_score": 0.7, "near_share": 3.88}
SEEN_ONLINE = {"constant": -7.6, "score": 0.48, "near_score": 0.71, "near_share": 2.14, "height": -4.26}
PREDICTED_ONLINE = {"constant": -5.46, "near_score": 0.94, "near_share": 1.96}
# A box is told where it is more likely labeled than not; a detected one is left out only where that is unlikely.
MIN_PREDICTED, MIN_SEEN = 0.5, 0.2
# Boxes so small that the benchmark does not count them as errors are carried on for so many frames.
SMALL_FRAMES = 20
# There are too few labeled people to learn from. Tracks of at least this confidence are filled where they are missed for at
# most so many frames, online for two.
FILLED_CONFIDENCE, FILLED_FRAMES, FILLED_FRAMES_ONLINE = 2.0, 15, 2


def choose(described: Described, *, online: bool) -> Boxes:
    """The boxes that are told, by frame; their score is how much their track is believed, up to their frame if online."""
    car = described.boxes.category == "Car"
    keep, score = _people(described, online=online)
    keep_car, score_car = _cars(described, online=online)
    keep = np.where(car, keep_car, keep)
    told = replace(described.boxes, score=np.where(car, score_car, score)).take(keep)
    return told.take(np.lexsort([told.track_id, told.frame]))


def _cars(d: Described, *, online: bool) -> tuple[Mask, Array]:
    small = is_small(d.boxes)
    # What cannot be an error says nothing against its track.
    seen = np.where(small, 1.0, labeled_probability(d.features, SEEN_ONLINE if online else SEEN))
    predicted = labeled_probability(d.features, PREDICTED_ONLINE if online else PREDICTED)
    keep = np.where(d.seen, seen >= MIN_SEEN, small & (d.distance <= SMALL_FRAMES) | (predicted >= MIN_PREDICTED))
    if online:
        # What is only predicted is believed as much as the last detection.
        before, _ = neighbors(d.seen, d.boxes.track_id)
        return keep, seen[before]
    return keep, _mean_of_track(d, seen, d.seen & keep & ~small)


def _people(d: Described, *, online: bool) -> tuple[Mask, Array]:
    few = d.distance <= FILLED_FRAMES_ONLINE if online else (d.gap > 0) & (d.gap <= FILLED_FRAMES)
    keep = d.seen | (d.confidence >= FILLED_CONFIDENCE) & few
    if not online:
        return keep, d.confidence
    # The evaluation takes the mean over the track: what is seen now counts beside all that was seen.
    before, _ = neighbors(d.seen, d.boxes.track_id)
    now = d.features["score"] + np.log(np.clip(d.hits, 1, FULL_HITS))
    return keep, (now[before] + d.confidence) / 2


def labeled_probability(features: Mapping[str, Array], weights: Mapping[str, float]) -> Array:
    """Probability (N,) of a logistic model; `weights` are those of its features and the `constant`."""
    log_odds = weights["constant"] + sum(w * features[name] for name, w in weights.items() if name != "constant")
    return np.asarray(1 / (1 + np.exp(-log_odds)))


def _mean_of_track(d: Described, values: Array, counted: Mask) -> Array:
    """Mean (N,) over the counted rows of a track, 1 without any."""
    track = d.boxes.track_id
    count = np.bincount(track, weights=counted, minlength=1)
    total = np.bincount(track, weights=values * counted, minlength=1)
    return np.divide(total, count, out=np.ones(len(count)), where=count > 0)[track]


# A frame without a detection counts as one with the lowest score that detectors of this benchmark report (a logit).
MISSED_SCORE = -1.0
# Scores of one track are alike: beyond so many detections another one tells no more.
FULL_HITS = 20
# What stands may be a pole; what moved this far is none.
MOVED_M = 5.0
# Detections within so many frames tell how surely an object is seen at that time.
NEAR_FRAMES = 5
# Higher boxes than this are seen as well as these, lower ones than that are no errors.
HEIGHTS_PX = (20.0, 60.0)


@dataclass(frozen=True, eq=False)
class Described:
    """Rows of tracks as boxes of the camera with what tells whether they are labeled, by track and frame.

    `boxes`: N rows; `track_id` is the track. `seen` (N,): whether the box was detected. `distance` (N,): frames to the
    nearest detection of the track, online to the last one. `gap` (N,): frames in a row without a detection between two of
    them, 0 where there is one and beyond the ends of the track. `hits` (N,): detections of the track so far. `confidence` (N,): how much the track is
    believed by all its detections, online by those so far. `features`: (N,) float64 each, by name: `score` of the detection,
    `near_score` and `near_share` the mean score of the detections around it and the share of the frames that have one,
    `height` the logarithm of that of its image box.
    """

    boxes: Boxes
    seen: Mask
    distance: Index
    gap: Index
    hits: Array
    confidence: Array
    features: Mapping[str, Array]


def describe(rows: Rows, boxes: Boxes, measurements: Measurements, view: View, *, online: bool) -> Described:
    """Boxes of the camera and features of all rows that it can see, given by track and frame; online no later frame is used."""
    told = {"frame": rows.frame, "track_id": rows.track, "category": rows.category}
    in_camera = from_map(*smooth_shapes(rows, boxes, measurements, online=online), rows.frame, view)
    out = replace(boxes.take(rows.model), **told, **in_camera)
    # In the image the detector knows better than a box around a box.
    (predicted,) = (rows.source < 0).nonzero()
    out.box_px[predicted] = project(out.take(predicted), view.P)
    inside = np.isfinite(out.box_px).all(axis=1)
    out, rows = out.take(inside), rows.take(inside)
    if not online:
        rows, kept = join_tracks(rows, out, _distances(rows, online=online)[0])
        order = np.flatnonzero(kept)[np.lexsort([rows.frame[kept], rows.track[kept]])]
        rows, out = rows.take(order), replace(out, track_id=rows.track).take(order)
    seen = rows.source >= 0
    score = np.where(seen, boxes.score[rows.source], 0.0)
    distance, gap, outside = _distances(rows, online=online)
    moved = np.clip(_moved_m(rows, measurements.center_m, online=online)[0] / MOVED_M, 0, 1) * view.motion_known
    confidence = _evidence(rows.track, seen, score, online | ~outside, online=online) + moved
    share, local = _near(rows, seen, score, online=online)
    height = np.clip(out.box_px[:, 3] - out.box_px[:, 1], *HEIGHTS_PX)
    features = {
        "score": score,
        "near_score": local,
        "near_share": share,
        "height": np.log(height / HEIGHTS_PX[1]),
    }
    hits = sum_so_far(seen, first_of_run(out.track_id))
    return Described(out, seen, distance, gap, hits, confidence, features)


def _distances(rows: Rows, *, online: bool) -> tuple[Index, Index, Mask]:
    """Frames (N,) to the nearest detection of the track and of the gap a row is in, and whether it is beyond the ends of the track.

    Online no detection is known but the last one.
    """
    seen = rows.source >= 0
    before, after = neighbors(seen, rows.track)
    since, until = rows.frame - rows.frame[before], rows.frame[after] - rows.frame
    outside = ~seen & (online | (before == after))
    distance = np.where(outside, np.abs(since), np.minimum(since, until))
    return distance, np.where(seen | outside, 0, since + until - 1), outside


def _evidence(track: Index, seen: Mask, score: Array, within: Mask, *, online: bool) -> Array:
    """Mean score (N,) of a track over the frames in which it was in view, and the logarithm of its detections.

    Online it is that of the rows up to each.
    """
    begin = first_of_run(track)
    counted = np.where(within, np.where(seen, score, MISSED_SCORE), 0.0)
    end = np.arange(len(begin)) if online else last_of_run(begin)
    total, frames, hits = (sum_so_far(v, begin)[end] for v in (counted, within, seen))
    return np.asarray(total / np.maximum(frames, 1) + np.log(np.clip(hits, 1, FULL_HITS)))


def _moved_m(rows: Rows, center_m: Array, *, online: bool) -> tuple[Array, Array]:
    """Distance (N,) in the map from the first detection of a track to its last one, online to the last one so far, and frames between."""
    first, last = end_rows(rows, online=online)
    moved = center_m[rows.source[last], :2] - center_m[rows.source[first], :2]
    return np.asarray(np.hypot(*moved.T)), rows.frame[last] - rows.frame[first]


def _near(rows: Rows, seen: Mask, score: Array, *, online: bool) -> tuple[Array, Array]:
    """Share (N,) of the frames around each row in which its track was detected, and the mean score there."""
    key = rows.track * (int(rows.frame.max(initial=0)) + 2 * NEAR_FRAMES + 1) + rows.frame
    known = key[seen]
    total = exact_sums(score[seen])
    a = np.searchsorted(known, key - NEAR_FRAMES, "left")
    b = np.searchsorted(known, key + (0 if online else NEAR_FRAMES), "right")
    window = NEAR_FRAMES if online else 2 * NEAR_FRAMES
    return (b - a - seen) / window, (total[b] - total[a]) / SCALE / np.maximum(b - a, 1)


# Boxes that overlap this much (IoU in 3D) are one object, as for the benchmark.
ONE_OBJECT_IOU = 0.25


def join_tracks(rows: Rows, boxes: Boxes, distance: Index) -> tuple[Rows, Mask]:
    """Rows (N,) by track and frame with one number for every object, and which of them stay, one a frame.

    `boxes` are the rows in the camera, `distance` (N,) the frames to the nearest detection of the track. Those that are nearer
    in time are joined first.
    """
    # Pairs of a predicted and a detected row of two tracks of one category that are one object.
    order = np.argsort(boxes.frame, kind="stable")
    found, predicted = order[distance[order] == 0], np.flatnonzero(distance > 0)
    i, j = same_frame(boxes.take(predicted), boxes.take(found), reach_m=True)
    i, j = predicted[i], found[j]
    other = (boxes.track_id[i] != boxes.track_id[j]) & (boxes.category[i] == boxes.category[j])
    i, j = i[other], j[other]
    one = overlap_3d(boxes.take(i), boxes.take(j)) >= ONE_OBJECT_IOU
    i, j = i[one], j[one]
    order = np.argsort(distance[i], kind="stable")
    pairs = np.column_stack([rows.track[i], rows.track[j]])[order]
    pairs = np.sort(pairs, axis=1)
    pairs = pairs[np.sort(np.unique(pairs, axis=0, return_index=True)[1])]
    seen = rows.source >= 0
    detected = {t: rows.frame[seen & (rows.track == t)] for t in np.unique(pairs).tolist()}
    head = {t: t for t in detected}
    for a, b in pairs.tolist():
        a, b = (_first(head, t) for t in (a, b))
        if a != b and len(np.intersect1d(detected[a], detected[b])) == 0:
            head[b] = a
            detected[a] = np.concatenate([detected[a], detected[b]])
    number = np.arange(int(rows.track.max(initial=-1)) + 1)
    for t in head:
        number[t] = _first(head, t)
    joined = replace(rows, track=number[rows.track])
    order = np.lexsort([distance, rows.frame, joined.track])
    first = np.r_[True, (np.diff(joined.track[order]) != 0) | (np.diff(rows.frame[order]) != 0)][: len(order)]
    keep = np.zeros(len(order), dtype=bool)
    keep[order[first]] = True
    return joined, keep


def _first(head: dict[int, int], track: int) -> int:
    while head[track] != track:
        track = head[track]
    return track


PEDESTRIAN, RIDER = "Pedestrian", "Cyclist"
SAME_OBJECT_M = 0.6
# Of labeled people the log-odds to be a rider are the score of the rider less that of the pedestrian and this; where a detector
# reports one of them alone the other one counts as missed.
RIDER_LEAD = 1.0
# What moved this far has a speed. Log-odds to be a rider: some 0.85 of those who walk and 0.1 of those who ride do so at 0.5 to
# 2 m/s, and 0.02 and 0.85 faster than people run.
MOVED_ON_FOOT_M, WALKING_MPS, WALKS, RIDES = 1.0, (0.5, 2.0), -2.0, 4.0


@dataclass(frozen=True, eq=False)
class Pairs:
    """Detections of a sequence, in places with a pedestrian and a rider only one of them first."""

    boxes: Boxes  # N detections for the tracker, by frame, then the others of their pairs, by frame as well
    count: int  # N
    other: Index  # (N,): row of the other one of the pair, -1 for none
    rider: Array  # (N,): how much rather it is a rider than a pedestrian, in units of a score

    @property
    def tracked(self) -> Boxes:
        """The detections for the tracker (N,)."""
        return self.boxes.take(slice(0, self.count))


def find_pairs(boxes: Boxes) -> Pairs:
    """Pair pedestrians with riders in their places; the likelier one of each pair is tracked."""
    boxes = boxes.take(np.argsort(boxes.frame, kind="stable"))
    pedestrian, rider = (np.flatnonzero(boxes.category == c) for c in (PEDESTRIAN, RIDER))
    i, j = same_frame(boxes.take(pedestrian), boxes.take(rider), reach_m=False)
    i, j = pedestrian[i], rider[j]
    apart_m = np.hypot(*(boxes.bottom_m[i] - boxes.bottom_m[j])[:, [0, 2]].T)
    one = choose_pairs(i, j, apart_m, SAME_OBJECT_M)
    pair = np.full(len(boxes), -1, dtype=np.int64)
    pair[i[one]], pair[j[one]] = j[one], i[one]
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
    moved_m, frames = _moved_m(rows, places_m, online=online)
    seconds = frames * PERIOD_NS / NS_PER_S
    speed = np.divide(moved_m, seconds, out=np.zeros(len(moved_m)), where=(seconds > 0) & (moved_m > MOVED_ON_FOOT_M))
    walks = (speed >= WALKING_MPS[0]) & (speed <= WALKING_MPS[1])
    return np.where(speed > MAX_PEDESTRIAN_SPEED_MPS, RIDES, np.where(walks, WALKS, 0.0))


def _nearest(right: Mask, rows: Rows, *, online: bool) -> tuple[Index, Mask]:
    """Nearest of the rows `right` (N,) of the same track, online the last one, and whether there is one."""
    before, after = (np.clip(k, 0, len(right) - 1) for k in neighbors(right, rows.track))
    sooner = np.abs(rows.frame - rows.frame[before]) <= np.abs(rows.frame[after] - rows.frame)
    nearest = before if online else np.where(sooner, before, after)
    known = right[nearest] & (rows.track[nearest] == rows.track)
    return nearest, known & ((nearest <= np.arange(len(nearest))) | (not online))
