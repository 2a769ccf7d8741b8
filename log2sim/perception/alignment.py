"""Points of moving objects put to one time before they are searched: two ends see a vehicle at 15 m/s 0.75 m apart within 0.05 s."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.boxes import rotate
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.tracking.stitch import choose_pairs

# Boxes that are no road users must not move points.
MIN_SCORE = 0.3
# Slower objects move less between the sweeps of a tick than a box is off; none is faster on a road with people beside it.
MIN_SPEED_MPS, MAX_SPEED_MPS = 4.0, 40.0
# Vehicles go where they point: of what moves across, the boxes are wrong.
MAX_ACROSS_SHARE = 0.3
# A box is off by less than this after it was moved on.
MARGIN_M = 0.3


def align_parts(cloud: Cloud, before: Sequence[Boxes3D]) -> Cloud:
    """Move the points of vehicles and riders, by how these moved between two earlier moments, to the time of most of their points.

    `cloud`: with parts; one without is returned as it is. `before`: what was found at the two moments before, the earlier
    first.
    """
    if not cloud.parts or len(before) < 2:
        return cloud
    boxes, speed = moving_boxes(*before)
    if not len(boxes):
        return cloud
    xyz, t_s = cloud.xyz.copy(), cloud.t_s.copy()
    first = np.cumsum([0, *(len(part.xyz) for part in cloud.parts)])
    of_parts = [np.arange(a, b)[part.obstacles] for part, a, b in zip(cloud.parts, first, first[1:])]
    members = [_members(boxes, speed, cloud, index) for index in of_parts]
    axis = np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)])
    for k in range(len(boxes)):
        own = [m[k] for m in members]
        most = max(own, key=len)
        if not len(most):
            continue
        points = np.concatenate(own)
        at_s = np.float32(cloud.t_s[most].mean())
        xyz[points, :2] += (at_s - cloud.t_s[points])[:, None] * (speed[k] * axis[k]).astype(np.float32)
        t_s[points] = at_s
    return replace(cloud, xyz=xyz, t_s=t_s)


def moving_boxes(earlier: Boxes3D, later: Boxes3D) -> tuple[Boxes3D, Array]:
    """Return the boxes (M,) of the later moment that moved along their axis since the earlier one, and their speeds (M,), m/s."""
    a, b = (found.take(_is_driven(found)) for found in (earlier, later))
    if not len(a) or not len(b):
        return b.take(np.zeros(0, dtype=np.intp)), np.zeros(0)
    away = b.center_m[:, None, :2] - a.center_m[:, :2]
    passed_s = np.maximum((b.t_ns[:, None] - a.t_ns) / NS_PER_S, 1.0 / NS_PER_S)
    distance = np.hypot(away[..., 0], away[..., 1])
    allowed = (distance <= MAX_SPEED_MPS * passed_s) & (b.category[:, None] == a.category)
    first, second = np.nonzero(allowed)
    i, j = choose_pairs(first, second, distance[allowed])
    local = rotate(away[i, j], -b.yaw_rad[i])
    speed = local[:, 0] / passed_s[i, j]
    moves = (np.abs(speed) >= MIN_SPEED_MPS) & (np.abs(local[:, 1]) <= MAX_ACROSS_SHARE * np.abs(local[:, 0]))
    return b.take(i[moves]), speed[moves]


def _is_driven(boxes: Boxes3D) -> NDArray[np.bool_]:
    groups = np.array([GROUP_OF[str(c)] for c in boxes.category], dtype="<U16")
    return np.asarray(np.isin(groups, ("vehicle", "two_wheeler")) & (boxes.score >= MIN_SCORE))


def _members(boxes: Boxes3D, speed: Array, cloud: Cloud, index: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Find those of the points at `index` that are in each box where it is at the mean time of these points."""
    if not len(index):
        return [index] * len(boxes)
    at_ns = cloud.stamp_ns + int(cloud.t_s[index].mean(dtype=np.float64) * NS_PER_S)
    on = speed * (at_ns - boxes.t_ns) / NS_PER_S
    center = boxes.center_m - cloud.origin
    center[:, :2] += on[:, None] * np.column_stack([np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)])
    found = points_of_boxes(cloud.xyz[index], center, boxes.size_m + 2 * MARGIN_M, boxes.yaw_rad)
    return [index[found.point[found.box == k]] for k in range(len(boxes))]
