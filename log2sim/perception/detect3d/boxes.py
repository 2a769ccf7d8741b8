"""Boxes from the maps of a network, by centers or by votes, and the suppression of weaker ones.

Zou, Guo, Chen and Yuan (2021) segment the cells of a roadside LiDAR's grid, let each cell of an object point to its center,
and cluster the votes by mean shift with a Gaussian kernel; majority decides the class of a cluster.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUPS, MAX_SIZE_M, MIN_SIZE_M, TYPICAL_SIZE_M
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, rectangle_overlap, wrap_angle
from log2sim.perception.detect3d.network import NetworkInfo, ScoreInfo

# Road users do not share ground; estimates of neighbors overlap by a little where sizes and headings are off.
MAX_IOU = 0.2
# A person inside a car, or a rider counted as a person too: most of the smaller box is on the larger one's ground.
MAX_OVERLAP_OF_SMALLER = 0.5
# Slender boxes of one object that cross share little area. Objects of one group keep half a width between their centers.
MIN_DISTANCE_WIDTHS = 0.5


def suppress(boxes: Array, score: Array, group: NDArray[Any], *, across: bool = True) -> NDArray[np.intp]:
    """Choose the boxes that no stronger chosen one excludes.

    `boxes`: (M, 5): x, y, length, width, yaw. `score`: (M,). `group`: (M,): boxes of one group exclude each other by IoU and by
    the distance of their centers, others by the part of the smaller one that they share. `across`: whether boxes of different
    groups exclude each other at all.

    Returns (K,) int: indices of the chosen boxes, best score first; ties by place, whatever the order of the input.
    """
    from scipy.spatial import cKDTree

    order = np.lexsort((boxes[:, 1], boxes[:, 0], -score))
    if len(order) < 2:
        return order
    boxes, group, kept = boxes[order], group[order], np.ones(len(order), dtype=bool)
    reach, area = np.hypot(boxes[:, 2], boxes[:, 3]) / 2, boxes[:, 2] * boxes[:, 3]
    pairs = np.sort(cKDTree(boxes[:, :2]).query_pairs(2 * reach.max(), output_type="ndarray"), axis=1)
    i, j = pairs[np.lexsort(pairs.T[::-1])].T
    away, same = np.hypot(*(boxes[i, :2] - boxes[j, :2]).T), group[i] == group[j]
    near = (away < reach[i] + reach[j]) & (same | across)
    i, j, away, same = i[near], j[near], away[near], same[near]
    excluded = same & (away < MIN_DISTANCE_WIDTHS * (boxes[i, 3] + boxes[j, 3]) / 2)
    # Areas are asked for last: most pairs are decided by now.
    left = np.flatnonzero(~excluded)
    shared, area_i, area_j = rectangle_overlap(boxes[i[left]], boxes[j[left]]), area[i[left]], area[j[left]]
    of_group = MAX_IOU * (area_i + area_j - shared)
    limit = np.where(same[left], of_group, MAX_OVERLAP_OF_SMALLER * np.minimum(area_i, area_j))
    excluded[left] = shared > limit
    for stronger, weaker in zip(i[excluded].tolist(), j[excluded].tolist()):
        kept[weaker] &= not kept[stronger]
    return np.asarray(order[kept], dtype=np.intp)


# Limits of what a network may say of a box: beyond them it is of no use, and exponentials overflow.
MIN_SIDE_M, MAX_SIDE_M = 0.1, 30.0
MAX_OFFSET_M = 15.0
MIN_CENTER_HEIGHT_M, MAX_CENTER_HEIGHT_M = -1.0, 5.0
MAX_LOGIT = 30.0
# Cells on each side of a center whose boxes are averaged: 0.5 m, within which boxes are taught for all but the slimmest.
AROUND_CELLS = 1
# Centers this part of a width apart may be of one object.
SAME_CENTER_WIDTHS = 0.5
# Cells whose heat is a smaller part of the center's are of the background, where no box is taught.
MIN_HEAT_SHARE = 0.1


@dataclass(frozen=True, eq=False)
class LevelBoxes(Columns):
    """M boxes; x and y along the map's axes, z above the ground."""

    center_m: Array  # `center_m`, `size_m`: (M, 3)
    size_m: Array
    yaw_rad: Array  # (M,)
    heading_score: Array  # (M,): probability in [0.5, 1] that front and back are not swapped
    group: NDArray[np.intp]  # (M,): index into the network's groups
    category: NDArray[np.str_]  # (M,)
    heat: Array  # `heat`, `quality`: (M,): logits of the object being there, and of the expected IoU
    quality: Array

    @property
    def rectangles(self) -> Array:
        """The boxes seen from above (M, 5): x, y, length, width, yaw."""
        return np.column_stack([self.center_m[:, :2], self.size_m[:, :2], self.yaw_rad])

    def terms(self, points: NDArray[Any], range_m: Array) -> Array:
        """Return what the score is computed from: (5, M), the terms of `NetworkInfo.calibration`.

        `points`: (M,): number in each box. `range_m`: (M,): distance of the centers from the sensor in the plane.
        """
        return np.stack([np.ones(len(self)), self.heat, self.quality, np.log1p(points), range_m / 10.0])

    def score(self, info: ScoreInfo, terms: Array) -> Array:
        """Compute the probability (M,) that each box is right from the first terms of the calibration, (up to 5, M)."""
        weights = np.array([info.calibration[group] for group in info.groups])[self.group, : len(terms)]
        return sigmoid((weights.T * terms).sum(axis=0))


