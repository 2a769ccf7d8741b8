"""Boxes from the maps of a network: one for every cluster of cells by where they vote their object's center to be.

Zou, Guo, Chen and Yuan (2021) segment the cells of a roadside LiDAR's grid, let each cell of an object point to its center,
and cluster the votes by mean shift with a Gaussian kernel; majority decides the class of a cluster.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUPS, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M
from log2sim.geometry import Array
from log2sim.perception.detect3d.level_boxes import (
    MAX_OFFSET_M,
    LevelBoxes,
    MapCells,
    boxes_of_cells,
    cells_around,
)
from log2sim.perception.detect3d.network import NetworkInfo

# Cells of the ground and its roughness; the lowest hoods and saddles are higher.
MIN_TOP_M = 0.3
# Cells of the grid of votes in a bandwidth: fine enough that a step of mean shift is not lost to rounding.
CELLS_PER_BANDWIDTH = 2
KERNEL_BANDWIDTHS = 3
MAX_STEPS = 50
# Heights are regressed with errors of a few percent; limits of categories are generous already.
HEIGHT_TOLERANCE = 1.25
MIN_SCORE = 0.5
"""Least mean probability of a cluster's class: without it the class would not be that of the majority."""


def decode_votes(maps: NDArray[np.float32], grid: NDArray[np.float32], info: NetworkInfo, low: Array) -> LevelBoxes:
    """Decode one box for each cluster of votes; the logit of its mean class probability stands for heat.

    Parameters
    ----------
    maps : (C, h, w) float32
        Output of the network.
    grid : (12, H, W) float32
        Its input, by whose greatest heights cells of the ground and empty ones are left out.
    low : (2,) float64, m
        Lower corner of both.

    Notes
    -----
    The box is that which the network regresses around the middle of the cluster: only there is it taught, and the mean
    over all cells of the cluster is much worse.
    """
    flat, probability = foreground(maps, grid, info)
    cells = MapCells.at(maps, flat, info, low)
    vote = cells.middle_m + np.clip(cells.values[info.channels.vote].T, -MAX_OFFSET_M, MAX_OFFSET_M)
    valid = np.flatnonzero(np.isfinite(cells.values).all(axis=0))
    vote, probability = vote[valid], probability[:, valid]
    label = cluster(vote, probability.argmax(axis=0), bandwidths_m(info))
    center, group, mean = summarize(vote, probability, label)
    i, j = np.floor((center - low) / (info.stride * info.cell_m)).astype(np.intp).T
    h, w = maps.shape[1:]
    middle = np.clip(i, 0, h - 1) * w + np.clip(j, 0, w - 1)
    logit = np.log(mean) - np.log1p(-np.minimum(mean, 1 - 1e-12))
    found = boxes_of_cells(cells_around(maps, middle, group, info, low), group, logit, info)
    return found.take(usual_height(found, info))


def foreground(
    maps: NDArray[np.float32], grid: NDArray[np.float32], info: NetworkInfo
) -> tuple[NDArray[np.intp], Array]:
    """Find cells of road users: flat indices (n,) and the probability (G, n) of each group."""
    segment = maps[info.channels.segment].reshape(len(info.groups) + 1, -1)
    step = info.stride
    corners = [grid[0, i::step, j::step] for i in range(step) for j in range(step)]
    high = np.flatnonzero(np.maximum.reduce(corners) > MIN_TOP_M / 2)
    seen = segment.take(high, axis=1)
    flat = high[seen[1:].max(axis=0) > seen[0]]
    logits = segment[:, flat].astype(np.float64)
    weight = np.exp(logits - logits.max(axis=0))
    return flat, weight[1:] / weight.sum(axis=0)


def bandwidths_m(info: NetworkInfo) -> Array:
    """Choose the bandwidth of each group (G,), m: half the typical width of its narrowest category.

    Notes
    -----
    Centers of two objects side by side are at least a width apart; the paper does not give its bandwidth.
    """
    return np.array([min(TYPICAL_SIZE_M[name][1] for name in info.categories[group]) / 2 for group in info.groups])


