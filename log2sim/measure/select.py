"""Which LiDAR points belong to the object in a detector's box."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.boxfit import subsample
from log2sim.geometry import Array, box_iou
from log2sim.types import GROUP_OF

Index = NDArray[np.intp]

CELL_M = {"vehicle": 0.4, "two_wheeler": 0.3, "pedestrian": 0.25, "other": 0.4}
# Longest that an object of a category can be: points farther apart belong to several things.
LONGEST_M = {
    "car": 6.0, "truck": 14.0, "bus": 19.0, "motorcycle": 2.8, "cyclist": 2.4, "bicycle": 2.4, "pedestrian": 1.4, "other": 8.0,
}  # fmt: skip
LEAST_POINTS = 4
MOST_SCORED_POINTS = 400
# A cluster that fills less of the box than this is something in front of the object or behind it.
LEAST_FILL = 0.12


def clusters_of(xy: NDArray[np.floating[Any]], cell_m: float) -> NDArray[np.intp]:
    """Label (N,) the connected clusters of points (N, 2): neighbors are in touching cells, corners included."""
    from scipy.ndimage import label

    cell = np.floor((xy - xy.min(axis=0)) / cell_m).astype(np.intp)
    grid = np.zeros(cell.max(axis=0) + 1, dtype=bool)
    grid[cell[:, 0], cell[:, 1]] = True
    labels, _ = label(grid, structure=np.ones((3, 3), dtype=int))
    return np.asarray(labels[cell[:, 0], cell[:, 1]], dtype=np.intp) - 1


def select_cluster(xyz: NDArray[np.float32], uv: Array, range_m: Array, box_px: Array, category: str) -> Index:
    """Indices of the points that are the object, among the points (N, 3) inside its box; empty when none fits.

    Parameters
    ----------
    uv : (N, 2) pixels of the points
    range_m : (N,) distance from the sensor
    box_px : (4,) the detector's box

    Notes
    -----
    Every cluster of the points in the box spans a rectangle in the image. The object's own one fills the detector's box;
    what stands in front covers a part of it, and the background shows only around the object. Of clusters that fill the
    box alike the nearer one is the object.
    """
    none = np.zeros(0, dtype=np.intp)
    if len(xyz) < LEAST_POINTS:
        return none
    labels = clusters_of(xyz[:, :2], CELL_M[GROUP_OF[category]])
    order, count = np.argsort(labels, kind="stable"), np.bincount(labels)
    first = np.cumsum(count) - count
    enough = count >= LEAST_POINTS
    if not enough.any():
        return none
    span = np.concatenate(_ends(uv[order], first), axis=1)
    middle_m = _medians(range_m, labels, first, count)
    nearest_m = middle_m[enough].min()
    low, high = _ends(xyz[order, :2], first)
    unusual = enough & ((np.hypot(*(high - low).T) > LONGEST_M[category]) | (count > MOST_SCORED_POINTS))
    members = {int(g): order[first[g] : first[g] + count[g]] for g in np.flatnonzero(unusual)}
    for g, group in members.items():
        members[g] = cropped = within_length(xyz, group, range_m, LONGEST_M[category])
        sample = uv[subsample(cropped, MOST_SCORED_POINTS)]
        span[g] = np.concatenate([sample.min(axis=0), sample.max(axis=0)])
        middle_m[g] = np.median(range_m[cropped])
    fill = box_iou(span, box_px)[:, 0]
    score = np.where(enough & (fill >= LEAST_FILL), fill * np.sqrt(nearest_m / np.maximum(middle_m, 1e-3)), 0.0)
    best = int(np.argmax(score))
    if score[best] <= 0:
        return none
    return members[best] if best in members else order[first[best] : first[best] + count[best]]


def _ends(values: NDArray[Any], first: Index) -> tuple[NDArray[Any], NDArray[Any]]:
    """Smallest and largest values (G, 2), (G, 2) of consecutive groups of rows (N, 2) that begin at `first` (G,)."""
    return np.minimum.reduceat(values, first), np.maximum.reduceat(values, first)


def _medians(values: NDArray[Any], labels: Index, first: Index, count: Index) -> Array:
    """Median (G,) of the values (N,) of every label; each label's rows begin at `first` once sorted."""
    ordered = values[np.lexsort((values, labels))]
    return np.asarray((ordered[first + (count - 1) // 2] + ordered[first + count // 2]) / 2, dtype=np.float64)


def within_length(xyz: NDArray[np.float32], group: Index, range_m: Array, longest_m: float) -> Index:
    """Cut a cluster that is longer than its object can be around its nearer part."""
    xy = xyz[group, :2]
    if np.hypot(*(xy.max(axis=0) - xy.min(axis=0))) <= longest_m:
        return group
    near = group[range_m[group] <= np.quantile(range_m[group], 0.4)]
    center = np.median(xyz[near, :2], axis=0)
    kept = group[np.hypot(*(xyz[group, :2] - center).T) <= longest_m / 2]
    return kept if len(kept) >= LEAST_POINTS else near


def grow(xy_all: NDArray[np.float32], seed: NDArray[np.float32], category: str) -> Index:
    """Indices of all points (N, 2) connected to a seed cluster (n, 2), for an object that the image border cuts.

    Bounded by the category's longest size, so that it cannot run along a wall.
    """
    reach = LONGEST_M[category]
    center = np.median(seed, axis=0)
    near = np.flatnonzero(np.abs(xy_all[:, 0] - center[0]) <= reach)
    near = near[np.abs(xy_all[near, 1] - center[1]) <= reach]
    if len(near) == 0:
        return near
    labels = clusters_of(np.vstack([xy_all[near], seed]), CELL_M[GROUP_OF[category]])
    wanted = np.bincount(labels[len(near) :]).argmax()
    kept = near[labels[: len(near)] == wanted]
    return kept[np.hypot(*(xy_all[kept] - center).T) <= reach]
