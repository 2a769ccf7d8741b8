"""Detected 3D boxes against true ones: average precision, precision and recall, calibration of scores."""

from __future__ import annotations

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import (
    PrecisionRecall,
    average_precision,
    operating_point,
    precision_recall,
)
from log2sim.evaluation.detection.protocols import Criterion, Matches, match_detections

__all__ = [
    "Criterion", "Matches", "PrecisionRecall", "SceneBoxes", "average_precision", "match_detections", "operating_point",
    "precision_recall",
]  # fmt: skip
