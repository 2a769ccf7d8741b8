"""Measurement: LiDAR points inside a detector's box give its object's place, size and heading.

Mode "paper" follows Bhardwaj & Kalra: depth of the point nearest to the box center, extents of all points in the box.
Mode "robust" takes the ground away, gives every box the cluster that is its object's own, fits an oriented box to it, and
completes the sides that were not seen with the typical size of the category, from the ends that are real.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Detections, Measurements
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception import box_fitting
from log2sim.perception.box_fitting import upper_median
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import (
    MARGIN,
    MIN_CLUSTER_POINTS,
    assign_clusters,
    candidate_clusters,
    region_grow,
)
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_points

BORDER_PX = 3.0
KEPT_POINTS = 400


def measure_view(view: View, detections: Detections, cloud: Cloud | None, *, mode: str = "robust") -> Measurements:
    """Measure every detection (M,) of one camera frame; rows without LiDAR points come with source "" and NaN places."""
    columns = _blank(view, detections)
    if cloud is not None and len(detections):
        (_measure_as_paper if mode == "paper" else _measure_robustly)(columns, view, detections, cloud)
    return Measurements(**columns)


def _measure_robustly(columns: dict[str, Any], view: View, detections: Detections, cloud: Cloud) -> None:
    """Give every box the cluster that is its object, and write what it says into its row."""
    points, columns_m = cloud.obstacles, cloud.obstacle_columns
    seen = project_points(view, cloud.origin, columns_m)
    index, uv = points[seen.index], np.stack([seen.u, seen.v], axis=1)
    xyz = columns_m[:, seen.index].T
    range_m = np.linalg.norm(xyz - cloud.sensor, axis=1)
    options = []
    for k, i in enumerate(points_in_image_boxes(seen, detections.box_px, MARGIN)):
        found = candidate_clusters(xyz[i], uv[i], range_m[i], detections.box_px[k], str(detections.category[k]))
        options.append([(i[points], score) for points, score in found])
    clusters = list(columns["cluster"])
    for k, chosen in enumerate(assign_clusters(options, detections.box_px, len(index))):
        box, category = detections.box_px[k], str(detections.category[k])
        if len(chosen) < MIN_CLUSTER_POINTS:
            continue
        members = index[chosen]
        if columns["truncated"][k]:
            mine = np.zeros(len(cloud.xyz), dtype=bool)
            mine[members] = mine[points[region_grow(columns_m[:2].T, cloud.xyz[members, :2], category)]] = True
            members = np.flatnonzero(mine)
        columns["height_px_m"][k] = (box[3] - box[1]) * upper_median(seen.depth[chosen]) / view.camera.K[1, 1]
        clusters[k] = _fill_row(columns, k, members, category, cloud)
    columns["cluster"] = tuple(clusters)


def _blank(view: View, detections: Detections) -> dict[str, Any]:
    m = len(detections)
    box = detections.box_px
    border = np.array([view.camera.width_px, view.camera.height_px]) - BORDER_PX
    cut = (box[:, :2] < BORDER_PX).any(axis=1) | (box[:, 2:] > border).any(axis=1)
    size = np.array([TYPICAL_SIZE_M[str(c)] for c in detections.category]).reshape(m, 3)
    return {
        "t_ns": np.full(m, view.t_ns, dtype=np.int64),
        "category": detections.category,
        "score": detections.score,
        "camera": np.full(m, view.camera.name),
        "box_px": box,
        "truncated": cut,
        "ends_visible": np.zeros((m, 2), dtype=bool),
        "center_m": np.full((m, 3), np.nan),
        "size_m": size,
        "yaw_rad": np.full(m, np.nan),
        "covariance": np.full((m, 2, 2), np.nan),
        "points": np.zeros(m, dtype=np.int64),
        "source": np.full(m, "", dtype="<U16"),
        "cluster": tuple(np.zeros((0, 3)) for _ in range(m)),
        "sensor_m": np.tile(view.map_T_cam[:3, 3], (m, 1)),
        "height_px_m": np.full(m, np.nan),
    }


def _fill_row(columns: dict[str, Any], k: int, members: NDArray[np.intp], category: str, cloud: Cloud) -> Array:
    """Write what one cluster says into row `k` and return its points in the map frame."""
    xyz = cloud.xyz[members].astype(np.float64)
    ground_z = upper_median(xyz[:, 2] - cloud.height[members])
    ends_visible = cloud.azimuth_index.ends_visible(members)
    center, size, yaw, covariance = box_fitting.fit_box(
        xyz, cloud.sensor.astype(np.float64), category, ground_z, ends_visible
    )
    columns["ends_visible"][k] = ends_visible
    columns["center_m"][k] = center + cloud.origin
    columns["size_m"][k], columns["yaw_rad"][k], columns["covariance"][k] = size, yaw, covariance
    columns["points"][k], columns["source"][k] = len(members), "lidar"
    columns["t_ns"][k] = cloud.stamp_ns + round(float(cloud.t_s[members].mean()) * NS_PER_S)
    columns["sensor_m"][k] = cloud.sensor + cloud.origin
    return box_fitting.subsample(xyz, KEPT_POINTS) + cloud.origin


def _measure_as_paper(columns: dict[str, Any], view: View, detections: Detections, cloud: Cloud) -> None:
    """Depth of the point nearest to the box center, extents of all points in the box."""
    seen = project_points(view, cloud.origin, cloud.columns)
    uv, xyz = np.stack([seen.u, seen.v], axis=1), cloud.xyz[seen.index]
    for k, inside in enumerate(points_in_image_boxes(seen, detections.box_px)):
        if len(inside) == 0:
            continue
        box = detections.box_px[k]
        nearest = inside[np.argmin(np.hypot(*(uv[inside] - (box[:2] + box[2:]) / 2).T))]
        columns["center_m"][k] = xyz[nearest] + cloud.origin
        columns["size_m"][k] = np.maximum(np.ptp(xyz[inside], axis=0), 0.1)
        columns["yaw_rad"][k], columns["covariance"][k] = 0.0, np.eye(2)
        columns["points"][k], columns["source"][k] = len(inside), "lidar"
        columns["t_ns"][k] = cloud.stamp_ns


def project_cloud(view: View, cloud: Cloud, index: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array, Array]:
    """Which of the cloud's points at `index` the camera sees, their pixels (n, 2) and depths (n,)."""
    seen = project_points(view, cloud.origin, np.ascontiguousarray(cloud.xyz[index].T))
    uv = np.stack([seen.u, seen.v], axis=1).astype(np.float64)
    return seen.index, uv, seen.depth.astype(np.float64)
