"""Late fusion: boxes of images and boxes of sweeps that are the same object become one row, others are doubted.

A pair is judged by the score in the image, the score in the sweep, the IoU of the image box with the projected 3D box and
the distance, as in Pang, Morris & Radha, "CLOCs: Camera-LiDAR Object Candidates Fusion for 3D Object Detection" (IROS 2020);
in place of their network a logistic function is fitted to these four (`tools/fit_late_fusion.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, TUPLES, Measurements
from log2sim.geometry import Array, box_iou
from log2sim.log_odds import log_odds_of, probability_of
from log2sim.perception.lidar.projection import View, project_boxes_in_view

# Boxes that overlap less are different objects.
MIN_IOU = 0.3
# The category of the image counts where the boxes overlap by this.
MIN_CATEGORY_IOU = 0.5
# A rider is taken for a pedestrian now and then and the other way round.
RELATED = (("pedestrian", "two_wheeler"), ("two_wheeler", "pedestrian"))
# Scores nearer to 0 or 1 are not believed.
MIN_SCORE, MAX_SCORE = 0.01, 0.99
# Recall of a detector in images for objects of at least this height in px, and the height at which it finds none.
IMAGE_RECALL, IMAGE_RECALL_PX, NO_IMAGE_RECALL_PX = 0.6, 40.0, 12.0
# Recall of a detector in sweeps for objects with many points, within its range, by group; half of it is reached at so many
# points.
SWEEP_RECALL = {"vehicle": 0.75, "two_wheeler": 0.6, "pedestrian": 0.5}
SWEEP_RECALL_POINTS, SWEEP_RANGE_M = 15.0, 40.0


@dataclass(frozen=True)
class PairWeights:
    """Weights of the logistic function that scores an object found in an image and in a sweep.

    Attributes
    ----------
    bias : float
    image : float
        Of the log-odds of the score in the image.
    sweep : float
        Of the log-odds of the score in the sweep.
    iou : float
    range_10m : float
        Of the distance in units of 10 m.
    """

    bias: float
    image: float
    sweep: float
    iou: float
    range_10m: float

    def score(self, image: Array, sweep: Array, iou: Array, range_m: Array) -> Array:
        """Return the probability (M,) that pairs are objects."""
        log_odds = self.bias + self.image * logit(image) + self.sweep * logit(sweep) + self.iou * iou
        return probability_of(log_odds + self.range_10m * range_m / 10.0)


# Independent evidence: two scores of 0.5 with an IoU of 0.7 are one of 0.75, as by 1 - (1 - a) (1 - b).
PAIR_WEIGHTS = PairWeights(bias=-1.7, image=1.0, sweep=1.0, iou=4.0, range_10m=0.0)


@dataclass(frozen=True, eq=False)
class ImageMatches:
    """How the boxes of a sweep (M,) fit the detections of one camera frame.

    Attributes
    ----------
    rows : Measurements
        Of the frame.
    partner : (M,) int
        Row of the frame that is the same object; -1 without.
    iou : (M,) float64
        Of the projected box with that row's, 0 without.
    height_px : (M,) float64
        Height of the projected box, 0 for a box outside the image.
    """

    rows: Measurements
    partner: NDArray[np.intp]
    iou: Array
    height_px: Array


def match_boxes(boxes: Measurements, rows: Measurements, view: View) -> ImageMatches:
    """Match the boxes of a sweep (M,) with the measured detections (N,) of a camera frame, the best pairs first."""
    projected = project_boxes_in_view(view, boxes.box_center_m, boxes.box_size_m, boxes.box_yaw_rad)
    height = np.where(projected.valid, projected.box_px[:, 3] - projected.box_px[:, 1], 0.0)
    partner, best = np.full(len(boxes), -1), np.zeros(len(boxes))
    iou = np.where(_may_be_same(boxes, rows), box_iou(np.nan_to_num(projected.box_px), rows.box_px), 0.0)
    while iou.size and iou.max() >= MIN_IOU:
        i, j = np.unravel_index(np.argmax(iou), iou.shape)
        partner[i], best[i] = j, iou[i, j]
        iou[i], iou[:, j] = 0.0, 0.0
    return ImageMatches(rows, partner, best, height)


def _may_be_same(boxes: Measurements, rows: Measurements) -> NDArray[np.bool_]:
    """Mark the pairs (M, N) whose categories are of one group or confused with each other."""
    a, b = (np.array([GROUP_OF[str(c)] for c in m.category], dtype="<U16") for m in (boxes, rows))
    same = a[:, None] == b
    for one, other in RELATED:
        same |= (a[:, None] == one) & (b == other)
    return np.asarray(same)


def join_with_images(
    boxes: Measurements, frames: Sequence[ImageMatches], weights: PairWeights = PAIR_WEIGHTS
) -> Measurements:
    """Join the boxes of a sweep (M,) with their partners in all frames, and doubt what only one of the sensors sees.

    Notes
    -----
    A row of a sweep with a partner takes its camera, image box and category, of several partners those of the best. One
    that a camera should show and has no partner keeps the odds that its detector misses such an object; one outside all
    images keeps its score. The same holds for rows of a frame that the detector in sweeps should find.
    """
    joined = _with_partners(boxes, frames, weights)
    alone = [_doubted(_take_alone(frame)) for frame in frames]
    return Measurements.join([*alone, joined])


def _with_partners(boxes: Measurements, frames: Sequence[ImageMatches], weights: PairWeights) -> Measurements:
    """Return the boxes of a sweep (M,) with what their partners add."""
    columns = {k: v.copy() for k, v in vars(boxes).items() if k not in TUPLES}
    range_m = np.hypot(*(boxes.center_m - boxes.sensor_m)[:, :2].T)
    best = np.zeros(len(boxes))
    for frame in frames:
        mine = np.flatnonzero(frame.partner >= 0)
        mine = mine[frame.iou[mine] * frame.rows.score[frame.partner[mine]] > best[mine]]
        theirs = frame.partner[mine]
        best[mine] = frame.iou[mine] * frame.rows.score[theirs]
        sure = frame.iou[mine] >= MIN_CATEGORY_IOU
        for name in ("camera", "box_px", "truncated", "height_px_m", "category"):
            taken = sure if name == "category" else np.ones(len(mine), dtype=bool)
            column = getattr(frame.rows, name)[theirs[taken]]
            # Texts of fixed width would be cut.
            columns[name] = columns[name].astype(np.promote_types(columns[name].dtype, column.dtype))
            columns[name][mine[taken]] = column
        columns["seen_by"][mine] |= frame.rows.seen_by[theirs]
        columns["score"][mine] = weights.score(
            frame.rows.score[theirs], boxes.score[mine], frame.iou[mine], range_m[mine]
        )
    height_px = np.max([frame.height_px for frame in frames], axis=0, initial=0.0)
    lonely = best == 0
    recall = IMAGE_RECALL * np.clip((height_px - NO_IMAGE_RECALL_PX) / (IMAGE_RECALL_PX - NO_IMAGE_RECALL_PX), 0, 1)
    columns["score"][lonely] = if_missed(boxes.score, recall)[lonely]
    return Measurements(**columns, cluster=boxes.cluster, others=boxes.others)


def _take_alone(frame: ImageMatches) -> Measurements:
    """Take the rows of a frame that no box of the sweep is partner of."""
    alone = np.ones(len(frame.rows), dtype=bool)
    alone[frame.partner[frame.partner >= 0]] = False
    return frame.rows.take(alone)


def _doubted(rows: Measurements) -> Measurements:
    """Lower the scores of rows (M,) of a frame that the detector in sweeps should have found by their points."""
    found = np.array([SWEEP_RECALL.get(GROUP_OF[str(c)], 0.0) for c in rows.category], dtype=np.float64)
    reach = np.hypot(*(rows.center_m - rows.sensor_m)[:, :2].T)
    with np.errstate(invalid="ignore"):
        covered = reach <= SWEEP_RANGE_M
    recall = np.where(covered, found * rows.points / (rows.points + SWEEP_RECALL_POINTS), 0.0)
    return replace(rows, score=if_missed(rows.score, recall))


def if_missed(score: Array, recall: Array) -> Array:
    """Return the probability (M,) of objects that another detector missed: the odds of the score times 1 - recall."""
    return np.where(recall > 0, probability_of(logit(score) + np.log1p(-recall)), score)


def logit(p: Array) -> Array:
    """Return the log-odds (M,) of scores, limited to those that are believed."""
    return log_odds_of(np.clip(p, MIN_SCORE, MAX_SCORE))
