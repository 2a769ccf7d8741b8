"""LiDAR clusters assigned to detection boxes, and people with too few points for a cluster.

A sensor with 32 layers has 2 to 6 points on a person at 20 to 30 m.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, TYPICAL_SIZE_M, groups_of
from log2sim.geometry import NS_PER_S, Array, apply, box_iou, undistort
from log2sim.perception.boxes import (
    MIN_SIDE_DISTANCE_M,
    azimuth_steps,
    oriented_covariance,
    rotate,
    subsample,
    upper_median,
)
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.projection import ProjectedPoints, View

Index = NDArray[np.intp]

CELL_M = {"vehicle": 0.4, "two_wheeler": 0.3, "pedestrian": 0.25, "other": 0.4}
MIN_CLUSTER_POINTS = 4
MAX_SCORED_POINTS = 400
# A cluster whose image rectangle overlaps the detection box less is an occluder or background.
MIN_IMAGE_IOU = 0.12
# Margin around a box, as a share of its sides, and the point density in it, relative to the cluster's, from which on the
# cluster counts as extending beyond the box.
MARGIN, MIN_DENSITY_RATIO = 0.15, 0.3
# Points of one side lie in a layer of this depth; a nearer side shows no flank. Between points of a side a ray may be lost.
SIDE_DEPTH_M, MAX_MISSED_RAYS = 0.2, 1.5
# Boxes with a higher IoU are duplicates and share points; a cluster of which a larger share is of another box is rejected.
DUPLICATE_IOU, MAX_FOREIGN_SHARE = 0.7, 0.5


def _cluster(xy: NDArray[np.floating[Any]], cell_m: float) -> tuple[NDArray[np.intp], Array, NDArray[Any]]:
    """Label (N,) the connected clusters of points (N, 2): points in adjacent grid cells, diagonals included, are connected.

    Returned with the lower corner (2,) of the grid, and the labels of its cells plus one, 0 where empty.
    """
    import cv2

    x, y = xy.T
    corner = np.array([x.min(), y.min()], dtype=xy.dtype) - cell_m
    i, j = ((values - low) / cell_m for values, low in zip((x, y), corner))
    i, j = i.astype(np.intp), j.astype(np.intp)
    grid = np.zeros((i.max() + 2, j.max() + 2), dtype=np.uint8)
    grid[i, j] = 1
    _, labels = cv2.connectedComponents(grid, connectivity=8, ltype=cv2.CV_16U)
    owner = np.asarray(labels)
    return owner[i, j].astype(np.intp) - 1, corner, owner


def candidate_clusters(
    xyz: NDArray[np.float32], uv: NDArray[np.floating[Any]], range_m: Array, box_px: Array, category: str
) -> list[tuple[Index, float]]:
    """Find the clusters inside a detection box that could be its object.

    `xyz`: (N, 3), m: points in the box and in a margin around it. `uv`: (N, 2): their pixels. `range_m`: (N,): their
    distances from the sensor. `box_px`: (4,): the detection box: u0, v0, u1, v1.

    Returns list of (indices (n,), score): the score, in (0, 1], is the IoU of the cluster's image rectangle with the box,
    times the square root of the ratio of the nearest cluster's range to its own.

    The rectangle of the object's own cluster fills the box; an occluder covers a part of it, and background is visible
    only around the object. Of clusters that fill the box equally the nearer one is the object. A cluster that extends
    beyond the box, such as a wall or a hedge, is left out.
    """
    import cv2

    u, v = uv.T
    inside = np.flatnonzero((u >= box_px[0]) & (u <= box_px[2]) & (v >= box_px[1]) & (v <= box_px[3]))
    if len(inside) < MIN_CLUSTER_POINTS:
        return []
    cell_m, longest_m = CELL_M[GROUP_OF[category]], MAX_SIZE_M[category][0]
    labels, corner, owner = _cluster(xyz[inside, :2], cell_m)
    # NumPy sorts 16-bit integers by radix.
    order, count = np.argsort(labels.astype(np.uint16), kind="stable"), np.bincount(labels)
    # Clusters that extend into the margin beyond two of the left, right and upper side of the box are structures.
    outside = np.flatnonzero(((u < box_px[0]) | (u > box_px[2]) | (v < box_px[1])) & (v <= box_px[3]))
    i, j = ((xyz[outside, axis] - corner[axis]) / cell_m for axis in (0, 1))
    on_grid = (i >= 0) & (i < owner.shape[0]) & (j >= 0) & (j < owner.shape[1])
    outside, i, j = outside[on_grid], i[on_grid].astype(np.intp), j[on_grid].astype(np.intp)
    next_to = cv2.dilate(owner, np.ones((3, 3)))[i, j].astype(np.intp) - 1
    sides, u, v = np.zeros(len(count), dtype=np.int64), u[outside], v[outside]
    within = (u >= box_px[0]) & (u <= box_px[2])
    for rows in (u < box_px[0], u > box_px[2], within & (v < box_px[1])):
        beyond = np.bincount(next_to[rows & (next_to >= 0)], minlength=len(count))
        sides += beyond >= np.maximum(MIN_DENSITY_RATIO * MARGIN * count, 3)
    enough = (count >= MIN_CLUSTER_POINTS) & (sides < 2)
    if not enough.any():
        return []
    first = np.cumsum(count) - count
    span = np.concatenate([end.reduceat(uv[inside[order]], first) for end in (np.minimum, np.maximum)], axis=1)
    low, high = (end.reduceat(xyz[inside[order], :2], first) for end in (np.minimum, np.maximum))
    middle_m = np.bincount(labels, range_m[inside]) / np.maximum(count, 1)
    nearest_m = middle_m[enough].min()
    members = {int(g): inside[order[first[g] : first[g] + count[g]]] for g in np.flatnonzero(enough)}
    too_long = np.hypot(*(high - low).T) > longest_m
    for g in np.flatnonzero(enough & (too_long | (count > MAX_SCORED_POINTS))).tolist():
        cropped = members[g]
        if too_long[g]:  # to half the length around the median of its nearest 40 %
            near = cropped[range_m[cropped] <= np.quantile(range_m[cropped], 0.4)]
            kept = cropped[np.hypot(*(xyz[cropped, :2] - np.median(xyz[near, :2], axis=0)).T) <= longest_m / 2]
            cropped = members[g] = kept if len(kept) >= MIN_CLUSTER_POINTS else near
        sample = uv[subsample(cropped, MAX_SCORED_POINTS)]
        span[g] = np.concatenate([sample.min(axis=0), sample.max(axis=0)])
        middle_m[g] = range_m[cropped].mean()
    fill = box_iou(span, box_px)[:, 0]
    score = fill * np.sqrt(nearest_m / np.maximum(middle_m, 1e-3))
    return [(points, float(score[g])) for g, points in members.items() if fill[g] >= MIN_IMAGE_IOU]


def assign_clusters(options: Sequence[Sequence[tuple[Index, float]]], boxes_px: Array, count: int) -> list[Index]:
    """Assign one cluster to each of K boxes.

    `options`: K sequences of (indices, score): candidate clusters of each box, see `candidate_clusters`. `boxes_px`: (K,
    4). `count`: number of points that the indices refer to.

    Returns K arrays (n,) of indices, empty for a box without a cluster.

    Greedy: the box whose best candidate has the most points is served first, and its points are taken from the candidates
    of other boxes, except of duplicate boxes. Of an occluded object only the points around its occluder remain.
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


