"""Non-maximum suppression across the classes of a group."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections
from log2sim.geometry import box_iou
from log2sim.perception.detect.classes import groups_of

# Of more boxes the weakest are cut, since suppression takes time quadratic in their number.
MAX_CANDIDATES = 2000


def strongest_first(detections: Detections) -> Detections:
    """Sort by descending score, ties by box and category, so that the order of the input does not matter."""
    box = detections.box_px
    keys = (detections.category, box[:, 3], box[:, 2], box[:, 1], box[:, 0], -detections.score)
    return detections.take(np.lexsort(keys))


def suppress(detections: Detections, max_overlap: float) -> Detections:
    """Keep the strongest of boxes that overlap by more than `max_overlap` (IoU) within one group of categories.

    Notes
    -----
    Greedy suppression across the classes of a group: a van that a model detects as car and truck becomes one box, while
    a person in front of a car is kept. O(M^2) time.
    """
    ordered = strongest_first(detections).take(slice(MAX_CANDIDATES))
    keep = suppressed_mask(ordered.box_px, groups_of(ordered.category), max_overlap)
    return ordered.take(keep)


def suppressed_mask(box_px: NDArray[np.float64], group: NDArray[np.str_], max_overlap: float) -> NDArray[np.bool_]:
    """Compute the mask (M,) of the boxes that are kept, for boxes (M, 4) sorted by descending score."""
    keep = np.ones(len(box_px), dtype=bool)
    for i in range(len(box_px)):
        if keep[i]:
            later = np.flatnonzero(keep[i + 1 :] & (group[i + 1 :] == group[i])) + i + 1
            keep[later] = box_iou(box_px[i], box_px[later])[0] <= max_overlap
    return keep
