"""A person on a two-wheeler is one agent: `cyclist` or `motorcycle`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import Array
from log2sim.perception.detect.suppression import strongest_first

MIN_HORIZONTAL_SHARE = 0.5
MAX_FEET_OFF = 0.5  # of the two-wheeler's height: feet are between its axles and the ground
MAX_INSIDE = 0.8  # of a box's area inside a ridden two-wheeler's: the same bicycle or person once more
MIN_RISE = 0.1  # of the two-wheeler's height
RIDDEN = {"bicycle": "cyclist", "motorcycle": "motorcycle", "cyclist": "cyclist"}


def join_riders(detections: Detections) -> Detections:
    """Replace each two-wheeler and the person on it by one box around both; a bicycle without a person stays one.

    Notes
    -----
    A person rides where its box ends near the two-wheeler's lower end, rises above it, and shares most of the narrower
    width of both. Somebody who pushes a bicycle walks beside it and is often joined too: in one picture
    that cannot be told apart, and together they move as one. Best pairs first, each box in one pair; what lies inside
    a pair is dropped, since models often see a wheel or a torso as another bicycle or person.
    """
    person = np.flatnonzero(detections.category == "pedestrian")
    wheeler = np.flatnonzero(np.isin(detections.category, list(RIDDEN)))
    if not len(person) or not len(wheeler):
        return detections
    fit = rider_fit(detections.box_px[person], detections.box_px[wheeler])
    box, score = detections.box_px.copy(), detections.score.copy()
    category, kept = detections.category.copy(), np.ones(len(detections), dtype=bool)
    while fit.max() > 0:
        p, w = np.unravel_index(int(np.argmax(fit)), fit.shape)
        i, j = person[p], wheeler[w]
        box[j] = np.concatenate([np.minimum(box[i, :2], box[j, :2]), np.maximum(box[i, 2:], box[j, 2:])])
        score[j], category[j] = max(score[i], score[j]), RIDDEN[str(category[j])]
        fit[:, w] = 0
        kept[i] = False
        again = inside_share(box, box[j]) > MAX_INSIDE
        again[j] = False
        kept &= ~(again & np.isin(category, ["bicycle", "motorcycle", "pedestrian"]))
        fit[~kept[person], :], fit[:, ~kept[wheeler]] = 0, 0
    return strongest_first(Detections(box, score, category).take(kept))


def rider_fit(person_px: Array, wheeler_px: Array) -> Array:
    """How well persons (P, 4) sit on two-wheelers (W, 4): shared width (P, W) in [0, 1], 0 where they do not."""
    p, w = person_px[:, None], wheeler_px[None]
    shared = np.minimum(p[..., 2], w[..., 2]) - np.maximum(p[..., 0], w[..., 0])
    narrow = np.minimum(p[..., 2] - p[..., 0], w[..., 2] - w[..., 0])
    share = np.divide(shared, narrow, out=np.zeros_like(shared), where=narrow > 0)
    return np.where((share >= MIN_HORIZONTAL_SHARE) & _stands_on(p, w), np.clip(share, 0, 1), 0.0)


def inside_share(box_px: Array, outer_px: Array) -> Array:
    """Share (M,) in [0, 1] of the area of boxes (M, 4) that lies inside one other (4,); 0 for empty ones."""
    shared = np.minimum(box_px[:, 2:], outer_px[2:]) - np.maximum(box_px[:, :2], outer_px[:2])
    area = np.prod(box_px[:, 2:] - box_px[:, :2], axis=1)
    return np.divide(np.clip(shared, 0, None).prod(axis=1), area, out=np.zeros(len(area)), where=area > 0)


def _stands_on(p: Array, w: Array) -> NDArray[np.bool_]:
    height = w[..., 3] - w[..., 1]
    rises_above = p[..., 1] < w[..., 1] - MIN_RISE * height
    # Before or behind it, feet and tires end at different rows.
    same_depth = np.abs(p[..., 3] - w[..., 3]) < MAX_FEET_OFF * height
    return np.asarray(rises_above & same_depth)
