"""Labels and results of the KITTI tracking benchmark side by side: what overlaps, what is ignored, what is matched."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitti.boxes import Boxes, overlap_3d
from log2sim.evaluation.metrics.comparison import assign
from log2sim.geometry import Array

NEIGHBORS = {"Car": "Van", "Pedestrian": "Person_sitting"}
MAX_OCCLUSION, MAX_TRUNCATION, MIN_HEIGHT_PX = 2, 0, 25.0
DONT_CARE_SHARE = 0.5

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scene:
    """All sequences of one category, one after the other on one axis of frames, with what of each other overlaps.

    `truth`, `found` are boxes whose `track_id` is an index; `ignorable` (A,) labels that need not be found, `excused` (B,)
    found boxes that are no error; `row`, `col`, `iou` (P,) are the pairs that overlap at all, by frame, `near` (P,) those that
    may match. `score` (B,) is the mean over the track.
    """

    truth: Boxes
    found: Boxes
    ignorable: Mask
    excused: Mask
    score: Array
    row: Index
    col: Index
    iou: Array
    near: Mask


def make_scene(results: Mapping[str, Boxes], labels: Mapping[str, Boxes], category: str, *, iou: float) -> Scene:
    """Line the sequences up; sequences without results count as missed altogether."""
    truths, founds, areas, begin = [], [], [], 0
    for k, name in enumerate(sorted(labels)):
        label = _shifted(labels[name], begin, k)
        truths.append(label.take(np.isin(label.category, with_neighbors(category))))
        areas.append(label.take(label.category == "DontCare"))
        end = int(label.frame.max(initial=begin - 1)) + 1
        if name in results:
            found = _shifted(results[name], begin, k)
            founds.append(found.take((found.category == category) & (found.frame < end)))
        begin = end
    truth, area = Boxes.join(truths), Boxes.join(areas)
    found = Boxes.join(founds) if founds else truth.take(slice(0, 0))
    truth, found = _in_order(truth), _in_order(found)
    ignorable = is_ignorable(truth, category)
    count = np.bincount(found.track_id)
    mean = np.bincount(found.track_id, weights=found.score) / np.maximum(count, 1)
    row, col = same_frame(truth, found, reach_m=True)
    overlap = overlap_3d(truth.take(row), found.take(col))
    touching = overlap > 0
    row, col, overlap = row[touching], col[touching], overlap[touching]
    return Scene(
        truth, found, ignorable, is_small(found) | in_areas(found, area), mean[found.track_id] if len(found) else np.zeros(0),
        row, col, overlap, overlap >= iou,
    )  # fmt: skip


def with_neighbors(category: str) -> list[str]:
    """The category and the one that looks like it, whose labels are no errors."""
    return [category, NEIGHBORS.get(category, category)]


def is_ignorable(truth: Boxes, category: str) -> Mask:
    """Which labels (A,) need not be found: too much of them is hidden or cut off, or they are of the neighboring category."""
    return (truth.occlusion > MAX_OCCLUSION) | (truth.truncation > MAX_TRUNCATION) | (truth.category != category)


def is_small(found: Boxes) -> Mask:
    """Which boxes (B,) are too low in the image to be errors."""
    return np.asarray(np.abs(found.box_px[:, 3] - found.box_px[:, 1]) <= MIN_HEIGHT_PX)


def _shifted(boxes: Boxes, begin: int, sequence: int) -> Boxes:
    columns = {**vars(boxes), "frame": boxes.frame + begin, "track_id": boxes.track_id + sequence * 10_000_000}
    return Boxes(**columns)


def _in_order(boxes: Boxes) -> Boxes:
    boxes = boxes.take(np.lexsort([boxes.track_id, boxes.frame]))
    _, index = np.unique(boxes.track_id, return_inverse=True)
    return Boxes(**{**vars(boxes), "track_id": index.astype(np.int64)})


def same_frame(a: Boxes, b: Boxes, *, reach_m: bool) -> tuple[Index, Index]:
    """All pairs of rows of the same frame, by row of `a`; `b` is sorted by frame; with `reach_m` only those whose boxes can touch."""
    first, last = np.searchsorted(b.frame, a.frame, "left"), np.searchsorted(b.frame, a.frame, "right")
    count = last - first
    row = np.repeat(np.arange(len(a)), count)
    col = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    if reach_m:
        gap = a.bottom_m[row] - b.bottom_m[col]
        reach = np.hypot(*a.size_hwl_m[row, 1:].T) / 2 + np.hypot(*b.size_hwl_m[col, 1:].T) / 2
        near = np.hypot(gap[:, 0], gap[:, 2]) <= reach
        row, col = row[near], col[near]
    return row, col


def in_areas(found: Boxes, area: Boxes) -> Mask:
    """Which found boxes lie by more than half in an area without labels, in the image."""
    area = area.take(np.argsort(area.frame, kind="stable"))
    row, col = same_frame(found, area, reach_m=False)
    a, b = found.box_px[row], area.box_px[col]
    common = np.clip(np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2]), 0, None).prod(1)
    own = (a[:, 2:] - a[:, :2]).prod(1)
    inside = np.zeros(len(found), dtype=bool)
    inside[row[common > DONT_CARE_SHARE * own]] = True
    return inside


class Matcher:
    """Assignment of found boxes to labels at any threshold; frames whose candidates are the same are solved once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        frame = scene.truth.frame[scene.row]
        cuts = np.flatnonzero(np.diff(frame)) + 1
        self.spans = list(zip(np.r_[0, cuts], np.r_[cuts, len(frame)])) if len(frame) else []
        self.known: dict[tuple[int, bytes], Index] = {}

    def match(self, threshold: float) -> Index:
        """Row of the found box of every label (A,), -1 for none: most pairs, then the greatest overlap, frame by frame."""
        match = np.full(len(self.scene.truth), -1, dtype=np.int64)
        keep = self.scene.near & (self.scene.score[self.scene.col] >= threshold)
        for a, b in self.spans:
            key = (a, keep[a:b].tobytes())
            if key not in self.known:
                rows = a + np.flatnonzero(keep[a:b])
                # One more pair must always be worth more than any overlap.
                self.known[key] = rows[
                    assign(self.scene.row[rows], self.scene.col[rows], len(rows) + self.scene.iou[rows])
                ]
            chosen = self.known[key]
            match[self.scene.row[chosen]] = self.scene.col[chosen]
        return match