def region_grow(xy_all: NDArray[np.float32], seed: NDArray[np.float32], category: str) -> Index:
    """Grow a seed cluster (n, 2) to all connected points (N, 2): their indices, for an object that the image border cuts.

    Limited to the longest extent of the category around the seed's median, so that it does not grow along a wall.
    """
    reach = MAX_SIZE_M[category][0]
    center = np.median(seed, axis=0)
    near = np.flatnonzero(np.abs(xy_all[:, 0] - center[0]) <= reach)
    near = near[np.abs(xy_all[near, 1] - center[1]) <= reach]
    if len(near) == 0:
        return np.zeros(0, dtype=np.intp)
    labels, _, _ = _cluster(np.vstack([xy_all[near], seed]), CELL_M[GROUP_OF[category]])
    wanted = np.bincount(labels[len(near) :]).argmax()
    kept = near[labels[: len(near)] == wanted]
    return np.asarray(kept[np.hypot(*(xy_all[kept] - center).T) <= reach])


def continued_sides(own: Array, others: Array, max_length_m: float, max_gap_m: float = np.inf) -> Index:
    """Find the points (2, m) that continue the sides of a cluster (2, n) where rays are far apart: their indices.

    `own`, `others`: (2, n), (2, m), m: along two of the sides, relative to the sensor. `max_length_m`: no side grows beyond it.
    `max_gap_m`: a wider gap ends a side also where rays are farther apart.

    The flank of a long vehicle is seen at so flat an angle that successive rays meet it farther apart than the cells of
    the clusters are: at 15 m along a flank 2.5 m aside, 0.4 degrees are 0.6 m.
    """
    step_rad = float(azimuth_steps(own.T, np.array([own.shape[1]]))[0])
    low, high = own.min(axis=1), own.max(axis=1)
    found = np.zeros(others.shape[1], dtype=bool)
    for axis in range(2):
        across = 1 - axis
        side_m = low[across] if low[across] > 0 else high[across] if high[across] < 0 else 0.0
        if abs(side_m) < MIN_SIDE_DISTANCE_M:
            continue
        on_side = np.flatnonzero(np.abs(others[across] - side_m) < SIDE_DEPTH_M)
        for sign, end in ((1.0, high[axis]), (-1.0, low[axis])):
            along = sign * others[axis].take(on_side)
            farthest = _walk(along, sign * end, step_rad, abs(side_m), max_gap_m)
            farthest = min(farthest, sign * end + max_length_m - (high[axis] - low[axis]))
            found[on_side[(along > sign * end) & (along <= farthest)]] = True
    return np.flatnonzero(found)


