"""Calibration of scores: of the boxes with a score of 0.8, 8 of 10 should be right."""

from __future__ import annotations

from typing import Any

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.matching import Matches
from log2sim.evaluation.metrics.calibration import reliability


def calibration(found: SceneBoxes, matches: Matches) -> dict[str, Any]:
    """Compare scores with the share of right boxes.

    Returns
    -------
    dict
        "boxes", "expected_calibration_error" (None without boxes), and "bins" of equal width from 0 to 1 with "low", "high",
        "boxes", "mean_score" and "precision" (None in empty bins).

    Notes
    -----
    See `reliability`. Ignored boxes are left out.
    """
    judged = matches.right | matches.false
    table = reliability(found.score[judged], matches.right[judged])
    bins = [
        {
            "low": b["low"],
            "high": b["high"],
            "boxes": b["count"],
            "mean_score": b["mean_confidence"],
            "precision": b["right"],
        }
        for b in table["bins"]
    ]
    return {
        "boxes": table["count"],
        "expected_calibration_error": table["expected_calibration_error"],
        "bins": bins,
    }
