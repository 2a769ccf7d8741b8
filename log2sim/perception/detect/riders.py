"""Joining of riders: a person on a two-wheeler becomes one box, `cyclist` or `motorcycle`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import Array
from log2sim.perception.detect.suppression import strongest_first

# Shares of the narrower width that rider and two-wheeler have in common.
MIN_HORIZONTAL_SHARE = 0.5
# Difference of the lower edges, in heights of the two-wheeler: feet are between its axles and the ground.
MAX_FEET_OFFSET = 0.5
# Share of a box's area inside a joined box beyond which it is the same two-wheeler or person once more.
MAX_INSIDE_SHARE = 0.8
# How far a rider rises above the two-wheeler, in heights of it.
MIN_RISE = 0.1
RIDDEN = {"bicycle": "cyclist", "motorcycle": "motorcycle", "cyclist": "cyclist"}


def join_riders(detections: Detections, *, sure_score: float = 0.0) -> Detections:
    """Replace each two-wheeler and the person on it by one box around both; a bicycle without a person stays one.

    Parameters
    ----------
    detections : Detections
    sure_score : float
        A two-wheeler of a lower score that lies inside the person's box is a bag or clothes, and nothing is joined.

    Notes
    -----
    A person rides if its box ends near the two-wheeler's lower edge, rises above it, and shares most of the narrower
    width of both. A person who pushes a bicycle is often joined too: one image does not tell the two cases apart, and
    both move as one. Pairs are chosen greedily, each box in one pair. Boxes inside a pair are dropped, since models often
    detect a wheel or a torso as another bicycle or person.
    """
    person = np.flatnonzero(detections.category == "pedestrian")
    wheeler = np.flatnonzero(np.isin(detections.category, list(RIDDEN)))
    if not len(person) or not len(wheeler):
        return detections
    fit = rider_fit(detections.box_px[person], detections.box_px[wheeler])
    for weak in np.flatnonzero(detections.score[wheeler] < sure_score).tolist():
        px = detections.box_px[wheeler[weak]]
        fit[[inside_share(px[None], p)[0] > MAX_INSIDE_SHARE for p in detections.box_px[person]], weak] = 0
    box, score = detections.box_px.copy(), detections.score.copy()
    category, kept = detections.category.copy(), np.ones(len(detections), dtype=bool)
    while fit.max() > 0:
        p, w = np.unravel_index(int(np.argmax(fit)), fit.shape)
        i, j = person[p], wheeler[w]
        box[j] = np.concatenate([np.minimum(box[i, :2], box[j, :2]), np.maximum(box[i, 2:], box[j, 2:])])
        score[j], category[j] = max(score[i], score[j]), RIDDEN[str(category[j])]
        fit[:, w] = 0
        kept[i] = False
        again = inside_share(box, box[j]) > MAX_INSIDE_SHARE
        again[j] = False
        kept &= ~(again & np.isin(category, ["bicycle", "motorcycle", "pedestrian"]))
        fit[~kept[person], :], fit[:, ~kept[wheeler]] = 0, 0
    return strongest_first(Detections(box, score, category).take(kept))


def rider_fit(person_px: Array, wheeler_px: Array) -> Array:
    """Compute the shared width (P, W) in [0, 1] of persons (P, 4) and two-wheelers (W, 4); 0 for pairs that do not fit."""
    p, w = person_px[:, None], wheeler_px[None]
    shared = np.minimum(p[..., 2], w[..., 2]) - np.maximum(p[..., 0], w[..., 0])
    narrow = np.minimum(p[..., 2] - p[..., 0], w[..., 2] - w[..., 0])
    share = np.divide(shared, narrow, out=np.zeros_like(shared), where=narrow > 0)
    return np.where((share >= MIN_HORIZONTAL_SHARE) & _is_rider_height(p, w), np.clip(share, 0, 1), 0.0)


def inside_share(box_px: Array, outer_px: Array) -> Array:
    """Compute the share (M,) in [0, 1] of the area of boxes (M, 4) inside one other (4,); 0 for empty ones."""
    shared = np.minimum(box_px[:, 2:], outer_px[2:]) - np.maximum(box_px[:, :2], outer_px[:2])
    area = np.prod(box_px[:, 2:] - box_px[:, :2], axis=1)
    return np.asarray(np.divide(np.clip(shared, 0, None).prod(axis=1), area, out=np.zeros(len(area)), where=area > 0))


def _is_rider_height(p: Array, w: Array) -> NDArray[np.bool_]:
    """Return whether persons end and rise where riders of the two-wheelers do."""
    height = w[..., 3] - w[..., 1]
    rises_above = p[..., 1] < w[..., 1] - MIN_RISE * height
    # Of a person nearer or farther than the two-wheeler the lower edge is elsewhere.
    same_depth = np.abs(p[..., 3] - w[..., 3]) < MAX_FEET_OFFSET * height
    return np.asarray(rises_above & same_depth)
