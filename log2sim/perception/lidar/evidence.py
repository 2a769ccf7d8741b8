"""What the points of objects show: their oriented extents, which ends of these are ends of the object, their times and heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, OtherView
from log2sim.geometry import NS_PER_S
from log2sim.perception.box_fitting import (
    TOP_QUANTILE,
    fit_extents_of_clusters,
    quantile_of_clusters,
    sample_surface,
    sort_clusters,
)
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS

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
    cloud : Cloud
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
