"""Which LiDAR points belong to the object in a detector's box."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF
from log2sim.geometry import Array, box_iou
from log2sim.perception.box_fitting import subsample

Index = NDArray[np.intp]

CELL_M = {"vehicle": 0.4, "two_wheeler": 0.3, "pedestrian": 0.25, "other": 0.4}
# Longest that an object of a category can be: points farther apart belong to several things.
MAX_LENGTH_M = {
    "car": 6.0, "truck": 14.0, "bus": 19.0, "motorcycle": 2.8, "cyclist": 2.4, "bicycle": 2.4, "pedestrian": 1.4, "other": 8.0,
}  # fmt: skip
MIN_CLUSTER_POINTS = 4
MAX_SCORED_POINTS = 400
# A cluster that fills less of the box than this is something in front of the object or behind it.
MIN_IMAGE_IOU = 0.12
# Around a box, a margin of this share of its sides is searched for what goes on there, as dense as this at least.
MARGIN, MIN_DENSITY_RATIO = 0.15, 0.3
# Boxes that overlap by more are two of one object; a cluster of which more is another box's is that one's.
DUPLICATE_IOU, MAX_FOREIGN_SHARE = 0.7, 0.5


def clusters_of(xy: NDArray[np.floating[Any]], cell_m: float) -> NDArray[np.intp]:
    """Label (N,) the connected clusters of points (N, 2): neighbors are in touching cells, corners included."""
    return _cluster(xy, cell_m)[0]


def _cluster(xy: NDArray[np.floating[Any]], cell_m: float) -> tuple[NDArray[np.intp], Array, NDArray[Any]]:
    """Labels (N,) of the clusters, the corner of their grid, and that grid: labels plus one, 0 where empty, with a border."""
    import cv2

    x, y = xy.T
    corner = np.array([x.min(), y.min()], dtype=xy.dtype) - cell_m
    i, j = ((values - low) / cell_m for values, low in zip((x, y), corner))
    i, j = i.astype(np.intp), j.astype(np.intp)
    grid = np.zeros((i.max() + 2, j.max() + 2), dtype=np.uint8)
    grid[i, j] = 1
    _, labels = cv2.connectedComponents(grid, connectivity=8, ltype=cv2.CV_16U)
    grid = np.asarray(labels)
    return grid[i, j].astype(np.intp) - 1, corner, grid


def candidate_clusters(
    xyz: NDArray[np.float32], uv: NDArray[np.floating[Any]], range_m: Array, box_px: Array, category: str
) -> list[tuple[Index, float]]:
    """Clusters of the points (N, 3) inside a box that could be its object, as indices, each with a score in (0, 1].

    Parameters
    ----------
    xyz, uv, range_m : (N, 3), (N, 2), (N,)
        Points in and right around the box, their pixels, and their distances from the sensor.
    box_px : (4,) the detector's box

    Notes
    -----
    Every cluster of the points in the box spans a rectangle in the image. The object's own one fills the detector's box;
    what stands in front covers a part of it, and the background shows only around the object. Of clusters that fill the
    box alike the nearer one is the object. What goes on outside the box is a wall or a hedge.
    """
    u, v = uv.T
    inside = np.flatnonzero((u >= box_px[0]) & (u <= box_px[2]) & (v >= box_px[1]) & (v <= box_px[3]))
    if len(inside) < MIN_CLUSTER_POINTS:
        return []
    cell_m = CELL_M[GROUP_OF[category]]
    labels, corner, grid = _cluster(xyz[inside, :2], cell_m)
    structure = _extends_beyond_box(xyz, uv, box_px, labels, corner, grid, cell_m)
    # Whole numbers of 16 bits are sorted by their digits.
    order, count = np.argsort(labels.astype(np.uint16), kind="stable"), np.bincount(labels)
    first = np.cumsum(count) - count
    enough = (count >= MIN_CLUSTER_POINTS) & ~structure
    if not enough.any():
        return []
    span = np.concatenate(_group_extents(uv[inside[order]], first), axis=1)
    middle_m = np.bincount(labels, range_m[inside]) / np.maximum(count, 1)
    nearest_m = middle_m[enough].min()
    low, high = _group_extents(xyz[inside[order], :2], first)
    members = {int(g): inside[order[first[g] : first[g] + count[g]]] for g in np.flatnonzero(enough)}
    too_long = np.hypot(*(high - low).T) > MAX_LENGTH_M[category]
    for g in np.flatnonzero(enough & (too_long | (count > MAX_SCORED_POINTS))).tolist():
        members[g] = cropped = crop_to_length(xyz, members[g], range_m, MAX_LENGTH_M[category])
        sample = uv[subsample(cropped, MAX_SCORED_POINTS)]
        span[g] = np.concatenate([sample.min(axis=0), sample.max(axis=0)])
        middle_m[g] = range_m[cropped].mean()
    fill = box_iou(span, box_px)[:, 0]
    score = fill * np.sqrt(nearest_m / np.maximum(middle_m, 1e-3))
    return [(points, float(score[g])) for g, points in members.items() if fill[g] >= MIN_IMAGE_IOU]


def _group_extents(values: NDArray[Any], first: Index) -> tuple[NDArray[Any], NDArray[Any]]:
    """Smallest and largest values (G, 2), (G, 2) of consecutive groups of rows (N, 2) that begin at `first` (G,)."""
    return np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)


def _extends_beyond_box(
    xyz: NDArray[np.float32],
    uv: NDArray[np.floating[Any]],
    box_px: Array,
    labels: NDArray[np.intp],
    corner: Array,
    grid: NDArray[Any],
    cell_m: float,
) -> NDArray[np.bool_]:
    """Which clusters (L,) go on beyond two of the left, the right and the upper side of the box, in its margin."""
    import cv2

    count = np.bincount(labels)
    u, v = uv.T
    outside = np.flatnonzero(((u < box_px[0]) | (u > box_px[2]) | (v < box_px[1])) & (v <= box_px[3]))
    i, j = ((xyz[outside, axis] - corner[axis]) / cell_m for axis in (0, 1))
    on_grid = (i >= 0) & (i < grid.shape[0]) & (j >= 0) & (j < grid.shape[1])
    outside, i, j = outside[on_grid], i[on_grid].astype(np.intp), j[on_grid].astype(np.intp)
    owner = cv2.dilate(grid, np.ones((3, 3)))[i, j].astype(np.intp) - 1
    sides = np.zeros(len(count), dtype=np.int64)
    u, v = u[outside], v[outside]
    within = (u >= box_px[0]) & (u <= box_px[2])
    for rows in (u < box_px[0], u > box_px[2], within & (v < box_px[1])):
        beyond = np.bincount(owner[rows & (owner >= 0)], minlength=len(count))
        sides += beyond >= np.maximum(MIN_DENSITY_RATIO * MARGIN * count, 3)
    return sides >= 2


def assign_clusters(options: Sequence[Sequence[tuple[Index, float]]], boxes_px: Array, count: int) -> list[Index]:
    """One cluster for each of K boxes, from its candidates over `count` points; empty where none is left.

    Notes
    -----
    Boxes choose their best candidates, the largest clusters first. Points that are another box's are no longer to be
    had: what shows of a hidden object is the little around the one that hides it. Boxes that overlap almost wholly are
    two of one object and share its points.
    """
    chosen: list[Index] = [np.zeros(0, dtype=np.intp)] * len(options)
    overlap = box_iou(boxes_px, boxes_px) if len(options) else np.zeros((0, 0))
    owner = np.full(count, -1)
    open_rows = {k: sorted(c, key=lambda o: -o[1]) for k, c in enumerate(options) if c}
    while open_rows:
        k = max(open_rows, key=lambda r: (len(open_rows[r][0][0]), -r))
        points, _ = open_rows[k].pop(0)
        taken = owner[points]
        foreign = (taken >= 0) & (overlap[k, np.maximum(taken, 0)] < DUPLICATE_IOU)
        if foreign.mean() <= MAX_FOREIGN_SHARE:
            chosen[k] = points[~foreign]
            owner[points[taken < 0]] = k
        if len(chosen[k]) or not open_rows[k]:
            del open_rows[k]
    return chosen


def crop_to_length(xyz: NDArray[np.float32], group: Index, range_m: Array, longest_m: float) -> Index:
    """Cut a cluster that is longer than its object can be around its nearer part."""
    xy = xyz[group, :2]
    if np.hypot(*(xy.max(axis=0) - xy.min(axis=0))) <= longest_m:
        return group
    near = group[range_m[group] <= np.quantile(range_m[group], 0.4)]
    center = np.median(xyz[near, :2], axis=0)
    kept = group[np.hypot(*(xyz[group, :2] - center).T) <= longest_m / 2]
    return kept if len(kept) >= MIN_CLUSTER_POINTS else near


def region_grow(xy_all: NDArray[np.float32], seed: NDArray[np.float32], category: str) -> Index:
    """Indices of all points (N, 2) connected to a seed cluster (n, 2), for an object that the image border cuts.

    Bounded by the category's longest size, so that it cannot run along a wall.
    """
    reach = MAX_LENGTH_M[category]
    center = np.median(seed, axis=0)
    near = np.flatnonzero(np.abs(xy_all[:, 0] - center[0]) <= reach)
    near = near[np.abs(xy_all[near, 1] - center[1]) <= reach]
    if len(near) == 0:
        return near
    labels = clusters_of(np.vstack([xy_all[near], seed]), CELL_M[GROUP_OF[category]])
    wanted = np.bincount(labels[len(near) :]).argmax()
    kept = near[labels[: len(near)] == wanted]
    return kept[np.hypot(*(xy_all[kept] - center).T) <= reach]
