"""How much tracks of the KITTI benchmark are believed, by all their detections, and what else tells which of their boxes are labeled."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from kitti.boxes import Boxes, overlap_3d
from kitti.joining import join_tracks
from kitti.map import View, from_map, hidden_share
from kitti.rows import SCALE, Index, Mask, Rows, end_rows, exact_sums, first_of_run, last_of_run, neighbors, sum_so_far
from kitti.scene import same_frame
from kitti.shapes import smooth_shapes
from log2sim.datatypes import Measurements
from log2sim.geometry import Array

# A frame without a detection counts as one with the lowest score that detectors of this benchmark report (a logit).
MISSED_SCORE = -1.0
# Scores of one track are alike: beyond so many detections another one tells no more.
FULL_HITS = 20
# What stands may be a pole; what moved this far is none.
MOVED_M = 5.0
# Confidences are told apart within these limits; tracks from this one on hide others.
CONFIDENCE_LIMITS, HIDING_CONFIDENCE = (-2.0, 8.0), 2.0
# Detections within so many frames tell how surely an object is seen at that time.
NEAR_FRAMES = 5
# What may stand behind: shares of image boxes that are hidden by more than this weigh.
HIDDEN_SHARE = 0.6
# Higher boxes than this are seen as well as these, lower ones than that are no errors.
HEIGHTS_PX = (20.0, 60.0)
# A predicted box that overlaps a detection of another track by this much (IoU in 3D) is no second object.
SAME_PLACE_IOU = 0.1


@dataclass(frozen=True, eq=False)
class Described:
    """Rows of tracks as boxes of the camera with what tells whether they are labeled, by track and frame.

    Attributes
    ----------
    boxes : Boxes
        N rows; `track_id` is the track.
    seen : (N,) bool
        Whether the box was detected.
    distance : (N,) int64
        Frames to the nearest detection of the track, online to the last one.
    gap : (N,) int64
        Frames in a row without a detection between two of them, 0 where there is one and beyond the ends of the track.
    doubled : (N,) bool
        Predicted boxes where another track is that was seen there or nearer in time.
    hits : (N,) float64
        Detections of the track so far.
    confidence : (N,) float64
        How much the track is believed by all its detections, online by those so far.
    features : mapping
        (N,) float64 each, by name: `score` of the detection, `near_score` and `near_share` the mean score of the detections
        around it and the share of the frames that have one, `hidden` the share of the image box that others hide beyond what
        does not matter, `height` the logarithm of its height.
    """

    boxes: Boxes
    seen: Mask
    distance: Index
    gap: Index
    doubled: Mask
    hits: Array
    confidence: Array
    features: Mapping[str, Array]


def describe(rows: Rows, boxes: Boxes, measurements: Measurements, view: View, *, online: bool) -> Described:
    """Boxes of the camera and features of all rows that it can see, given by track and frame; online no later frame is used."""
    out = _in_camera(rows, boxes, measurements, view, online=online)
    inside = np.isfinite(out.box_px).all(axis=1)
    out, rows = out.take(inside), rows.take(inside)
    if not online:
        rows, kept = join_tracks(rows, out, _distances(rows, online=online)[0])
        order = np.flatnonzero(kept)[np.lexsort([rows.frame[kept], rows.track[kept]])]
        rows, out = rows.take(order), replace(out, track_id=rows.track).take(order)
    seen = rows.source >= 0
    score = np.where(seen, boxes.score[rows.source], 0.0)
    distance, beyond, gap = _distances(rows, online=online)
    moved = np.clip(_moved_m(rows, measurements, online=online) / MOVED_M, 0, 1) * view.motion_known
    evidence = _evidence(rows.track, seen, score, online | (beyond == 0), online=online)
    confidence = np.clip(evidence + moved, *CONFIDENCE_LIMITS)
    share, local = _near(rows, seen, score, online=online)
    hidden = _hidden(out, seen & (confidence >= HIDING_CONFIDENCE), len(view.map_T_cam))
    height = np.clip(out.box_px[:, 3] - out.box_px[:, 1], *HEIGHTS_PX)
    features = {
        "score": score,
        "near_score": local,
        "near_share": share,
        "hidden": np.maximum(hidden - HIDDEN_SHARE, 0),
        "height": np.log(height / HEIGHTS_PX[1]),
    }
    doubled = _from_there_on(_doubled(out, distance), beyond, out.track_id)
    hits = sum_so_far(seen, first_of_run(out.track_id))
    return Described(out, seen, distance, gap, doubled, hits, confidence, features)


def _distances(rows: Rows, *, online: bool) -> tuple[Index, Index, Index]:
    """Frames (N,) to the nearest detection of the track, beyond its end (negative before it), and of the gap a row is in.

    Online no detection is known but the last one.
    """
    seen = rows.source >= 0
    before, after = neighbors(seen, rows.track)
    since, until = rows.frame - rows.frame[before], rows.frame[after] - rows.frame
    outside = ~seen & (online | (before == after))
    distance = np.where(outside, np.abs(since), np.minimum(since, until))
    return distance, np.where(outside, since, 0), np.where(seen | outside, 0, since + until - 1)


def _in_camera(rows: Rows, boxes: Boxes, measurements: Measurements, view: View, *, online: bool) -> Boxes:
    columns = {**vars(boxes.take(rows.model)), "frame": rows.frame, "track_id": rows.track, "category": rows.category}
    center, size, yaw = smooth_shapes(rows, boxes, measurements, online=online)
    in_camera = from_map(center, size, yaw, rows.frame, view)
    # In the image the detector knows better than a box around a box.
    in_camera["box_px"] = np.where((rows.source < 0)[:, None], in_camera["box_px"], boxes.box_px[rows.model])
    return Boxes(**(columns | in_camera))


def _evidence(track: Index, seen: Mask, score: Array, within: Mask, *, online: bool) -> Array:
    """Mean score (N,) of a track over the frames in which it was in view, and the logarithm of its detections.

    Online it is that of the rows up to each.
    """
    begin = first_of_run(track)
    counted = np.where(within, np.where(seen, score, MISSED_SCORE), 0.0)
    sums = [sum_so_far(v, begin) for v in (counted, within, seen)]
    if not online:
        last = last_of_run(begin)
        sums = [s[last] for s in sums]
    total, frames, hits = sums
    return np.asarray(total / np.maximum(frames, 1) + np.log(np.clip(hits, 1, FULL_HITS)))


def _moved_m(rows: Rows, measurements: Measurements, *, online: bool) -> Array:
    """Distance (N,) in the map from the first detection of a track to its last one, online to the last one so far."""
    first, last = end_rows(rows, online=online)
    xy = measurements.center_m[:, :2]
    return np.asarray(np.hypot(*(xy[rows.source[last]] - xy[rows.source[first]]).T))


def _near(rows: Rows, seen: Mask, score: Array, *, online: bool) -> tuple[Array, Array]:
    """Share (N,) of the frames around each row in which its track was detected, and the mean score there."""
    key = rows.track * (int(rows.frame.max(initial=0)) + 2 * NEAR_FRAMES + 1) + rows.frame
    known = key[seen]
    total = exact_sums(score[seen])
    a = np.searchsorted(known, key - NEAR_FRAMES, "left")
    b = np.searchsorted(known, key + (0 if online else NEAR_FRAMES), "right")
    window = NEAR_FRAMES if online else 2 * NEAR_FRAMES
    return (b - a - seen) / window, (total[b] - total[a]) / SCALE / np.maximum(b - a, 1)


def _hidden(out: Boxes, hides: Mask, frames: int) -> Array:
    """Share (N,) of every image box that nearer ones of the rows `hides` (N,) hide."""
    order = np.argsort(out.frame, kind="stable")
    hidden = np.empty(len(out))
    hidden[order] = hidden_share(out.take(order), frames, hides[order])
    return hidden


def _doubled(out: Boxes, distance: Index) -> Mask:
    """Which predicted boxes (N,) are where another track is that was detected there or, `distance` (N,) frames away, nearer."""
    order = np.argsort(out.frame, kind="stable")
    predicted = np.flatnonzero(distance > 0)
    i, j = same_frame(out.take(predicted), out.take(order), reach_m=True)
    i, j = predicted[i], order[j]
    stronger = (out.track_id[i] != out.track_id[j]) & (
        (distance[j] < distance[i]) | (distance[j] == distance[i]) & (j < i)
    )
    i, j = i[stronger], j[stronger]
    doubled = np.zeros(len(out), dtype=bool)
    doubled[i[overlap_3d(out.take(i), out.take(j)) >= SAME_PLACE_IOU]] = True
    return doubled


def _from_there_on(doubled: Mask, beyond: Index, track: Index) -> Mask:
    """Doubled boxes (N,) and those farther from the end of their track, `beyond` (N,) frames after it or, negative, before it."""
    out = doubled.copy()
    for sign in (1, -1):
        rows = np.flatnonzero(sign * beyond > 0)[::sign]
        if len(rows):
            # Rows beyond the same end follow each other; elsewhere the frame jumps back to one beside an end.
            begin = first_of_run(track[rows] + np.cumsum(np.abs(beyond[rows]) == 1) * (int(track.max()) + 1))
            out[rows] |= sum_so_far(doubled[rows], begin) > 0
    return out