def cluster(vote: Array, group: NDArray[np.intp], bandwidth_m: Array) -> NDArray[np.intp]:
    """Cluster votes (n, 2), m, by mean shift, each group (n,) with its own bandwidth (G,), then across groups.

    Returns
    -------
    (n,) int
        Clusters, numbered from 0.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    modes, widths, of_vote, total = [], [], np.zeros(len(vote), np.intp), 0
    for k, width in enumerate(bandwidth_m):
        rows = np.flatnonzero(group == k)
        if len(rows):
            found, index = mean_shift(vote[rows], float(width))
            of_vote[rows] = index + total
            total += len(found)
            modes.append(found)
            widths.append(np.full(len(found), width))
    if total < 2:
        return of_vote
    mode, reach = np.concatenate(modes), np.concatenate(widths)
    pairs = cKDTree(mode).query_pairs(reach.max(), output_type="ndarray")
    i, j = pairs.T
    near = np.hypot(*(mode[i] - mode[j]).T) < np.minimum(reach[i], reach[j])
    links = coo_array((np.ones(near.sum()), (i[near], j[near])), shape=(total, total))
    joined = connected_components(links, directed=False)[1]
    return np.asarray(joined[of_vote], dtype=np.intp)


def mean_shift(vote: Array, bandwidth_m: float) -> tuple[Array, NDArray[np.intp]]:
    """Let votes (n, 2), m, climb to the modes of their density.

    Returns
    -------
    modes : (K, 2) float64, m
    index : (n,) int
        The mode of each vote.

    Notes
    -----
    Kernel-weighted means are computed once, on a grid: three blurs instead of a sum over neighbors at every step, in time
    that does not depend on how dense the votes are. Every cell then points to the cell of its mean.
    """
    import cv2

    side = bandwidth_m / CELLS_PER_BANDWIDTH
    radius = KERNEL_BANDWIDTHS * CELLS_PER_BANDWIDTH
    corner = vote.min(axis=0) - radius * side
    place = (vote - corner) / side
    shape = tuple((place.max(axis=0) + radius + 1).astype(int))
    start = place[:, 0].astype(np.intp) * shape[1] + place[:, 1].astype(np.intp)
    maps = [np.bincount(start, weights, minlength=shape[0] * shape[1]) for weights in (None, *place.T)]
    density, x, y = (
        cv2.GaussianBlur(
            m.reshape(shape).astype(np.float32), (2 * radius + 1, 2 * radius + 1), CELLS_PER_BANDWIDTH,
            borderType=cv2.BORDER_CONSTANT,
        ).ravel()
        for m in maps
    )  # fmt: skip
    cell, index = np.unique(start, return_inverse=True)
    for _ in range(MAX_STEPS):
        mean = np.stack([x[cell], y[cell]], axis=1).astype(np.float64) / density[cell, None]
        following = mean[:, 0].astype(np.intp) * shape[1] + mean[:, 1].astype(np.intp)
        if np.array_equal(following, cell):
            break
        cell = following
    ends, inverse = np.unique(cell, return_inverse=True)
    mode = np.stack([x[ends], y[ends]], axis=1).astype(np.float64) / density[ends, None]
    return mode * side + corner, inverse[index]


def summarize(vote: Array, probability: Array, label: NDArray[np.intp]) -> tuple[Array, NDArray[np.intp], Array]:
    """Find center, class and class probability of each of K clusters.

    Parameters
    ----------
    vote : (n, 2) float64, m
    probability : (G, n) float64
    label : (n,) int
        Cluster of each vote.

    Returns
    -------
    center : (K, 2) float64, m
        Mean vote of the cells of the cluster's class, weighted by its probability.
    group : (K,) int
        The class that most cells have, each counted by its probability.
    mean : (K,) float64
        Mean probability of that class over all cells.
    """
    count = int(label.max(initial=-1)) + 1
    best = probability.argmax(axis=0)
    support = [np.bincount(label, p * (best == k), minlength=count) for k, p in enumerate(probability)]
    group = np.argmax(support, axis=0)
    of_class = probability[group[label], np.arange(len(label))]
    mean = np.bincount(label, of_class, minlength=count) / np.bincount(label, minlength=count)
    weight = np.where(best == group[label], of_class, 0.0)
    total = np.bincount(label, weight, minlength=count)
    center = np.stack([np.bincount(label, weight * v, minlength=count) / total for v in vote.T], axis=1)
    return center, group, mean


def usual_height(found: LevelBoxes, info: NetworkInfo) -> NDArray[np.bool_]:
    """Mark the boxes (M,) whose height is between the limits of their group."""
    limits = [(min(MIN_SIZE_M[n][2] for n in GROUPS[g]), max(MAX_SIZE_M[n][2] for n in GROUPS[g])) for g in info.groups]
    low, high = np.array(limits)[found.group].T
    height = found.size_m[:, 2]
    return np.asarray((height >= low / HEIGHT_TOLERANCE) & (height <= high * HEIGHT_TOLERANCE))