@dataclass(frozen=True, eq=False)
class MapCells:
    """Values of the maps at K cells, or means of several cells each: all channels are such that means make sense."""

    middle_m: Array  # (K, 2): middles of the cells
    values: Array  # (C, K): all channels

    @classmethod
    def at(cls, maps: NDArray[np.float32], flat: NDArray[np.intp], info: NetworkInfo, low: Array) -> MapCells:
        """Gather the cells at flat indices (K,) of maps (C, h, w) whose lower corner is at `low` (2,), m."""
        i, j = np.divmod(flat, maps.shape[2])
        middle = np.asarray(low) + (np.stack([i, j], axis=1) + 0.5) * (info.stride * info.cell_m)
        return cls(middle, maps.reshape(len(maps), -1).take(flat, axis=1).astype(np.float64))

    def means(self, weight: Array) -> MapCells:
        """Average cells that follow each other by weights (K, n), K n of them; NaN where none has a weight.

        Cells with a value that is not finite count for nothing.
        """
        rows = np.concatenate([self.middle_m.T, self.values])
        rows = rows.reshape(len(rows), *weight.shape)
        weight = np.where(np.isfinite(rows).all(axis=0), weight, 0.0)
        with np.errstate(invalid="ignore"):
            mean = np.einsum("rkn,kn->rk", np.where(weight > 0, rows, 0.0), weight) / weight.sum(axis=1)
        return MapCells(mean[:2].T, mean[2:])


def cells_around(
    maps: NDArray[np.float32], flat: NDArray[np.intp], group: NDArray[np.intp], info: NetworkInfo
) -> tuple[NDArray[np.intp], Array]:
    """Return flat indices (K, 9) of cells (K,) and those around, themselves in the middle, and logits of the heat for their groups (K,).

    `maps` is as for `MapCells.at`. Logits are minus infinity for cells that regress another center, or are outside, whose index is 0.
    """
    h, w = maps.shape[1:]
    step = np.arange(-AROUND_CELLS, AROUND_CELLS + 1)
    di, dj = (d.ravel() for d in np.meshgrid(step, step, indexing="ij"))
    i, j = flat[:, None] // w + di, flat[:, None] % w + dj
    inside = (i >= 0) & (i < h) & (j >= 0) & (j < w)
    around = np.where(inside, i * w + j, 0)
    x, y, _, _, width, _ = maps[info.channels.box].reshape(6, -1)
    side_m = np.float32(info.stride * info.cell_m)
    with np.errstate(over="ignore", invalid="ignore"):
        dx, dy = (v[around] - v[flat, None] + d * side_m for v, d in ((x, di), (y, dj)))
        same = np.hypot(dx, dy) < SAME_CENTER_WIDTHS * np.exp(width[flat, None])
    logits = maps[info.channels.heat].reshape(len(info.groups), -1)[group[:, None], around]
    return around, np.where(inside & same, logits, -np.inf).astype(np.float64)


