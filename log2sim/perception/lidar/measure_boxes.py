"""Measurement of boxes that a detector found in a cloud: their points are evidence as those of image boxes are."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D, Log, Measurements
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.box_completion import place_boxes
from log2sim.perception.box_fitting import rotate
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.perception.lidar.evidence import write_evidence
from log2sim.perception.lidar.measure import with_tuples, writable

# A box is wrong by less than this at each side; neighbors are farther away.
BOX_MARGIN_M = 0.2
# Mirrors reach so far beyond a vehicle's width, and boxes around them half as far again.
EGO_MARGIN_M = 0.4
# A box is sought at the times of another viewpoint's points up to this speed and distance, in steps of a LiDAR's noise and
# the spacing of its rays.
MAX_FOLLOWED_MPS, MAX_FOLLOWED_M, FOLLOW_STEP_M = 30.0, 2.0, 0.1


def measure_boxes(boxes: Boxes3D, cloud: Cloud) -> Measurements:
    """Measure boxes (M,) found in a cloud; a row with too few points of its own keeps the position of its box."""
    columns = writable(Measurements.of_boxes(boxes, cloud.sensor + cloud.origin))
    columns["yaw_rad"][:] = boxes.yaw_rad
    columns["points"][:] = boxes.points
    for end, sign in (("bottom_m", -0.5), ("top_m", 0.5)):
        columns[end][:] = boxes.center_m[:, 2] + sign * boxes.size_m[:, 2]
    if cloud.parts:
        columns["sensor_m"][:] = _nearest_viewpoints(boxes, cloud)
    found = _members_of_all(boxes, cloud)
    for k, members in enumerate(found):
        columns["seen_by"][k] = cloud.ends_of(members)
    if boxes.seen_by is not None:
        columns["seen_by"] |= boxes.seen_by
    enough = [k for k, members in enumerate(found) if len(members) >= MIN_CLUSTER_POINTS]
    write_evidence(columns, enough, [found[k] for k in enough], cloud)
    return place_boxes(Measurements(**with_tuples(columns)))


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


def _nearest_viewpoints(boxes: Boxes3D, cloud: Cloud) -> Array:
    """Return the position (M, 3) of the viewpoint that is nearest to each box, m, map frame."""
    places = np.array([view.sensor + view.origin for view in cloud.views])
    away = np.hypot(*(boxes.center_m[:, None, :2] - places[:, :2]).transpose(2, 0, 1))
    return np.asarray(places[away.argmin(axis=1)])


def _members_of_all(boxes: Boxes3D, cloud: Cloud) -> list[NDArray[np.intp]]:
    """Find the points of all viewpoints in each box, where it is at the times of their points."""
    if not cloud.parts:
        return _members(boxes, cloud)
    first = np.cumsum([0, *(len(part.xyz) for part in cloud.parts)])
    found = [_members(follow_box(boxes, part), part) for part in cloud.parts]
    return [np.concatenate([start + own[k] for start, own in zip(first, found)]) for k in range(len(boxes))]


def follow_box(boxes: Boxes3D, view: Cloud) -> Boxes3D:
    """Move boxes (M,) along their axes to where most points of a viewpoint are in them, no farther than they can have come.

    At 15 m/s, sweeps that are 0.05 s apart show a vehicle 0.75 m apart. Boxes of the time of the points stay.
    """
    xyz, moved = view.xyz[view.obstacles], boxes.center_m.copy()
    for k in range(len(boxes)):
        local = xyz[:, :2] - (boxes.center_m[k] - view.origin)[:2]
        reach = float(np.hypot(*boxes.size_m[k, :2])) / 2 + MAX_FOLLOWED_M
        near = np.flatnonzero((np.abs(local[:, 0]) < reach) & (np.abs(local[:, 1]) < reach))
        if len(near) < MIN_CLUSTER_POINTS:
            continue
        along = rotate(local[near].astype(np.float64), -float(boxes.yaw_rad[k]))
        late_s = (view.stamp_ns - int(boxes.t_ns[k])) / NS_PER_S + float(view.t_s[view.obstacles[near]].mean())
        limit = min(abs(late_s) * MAX_FOLLOWED_MPS, MAX_FOLLOWED_M)
        if limit < BOX_MARGIN_M:
            continue
        steps = np.arange(-int(limit / FOLLOW_STEP_M), int(limit / FOLLOW_STEP_M) + 1) * FOLLOW_STEP_M
        half = boxes.size_m[k, :2] / 2
        along = along[np.abs(along[:, 1]) <= half[1] + BOX_MARGIN_M, 0]
        inside = (np.abs(along - steps[:, None]) <= half[0] + FOLLOW_STEP_M).sum(axis=1)
        # Of all places that hold as many points, the middle of those that are nearest.
        best = steps[inside >= inside.max()]
        yaw = float(boxes.yaw_rad[k])
        moved[k, :2] += best[np.argmin(np.abs(best))] * np.array([np.cos(yaw), np.sin(yaw)])
    return replace(boxes, center_m=moved)


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
