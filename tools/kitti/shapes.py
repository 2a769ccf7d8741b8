"""Size, height and heading of tracked boxes on the KITTI benchmark, from all their detections instead of one."""

from __future__ import annotations

import numpy as np

from kitti.boxes import Boxes
from kitti.rows import SCALE, Index, Rows, exact_sums, first_of_run, last_of_run, sum_so_far
from log2sim.datatypes import Measurements
from log2sim.geometry import Array

# An object keeps its size; the ground under it and its heading are taken to be the same for so many frames before and after.
NEAR_FRAMES = 3


def smooth_shapes(rows: Rows, boxes: Boxes, measurements: Measurements, *, online: bool) -> tuple[Array, Array, Array]:
    """Centers (N, 3) and yaws (N,) in the map and sizes (N, 3) length, width, height of rows by track and frame.

    Means over the detections with the category of the track, each by how likely it is one; online over those up to a row.
    """
    chance = np.where(rows.source >= 0, 1 / (1 + np.exp(-boxes.score[rows.source])), 0.0)
    begin = first_of_run(rows.track)
    size = boxes.size_hwl_m[rows.model, ::-1].copy()
    for category in np.unique(rows.category):
        # Online a track may have had another category before.
        weight = np.where(boxes.category[rows.source] == category, chance, 0.0)
        of = rows.category == category
        size[of] = _mean_of_track(boxes.size_hwl_m[rows.model, ::-1], weight, begin, online=online)[of]
    bottom = measurements.center_m[rows.model, 2] - boxes.size_hwl_m[rows.model, 0] / 2
    yaw = measurements.yaw_rad[rows.model]
    # Twice the angle: a box is the same from the front and from behind.
    columns = np.column_stack([bottom, np.cos(2 * yaw), np.sin(2 * yaw)])
    weight = np.where(boxes.category[rows.source] == rows.category, chance, 0.0)
    bottom, cos, sin = _mean_nearby(columns, weight, rows, online=online).T
    turn = np.arctan2(sin, cos) / 2 - yaw
    yaw = yaw + np.mod(turn + np.pi / 2, np.pi) - np.pi / 2
    return np.column_stack([rows.xy_m, bottom + size[:, 2] / 2]), size, yaw


def _mean_of_track(values: Array, weight: Array, begin: Index, *, online: bool) -> Array:
    """Means (N, K) of the values of a track, online of those so far; the value itself where no weight is."""
    end = np.arange(len(begin)) if online else last_of_run(begin)
    total = sum_so_far(weight, begin)[end]
    sums = np.column_stack([sum_so_far(weight * v, begin)[end] for v in values.T])
    return np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1.0)[:, None], values)


def _mean_nearby(values: Array, weight: Array, rows: Rows, *, online: bool) -> Array:
    """Means (N, K) of the values of a track in the frames around; the value itself where no weight is."""
    key = rows.track * (int(rows.frame.max(initial=0)) + 2 * NEAR_FRAMES + 1) + rows.frame
    a = np.searchsorted(key, key - NEAR_FRAMES, "left")
    b = np.searchsorted(key, key + (0 if online else NEAR_FRAMES), "right")
    total, *sums = (s[b] - s[a] for s in map(exact_sums, [weight, *(weight * values.T)]))
    means = np.column_stack(sums) / np.where(total > 0, total, SCALE)[:, None]
    return np.where(total[:, None] > 0, means, values)
