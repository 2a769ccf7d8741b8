"""Measurement: LiDAR points inside a detection box are the evidence for its object's position, size and heading.

Mode "paper" follows Bhardwaj & Kalra: depth of the point nearest to the box center, extents of all points in the box.
Mode "robust" removes the ground, assigns a cluster to every box, and measures the cluster's oriented extents and which of
their ends are ends of the object.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MAX_SIZE_M, TYPICAL_SIZE_M, Detections, Measurements, OtherView, end_of
from log2sim.geometry import NS_PER_S, Array, Camera
from log2sim.perception.box_completion import place_boxes
from log2sim.perception.box_fitting import fit_extents, sample_surface, top_of, upper_median
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

# A box that ends nearer to the image border may be cut by it.
BORDER_PX = 3.0
# Points of a cluster that are kept as evidence.
MAX_KEPT_POINTS = 400
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
    for k, i in enumerate(inside):
        xyz, uv = columns_m[:, visible.index[i]].T, np.stack([visible.u[i], visible.v[i]], axis=1)
        range_m = np.linalg.norm(xyz - cloud.sensor, axis=1)
        found = candidate_clusters(xyz, uv, range_m, rows.box_px[k], str(rows.category[k]))
        options.append([(i[members], score) for members, score in found])
    columns, assigned = writable(rows), assign_clusters(options, rows.box_px, len(index))
    taken = np.bincount(np.concatenate([*assigned, index[:0]]), minlength=len(index)) > 0
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
        write_evidence(columns, k, members, cloud)
    return place_boxes(Measurements(**with_tuples(columns)))


def _continuation(
    cloud: Cloud, members: NDArray[np.intp], rest: NDArray[np.intp], max_length_m: float
) -> NDArray[np.intp]:
    """Find those of the points `rest` that continue the sides of the points `members`, see `continued_sides`."""
    seed, others = (cloud.xyz[rows, :2].astype(np.float64) - cloud.sensor[:2] for rows in (members, rest))
    return continued_sides(seed, others, max_length_m)


def write_evidence(columns: dict[str, Any], k: int, members: NDArray[np.intp], cloud: Cloud) -> None:
    """Write what the points at `members` (n,) show into row `k`; a box of a 3D detector says which side is the length.

    Points of several viewpoints are measured from the one that has most of them; a second one is kept beside it.
    """
    views = cloud.split(members)
    view, own = views[0]
    if len(own) < min(MIN_CLUSTER_POINTS, len(members)):
        return
    _write_view(columns, k, own, view)
    columns["points"][k] = len(members)
    columns["seen_by"][k] |= cloud.ends_of(members)
    if len(views) > 1 and len(views[1][1]) >= MIN_CLUSTER_POINTS:
        columns["others"][k] = _other_view(*views[1], int(columns["t_ns"][k]))


def _other_view(cloud: Cloud, members: NDArray[np.intp], t_ns: int) -> OtherView:
    """Describe what the points at `members` (n,) of a second viewpoint show of an object that is measured at a time."""
    xyz = cloud.xyz[members].astype(np.float64)
    late_s = cloud.t_s[members].astype(np.float64) + (cloud.stamp_ns - t_ns) / NS_PER_S
    kept = sample_surface(np.linalg.norm(xyz - cloud.sensor, axis=1), MAX_KEPT_POINTS)
    return OtherView(
        cloud.sensor + cloud.origin,
        cloud.azimuth_index.ends_visible(members),
        np.column_stack([xyz + cloud.origin, late_s])[kept],
    )


def _write_view(columns: dict[str, Any], k: int, members: NDArray[np.intp], cloud: Cloud) -> None:
    """Write what the points at `members` (n,) of one viewpoint show into row `k`."""
    xyz = cloud.xyz[members].astype(np.float64)
    xy, box_yaw = xyz[:, :2] - cloud.sensor[:2], float(columns["box_yaw_rad"][k])
    typical = np.array(TYPICAL_SIZE_M[str(columns["category"][k])])
    yaw, low, high = fit_extents(xy, typical, None if np.isnan(box_yaw) else box_yaw)
    columns["yaw_rad"][k], columns["low_m"][k], columns["high_m"][k] = yaw, low, high
    columns["ends_visible"][k] = cloud.azimuth_index.ends_visible(members)
    columns["bottom_m"][k] = upper_median(xyz[:, 2] - cloud.height[members]) + cloud.origin[2]
    columns["top_m"][k] = top_of(xyz[:, 2]) + cloud.origin[2]
    t_s = cloud.t_s[members].astype(np.float64)
    mean_ns = round(float(t_s.mean()) * NS_PER_S)
    columns["t_ns"][k] = cloud.stamp_ns + mean_ns
    columns["sensor_m"][k] = cloud.sensor + cloud.origin
    timed = np.column_stack([xyz + cloud.origin, t_s - mean_ns / NS_PER_S])
    columns["cluster"][k] = timed[sample_surface(np.linalg.norm(xyz - cloud.sensor, axis=1), MAX_KEPT_POINTS)]


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
