"""Scores of tracks against KITTI's labels: CLEAR MOT, sAMOTA/AMOTA/AMOTP over 40 recalls and HOTA, on 3D boxes.

Notes
-----
CLEAR MOT: Bernardin and Stiefelhagen (2008), with what KITTI ignores (Geiger et al., 2012): neighboring categories, truncated
and hidden objects, areas labeled DontCare and boxes of less than 25 px. The averages over recall: Weng et al., "3D Multi-Object
Tracking: A Baseline and New Evaluation Metrics" (IROS 2020), section IV. A track is kept or left out as a whole, by the mean
of its scores; MOTA and the counts are those at the threshold with the highest MOTA. HOTA: Luiten et al. (2021), there as well.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from kitti.boxes import Boxes, Index, Mask, in_areas, is_ignorable, is_small, overlap_3d, same_frame, with_neighbors
from log2sim.evaluation.metrics.comparison import AgentPairs
from log2sim.evaluation.metrics.evaluator import hota
from log2sim.geometry import Array, choose_pairs

RECALL_STEPS, IOU = 40, 0.25


class Score(NamedTuple):
    """Figures of one category, in percent where the name has no count."""

    samota: float
    amota: float
    amotp: float
    mota: float
    motp: float
    hota: float
    id_switches: int
    fragments: int
    false_positives: int
    false_negatives: int


@dataclass(frozen=True)
class Counts:
    """What one threshold gives: `matches` and `overlap` are those of all matched labels, ignored ones too."""

    truths: int
    matches: int
    overlap: float
    false_positives: int
    false_negatives: int
    id_switches: int
    fragments: int

    @property
    def mota(self) -> float:
        return 1 - self._errors / self.truths if self.truths else 0.0

    @property
    def motp(self) -> float:
        return self.overlap / self.matches if self.matches else 0.0

    @property
    def _errors(self) -> int:
        return self.false_positives + self.false_negatives + self.id_switches

    def smota(self, recall: float) -> float:
        """MOTA without the misses that the recall makes unavoidable, relative to it, within 0 and 1."""
        if not self.truths:
            return 0.0
        return float(np.clip(1 - (self._errors - (1 - recall) * self.truths) / (recall * self.truths), 0, 1))


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


def make_scene(results: Mapping[str, Boxes], labels: Mapping[str, Boxes], category: str) -> Scene:
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
        row, col, overlap, overlap >= IOU,
    )  # fmt: skip


def _shifted(boxes: Boxes, begin: int, sequence: int) -> Boxes:
    return replace(boxes, frame=boxes.frame + begin, track_id=boxes.track_id + sequence * 10_000_000)


def _in_order(boxes: Boxes) -> Boxes:
    boxes = boxes.take(np.lexsort([boxes.track_id, boxes.frame]))
    _, index = np.unique(boxes.track_id, return_inverse=True)
    return replace(boxes, track_id=index.astype(np.int64))


def match(scene: Scene, threshold: float) -> Index:
    """Row of the found box of every label (A,) at a threshold of the score, -1 for none: most pairs, then the greatest overlap, frame by frame."""
    out = np.full(len(scene.truth), -1, dtype=np.int64)
    rows = np.flatnonzero(scene.near & (scene.score[scene.col] >= threshold))
    chosen = rows[choose_pairs(scene.row[rows], scene.col[rows], -scene.iou[rows])]
    out[scene.row[chosen]] = scene.col[chosen]
    return out


def evaluate(results: Mapping[str, Boxes], labels: Mapping[str, Boxes], category: str) -> Score:
    """Score one category over all sequences that are labeled."""
    scene = make_scene(results, labels, category)
    everything = match(scene, -np.inf)
    matched = np.flatnonzero(everything >= 0)
    wanted = len(scene.truth) - int((scene.ignorable & (everything < 0)).sum())
    steps = recall_thresholds(scene.score[everything[matched]], wanted)
    counts = [count(scene, match(scene, t), t) for t, _ in steps]
    best = max(range(len(steps)), key=lambda k: counts[k].mota, default=None)
    threshold = steps[best][0] if best is not None else np.inf
    matched_at_best = match(scene, threshold)
    at_best = count(scene, matched_at_best, threshold)
    sums = sum(c.smota(r) for c, (_, r) in zip(counts, steps)), sum(c.mota for c in counts), sum(c.motp for c in counts)
    shares = [*(v / RECALL_STEPS for v in sums), at_best.mota, at_best.motp, _hota(scene, matched_at_best, threshold)]
    errors = at_best.id_switches, at_best.fragments, at_best.false_positives, at_best.false_negatives
    return Score(*(100 * float(v) for v in shares), *errors)


def recall_thresholds(scores: Array, truths: int) -> list[tuple[float, float]]:
    """Thresholds of the score and the recalls 1/40, 2/40, ... that they give, as far as the results go.

    For every recall it is the score of the true positive with which the recall comes nearest to it.
    """
    ordered = np.sort(scores)[::-1]
    steps: list[tuple[float, float]] = []
    asked = 0.0
    for k, score in enumerate(ordered):
        last = k == len(ordered) - 1
        here, after = (k + 1) / truths, (k + 1 + (not last)) / truths
        if not last and after - asked < asked - here:
            continue
        steps.append((float(score), asked))
        asked += 1 / RECALL_STEPS
    return steps[1:]


def count(scene: Scene, match: Index, threshold: float) -> Counts:
    """Errors at one threshold, from the found box of every label, `match` (A,)."""
    there = scene.score >= threshold
    used = np.isin(np.arange(len(scene.found)), match)
    overlap = np.zeros(len(scene.found))
    chosen = match[scene.row] == scene.col
    overlap[scene.col[chosen]] = scene.iou[chosen]
    switches, fragments = _breaks(scene, match)
    false = int((there & ~used & ~scene.excused).sum()), int(((match < 0) & ~scene.ignorable).sum())
    return Counts(int((~scene.ignorable).sum()), int(used.sum()), float(overlap.sum()), *false, switches, fragments)


def _breaks(scene: Scene, match: Index) -> tuple[int, int]:
    """Identity switches and fragments as KITTI counts them: a switch from one labeled frame to the next, a fragment also after a gap."""
    identity = np.where(match >= 0, scene.found.track_id[match] if len(scene.found) else -1, -1)
    order = np.lexsort([scene.truth.frame, scene.truth.track_id])
    ids, ignored = identity[order], scene.ignorable[order]
    cuts = np.flatnonzero(np.diff(scene.truth.track_id[order])) + 1
    switches = fragments = 0
    for a, b in zip(np.r_[0, cuts], np.r_[cuts, len(ids)]):
        if b - a < 2:
            continue
        held = ids[a]
        for f in range(a + 1, b):
            if ignored[f]:
                held = -1
                continue
            if ids[f] < 0:
                continue
            if held >= 0:
                switches += int(held != ids[f] and ids[f - 1] >= 0)
                fragments += int(ids[f - 1] != ids[f] and (f == b - 1 or ids[f + 1] >= 0))
            held = ids[f]
    return switches, fragments


def _hota(scene: Scene, match: Index, threshold: float) -> float:
    """HOTA over the labels that count and the found boxes that are neither excused nor on others."""
    rows = np.arange(len(scene.found))
    on_ignorable, used = np.isin(rows, match[scene.ignorable]), np.isin(rows, match)
    there = (scene.score >= threshold) & ~on_ignorable & (used | ~scene.excused)
    frames = int(max(scene.truth.frame.max(initial=-1), scene.found.frame.max(initial=-1))) + 1
    truth_there = np.zeros((int(scene.truth.track_id.max(initial=-1)) + 1, frames), dtype=bool)
    other_there = np.zeros((int(scene.found.track_id.max(initial=-1)) + 1, frames), dtype=bool)
    counted = ~scene.ignorable
    truth_there[scene.truth.track_id[counted], scene.truth.frame[counted]] = True
    other_there[scene.found.track_id[there], scene.found.frame[there]] = True
    pairs = AgentPairs(
        scene.truth.frame[scene.row], scene.truth.track_id[scene.row], scene.found.track_id[scene.col],
        1 - scene.iou, scene.iou, np.ones(len(scene.iou), dtype=bool),
    )  # fmt: skip
    result = hota(pairs, truth_there, other_there)
    return float(result["hota"] or 0.0)