def mean_cells(
    maps: NDArray[np.float32], around: NDArray[np.intp], logits: Array, info: NetworkInfo, low: Array
) -> MapCells:
    """Average the cells around cells by their heat, with indices and logits (K, 9) of `cells_around`."""
    heat = sigmoid(logits)
    weight = np.where(np.isfinite(logits) & (heat >= MIN_HEAT_SHARE * heat[:, [heat.shape[1] // 2]]), heat, 0.0)
    return MapCells.at(maps, around.ravel(), info, low).means(weight)


def boxes_of_cells(cells: MapCells, group: NDArray[np.intp], heat: Array, info: NetworkInfo) -> LevelBoxes:
    """Decode the box that each cell (K,) regresses for its group (K,); boxes that are not finite are left out.

    `heat`: (K,): logit of the object being there.
    """
    channels, values = info.channels, cells.values
    box = values[channels.box]
    offset = np.clip(box[:2].T, -MAX_OFFSET_M, MAX_OFFSET_M)
    height = np.clip(box[2:3].T, MIN_CENTER_HEIGHT_M, MAX_CENTER_HEIGHT_M)
    size = np.exp(np.clip(box[3:6].T, np.log(MIN_SIDE_M), np.log(MAX_SIDE_M)))
    yaw, heading_score = headings(values[channels.axis], values[channels.direction])
    # The most probable category within the group.
    category, places = np.empty(len(group), dtype="<U16"), channels.category
    for k, name in enumerate(info.groups):
        rows, names = np.flatnonzero(group == k), np.array(info.categories[name], dtype="<U16")
        category[rows] = names[values[places[name]][:, rows].argmax(axis=0)] if name in places else names[0]
    found = LevelBoxes(
        np.concatenate([cells.middle_m + offset, height], axis=1),
        size,
        yaw,
        heading_score,
        group,
        category,
        np.clip(heat, -MAX_LOGIT, MAX_LOGIT),
        np.clip(values[channels.quality], -MAX_LOGIT, MAX_LOGIT),
    )
    columns = [found.center_m.T, found.size_m.T, found.yaw_rad, found.heading_score, found.heat, found.quality]
    return found.take(np.flatnonzero(np.isfinite(np.vstack(columns)).all(axis=0)))


def headings(axis: Array, direction: Array) -> tuple[Array, Array]:
    """Compute yaw over the full circle from its axis and its direction.

    `axis`: (2, K): sine and cosine of twice the yaw, which do not tell front from back. `direction`: (2, K): sine and
    cosine of the yaw, averaged over what the yaw may be: 2 p - 1 times the unit vector where the front is there with
    probability p.

    Returns `yaw_rad`: (K,); `heading_score`: (K,): probability in [0.5, 1] that front and back are not swapped.
    """
    yaw = np.arctan2(axis[0], axis[1]) / 2
    along = direction[0] * np.sin(yaw) + direction[1] * np.cos(yaw)
    turned = np.asarray(wrap_angle(np.where(along < 0, yaw + np.pi, yaw)), dtype=np.float64)
    return turned, (1 + np.minimum(np.abs(along), 1.0)) / 2


def sigmoid(logit: Array) -> Array:
    """Compute probabilities from logits."""
    return np.asarray(1 / (1 + np.exp(-np.clip(logit, -MAX_LOGIT, MAX_LOGIT))), dtype=np.float64)


# Fainter peaks are so hardly ever objects that average precision is the same without them.
MIN_HEAT = 0.1
# More than the road users in a sweep: with 200 the recall of random traffic is 0.002 lower, with 500 it is the same.
MAX_PEAKS = 300


def decode_centers(maps: NDArray[np.float32], info: NetworkInfo, low: Array) -> LevelBoxes:
    """Decode the boxes at the peaks of the heat, strongest first, not yet scored nor suppressed.

    `maps`: (C, h, w): output of the network. `low`: (2,), m: lower corner of the maps.

    Zhou, Wang and Kraehenbuehl (2019), "Objects as Points": a cell of the greatest heat among its eight neighbors is an
    object's center; here among those that regress the same center, as people side by side are in neighboring cells. Networks are taught an
    object's box in the cells around its center too; the mean over those that mean the same object errs less than the box of a single cell.
    """
    heat = maps[info.channels.heat].reshape(len(info.groups), -1)
    group, flat = np.nonzero(heat >= np.float32(np.log(MIN_HEAT / (1 - MIN_HEAT))))
    around, logits = cells_around(maps, flat, group, info)
    own = heat[group, flat].astype(np.float64)
    peak = np.flatnonzero(~(logits > own[:, None]).any(axis=1))
    peak = peak[np.argsort(-own[peak], kind="stable")[:MAX_PEAKS]]
    return boxes_of_cells(mean_cells(maps, around[peak], logits[peak], info, low), group[peak], own[peak], info)


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

    `maps`: (C, h, w): output of the network. `grid`: (12, H, W): its input, by whose greatest heights cells of the ground
    and empty ones are left out. `low`: (2,), m: lower corner of both.

    The box is that which the network regresses around the middle of the cluster: only there is it taught, and the mean
    over all cells of the cluster is much worse.
    """
    # Cells of road users, and the probability (G, n) of each group.
    segment, step = maps[info.channels.segment].reshape(len(info.groups) + 1, -1), info.stride
    highest = np.maximum.reduce([grid[0, i::step, j::step] for i in range(step) for j in range(step)])
    high = np.flatnonzero(highest > MIN_TOP_M / 2)
    seen = segment.take(high, axis=1)
    flat = high[seen[1:].max(axis=0) > seen[0]]
    logits = segment[:, flat].astype(np.float64)
    weight = np.exp(logits - logits.max(axis=0))
    probability = weight[1:] / weight.sum(axis=0)
    cells = MapCells.at(maps, flat, info, low)
    vote = cells.middle_m + np.clip(cells.values[info.channels.vote].T, -MAX_OFFSET_M, MAX_OFFSET_M)
    valid = np.flatnonzero(np.isfinite(cells.values).all(axis=0))
    vote, probability = vote[valid], probability[:, valid]
    # Centers of two objects side by side are at least a width apart; the paper does not give its bandwidth. Half the typical
    # width of a group's narrowest category is taken.
    bandwidth_m = [min(TYPICAL_SIZE_M[name][1] for name in info.categories[group]) / 2 for group in info.groups]
    label = cluster(vote, probability.argmax(axis=0), np.array(bandwidth_m))
    center, group, mean = summarize(vote, probability, label)
    i, j = np.floor((center - low) / (info.stride * info.cell_m)).astype(np.intp).T
    h, w = maps.shape[1:]
    middle = np.clip(i, 0, h - 1) * w + np.clip(j, 0, w - 1)
    logit = np.log(mean) - np.log1p(-np.minimum(mean, 1 - 1e-12))
    cells = mean_cells(maps, *cells_around(maps, middle, group, info), info, low)
    found = boxes_of_cells(cells, group, logit, info)
    limits = [(min(MIN_SIZE_M[n][2] for n in GROUPS[g]), max(MAX_SIZE_M[n][2] for n in GROUPS[g])) for g in info.groups]
    (least, most), height = np.array(limits)[found.group].T, found.size_m[:, 2]
    return found.take((height >= least / HEIGHT_TOLERANCE) & (height <= most * HEIGHT_TOLERANCE))


def cluster(vote: Array, group: NDArray[np.intp], bandwidth_m: Array) -> NDArray[np.intp]:
    """Cluster votes (n, 2), m, by mean shift, each group (n,) with its own bandwidth (G,), then across groups.

    Returns (n,) int: clusters, numbered from 0.
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

    Returns `modes`: (K, 2), m; `index`: (n,): the mode of each vote.

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

    `vote`: (n, 2), m. `probability`: (G, n). `label`: (n,): cluster of each vote.

    Returns `center`: (K, 2), m: mean vote of the cells of the cluster's class, weighted by its probability; `group`: (K,):
    the class that most cells have, each counted by its probability; `mean`: (K,): mean probability of that class over all
    cells.
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
