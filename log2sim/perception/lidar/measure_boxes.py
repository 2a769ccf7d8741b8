"""Measurement of boxes that a detector found in a cloud: their points are evidence as those of image boxes are."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D, Log, Measurements
from log2sim.perception.box_completion import place_boxes
from log2sim.perception.box_fitting import rotate
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.perception.lidar.measure import writable, write_evidence

# A box is wrong by less than this at each side; neighbors are farther away.
BOX_MARGIN_M = 0.2
# Mirrors reach so far beyond a vehicle's width, and boxes around them half as far again.
EGO_MARGIN_M = 0.4


def measure_boxes(boxes: Boxes3D, cloud: Cloud) -> Measurements:
    """Measure boxes (M,) found in a cloud; a row with too few points of its own keeps the position of its box."""
    columns = writable(Measurements.of_boxes(boxes, cloud.sensor + cloud.origin))
    columns["yaw_rad"][:] = boxes.yaw_rad
    columns["points"][:] = boxes.points
    for end, sign in (("bottom_m", -0.5), ("top_m", 0.5)):
        columns[end][:] = boxes.center_m[:, 2] + sign * boxes.size_m[:, 2]
    for k, members in enumerate(_members(boxes, cloud)):
        columns["seen_by"][k] = cloud.ends_of(members)
        if len(members) >= MIN_CLUSTER_POINTS:
            write_evidence(columns, k, members, cloud)
    return place_boxes(Measurements(**columns | {"cluster": tuple(columns["cluster"])}))


def outside_ego(log: Log, boxes: Boxes3D) -> Boxes3D:
    """Leave out the boxes on the ego: a LiDAR sees the roof, the mirrors and the rider of its own vehicle."""
    if log.ego is None or not len(boxes):
        return boxes
    map_T_ego, known = log.ego.at(boxes.t_ns)
    axis = map_T_ego[:, :2, 0]
    offset = (boxes.center_m - log.ego_centers(map_T_ego))[:, :2]
    along, across = (offset * axis).sum(axis=1), axis[:, 0] * offset[:, 1] - axis[:, 1] * offset[:, 0]
    length, width = np.array(log.ego_vehicle.size_m[:2]) / 2 + EGO_MARGIN_M
    return boxes.take(~(known & (np.abs(along) < length) & (np.abs(across) < width)))


def _members(boxes: Boxes3D, cloud: Cloud) -> list[NDArray[np.intp]]:
    """Find the points of the cloud above the ground in each box, somewhat widened; each point belongs to one box."""
    center, xyz = boxes.center_m - cloud.origin, cloud.xyz[cloud.obstacles]
    found = points_of_boxes(xyz, center, boxes.size_m + 2 * BOX_MARGIN_M, boxes.yaw_rad)
    own = np.ones(len(found.point), dtype=bool)
    # Of several boxes that hold a point, it is deepest in its own.
    shared = np.flatnonzero(np.bincount(found.point, minlength=len(xyz))[found.point] > 1)
    if len(shared):
        point, box = found.point[shared], found.box[shared]
        local = rotate(xyz[point, :2] - center[box, :2], -boxes.yaw_rad[box])
        outside_m = (np.abs(local) - boxes.size_m[box, :2] / 2).max(axis=1)
        order = np.lexsort((outside_m, point))
        own[shared[order[np.r_[False, np.diff(point[order]) == 0]]]] = False
    edges = np.searchsorted(found.box[own], np.arange(len(boxes) + 1))
    members = cloud.obstacles[found.point[own]]
    return [members[a:b] for a, b in pairwise(edges)]
