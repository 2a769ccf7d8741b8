"""Figures of a detector on simulated scenes and real sweeps: precision, recall, F1, their product and average precision."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from lidar_training.clouds import Example
from lidar_training.export import group_of
from lidar_training.network import GROUPS
from lidar_training.real_logs import LogSweep

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import average_precision, operating_point
from log2sim.evaluation.detection.protocols import MIN_POINTS, Criterion, match_detections
from log2sim.perception.detect3d.detectors import LidarDetector

# Two-wheelers and people are hit by a handful of points beyond.
MAX_RANGE_M = {"vehicle": 30.0, "two_wheeler": 20.0, "pedestrian": 20.0}
OVERLAP = {
    "vehicle": Criterion("iou_bev", 0.5),
    "two_wheeler": Criterion("iou_bev", 0.3),
    "pedestrian": Criterion("iou_bev", 0.3),
}
CENTER = dict.fromkeys(GROUPS, Criterion("center_m", 1.0))
MATCHES = {"overlap": OVERLAP, "center": CENTER}
SCORES = np.arange(0.1, 0.96, 0.05)
UNCOUNTED = ("bicycle", "other")

Scenes = Sequence[Example] | Sequence[LogSweep]


@dataclass(frozen=True, eq=False)
class Judged:
    """What a detector found in all scenes, and what there is, by group."""

    found: dict[str, SceneBoxes]
    truth: dict[str, SceneBoxes]


def judged(detectors: dict[str, LidarDetector], scenes: Scenes) -> dict[str, Judged]:
    """Search all scenes with several detectors; what was found where nothing was labeled is ignored."""
    found: dict[str, list[SceneBoxes]] = {name: [] for name in detectors}
    truth = []
    for scene in scenes:
        for name, detector in detectors.items():
            found[name].append(_search(detector, scene))
        t = scene.truth
        truth.append(t.ignoring((t.points < MIN_POINTS) | np.isin(t.category, UNCOUNTED)))
    true = {group: SceneBoxes.join([group_of(table, group) for table in truth]) for group in GROUPS}
    true = {group: t.ignoring(t.range_m >= MAX_RANGE_M[group]) for group, t in true.items()}
    out = {}
    for name, tables in found.items():
        by_group = {group: SceneBoxes.join([group_of(table, group) for table in tables]) for group in GROUPS}
        out[name] = Judged({g: f.take(f.range_m < MAX_RANGE_M[g]) for g, f in by_group.items()}, true)
    return out


def _search(detector: LidarDetector, scene: Example | LogSweep) -> SceneBoxes:
    """Search one scene; boxes relative to the cloud's origin."""
    cloud, boxes = scene.cloud, detector.detect(scene.cloud)
    rows = np.column_stack([boxes.center_m - cloud.origin, boxes.size_m, boxes.yaw_rad])
    away = np.hypot(*(rows[:, :2] - cloud.sensor[:2]).T)
    table = SceneBoxes.of(rows, boxes.category, boxes.score, points=boxes.points, range_m=away)
    return table.ignoring(~scene.labeled(rows[:, :3])) if isinstance(scene, LogSweep) and len(rows) else table


def figures(result: Judged, criteria: dict[str, Criterion], min_score: float) -> dict[str, Any]:
    """Count all groups together at one score, and average precision by group and over the groups that are there."""
    counts, average = np.zeros(3), {}
    for group in GROUPS:
        f, t = result.found[group], result.truth[group]
        point = operating_point(f, match_detections(f, t, criteria[group]), min_score)
        counts += [point["true_positives"], point["false_positives"], point["false_negatives"]]
        average[group] = average_precision(f, t, criteria[group])
    right, false, missed = counts
    precision, recall = right / max(right + false, 1), right / max(right + missed, 1)
    there = [v for v in average.values() if v is not None]
    return {
        "truths": int(right + missed),
        "precision": precision,
        "recall": recall,
        "f1": 2 * right / max(2 * right + false + missed, 1),
        "precision_times_recall": precision * recall,
        "average_precision": average,
        "mean_average_precision": float(np.mean(there)) if there else None,
    }


def best_score(result: Judged) -> float:
    """Choose the score with the best F1 by overlap; for scenes that nothing is reported of."""
    return float(max(SCORES, key=lambda score: figures(result, OVERLAP, float(score))["f1"]))
