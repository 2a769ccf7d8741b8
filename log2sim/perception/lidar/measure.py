"""Measurement: the LiDAR points inside the 3D boxes and the image boxes of one tick are the evidence for objects.

3D boxes come first. Those that an image box shows, too, take their points; only image boxes without a partner are clustered, in
the points that are left. A pair is judged by the score in the image, the score in the sweep and the IoU of the image box with
the projected 3D box, as in Pang, Morris & Radha, "CLOCs: Camera-LiDAR Object Candidates Fusion for 3D Object Detection" (IROS
2020); in place of their network a logistic function is fitted to these three (`tools/fit.py late_fusion`).

Mode "paper" follows Bhardwaj & Kalra in image boxes: depth of the point nearest to the box center, extents of all points in the
box. Mode "robust" removes the ground, assigns a cluster to every box, and measures the cluster's oriented extents and which of
their ends are ends of the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import (
    GROUP_OF,
    MAX_SIZE_M,
    RELATED_GROUPS,
    TYPICAL_SIZE_M,
    Boxes3D,
    Detections,
    Log,
    Measurements,
    OtherView,
    end_of,
    groups_of,
    seen_from,
)
from log2sim.datatypes.log_odds import MAX_PROBABILITY, MIN_PROBABILITY, log_odds_of, probability_of
from log2sim.geometry import NS_PER_S, Array, Camera, box_iou
from log2sim.perception.boxes import (
    TOP_QUANTILE,
    correct_yaws,
    fit_extents_of_clusters,
    fit_yaw,
    place_boxes,
    quantile_of_clusters,
    rotate,
    sample_surfaces,
    sort_clusters,
    upper_median,
)
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.clusters import (
    MARGIN,
    MIN_CLUSTER_POINTS,
    Index,
    Shown,
    assign_clusters,
    candidate_clusters,
    continued_sides,
    place_few_points,
    region_grow,
)
from log2sim.perception.lidar.projection import View, points_in_image_boxes, project_boxes_in_view, project_points

Frame = tuple[View, Detections, "Cloud | None"]
"""A frame with its image boxes, and the cloud nearest in time, None without one."""


def measure(
    frames: Sequence[Frame], boxes: Boxes3D | None = None, sweep: Cloud | None = None, *, mode: str = "robust"
) -> Measurements:
    """Measure the image boxes and the 3D boxes of one tick: one row for each object, also where both show it.

    `boxes`: what a detector found in `sweep`; None where none searched it. `mode`: of image boxes: "robust" or "paper".

    Returns Measurements: rows of the 3D boxes, then those of the image boxes without a partner in the order of the frames;
    without LiDAR points these have no position.
    """
    searched = boxes is not None and sweep is not None
    boxes = boxes if boxes is not None and sweep is not None else Boxes3D.empty()
    images, frame = _rows_of_images(frames)
    pairs = match_boxes(boxes, images, frame, [view for view, _, _ in frames])
    alone = np.setdiff1d(np.arange(len(images)), pairs.image)
    rows, own = images.take(alone), list[Index]()
    frame = np.concatenate([np.full(len(boxes), -1), frame[alone]])
    if sweep is not None and len(boxes):
        # Where each box is at the times of the points of a viewpoint.
        found_in = [_members(follow_box(boxes, part) if sweep.parts else boxes, part) for part in sweep.views]
        first = np.cumsum([0, *(len(part.xyz) for part in sweep.views)])
        own = [np.concatenate([start + of[k] for start, of in zip(first, found_in)]) for k in range(len(boxes))]
        # With too few points a row keeps the position of its box. It is seen from the nearest viewpoint.
        places = np.array([view.sensor + view.origin for view in sweep.views])
        away = np.hypot(*(boxes.center_m[:, None, :2] - places[:, :2]).transpose(2, 0, 1))
        seen_by = np.array([sweep.ends_of(index) for index in own], dtype=bool)
        of_boxes = replace(
            Measurements.from_boxes(boxes, sweep.sensor + sweep.origin),
            yaw_rad=boxes.yaw_rad,
            points=boxes.points,
            bottom_m=boxes.center_m[:, 2] - boxes.size_m[:, 2] / 2,
            top_m=boxes.center_m[:, 2] + boxes.size_m[:, 2] / 2,
            sensor_m=places[away.argmin(axis=1)],
            seen_by=seen_by if boxes.seen_by is None else seen_by | boxes.seen_by,
        )
        rows = Measurements.join([of_boxes, rows])
    columns: dict[str, Any] = vars(rows) | {"cluster": list(rows.cluster), "others": [None] * len(rows)}
    # The points of rows, by the cloud in which these were sought.
    found: dict[int, tuple[Cloud, dict[int, Index]]] = {}
    if sweep is not None:
        found[id(sweep)] = sweep, {k: members for k, members in enumerate(own) if len(members) >= MIN_CLUSTER_POINTS}
    # The obstacles of each cloud but those that boxes with an image own, and the same as rows x, y, z (3, n).
    owned: dict[int, NDArray[np.bool_]] = {}
    if sweep is not None and len(pairs.box):
        mask = np.zeros(len(sweep.xyz), dtype=bool)
        mask[np.concatenate([own[k] for k in np.unique(pairs.box)])] = True
        edges = np.cumsum([len(part.xyz) for part in sweep.views])[:-1]
        owned = {id(part): of_part for part, of_part in zip(sweep.views, np.split(mask, edges))}
    free = {}
    for one in {id(cloud): cloud for _, _, cloud in frames if cloud is not None}.values():
        free[id(one)] = one.obstacles, one.obstacle_columns
        if any(id(part) in owned for part in one.views):
            masks = [owned.get(id(part), np.zeros(len(part.xyz), dtype=bool)) for part in one.views]
            left = ~np.concatenate(masks)[one.obstacles]
            free[id(one)] = one.obstacles[left], one.obstacle_columns.compress(left, axis=1)
    shown = list[tuple[Shown, Index, Array]]()
    for k, (view, detections, cloud) in enumerate(frames):
        of_frame = np.flatnonzero(frame == k)
        if cloud is not None and len(of_frame) and mode == "robust":
            points, columns_m = free[id(cloud)]
            seen = Shown(view, cloud, points, columns_m, project_points(view, cloud.origin, columns_m))
            found.setdefault(id(cloud), (cloud, {}))[1].update(_cluster_boxes(seen, of_frame, columns))
            shown.append((seen, of_frame, detections.box_px))
    for cloud, members in found.values():
        write_evidence(columns, list(members), list(members.values()), cloud)
    columns |= vars(place_boxes(Measurements(**columns)))
    for seen, of_frame, boxes_px in shown:
        place_few_points(seen, columns, of_frame, boxes_px)
    for n, (view, _, cloud) in enumerate(frames if mode == "paper" else ()):
        if cloud is None:
            continue
        # The depth of the point nearest to the box center, and the extents of all points in the box.
        of_frame = np.flatnonzero(frame == n)
        visible = project_points(view, cloud.origin, cloud.columns)
        uv, xyz = np.stack([visible.u, visible.v], axis=1), cloud.xyz[visible.index]
        for k, inside in zip(of_frame.tolist(), points_in_image_boxes(visible, columns["box_px"][of_frame])):
            if len(inside) == 0:
                continue
            box = columns["box_px"][k]
            nearest = inside[np.argmin(np.hypot(*(uv[inside] - (box[:2] + box[2:]) / 2).T))]
            center = xyz[nearest] + cloud.origin
            half = np.maximum(np.ptp(xyz[inside], axis=0), MIN_EXTENT_M) / 2
            offset = (center - columns["sensor_m"][k])[:2]
            columns["yaw_rad"][k], columns["low_m"][k], columns["high_m"][k] = 0.0, offset - half[:2], offset + half[:2]
            columns["bottom_m"][k], columns["top_m"][k] = center[2] - half[2], center[2] + half[2]
            columns["center_m"][k], columns["covariance"][k], columns["source"][k] = center, np.eye(2), "lidar"
            columns["points"][k], columns["t_ns"][k] = len(inside), cloud.stamp_ns
            columns["seen_by"][k] |= cloud.ends_of(visible.index[inside])
    if searched:
        _weigh_pairs(columns, images, pairs, len(boxes), [view for view, _, _ in frames])
    others = tuple(columns["others"]) if any(view is not None for view in columns["others"]) else ()
    return Measurements(**columns | {"cluster": tuple(columns["cluster"]), "others": others})


def _rows_of_images(frames: Sequence[Frame]) -> tuple[Measurements, Index]:
    """Return a row without a position for each image box (N,), and the number (N,) of its frame."""
    frame = np.repeat(np.arange(len(frames)), [len(found) for _, found, _ in frames])
    if not len(frame):
        return Measurements.empty(), frame
    parts = (np.concatenate([getattr(d, k) for _, d, _ in frames]) for k in ("box_px", "score", "category"))
    found = Detections(*parts)
    views = [view for view, _, _ in frames]
    border = np.array([[view.camera.width_px, view.camera.height_px] for view in views])[frame] - BORDER_PX
    return replace(
        Measurements.unplaced(found, t_ns=0, camera="", sensor_m=np.zeros(3)),
        t_ns=np.array([view.t_ns for view in views])[frame],
        camera=np.array([view.camera.name for view in views])[frame],
        truncated=np.asarray(((found.box_px[:, :2] < BORDER_PX) | (found.box_px[:, 2:] > border)).any(axis=1)),
        sensor_m=np.array([view.map_T_cam[:3, 3] for view in views])[frame],
        seen_by=np.concatenate([seen_from(end_of(view.camera), 1) for view in views])[frame],
    ), frame


# Boxes that overlap less are different objects.
MIN_IOU = 0.3
# The category of the image counts where the boxes overlap by this.
MIN_CATEGORY_IOU = 0.5
# Recall of a detector in sweeps, within its range, for many points, by group; half of it is reached at so many points.
SWEEP_RECALL = {"vehicle": 0.75, "two_wheeler": 0.6, "pedestrian": 0.5}
SWEEP_RECALL_POINTS, SWEEP_RANGE_M = 15.0, 40.0


@dataclass(frozen=True)
class PairWeights:
    """Weights of the logistic function that scores an object found in an image and in a sweep."""

    bias: float
    image: float  # `image`, `sweep`: of the log-odds of the scores
    sweep: float
    iou: float

    def score(self, image: Array, sweep: Array, iou: Array) -> Array:
        """Return the probability (M,) that pairs are objects."""
        return probability_of(self.bias + self.image * logit(image) + self.sweep * logit(sweep) + self.iou * iou)


# Independent evidence: two scores of 0.5 with an IoU of 0.7 are one of 0.75, as by 1 - (1 - a) (1 - b).
PAIR_WEIGHTS = PairWeights(bias=-1.7, image=1.0, sweep=1.0, iou=4.0)


@dataclass(frozen=True, eq=False)
class Pairs:
    """Which image boxes show which of M 3D boxes, the best of P pairs first."""

    box: Index  # `box`, `image`: (P,)
    image: Index
    iou: Array  # (P,): of the projected box with the image box


def match_boxes(boxes: Boxes3D, images: Measurements, frame: Index, views: Sequence[View]) -> Pairs:
    """Match 3D boxes (M,) with image boxes (N,) of frames numbered (N,), the best pairs first; one of a box in each frame."""
    iou = np.zeros((len(boxes), len(images)))
    for k, view in enumerate(views):
        projected = project_boxes_in_view(view, boxes.center_m, boxes.size_m, boxes.yaw_rad)
        of_frame = np.flatnonzero(frame == k)
        iou[:, of_frame] = box_iou(np.nan_to_num(projected.box_px), images.box_px[of_frame])
    # Categories of one group may be of one object, and those that are confused with each other.
    a, b = groups_of(boxes.category), groups_of(images.category)
    allowed = [(a[:, None] == one) & (b == other) for one, other in RELATED_GROUPS]
    iou[~np.logical_or.reduce([a[:, None] == b, *allowed])] = 0.0
    pairs = np.argwhere(iou >= MIN_IOU)
    pairs = pairs[np.argsort(-iou[*pairs.T], kind="stable")]
    free_images, free_boxes, kept = set(pairs[:, 1].tolist()), {(i, int(frame[j])) for i, j in pairs.tolist()}, []
    for n, (i, j) in enumerate(pairs.tolist()):
        if j in free_images and (i, int(frame[j])) in free_boxes:
            free_images.remove(j)
            free_boxes.remove((i, int(frame[j])))
            kept.append(n)
    box, image = pairs[kept].T
    return Pairs(box, image, iou[box, image])


def _weigh_pairs(
    columns: dict[str, Any], images: Measurements, pairs: Pairs, count: int, views: Sequence[View]
) -> None:
    """Write what image boxes say into the first rows, of 3D boxes; doubt the others where the LiDAR should have shown an object."""
    score = columns["score"][:count].copy()
    # Of images alone, by how many points they have.
    found = np.array([SWEEP_RECALL.get(GROUP_OF[str(c)], 0.0) for c in columns["category"][count:]], dtype=np.float64)
    points = columns["points"][count:]
    with np.errstate(invalid="ignore"):
        covered = np.hypot(*(columns["center_m"] - columns["sensor_m"])[count:, :2].T) <= SWEEP_RANGE_M
    recall = np.where(covered, found * points / (points + SWEEP_RECALL_POINTS), 0.0)
    # The odds of an object that the LiDAR missed are those of its score times 1 - recall.
    alone = columns["score"][count:]
    columns["score"][count:] = np.where(recall > 0, probability_of(logit(alone) + np.log1p(-recall)), alone)
    view_of = {view.camera.name: view for view in views}
    # Of several images the best one is written last.
    for n in np.argsort(pairs.iou * images.score[pairs.image], kind="stable").tolist():
        row, image, iou = int(pairs.box[n]), int(pairs.image[n]), pairs.iou[n]
        for name in ("camera", "box_px", "truncated", "category")[: 4 if iou >= MIN_CATEGORY_IOU else 3]:
            columns[name][row] = getattr(images, name)[image]
        columns["seen_by"][row] |= images.seen_by[image]
        columns["score"][row] = PAIR_WEIGHTS.score(images.score[image], score[row], iou)
        view, cluster = view_of[str(images.camera[image])], columns["cluster"][row]
        places = cluster[:, :3] if len(cluster) else columns["center_m"][row][None]
        depth_m = (places - view.map_T_cam[:3, 3]) @ view.map_T_cam[:3, 2]
        category = str(columns["category"][row])
        columns["height_px_m"][row] = _height_m(images.box_px[image], depth_m, category, view.camera)


def logit(p: Array) -> Array:
    """Return the log-odds (M,) of scores, limited to those that are believed."""
    return log_odds_of(np.clip(p, MIN_PROBABILITY, MAX_PROBABILITY))


# A box that ends nearer to the image border may be cut by it.
BORDER_PX = 3.0
# Vehicles that may be longer show flanks at such flat angles that rays are far apart on them.
MIN_LONG_M = 10.0
NEAR_END_QUANTILE = 0.05
# Smallest extent in mode "paper", m.
MIN_EXTENT_M = 0.1


def _cluster_boxes(seen: Shown, rows: Index, columns: dict[str, Any]) -> dict[int, Index]:
    """Assign a cluster to each of the rows (R,) of a frame, as indices in its cloud, and write how high the image box is there."""
    cloud, points, visible, columns_m = seen.cloud, seen.points, seen.visible, seen.columns_m
    index, boxes_px = points[visible.index], columns["box_px"][rows]
    category = [str(c) for c in columns["category"][rows]]
    options, inside = [], points_in_image_boxes(visible, boxes_px, MARGIN)
    xyz, uv = columns_m.take(visible.index, axis=1).T, np.stack([visible.u, visible.v], axis=1)
    range_m = np.linalg.norm(xyz - cloud.sensor, axis=1)
    for k, i in enumerate(inside):
        found = candidate_clusters(xyz[i], uv[i], range_m[i], boxes_px[k], category[k])
        options.append([(i[members], score) for members, score in found])
    assigned = assign_clusters(options, boxes_px, len(index))
    taken = np.bincount(np.concatenate([*assigned, index[:0]]), minlength=len(index)) > 0
    out = {}
    for k, chosen in enumerate(assigned):
        if len(chosen) < MIN_CLUSTER_POINTS:
            continue
        members, truncated = index[chosen], columns["truncated"][rows[k]]
        if truncated:
            grown = points[region_grow(columns_m[:2].T, cloud.xyz[members, :2], category[k])]
            members = np.union1d(members, grown)
        if MAX_SIZE_M[category[k]][0] >= MIN_LONG_M:
            rest = points if truncated else index[inside[k]]
            other = np.ones(len(cloud.xyz), dtype=bool)
            other[members] = other[index[taken]] = False
            rest = rest[other[rest]]
            seed, more = (cloud.xyz[part, :2].astype(np.float64) - cloud.sensor[:2] for part in (members, rest))
            yaw_rad = fit_yaw(seed)[0]
            own, others = (np.ascontiguousarray(rotate(xy, -yaw_rad).T) for xy in (seed, more))
            members = np.union1d(members, rest[continued_sides(own, others, MAX_SIZE_M[category[k]][0])])
        columns["height_px_m"][rows[k]] = _height_m(boxes_px[k], visible.depth[chosen], category[k], seen.view.camera)
        out[int(rows[k])] = members
    return out


def _height_m(box_px: Array, depth_m: NDArray[np.floating[Any]], category: str, camera: Camera) -> float:
    """Return how high an image box is at the depths (n,) of its object; that of a long vehicle is as high as its near end looks."""
    is_long = MAX_SIZE_M[category][0] >= MIN_LONG_M
    at_m = float(np.quantile(depth_m, NEAR_END_QUANTILE)) if is_long else upper_median(depth_m)
    return float((box_px[3] - box_px[1]) * at_m / camera.K[1, 1])


def write_evidence(columns: dict[str, Any], rows: Sequence[int], members: Sequence[Index], cloud: Cloud) -> None:
    """Write what points show into rows of columns; a box of a 3D detector says which side is the length.

    Points of several viewpoints are measured from the one that has most of them; a second one is kept beside it.

    `columns`: of `Measurements`, arrays or lists, written to. `members`: R arrays (n,): points of each row in the cloud.
    """
    split = [cloud.split(index) for index in members]
    kept = [i for i, views in enumerate(split) if len(views[0][1]) >= min(MIN_CLUSTER_POINTS, len(members[i]))]
    for view in cloud.views:
        own = [i for i in kept if split[i][0][0] is view]
        if not own:
            continue
        of, parts = np.array([rows[i] for i in own]), [split[i][0][1] for i in own]
        index, count = np.concatenate(parts), np.array([len(points) for points in parts])
        edges = np.concatenate([[0], np.cumsum(count)])
        xyz = view.xyz.take(index, axis=0).astype(np.float64)
        start, of_sensor = edges[:-1], xyz - view.sensor
        typical = np.array([TYPICAL_SIZE_M[str(category)] for category in columns["category"][of]])
        yaw, low, high = fit_extents_of_clusters(of_sensor[:, :2], count, typical, columns["box_yaw_rad"][of])
        columns["yaw_rad"][of], columns["low_m"][of], columns["high_m"][of] = yaw, low, high
        heights = np.stack([xyz[:, 2], xyz[:, 2] - view.height[index]])
        sort_clusters(heights, count)
        columns["bottom_m"][of] = heights[1, start + count // 2] + view.origin[2]
        columns["top_m"][of] = quantile_of_clusters(heights[:1], count, TOP_QUANTILE)[0] + view.origin[2]
        t_s = view.t_s[index].astype(np.float64)
        mean_ns = np.round(np.add.reduceat(t_s, start) / count * NS_PER_S).astype(np.int64)
        columns["t_ns"][of] = view.stamp_ns + mean_ns
        columns["sensor_m"][of] = view.sensor + view.origin
        columns["ends_visible"][of] = view.azimuth_index.ends_visible(parts)
        shown = sample_surfaces(np.sqrt(np.einsum("ij,ij->i", of_sensor, of_sensor)), count)
        late_s = t_s[shown] - np.repeat(mean_ns, count)[shown] / NS_PER_S
        timed = np.column_stack([xyz.take(shown, axis=0) + view.origin, late_s])
        for row, points in zip(of.tolist(), np.split(timed, np.searchsorted(shown, edges[1:-1]))):
            columns["cluster"][row] = points
    for i in kept:
        columns["points"][rows[i]] = len(members[i])
        columns["seen_by"][rows[i]] |= cloud.ends_of(members[i])
        if len(split[i]) > 1 and len(split[i][1][1]) >= MIN_CLUSTER_POINTS:
            view, index = split[i][1]
            of_sensor = view.xyz.take(index, axis=0).astype(np.float64) - view.sensor
            shown = sample_surfaces(np.linalg.norm(of_sensor, axis=1), np.array([len(index)]))
            stamp_s = (view.stamp_ns - int(columns["t_ns"][rows[i]])) / NS_PER_S
            late_s = view.t_s[index[shown]].astype(np.float64) + stamp_s
            place, ends = view.sensor + view.origin, view.azimuth_index.ends_visible([index])[0]
            columns["others"][rows[i]] = OtherView(place, ends, np.column_stack([of_sensor[shown] + place, late_s]))


# A box is wrong by less than this at each side; neighbors are farther away.
BOX_MARGIN_M = 0.2
# Two vehicles of a row stand this near to each other.
ROW_GAP_M = 1.0
# Mirrors reach so far beyond a vehicle's width, and boxes around them half as far again.
EGO_MARGIN_M = 0.4
# A box is sought at the times of another viewpoint's points up to this speed and distance, in steps of a LiDAR's noise and
# the spacing of its rays.
MAX_FOLLOWED_MPS, MAX_FOLLOWED_M, FOLLOW_STEP_M = 30.0, 2.0, 0.1


def outside_ego(log: Log, boxes: Boxes3D) -> Boxes3D:
    """Leave out the boxes on the ego: a LiDAR sees the roof, the mirrors and the rider of its own vehicle."""
    if log.ego is None or not len(boxes):
        return boxes
    map_T_ego, known = log.ego.at(boxes.t_ns)
    axis = map_T_ego[:, :2, 0]
    offset = (boxes.center_m - log.ego_centers(map_T_ego))[:, :2]
    along, across = (offset * axis).sum(axis=1), axis[:, 0] * offset[:, 1] - axis[:, 1] * offset[:, 0]
    length, width = np.array(log.ego_vehicle.size_m[:2]) / 2 + EGO_MARGIN_M
    return boxes.take(~(known & (np.abs(along) < length) & (np.abs(across) < width)))


def follow_box(boxes: Boxes3D, view: Cloud) -> Boxes3D:
    """Move boxes (M,) along their axes to where most points of a viewpoint are in them, no farther than they can have come.

    At 15 m/s, sweeps that are 0.05 s apart show a vehicle 0.75 m apart. Boxes of the time of the points stay.
    """
    xyz, moved = view.xyz[view.obstacles], boxes.center_m.copy()
    for k in range(len(boxes)):
        local = xyz[:, :2] - (boxes.center_m[k] - view.origin)[:2]
        reach = float(np.hypot(*boxes.size_m[k, :2])) / 2 + MAX_FOLLOWED_M
        near = np.flatnonzero((np.abs(local[:, 0]) < reach) & (np.abs(local[:, 1]) < reach))
        if len(near) < MIN_CLUSTER_POINTS:
            continue
        along = rotate(local[near].astype(np.float64), -float(boxes.yaw_rad[k]))
        late_s = (view.stamp_ns - int(boxes.t_ns[k])) / NS_PER_S + float(view.t_s[view.obstacles[near]].mean())
        limit = min(abs(late_s) * MAX_FOLLOWED_MPS, MAX_FOLLOWED_M)
        if limit < BOX_MARGIN_M:
            continue
        steps = np.arange(-int(limit / FOLLOW_STEP_M), int(limit / FOLLOW_STEP_M) + 1) * FOLLOW_STEP_M
        half = boxes.size_m[k, :2] / 2
        along = along[np.abs(along[:, 1]) <= half[1] + BOX_MARGIN_M, 0]
        inside = (np.abs(along - steps[:, None]) <= half[0] + FOLLOW_STEP_M).sum(axis=1)
        # Of all places that hold as many points, the middle of those that are nearest.
        best = steps[inside >= inside.max()]
        yaw = float(boxes.yaw_rad[k])
        moved[k, :2] += best[np.argmin(np.abs(best))] * np.array([np.cos(yaw), np.sin(yaw)])
    return replace(boxes, center_m=moved)


def _members(boxes: Boxes3D, cloud: Cloud) -> list[NDArray[np.intp]]:
    """Find the points of the cloud above the ground in each box, somewhat widened; each point belongs to one box."""
    center, xyz = boxes.center_m - cloud.origin, cloud.obstacle_columns.T
    found = points_of_boxes(xyz, center, boxes.size_m + 2 * BOX_MARGIN_M, boxes.yaw_rad)
    own = np.ones(len(found.point), dtype=bool)
    # Of several boxes that hold a point, it is deepest in its own.
    shared = np.flatnonzero(np.bincount(found.point, minlength=len(xyz))[found.point] > 1)
    if len(shared):
        point, box = found.point[shared], found.box[shared]
        local = rotate(xyz[point, :2] - center[box, :2], -boxes.yaw_rad[box])
        outside_m = (np.abs(local) - boxes.size_m[box, :2] / 2).max(axis=1)
        order = np.lexsort((outside_m, point))
        own[shared[order[np.r_[False, np.diff(point[order]) == 0]]]] = False
    edges = np.searchsorted(found.box[own], np.arange(len(boxes) + 1))
    free = np.ones(len(xyz), dtype=bool)
    free[found.point] = False
    point, (x, y, _) = found.point[own], cloud.obstacle_columns
    place = cloud.obstacle_columns[:2] - cloud.sensor[:2, None]
    members = [point[a:b] for a, b in pairwise(edges)]
    longest_m = np.array([MAX_SIZE_M[category][0] for category in boxes.category])
    is_long = (longest_m >= MIN_LONG_M) & (np.diff(edges) >= MIN_CLUSTER_POINTS)
    seeds = place.take(point[np.repeat(is_long, np.diff(edges))], axis=1)
    yaws = correct_yaws(seeds.T.astype(np.float64), np.diff(edges)[is_long], boxes.yaw_rad[is_long])
    for k, yaw_rad in zip(np.flatnonzero(is_long).tolist(), yaws.tolist()):
        # The boxes of a detector that sees little of a long flank at a time end before it does.
        middle, reach_m = center[k].astype(xyz.dtype), longest_m[k]
        rest = np.flatnonzero(free & (np.abs(x - middle[0]) < reach_m) & (np.abs(y - middle[1]) < reach_m))
        index = np.concatenate([members[k], rest])
        (c, s), of_sensor = np.array([np.cos(yaw_rad), np.sin(yaw_rad)], dtype=xyz.dtype), place.take(index, axis=1)
        sides = np.stack([of_sensor[0] * c + of_sensor[1] * s, of_sensor[1] * c - of_sensor[0] * s])
        own = np.arange(len(index)) < len(members[k])
        for _ in range(2):  # along the flank, then round the corner
            seed, others = np.flatnonzero(own), np.flatnonzero(~own)
            added = continued_sides(sides.take(seed, axis=1), sides.take(others, axis=1), np.inf, ROW_GAP_M)
            own[others[added]] = True
            if not len(added):
                break
        # Sides that go on past the longest and widest vehicle are a wall's.
        sides_m = np.sort(np.ptp(sides.take(np.flatnonzero(own), axis=1), axis=1))
        if (sides_m <= MAX_SIZE_M[boxes.category[k]][1::-1]).all():
            members[k] = np.sort(index[own])
            free[members[k]] = False
    return [cloud.obstacles[index] for index in members]
