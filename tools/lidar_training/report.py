"""How good a detector is on simulated scenes: by group, range and points, and whether its scores are probabilities."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidar_training.clouds import Example
from lidar_training.export import RIGHT, group_of
from lidar_training.targets import GROUPS
from log2sim.datatypes import Boxes3D
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import calibration, operating_point, precision_recall
from log2sim.evaluation.detection.protocols import Matches, match
from log2sim.perception.detect3d.detectors import LidarDetector

SCORE = 0.5
RANGES_M = ((0, 15), (15, 30), (30, 50))
POINTS = ((5, 10), (10, 20), (20, 50), (50, 10**9))


def found_boxes(boxes: Boxes3D) -> SceneBoxes:
    """Return detections as a table of one scene."""
    rows = np.column_stack([boxes.center_m, boxes.size_m, boxes.yaw_rad])
    return SceneBoxes.of(rows, boxes.category, boxes.score, points=boxes.points)


def report(detector: LidarDetector, examples: list[Example], *, range_m: float) -> dict[str, Any]:
    """Evaluate a detector on examples."""
    found = [found_boxes(detector.detect(e.cloud)) for e in examples]
    out: dict[str, Any] = {"scenes": len(examples), "score": SCORE, "max_range_m": range_m}
    totals = np.zeros(3)
    for group in GROUPS:
        f = SceneBoxes.join([group_of(boxes, group) for boxes in found])
        t = SceneBoxes.join([group_of(e.truth, group) for e in examples])
        f, t = f.take(f.range_m < range_m), t.ignoring(t.range_m >= range_m)
        matches = match(f, t, RIGHT[group])
        point = operating_point(f, matches, SCORE)
        totals += [point["true_positives"], point["false_positives"], point["false_negatives"]]
        right = np.flatnonzero(matches.right & (f.score >= SCORE))
        off = np.abs((f.box[right, 6] - t.box[matches.truth[right], 6] + np.pi) % (2 * np.pi) - np.pi)
        hit = np.zeros(len(t), bool)
        hit[matches.truth[right]] = True
        counted = ~t.ignored
        out[group] = {
            "match": str(RIGHT[group]),
            "truths": matches.truths,
            "average_precision": precision_recall(f, matches).average(40),
            **{k: point[k] for k in ("precision", "recall", "f1")},
            "headings_flipped": float((off > np.pi / 2).mean()) if len(off) else None,
            "recall_by_range_m": {
                f"{a}-{b}": _share(hit[counted & (t.range_m >= a) & (t.range_m < b)]) for a, b in RANGES_M
            },
            "recall_by_points": {f"{a}+": _share(hit[counted & (t.points >= a) & (t.points < b)]) for a, b in POINTS},
            "calibration": _reliability(f, matches),
        }
    tp, fp, fn = totals
    precision = tp / (tp + fp) if tp + fp else None
    out["all"] = {"precision": precision, "recall": tp / max(tp + fn, 1), "f1": 2 * tp / max(2 * tp + fp + fn, 1)}
    return out


def _share(hit: np.ndarray) -> list[float | int]:
    """Return the share of true values and how many there are."""
    return [round(float(hit.mean()), 4) if len(hit) else 0.0, len(hit)]


def _reliability(found: SceneBoxes, matches: Matches) -> list[list[float | int]]:
    """Return mean score, share that is right, and count of the bins of the score that have boxes."""
    bins = calibration(found, matches)["bins"]
    return [[round(b["mean_score"], 4), round(b["precision"], 4), b["boxes"]] for b in bins if b["boxes"]]
