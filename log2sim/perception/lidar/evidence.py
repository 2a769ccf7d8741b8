"""What the points of objects show: their oriented extents, which ends of these are ends of the object, their times and heights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, OtherView
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.box_fitting import MAX_TRIM_M, TOP_QUANTILE, TRIM, axes_swapped, rotate, sample_surface
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import MIN_CLUSTER_POINTS
from log2sim.perception.yaw_search import correct_yaws, fit_yaws

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
    yaw, low, high = _extents(xy, count, columns["box_yaw_rad"][rows], columns["category"][rows])
    columns["yaw_rad"][rows], columns["low_m"][rows], columns["high_m"][rows] = yaw, low, high
    heights = np.stack([xyz[:, 2], xyz[:, 2] - cloud.height[index]])
    _sort_each(heights, edges)
    columns["bottom_m"][rows] = heights[1, start + count // 2] + cloud.origin[2]
    columns["top_m"][rows] = _quantile(heights[:1], start, count, TOP_QUANTILE)[0] + cloud.origin[2]
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


def _extents(xy: Array, count: Index, known_yaw_rad: Array, category: NDArray[Any]) -> tuple[Array, Array, Array]:
    """Fit the yaws (R,) and the ends (R, 2), (R, 2) of R clusters of points (N, 2), as `fit_extents` does for one.

    Where the yaw is not known, NaN, the category says which side is the length.
    """
    known = np.isfinite(known_yaw_rad)
    yaw, of_known = known_yaw_rad.copy(), np.repeat(known, count)
    if known.any():
        yaw[known] = correct_yaws(xy[of_known], count[known], yaw[known])
    if not known.all():
        yaw[~known] = fit_yaws(xy[~of_known], count[~known])[0]
    edges = np.concatenate([[0], np.cumsum(count)])
    local = np.ascontiguousarray(rotate(xy, -np.repeat(yaw, count)).T)
    _sort_each(local, edges)
    start = edges[:-1]
    third = np.minimum(2, (count - 1) // 2)
    low = np.minimum(_quantile(local, start, count, TRIM), local[:, start + third] + MAX_TRIM_M).T
    high = np.maximum(_quantile(local, start, count, 1 - TRIM), local[:, start + count - 1 - third] - MAX_TRIM_M).T
    for k in np.flatnonzero(~known).tolist():
        if axes_swapped(high[k] - low[k], -(low[k] + high[k]) / 2, np.array(TYPICAL_SIZE_M[str(category[k])])):
            yaw[k] += np.pi / 2
            low[k], high[k] = [low[k, 1], -high[k, 0]], [high[k, 1], -low[k, 0]]
    return yaw, low, high


def _sort_each(values: Array, edges: Index) -> None:
    """Sort values (V, N) in place between successive edges (R + 1,)."""
    for a, b in zip(edges[:-1].tolist(), edges[1:].tolist()):
        values[:, a:b].sort(axis=1)


def _quantile(ordered: Array, start: Index, count: Index, share: float) -> Array:
    """Interpolate a quantile (V, R) of values (V, N) that are sorted within R clusters, as `quantile_of_sorted` does for one."""
    place = share * (count - 1)
    below = place.astype(np.intp)
    first, second = ordered[:, start + below], ordered[:, start + np.minimum(below + 1, count - 1)]
    return np.asarray(first + (place - below) * (second - first))