def _walk(along_m: Array, end_m: float, step_rad: float, side_m: float, max_gap_m: float) -> float:
    """Go on from an end over coordinates (m,) along a side at a distance, as long as the next is no farther than the next ray."""
    place_m = np.concatenate([[end_m], np.sort(along_m[along_m > end_m])])
    reach_m = np.minimum(MAX_MISSED_RAYS * step_rad * (side_m**2 + place_m[1:] ** 2) / side_m, max_gap_m)
    ends = np.flatnonzero(np.diff(place_m) > reach_m)
    return float(place_m[ends[0] if len(ends) else -1])


GROUPS_OF_FEW_POINTS = ("pedestrian", "two_wheeler")
# A single point may be dust or the edge of something else.
MIN_POINTS = 2
# Share of the box's width at either side in which points may be beside the body: sensors are aligned to about 0.05 degrees, which
# is 2 cm of 50 at 25 m.
SIDE_SHARE = 0.05
# Points of one body are nearer to each other in depth: half a stride.
MAX_DEPTH_GAP_M = 0.5
# Standard deviation of the heights of people (adults 0.07 m, DIN 33402-2, with half-grown children and the edges of the box), as
# a share, and how many of them a body may be off: 99 % of people.
HEIGHT_SIGMA_SHARE, MAX_HEIGHT_SIGMAS = 0.12, 2.5
# Standard deviations of the depth of a body behind its points, m, and of the box's middle, as a share of its width.
DEPTH_SIGMA_M, MIDDLE_SIGMA_SHARE = 0.15, 0.15
# From the front of a body to its middle, as a share of the typical width.
FRONT_SHARE = 0.25
# How far beside and above the box a wall or a pole is searched, in widths and in heights of the box.
BESIDE_SHARE, ABOVE_SHARE = 1.0, 0.25
# Points so near to those of another object belong to it.
OWNED_MARGIN_M = 0.1


@dataclass(frozen=True, eq=False)
class Shown:
    """Points above the ground that a frame shows and no 3D box owns."""

    view: View
    cloud: Cloud
    points: Index  # (n,): rows of the cloud that may be image boxes' objects
    columns_m: NDArray[np.float32]  # (3, n): the same as rows x, y, z, relative to the cloud's origin
    visible: ProjectedPoints  # which of them are in the image


