"""Where a picture that is laid out flat shows the road itself, not what stands on it: by its color near the camera."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.lanes.detection.layers import log_color
from log2sim.mapping.ground_map import GroundMap

NEAR_M, BESIDE_M = 12.0, 3.0  # from the camera: ground that is mostly road in pictures that look along one
# Paint and joints are narrower; vehicles are wider.
NARROW_M = 0.7
# Logarithms: other surfaces, wear and far haze; shadows of vehicles and their lower parts are darker by far.
DARKER, BRIGHTER, COLORED = 0.6, 0.4, 0.12
MIN_SHARE = 0.02  # of what is seen: with less, the color near the camera is not that of a road
AROUND_M = 0.3


def keep_road(ground: GroundMap, camera_x_m: float, camera_y_m: float) -> GroundMap:
    """Hide what has not the color of the ground in front of the camera; all is kept where that is no wide surface."""
    seen = ground.alpha > 0
    bright, yellow = (_without_narrow(a, ground.resolution_m) for a in log_color(ground.color_bgr))
    near = np.zeros(seen.shape, bool)
    x0, _, _, y1 = ground.extent_m
    rows = slice(*(max(round((y1 - camera_y_m + side * BESIDE_M) / ground.resolution_m), 0) for side in (-1, 1)))
    first = max(round((camera_x_m - x0) / ground.resolution_m), 0)
    near[rows, first : first + round(NEAR_M / ground.resolution_m)] = True
    near &= seen
    if not near.any():
        return ground
    level, tint = float(np.median(bright[near])), float(np.median(yellow[near]))
    road = seen & (bright > level - DARKER) & (bright < level + BRIGHTER) & (np.abs(yellow - tint) < COLORED)
    if np.count_nonzero(road) < MIN_SHARE * np.count_nonzero(seen):
        return ground
    size = (2 * round(AROUND_M / ground.resolution_m) + 1,) * 2
    whole = cv2.morphologyEx(road.astype(np.uint8), cv2.MORPH_OPEN, np.ones(size, np.uint8))
    wider = cv2.dilate(whole, np.ones((size[0] // 2 | 1,) * 2, np.uint8))
    return replace(ground, alpha=np.where(wider > 0, ground.alpha, 0).astype(np.uint8))


def _without_narrow(values: NDArray[np.float32], cell_m: float) -> NDArray[np.float32]:
    """Remove what is narrow across the road, which runs along the rows: bright lines first, then dark ones."""
    across = np.ones((2 * round(NARROW_M / cell_m / 2) + 1, 1), np.uint8)
    soft = cv2.blur(values, (5, 5))
    return np.asarray(
        cv2.morphologyEx(cv2.morphologyEx(soft, cv2.MORPH_OPEN, across), cv2.MORPH_CLOSE, across), np.float32
    )
