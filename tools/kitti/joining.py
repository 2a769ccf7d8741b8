"""Tracks of the KITTI benchmark that are one object: one is predicted where the other one is detected, and never are both."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from kitti.boxes import Boxes, overlap_3d
from kitti.rows import Index, Mask, Rows
from kitti.scene import same_frame

# Boxes that overlap this much (IoU in 3D) are one object, as for the benchmark.
ONE_OBJECT_IOU = 0.25


def join_tracks(rows: Rows, boxes: Boxes, distance: Index) -> tuple[Rows, Mask]:
    """Rows (N,) by track and frame with one number for every object, and which of them stay, one a frame.

    `boxes` are the rows in the camera, `distance` (N,) the frames to the nearest detection of the track. Those that are nearer
    in time are joined first.
    """
    i, j = predicted_on_detected(boxes, distance)
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
    joined = Rows(**{**vars(rows), "track": number[rows.track]})
    return joined, _nearest_of_frame(joined, distance)


def predicted_on_detected(boxes: Boxes, distance: Index) -> tuple[Index, Index]:
    """Pairs of a predicted and a detected row of two tracks of one category that are one object."""
    order = np.argsort(boxes.frame, kind="stable")
    found = order[distance[order] == 0]
    predicted = np.flatnonzero(distance > 0)
    i, j = same_frame(boxes.take(predicted), boxes.take(found), reach_m=True)
    i, j = predicted[i], found[j]
    other = (boxes.track_id[i] != boxes.track_id[j]) & (boxes.category[i] == boxes.category[j])
    i, j = i[other], j[other]
    one = overlap_3d(boxes.take(i), boxes.take(j)) >= ONE_OBJECT_IOU
    return i[one], j[one]


def _first(head: dict[int, int], track: int) -> int:
    while head[track] != track:
        track = head[track]
    return track


def _nearest_of_frame(rows: Rows, distance: Index) -> NDArray[np.bool_]:
    order = np.lexsort([distance, rows.frame, rows.track])
    first = np.r_[True, (np.diff(rows.track[order]) != 0) | (np.diff(rows.frame[order]) != 0)][: len(order)]
    keep = np.zeros(len(order), dtype=bool)
    keep[order[first]] = True
    return keep