def place_few_points(seen: Shown, columns: dict[str, Any], rows: Index, boxes_px: Array) -> None:
    """Place the people and riders among the rows (R,) of a frame who have no points of their own yet.

    `columns`: of `Measurements`, written to. `boxes_px`: (N, 4): all image boxes of the frame, which hide what is behind.

    A body is where two or more points inside its box have a depth at which the box is as high as a person. Points that go
    on at that depth on both sides of the box or above it belong to a wall, a fence or a pole.
    """
    small = np.isin(groups_of(columns["category"][rows]), GROUPS_OF_FEW_POINTS)
    wanted = rows[small & (columns["source"][rows] == "") & ~columns["truncated"][rows]]
    extended = rows[np.isfinite(columns["low_m"][rows, 0])]
    u, v, depth, index = seen.visible.u, seen.visible.v, seen.visible.depth, seen.points[seen.visible.index]
    for k in wanted.tolist():
        box_px, tall_m = columns["box_px"][k], TYPICAL_SIZE_M[str(columns["category"][k])][2]
        u0, v0, u1, v1 = box_px.tolist()
        # By how many sigma the heights of people at the depths are off, whose usual height fills the box.
        usual_m = np.float32(seen.view.camera.K[1, 1] * tall_m / (box_px[3] - box_px[1]))
        off = (depth / usual_m - 1) / HEIGHT_SIGMA_SHARE
        inner = np.abs(u - (u0 + u1) / 2) <= (0.5 - SIDE_SHARE) * (u1 - u0)
        inside = np.flatnonzero(inner & (v >= v0) & (v <= v1) & (np.abs(off) <= MAX_HEIGHT_SIGMAS))
        if len(inside) >= MIN_POINTS:  # without those within the extents of another object
            xy, free = seen.cloud.xyz[index[inside], :2] + seen.cloud.origin[:2], np.ones(len(inside), dtype=bool)
            for j in extended:
                local = rotate(xy - columns["sensor_m"][j, :2], -float(columns["yaw_rad"][j]))
                low, high = columns["low_m"][j] - OWNED_MARGIN_M, columns["high_m"][j] + OWNED_MARGIN_M
                free &= ~((local >= low) & (local <= high)).all(axis=1)
            inside = inside[free]
        if len(inside) < MIN_POINTS:
            continue
        # Points left, right and above that no other box shows but one as wide.
        beside, above = BESIDE_SHARE * (u1 - u0), ABOVE_SHARE * (v1 - v0)
        around = np.flatnonzero((u >= u0 - beside) & (u <= u1 + beside) & (v >= v0 - above) & (v <= v1))
        around = around[(u[around] < u0) | (u[around] > u1) | (v[around] < v0)]
        for a0, b0, a1, b1 in boxes_px.tolist():
            if not (a0 <= u0 and a1 >= u1):
                ua, va = u[around], v[around]
                around = around[~((ua >= a0) & (ua <= a1) & (va >= b0) & (va <= b1))]
        inside = inside[np.argsort(depth[inside], kind="stable")]
        bodies = dict[float, Index]()  # by their likelihood; of equally likely ones the first
        for body in np.split(inside, np.flatnonzero(np.diff(depth[inside]) > MAX_DEPTH_GAP_M) + 1):
            if len(body) < MIN_POINTS:
                continue
            low_m, high_m = depth[body].min() - MAX_DEPTH_GAP_M, depth[body].max() + MAX_DEPTH_GAP_M
            same = around[(depth[around] >= low_m) & (depth[around] <= high_m)]
            left, right, over = u[same] < box_px[0], u[same] > box_px[2], v[same] < box_px[1]
            if not (left.any() and right.any()) and not (over & ~left & ~right).any():
                bodies.setdefault(float(np.log(len(body)) - off[body].mean() ** 2 / 2), body)
        if bodies:
            _write(columns, k, seen, bodies[max(bodies)])


def _write(columns: dict[str, Any], k: int, seen: Shown, chosen: Index) -> None:
    """Write the place of a body into row `k`: along the middle of its image box, as deep as its points in the image."""
    view, cloud, members = seen.view, seen.cloud, seen.points[seen.visible.index[chosen]]
    box, camera, category = columns["box_px"][k], view.camera, str(columns["category"][k])
    front_m = float(seen.visible.depth[chosen].mean())
    middle = undistort(camera, np.array([[(box[0] + box[2]) / 2, (box[1] + box[3]) / 2]]))[0]
    if not np.isfinite(middle).all():
        return
    front = apply(view.map_T_cam, np.append(middle, 1.0)[None] * front_m)[0]
    ray = (front - view.map_T_cam[:3, 3])[:2]
    yaw = float(np.arctan2(ray[1], ray[0]))
    xyz = cloud.xyz[members].astype(np.float64)
    bottom_m = float(upper_median(xyz[:, 2] - cloud.height[members]) + cloud.origin[2])
    tall_m = float((box[3] - box[1]) * front_m / camera.K[1, 1])
    behind = FRONT_SHARE * TYPICAL_SIZE_M[category][1] * np.array([np.cos(yaw), np.sin(yaw)])
    across_m = MIDDLE_SIGMA_SHARE * (box[2] - box[0]) * front_m / camera.K[0, 0]
    columns["center_m"][k] = [*(front[:2] + behind), bottom_m + tall_m / 2]
    columns["covariance"][k] = oriented_covariance(np.array([DEPTH_SIGMA_M, max(across_m, DEPTH_SIGMA_M)]), yaw)
    columns["bottom_m"][k], columns["top_m"][k], columns["height_px_m"][k] = bottom_m, bottom_m + tall_m, tall_m
    columns["points"][k], columns["source"][k] = len(members), "lidar"
    columns["seen_by"][k] |= cloud.ends_of(members)
    columns["t_ns"][k] = cloud.stamp_ns + round(float(cloud.t_s[members].mean()) * NS_PER_S)
    columns["sensor_m"][k] = cloud.sensor + cloud.origin
