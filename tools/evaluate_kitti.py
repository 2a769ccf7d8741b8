"""Scores tracking results against KITTI's labels: CLEAR MOT, sAMOTA/AMOTA/AMOTP over 40 recalls and HOTA, on 3D boxes.

    python tools/evaluate_kitti.py --results DIR --labels DIR [--categories Car,Pedestrian,Cyclist] [--iou 0.25] [--out FILE.json]

Notes
-----
CLEAR MOT: Bernardin and Stiefelhagen (2008), with what KITTI ignores (Geiger et al., 2012): neighboring categories, truncated
and hidden objects, areas labeled DontCare and boxes of less than 25 px. The averages over recall: Weng et al., "3D Multi-Object
Tracking: A Baseline and New Evaluation Metrics" (IROS 2020), section IV. A track is kept or left out as a whole, by the mean
of its scores; MOTA and the counts are those at the threshold with the highest MOTA. HOTA: Luiten et al. (2021), there as well.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from kitti.boxes import Boxes, read_tracks
from kitti.map import Index, Matcher, Scene, make_scene

from log2sim.errors import Log2SimError
from log2sim.evaluation.metrics.comparison import AgentPairs
from log2sim.evaluation.metrics.evaluator import hota
from log2sim.geometry import Array

RECALL_STEPS = 40


@dataclass(frozen=True)
class Score:
    """Figures of one category, in percent where the name has no count."""

    samota: float
    amota: float
    amotp: float
    mota: float
    motp: float
    hota: float
    det_a: float
    ass_a: float
    id_switches: int
    fragments: int
    false_positives: int
    false_negatives: int
    threshold: float


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


def evaluate(results: Mapping[str, Boxes], labels: Mapping[str, Boxes], category: str, *, iou: float = 0.25) -> Score:
    """Score one category over all sequences that are labeled."""
    return score_scene(make_scene(results, labels, category, iou=iou))


def score_scene(scene: Scene) -> Score:
    """All figures of a lined-up scene."""
    matcher = Matcher(scene)
    everything = matcher.match(-np.inf)
    matched = np.flatnonzero(everything >= 0)
    wanted = len(scene.truth) - int((scene.ignorable & (everything < 0)).sum())
    steps = recall_thresholds(scene.score[everything[matched]], wanted)
    counts = [count(scene, matcher.match(t), t) for t, _ in steps]
    best = max(range(len(steps)), key=lambda k: counts[k].mota, default=None)
    threshold = steps[best][0] if best is not None else np.inf
    at_best = count(scene, matcher.match(threshold), threshold)
    higher_order = _hota(scene, matcher.match(threshold), threshold)
    return Score(
        samota=100 * sum(c.smota(r) for c, (_, r) in zip(counts, steps)) / RECALL_STEPS,
        amota=100 * sum(c.mota for c in counts) / RECALL_STEPS,
        amotp=100 * sum(c.motp for c in counts) / RECALL_STEPS,
        mota=100 * at_best.mota,
        motp=100 * at_best.motp,
        hota=100 * higher_order[0],
        det_a=100 * higher_order[1],
        ass_a=100 * higher_order[2],
        id_switches=at_best.id_switches,
        fragments=at_best.fragments,
        false_positives=at_best.false_positives,
        false_negatives=at_best.false_negatives,
        threshold=float(threshold),
    )


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
    used = np.zeros(len(scene.found), dtype=bool)
    used[match[match >= 0]] = True
    overlap = np.zeros(len(scene.found))
    chosen = match[scene.row] == scene.col
    overlap[scene.col[chosen]] = scene.iou[chosen]
    switches, fragments = _breaks(scene, match)
    return Counts(
        truths=int((~scene.ignorable).sum()),
        matches=int(used.sum()),
        overlap=float(overlap.sum()),
        false_positives=int((there & ~used & ~scene.excused).sum()),
        false_negatives=int(((match < 0) & ~scene.ignorable).sum()),
        id_switches=switches,
        fragments=fragments,
    )


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


def _hota(scene: Scene, match: Index, threshold: float) -> tuple[float, float, float]:
    """HOTA, DetA, AssA over the labels that count and the found boxes that are neither excused nor on others."""
    there = scene.score >= threshold
    on_ignorable = np.zeros(len(scene.found), dtype=bool)
    on_ignorable[match[scene.ignorable & (match >= 0)]] = True
    used = np.zeros(len(scene.found), dtype=bool)
    used[match[match >= 0]] = True
    there &= ~on_ignorable & (used | ~scene.excused)
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
    return tuple(result[name] or 0.0 for name in ("hota", "det_a", "ass_a"))


def table(scores: Mapping[str, Score]) -> str:
    """The figures as lines of text, one a category."""
    head = f"{'':<12}{'sAMOTA':>8}{'AMOTA':>8}{'AMOTP':>8}{'MOTA':>8}{'MOTP':>8}{'HOTA':>8}{'IDS':>6}{'FRAG':>6}{'FP':>7}{'FN':>7}"
    lines = [
        f"{name:<12}{s.samota:>8.2f}{s.amota:>8.2f}{s.amotp:>8.2f}{s.mota:>8.2f}{s.motp:>8.2f}{s.hota:>8.2f}"
        f"{s.id_switches:>6}{s.fragments:>6}{s.false_positives:>7}{s.false_negatives:>7}"
        for name, s in scores.items()
    ]
    return "\n".join([head, *lines])


def main(arguments: Sequence[str] | None = None) -> int:
    """Command line; returns the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--results", type=Path, required=True)
    parser.add_argument("--labels", type=Path, required=True)
    parser.add_argument("--categories", default="Car,Pedestrian,Cyclist")
    parser.add_argument("--iou", type=float, default=0.25)
    parser.add_argument("--out", type=Path)
    options = parser.parse_args(arguments)
    try:
        results = {p.stem: read_tracks(p) for p in sorted(options.results.glob("*.txt"))}
        labels = {name: read_tracks(options.labels / f"{name}.txt") for name in results}
    except Log2SimError as problem:
        print(f"error: {problem}", file=sys.stderr)
        return 3
    if not results:
        print(f"error: {options.results}: no files NNNN.txt with results", file=sys.stderr)
        return 3
    scores = {c: evaluate(results, labels, c, iou=options.iou) for c in options.categories.split(",")}
    print(table(scores))
    if options.out:
        options.out.write_text(json.dumps({c: asdict(s) for c, s in scores.items()}, indent=1), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
