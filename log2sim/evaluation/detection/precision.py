"""Precision and recall over the score, average precision, and the figures at one score."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.matching import Criterion, Matches, match
from log2sim.geometry import Array

ROUNDING = 1e-9
SAMPLES = 40
"""Steps of recall of KITTI's published program."""
NUSCENES_FLOOR = 0.1
"""nuScenes leaves out what lies below this precision and this recall."""


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall at each distinct score, greatest first.

    Attributes
    ----------
    score : (K,) float64
        Boxes of this score and above are reported.
    precision, recall : (K,) float64
    truths : int
        Number of counted true boxes.
    """

    score: Array
    precision: Array
    recall: Array
    truths: int

    def best_precision(self, recall: Array) -> Array:
        """Return the greatest precision at or beyond recalls (R,), 0 where none is reached."""
        at_least = np.maximum.accumulate(self.precision[::-1])[::-1]
        k = np.searchsorted(self.recall, recall - ROUNDING)
        return np.where(k < len(at_least), np.append(at_least, 0.0)[k], 0.0)

    def average(self, recall_points: int = 40) -> float | None:
        """Average the best precision over recalls; None without true boxes.

        Parameters
        ----------
        recall_points : {40, 11}
            40: recalls 1/40 to 1, KITTI's rule since 2019, which drops the first of 41 points (Simonelli et al., ICCV 2019);
            11: recalls 0 to 1 (PASCAL VOC; Everingham et al., IJCV 2010), KITTI's rule before.
        """
        if recall_points not in (40, 11):
            raise ValueError(f"recall_points is {recall_points}, expected 40 or 11")
        at = np.arange(1, 41) / 40 if recall_points == 40 else np.arange(11) / 10
        return float(self.best_precision(at).mean()) if self.truths else None

    def nuscenes_average(self) -> float | None:
        """Average as nuScenes does (Caesar et al., CVPR 2020, section 3.1); None without true boxes.

        Notes
        -----
        Over recalls 0.11 to 1 in steps of 0.01, of the precision above 0.1, scaled to 1. The precision is the best one at or
        beyond each recall; nuScenes interpolates between neighbors instead.
        """
        if not self.truths:
            return None
        above = np.maximum(self.best_precision(np.arange(11, 101) / 100) - NUSCENES_FLOOR, 0)
        return min(float(above.mean() / (1 - NUSCENES_FLOOR)), 1.0)

    def sampled_average(self, recall_points: int = 40) -> float | None:
        """Average as KITTI's published program does; None without true boxes.

        Notes
        -----
        The program looks at no more than 41 of the scores of right boxes, those at which the recall is nearest to 0, 1/40 and
        so on; points that are not reached count 0, and the last right box counts as one more point, which adds up to 1/40. With
        fewer than 40 true boxes even a perfect detector gets less than 1: take `average` for small sets, and this figure to
        compare with published ones.
        """
        if not self.truths:
            return None
        right = np.round(self.recall * self.truths).astype(np.int64)
        of_curve = np.repeat(np.arange(len(self.score)), np.diff(right, prepend=0))
        sampled, reached, aim = np.zeros(SAMPLES + 1), 0, 0.0
        for n, k in enumerate(of_curve.tolist(), start=1):
            here, following = n / self.truths, (n + 1) / self.truths
            if n < len(of_curve) and following - aim < aim - here:
                continue
            sampled[reached] = self.precision[k]
            reached += 1
            aim += 1 / SAMPLES  # summed as there, since rounding decides where two scores are equally near
        best = np.maximum.accumulate(sampled[::-1])[::-1]
        return float(best[1:].mean() if recall_points == 40 else best[::4].mean())


def precision_recall(found: SceneBoxes, matches: Matches) -> PrecisionRecall:
    """Compute the curve of matched boxes; boxes of equal score come together."""
    rows = np.flatnonzero(matches.right | matches.false)
    rows = rows[np.argsort(-found.score[rows], kind="stable")]
    score = found.score[rows]
    last = np.flatnonzero(np.append(score[1:] != score[:-1], len(score) > 0))
    right = np.cumsum(matches.right[rows])[last]
    recall = right / matches.truths if matches.truths else np.zeros(len(last))
    return PrecisionRecall(score[last], right / (last + 1), recall, matches.truths)


def average_precision(
    found: SceneBoxes, truth: SceneBoxes, criterion: Criterion, recall_points: int = 40
) -> float | None:
    """Compute the average precision of the boxes of one class; None without counted true boxes.

    Parameters
    ----------
    found, truth : SceneBoxes
    criterion : Criterion
    recall_points : {40, 11}
        As in `PrecisionRecall.average`.
    """
    return precision_recall(found, match(found, truth, criterion)).average(recall_points)


def operating_point(found: SceneBoxes, matches: Matches, min_score: float) -> dict[str, Any]:
    """Count what is right when only boxes of at least a score are reported.

    Returns
    -------
    dict
        "true_positives", "false_positives", "false_negatives", and "precision", "recall", "f1" and
        "precision_times_recall", which are None where nothing was reported or nothing was there to be found. Some authors
        call the last one mean average precision, which it is not: it is one point of the curve.
    """
    reported = found.score >= min_score
    right, false = (int(np.count_nonzero(rows & reported)) for rows in (matches.right, matches.false))
    return rates(right, false, matches.truths - right)


def rates(right: int, false: int, missed: int) -> dict[str, Any]:
    """Compute the figures of `operating_point` from its counts."""
    precision = right / (right + false) if right + false else None
    recall = right / (right + missed) if right + missed else None
    both = precision is not None and recall is not None
    return {
        "true_positives": right,
        "false_positives": false,
        "false_negatives": missed,
        "precision": precision,
        "recall": recall,
        "f1": 2 * right / (2 * right + false + missed) if both else None,
        "precision_times_recall": precision * recall if precision is not None and recall is not None else None,
    }
