"""Calibration of scores: of the boxes with a score of 0.8, 8 of 10 should be right."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.matching import Matches

BINS = 10


def calibration(found: SceneBoxes, matches: Matches) -> dict[str, Any]:
    """Compare scores with the share of right boxes.

    Returns
    -------
    dict
        "boxes", "expected_calibration_error" (None without boxes), and "bins" of equal width from 0 to 1 with "low", "high",
        "boxes", "mean_score" and "precision" (None in empty bins).

    Notes
    -----
    Naeini, Cooper, Hauskrecht (AAAI 2015): the mean difference between score and precision, weighted by boxes. Ignored boxes
    are left out; scores outside 0 to 1 are in the outermost bins.
    """
    judged = matches.right | matches.false
    score, right = found.score[judged], matches.right[judged]
    of_bin = np.clip((score * BINS).astype(np.int64), 0, BINS - 1)
    count = np.bincount(of_bin, minlength=BINS)
    scores, rights = (np.bincount(of_bin, weights=v, minlength=BINS) for v in (score, right))
    bins = [
        {
            "low": k / BINS,
            "high": (k + 1) / BINS,
            "boxes": int(count[k]),
            "mean_score": float(scores[k] / count[k]) if count[k] else None,
            "precision": float(rights[k] / count[k]) if count[k] else None,
        }
        for k in range(BINS)
    ]
    error = float(np.abs(scores - rights).sum() / count.sum()) if len(score) else None
    return {"boxes": len(score), "expected_calibration_error": error, "bins": bins}
