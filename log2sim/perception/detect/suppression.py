"""Suppression of double boxes: one object, one box."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import box_iou
from log2sim.perception.detect.classes import groups

MAX_CANDIDATES = 2000


def strongest_first(detections: Detections) -> Detections:
    """Order by score; equal scores by box and category, so that the order never depends on that of the input."""
    box = detections.box_px
    keys = (detections.category, box[:, 3], box[:, 2], box[:, 1], box[:, 0], -detections.score)
    return detections.take(np.lexsort(keys))


def suppress(detections: Detections, max_overlap: float) -> Detections:
    """Keep the strongest of boxes that overlap by more than `max_overlap` (IoU) within one group of categories.

    Notes
    -----
    Greedy suppression across the classes of a group: a van that a model calls car and truck at once becomes one box, a
    person before a car stays. O(M^2) time; of more than `MAX_CANDIDATES` boxes the weakest are cut.
    """
    ordered = strongest_first(detections).take(slice(MAX_CANDIDATES))
    keep = suppressed_mask(ordered.box_px, groups(ordered.category), max_overlap)
    return ordered.take(keep)


def suppressed_mask(box_px: NDArray[np.float64], group: NDArray[np.str_], max_overlap: float) -> NDArray[np.bool_]:
    """Mask (M,) of the boxes that stay, for boxes (M, 4) in falling order of score."""
    keep = np.ones(len(box_px), dtype=bool)
    for i in range(len(box_px)):
        if keep[i]:
            later = np.flatnonzero(keep[i + 1 :] & (group[i + 1 :] == group[i])) + i + 1
            keep[later] = box_iou(box_px[i], box_px[later])[0] <= max_overlap
    return keep
