"""Measurement: LiDAR points inside boxes of images and of clouds are the evidence for objects.

Mode "paper" follows Bhardwaj & Kalra: depth of the point nearest to the box center, extents of all points in the box.
Mode "robust" removes the ground, assigns a cluster to every box, and measures the cluster's oriented extents and which of
their ends are ends of the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MAX_SIZE_M, TYPICAL_SIZE_M, Boxes3D, Detections, Log, Measurements, OtherView, end_of
from log2sim.geometry import NS_PER_S, Array, Camera
from log2sim.perception.boxes import (
    TOP_QUANTILE,
    fit_extents_of_clusters,
    place_boxes,
    quantile_of_clusters,
    rotate,
    sample_surface,
    sort_clusters,
    upper_median,
)
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import (
    MARGIN,
    MIN_CLUSTER_POINTS,
    assign_clusters,
    candidate_clusters,
    continued_sides,
    region_grow,
)
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

Index = NDArray[np.intp]

# Points of a cluster that are kept as evidence.
MAX_KEPT_POINTS = 400


def write_evidence(columns: dict[str, Any], rows: Sequence[int], members: Sequence[Index], cloud: Cloud) -> None:
    """Write what points show into rows of columns; a box of a 3D detector says which side is the length.

    Points of several viewpoints are measured from the one that has most of them; a second one is kept beside it.

    Parameters
    ----------
    columns : dict
        From `writable`.
    rows : R ints
    members : R arrays (n,) of int
        The points of each row in the cloud.
    """
    split = [cloud.split(index) for index in members]
    kept = [i for i, views in enumerate(split) if len(views[0][1]) >= min(MIN_CLUSTER_POINTS, len(members[i]))]
    for view in cloud.views:
        own = [i for i in kept if split[i][0][0] is view]
        if own:
            _write_view(columns, np.array([rows[i] for i in own]), [split[i][0][1] for i in own], view)
    for i in kept:
        columns["points"][rows[i]] = len(members[i])
        columns["seen_by"][rows[i]] |= cloud.ends_of(members[i])
        if len(split[i]) > 1 and len(split[i][1][1]) >= MIN_CLUSTER_POINTS:
            columns["others"][rows[i]] = _other_view(*split[i][1], int(columns["t_ns"][rows[i]]))


def _write_view(columns: dict[str, Any], rows: Index, members: Sequence[Index], cloud: Cloud) -> None:
    """Write what the points of one viewpoint, R arrays (n,), show into rows (R,)."""
    count = np.array([len(index) for index in members])
    edges = np.concatenate([[0], np.cumsum(count)])
    index = np.concatenate(members)
    xyz = cloud.xyz[index].astype(np.float64)
    xy, start = xyz[:, :2] - cloud.sensor[:2], edges[:-1]
    typical = np.array([TYPICAL_SIZE_M[str(category)] for category in columns["category"][rows]])
    yaw, low, high = fit_extents_of_clusters(xy, count, typical, columns["box_yaw_rad"][rows])
    columns["yaw_rad"][rows], columns["low_m"][rows], columns["high_m"][rows] = yaw, low, high
    heights = np.stack([xyz[:, 2], xyz[:, 2] - cloud.height[index]])
    sort_clusters(heights, count)
    columns["bottom_m"][rows] = heights[1, start + count // 2] + cloud.origin[2]
    columns["top_m"][rows] = quantile_of_clusters(heights[:1], count, TOP_QUANTILE)[0] + cloud.origin[2]
    t_s = cloud.t_s[index].astype(np.float64)
    mean_ns = np.round(np.add.reduceat(t_s, start) / count * NS_PER_S).astype(np.int64)
    columns["t_ns"][rows] = cloud.stamp_ns + mean_ns
    columns["sensor_m"][rows] = cloud.sensor + cloud.origin
    timed = np.column_stack([xyz + cloud.origin, t_s - np.repeat(mean_ns, count) / NS_PER_S])
    range_m = np.linalg.norm(xyz - cloud.sensor, axis=1)
    columns["ends_visible"][rows] = cloud.azimuth_index.ends_visible(members)
    for row, a, b in zip(rows.tolist(), edges[:-1].tolist(), edges[1:].tolist()):
        # A copy, which does not keep the points of all others in memory.
        columns["cluster"][row] = timed[a:b][sample_surface(range_m[a:b], MAX_KEPT_POINTS)]


def _other_view(cloud: Cloud, members: Index, t_ns: int) -> OtherView:
    """Describe what the points at `members` (n,) of a second viewpoint show of an object that is measured at a time."""
    xyz = cloud.xyz[members].astype(np.float64)
    late_s = cloud.t_s[members].astype(np.float64) + (cloud.stamp_ns - t_ns) / NS_PER_S
    kept = sample_surface(np.linalg.norm(xyz - cloud.sensor, axis=1), MAX_KEPT_POINTS)
    return OtherView(
        cloud.sensor + cloud.origin,
        cloud.azimuth_index.ends_visible([members])[0],
        np.column_stack([xyz + cloud.origin, late_s])[kept],
    )


# A box that ends nearer to the image border may be cut by it.
BORDER_PX = 3.0
# Vehicles that may be longer show flanks at such flat angles that rays are far apart on them.
MIN_LONG_M = 10.0
NEAR_END_QUANTILE = 0.05
# Smallest extent in mode "paper", m.
MIN_EXTENT_M = 0.1


def measure_view(view: View, detections: Detections, cloud: Cloud | None, *, mode: str = "robust") -> Measurements:
    """Measure every detection (M,) of one camera frame; rows without LiDAR points have no position."""
    rows = Measurements.unplaced(
        detections,
        t_ns=view.t_ns,
        camera=view.camera.name,
        sensor_m=view.map_T_cam[:3, 3],
        end=end_of(view.camera),
    )
    rows = replace(rows, truncated=_cut_by_border(view.camera, detections.box_px))
    if cloud is None or not len(detections):
        return rows
    return _measure_as_paper(rows, view, cloud) if mode == "paper" else _measure_robustly(rows, view, cloud)


def _cut_by_border(camera: Camera, box_px: Array) -> NDArray[np.bool_]:
    border = np.array([camera.width_px, camera.height_px]) - BORDER_PX
    return np.asarray((box_px[:, :2] < BORDER_PX).any(axis=1) | (box_px[:, 2:] > border).any(axis=1))


def writable(rows: Measurements) -> dict[str, Any]:
    """Copy the columns of rows, so that they can be written."""
    columns = {k: list(v) if isinstance(v, tuple) else v.copy() for k, v in vars(rows).items()}
    return columns | {"others": columns["others"] or [None] * len(rows)}


def with_tuples(columns: dict[str, Any]) -> dict[str, Any]:
    """Return columns from `writable` as rows have them."""
    others = columns["others"] if any(v is not None for v in columns["others"]) else ()
    return columns | {"cluster": tuple(columns["cluster"]), "others": tuple(others)}


def _measure_robustly(rows: Measurements, view: View, cloud: Cloud) -> Measurements:
    """Assign a cluster to every row and measure its extents."""
    points, columns_m = cloud.obstacles, cloud.obstacle_columns
    visible = project_points(view, cloud.origin, columns_m)
    index = points[visible.index]
    options, inside = [], points_in_image_boxes(visible, rows.box_px, MARGIN)
    xyz, uv = columns_m.take(visible.index, axis=1).T, np.stack([visible.u, visible.v], axis=1)
    range_m = np.linalg.norm(xyz - cloud.sensor, axis=1)
    for k, i in enumerate(inside):
        found = candidate_clusters(xyz[i], uv[i], range_m[i], rows.box_px[k], str(rows.category[k]))
        options.append([(i[members], score) for members, score in found])
    columns, assigned = writable(rows), assign_clusters(options, rows.box_px, len(index))
    taken = np.bincount(np.concatenate([*assigned, index[:0]]), minlength=len(index)) > 0
    rows_seen, members_seen = list[int](), list[NDArray[np.intp]]()
    for k, chosen in enumerate(assigned):
        if len(chosen) < MIN_CLUSTER_POINTS:
            continue
        members, category = index[chosen], str(rows.category[k])
        if rows.truncated[k]:
            grown = points[region_grow(columns_m[:2].T, cloud.xyz[members, :2], category)]
            members = np.union1d(members, grown)
        if MAX_SIZE_M[category][0] >= MIN_LONG_M:
            rest = points if rows.truncated[k] else index[inside[k]]
            other = np.ones(len(cloud.xyz), dtype=bool)
            other[members] = other[index[taken]] = False
            rest = rest[other[rest]]
            members = np.union1d(members, rest[_continuation(cloud, members, rest, MAX_SIZE_M[category][0])])
        box = rows.box_px[k]
        # The image box of a long vehicle is as high as its near end looks.
        is_long, depth = MAX_SIZE_M[category][0] >= MIN_LONG_M, visible.depth[chosen]
        depth_m = float(np.quantile(depth, NEAR_END_QUANTILE)) if is_long else upper_median(depth)
        columns["height_px_m"][k] = (box[3] - box[1]) * depth_m / view.camera.K[1, 1]
        rows_seen.append(k)
        members_seen.append(members)
    write_evidence(columns, rows_seen, members_seen, cloud)
    return place_boxes(Measurements(**with_tuples(columns)))


def _continuation(
    cloud: Cloud, members: NDArray[np.intp], rest: NDArray[np.intp], max_length_m: float
) -> NDArray[np.intp]:
    """Find those of the points `rest` that continue the sides of the points `members`, see `continued_sides`."""
    seed, others = (cloud.xyz[rows, :2].astype(np.float64) - cloud.sensor[:2] for rows in (members, rest))
    return continued_sides(seed, others, max_length_m)


def _measure_as_paper(rows: Measurements, view: View, cloud: Cloud) -> Measurements:
    """Take the depth of the point nearest to the box center, and the extents of all points in the box."""
    visible = project_points(view, cloud.origin, cloud.columns)
    uv, xyz = np.stack([visible.u, visible.v], axis=1), cloud.xyz[visible.index]
    columns = writable(rows)
    for k, inside in enumerate(points_in_image_boxes(visible, rows.box_px)):
        if len(inside) == 0:
            continue
        box = rows.box_px[k]
        nearest = inside[np.argmin(np.hypot(*(uv[inside] - (box[:2] + box[2:]) / 2).T))]
        center = xyz[nearest] + cloud.origin
        half = np.maximum(np.ptp(xyz[inside], axis=0), MIN_EXTENT_M) / 2
        offset = (center - rows.sensor_m[k])[:2]
        columns["yaw_rad"][k], columns["low_m"][k], columns["high_m"][k] = 0.0, offset - half[:2], offset + half[:2]
        columns["bottom_m"][k], columns["top_m"][k] = center[2] - half[2], center[2] + half[2]
        columns["center_m"][k], columns["covariance"][k], columns["source"][k] = center, np.eye(2), "lidar"
        columns["points"][k], columns["t_ns"][k] = len(inside), cloud.stamp_ns
        columns["seen_by"][k] |= cloud.ends_of(visible.index[inside])
    return Measurements(**with_tuples(columns))


def project_cloud(view: View, cloud: Cloud, index: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array, Array]:
    """Project the cloud's points at `index`: which of them the camera sees (n,), pixels (n, 2) and depths (n,)."""
    visible = project_points(view, cloud.origin, np.ascontiguousarray(cloud.xyz[index].T))
    uv = np.stack([visible.u, visible.v], axis=1).astype(np.float64)
    return visible.index, uv, visible.depth.astype(np.float64)


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
