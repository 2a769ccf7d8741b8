"""Detected boxes laid against the points of the end that sees them: a network is less sure of the near sides than points are."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.datatypes import Boxes3D
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.measure_boxes import measure_boxes

# Fewer points are too far apart to say where a side ends: in random scenes they made boxes worse.
MIN_REFINED_POINTS = 20


def refine_boxes(boxes: Boxes3D, view: Cloud) -> Boxes3D:
    """Move and turn boxes (M,) to the sides that points of a viewpoint show; they grow to hold them."""
    mine = np.flatnonzero(boxes.points >= MIN_REFINED_POINTS)
    rows = measure_boxes(boxes.take(mine), view)
    size, yaw, center = boxes.size_m.copy(), boxes.yaw_rad.copy(), boxes.center_m.copy()
    # The yaw of points is known up to half turns.
    turned = np.cos(rows.yaw_rad - yaw[mine]) < 0
    yaw[mine] = rows.yaw_rad + np.where(turned, np.pi, 0.0)
    center[mine, :2] = rows.center_m[:, :2]
    size[mine, :2] = np.fmax(size[mine, :2], rows.high_m - rows.low_m)
    return replace(boxes, center_m=center, size_m=size, yaw_rad=yaw)
