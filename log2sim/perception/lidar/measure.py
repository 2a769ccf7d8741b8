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

from log2sim.datatypes import MAX_SIZE_M, Detections, Measurements, end_of
from log2sim.geometry import Array, Camera
from log2sim.perception.box_completion import place_boxes
from log2sim.perception.box_fitting import upper_median
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import (
    MARGIN,
    MIN_CLUSTER_POINTS,
    assign_clusters,
    candidate_clusters,
    continued_sides,
    region_grow,
)
from log2sim.perception.lidar.evidence import write_evidence
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

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
