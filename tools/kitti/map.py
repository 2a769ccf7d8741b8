"""Boxes of the KITTI tracking benchmark in log2sim's map frame and back, and what of them the camera sees."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from kitti.boxes import PERIOD_NS, Boxes, overlap_3d
from log2sim.datatypes import VEHICLE, Measurements, seen_from
from log2sim.errors import LogError
from log2sim.evaluation.metrics.comparison import assign
from log2sim.geometry import Array, apply, box_corners, inverse, rotation_from_quaternion, transform
from log2sim.logs.kitti import labels

CATEGORY_OF = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "cyclist"}
# Camera axes (x right, y down, z forward) in the axes of a car (x forward, y left, z up).
EGO_R_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
IMAGE_PX = np.array([1242.0, 375.0])
NEAR_M = 1.0
# Spread of the detected centers of labeled cars as a line over the range, taken twice as wide for what is partly hidden.
SIGMA_M, SIGMA_PER_M = 0.1, 0.004
# Boxes are looked at through a grid of so many points on each side to tell how much of them is hidden.
GRID = 8
NEARER_M = 1.0


@dataclass(frozen=True, eq=False)
class View:
    """Where the camera was: `map_T_cam` (T, 4, 4) of the rectified camera 0 at every frame and `P` (3, 4) to the image.

    Where the ego motion is unknown (`motion_known` False) the axes of the car stand for the map, and nothing in it stands.
    """

    map_T_cam: Array
    P: Array
    motion_known: bool = True


def read_view(calib: Path, ego_motion: Path | None, frames: int) -> View:
    """The view of one sequence of at least `frames` frames.

    The ego motion holds t x y z qx qy qz qw of the IMU, one row a frame in order; its stamps are not those of the frames and
    are not used. Without it the axes of the car stand for the map.
    """
    c = labels.Calibration(calib)
    P = c.entry((3, 4), "P2")
    if ego_motion is None:
        return View(np.repeat(transform(EGO_R_CAM, np.zeros(3))[None], frames, axis=0), P, motion_known=False)
    rows = _poses(ego_motion)
    if len(rows) < frames:
        raise LogError(f"{ego_motion}: {len(rows)} poses, expected one for each of {frames} frames of the detections")
    map_T_imu = transform(rotation_from_quaternion(rows[:, [7, 4, 5, 6]]), rows[:, 1:4])
    rect_T_cam = transform(c.rotation("R0_rect", "R_rect"), np.zeros(3))
    cam_T_velo = c.rigid("Tr_velo_to_cam", "Tr_velo_cam")
    velo_T_imu = c.rigid("Tr_imu_to_velo", "Tr_imu_velo")
    return View(map_T_imu @ inverse(rect_T_cam @ cam_T_velo @ velo_T_imu), P)


def _poses(path: Path) -> Array:
    lines = [line.split() for line in labels.read_text(path).splitlines() if line.strip()]
    for k, words in enumerate(lines, start=1):
        if len(words) != 8:
            raise LogError(f"{path}, line {k}: {len(words)} columns, expected 8: t x y z qx qy qz qw")
    try:
        rows = np.array(lines, dtype=np.float64).reshape(-1, 8)
    except ValueError as problem:
        raise LogError(f"{path}: {problem}; expected numbers") from None
    if not (np.isfinite(rows).all() and np.all(np.abs(np.linalg.norm(rows[:, 4:], axis=1) - 1) < 1e-2)):
        raise LogError(f"{path}: poses must be finite and their quaternions of length 1")
    return rows


def to_measurements(boxes: Boxes, view: View) -> list[Measurements]:
    """Boxes, sorted by frame, as measurements in the map, one set a frame (T,)."""
    n = len(boxes)
    center = boxes.bottom_m.copy()
    center[:, 1] -= boxes.size_hwl_m[:, 0] / 2
    pose = view.map_T_cam[boxes.frame]
    ahead = np.column_stack([np.cos(boxes.yaw_rad), np.zeros(n), -np.sin(boxes.yaw_rad)])
    heading = np.einsum("nij,nj->ni", pose[:, :3, :3], ahead)
    sigma = SIGMA_M + SIGMA_PER_M * np.hypot(center[:, 0], center[:, 2])
    half_m = boxes.size_hwl_m[:, :0:-1] / 2
    map_center = apply(pose, center)
    everything = Measurements(
        t_ns=boxes.frame * PERIOD_NS,
        category=np.array([CATEGORY_OF[c] for c in boxes.category.tolist()], dtype="<U16"),
        score=1 / (1 + np.exp(-boxes.score)),
        camera=np.full(n, "image_02", dtype="<U16"),
        box_px=boxes.box_px,
        truncated=np.zeros(n, dtype=bool),
        ends_visible=np.ones((n, 2), dtype=bool),
        low_m=-half_m,
        high_m=half_m,
        bottom_m=map_center[:, 2] - boxes.size_hwl_m[:, 0] / 2,
        top_m=map_center[:, 2] + boxes.size_hwl_m[:, 0] / 2,
        center_m=map_center,
        yaw_rad=np.arctan2(heading[:, 1], heading[:, 0]),
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
        points=np.zeros(n, dtype=np.int64),
        source=np.full(n, "lidar", dtype="<U16"),
        cluster=(np.zeros((0, 3)),) * n,
        sensor_m=map_center,
        height_px_m=boxes.size_hwl_m[:, 0],
        box_center_m=np.full((n, 3), np.nan),
        box_size_m=np.full((n, 3), np.nan),
        box_yaw_rad=np.full(n, np.nan),
        heading_score=np.full(n, np.nan),
        seen_by=seen_from(VEHICLE, n),
    )
    cuts = np.searchsorted(boxes.frame, np.arange(len(view.map_T_cam) + 1))
    return [everything.take(slice(a, b)) for a, b in pairwise(cuts)]


def from_map(center_m: Array, size_m: Array, yaw_rad: Array, frame: NDArray[np.int64], view: View) -> dict[str, Array]:
    """Columns of `Boxes` for boxes (N,) given in the map: length, width, height and yaw about z."""
    cam_T_map = inverse(view.map_T_cam[frame])
    center = apply(cam_T_map, center_m)
    ahead = np.einsum(
        "nij,nj->ni", cam_T_map[:, :3, :3], np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad])
    )
    bottom = center.copy()
    bottom[:, 1] += size_m[:, 2] / 2
    yaw = np.arctan2(-ahead[:, 2], ahead[:, 0])
    return {
        "alpha": np.mod(yaw - np.arctan2(center[:, 0], center[:, 2]) + np.pi, 2 * np.pi) - np.pi,
        "box_px": project(bottom, size_m[:, ::-1], yaw, view.P),
        "size_hwl_m": size_m[:, ::-1],
        "bottom_m": bottom,
        "yaw_rad": yaw,
    }


def project(bottom_m: Array, size_hwl_m: Array, yaw_rad: Array, P: Array) -> Array:
    """Image boxes (N, 4) around 3D boxes, cut at the border; NaN where less than half lies inside or a corner is too near."""
    center = bottom_m[:, [0, 2, 1]] * np.array([1.0, 1.0, -1.0])
    center[:, 2] += size_hwl_m[:, 0] / 2
    corners = box_corners(center, size_hwl_m[:, ::-1], -yaw_rad)  # on axes x right, z forward, y up
    xyz = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1], np.ones(corners.shape[:2])], axis=-1)
    uvw = xyz @ P.T
    ahead = (uvw[..., 2] > NEAR_M).all(axis=1)
    uv = uvw[..., :2] / np.where(ahead[:, None], uvw[..., 2], 1.0)[..., None]
    low, high = uv.min(axis=1), uv.max(axis=1)
    cut_low, cut_high = np.clip(low, 0, IMAGE_PX - 1), np.clip(high, 0, IMAGE_PX - 1)
    inside = ahead & ((cut_high - cut_low).prod(1) >= 0.5 * (high - low).prod(1))
    return np.where(inside[:, None], np.concatenate([cut_low, cut_high], axis=1), np.nan)


def hidden_share(boxes: Boxes, frames: int, hides: NDArray[np.bool_] | None = None) -> Array:
    """Share (N,) of every image box that lies behind boxes of its frame that are nearer to the camera; rows by frame.

    With `hides` (N,) only those rows hide others.
    """
    depth = np.linalg.norm(boxes.bottom_m, axis=1)
    hides = np.ones(len(boxes), dtype=bool) if hides is None else hides
    steps = (np.arange(GRID) + 0.5) / GRID
    low, high = boxes.box_px[:, :2], boxes.box_px[:, 2:]
    grid = low[:, None] + (high - low)[:, None] * steps[:, None]
    out = np.zeros(len(boxes))
    cuts = np.searchsorted(boxes.frame, np.arange(frames + 1))
    for a, b in pairwise(cuts):
        front = a + np.flatnonzero(hides[a:b])
        if b - a < 2 or len(front) == 0:
            continue
        nearer = depth[None, front] < depth[a:b, None] - NEARER_M
        touching = np.all((low[None, front] < high[a:b, None]) & (high[None, front] > low[a:b, None]), axis=2) & nearer
        i, j = np.nonzero(touching)
        if len(i) == 0:
            continue
        covered = (grid[a + i] > low[front[j], None]) & (grid[a + i] < high[front[j], None])
        cells = covered[:, :, None, 0] & covered[:, None, :, 1]
        hidden = np.zeros((b - a, GRID, GRID), dtype=bool)
        np.logical_or.at(hidden, i, cells)
        out[a:b] = hidden.mean(axis=(1, 2))
    return out


NEIGHBORS = {"Car": "Van", "Pedestrian": "Person_sitting"}
MAX_OCCLUSION, MAX_TRUNCATION, MIN_HEIGHT_PX = 2, 0, 25.0
DONT_CARE_SHARE = 0.5

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Scene:
    """All sequences of one category, one after the other on one axis of frames, with what of each other overlaps.

    `truth`, `found` are boxes whose `track_id` is an index; `ignorable` (A,) labels that need not be found, `excused` (B,)
    found boxes that are no error; `row`, `col`, `iou` (P,) are the pairs that overlap at all, by frame, `near` (P,) those that
    may match. `score` (B,) is the mean over the track.
    """

    truth: Boxes
    found: Boxes
    ignorable: Mask
    excused: Mask
    score: Array
    row: Index
    col: Index
    iou: Array
    near: Mask


def make_scene(results: Mapping[str, Boxes], labels: Mapping[str, Boxes], category: str, *, iou: float) -> Scene:
    """Line the sequences up; sequences without results count as missed altogether."""
    truths, founds, areas, begin = [], [], [], 0
    for k, name in enumerate(sorted(labels)):
        label = _shifted(labels[name], begin, k)
        truths.append(label.take(np.isin(label.category, with_neighbors(category))))
        areas.append(label.take(label.category == "DontCare"))
        end = int(label.frame.max(initial=begin - 1)) + 1
        if name in results:
            found = _shifted(results[name], begin, k)
            founds.append(found.take((found.category == category) & (found.frame < end)))
        begin = end
    truth, area = Boxes.join(truths), Boxes.join(areas)
    found = Boxes.join(founds) if founds else truth.take(slice(0, 0))
    truth, found = _in_order(truth), _in_order(found)
    ignorable = is_ignorable(truth, category)
    count = np.bincount(found.track_id)
    mean = np.bincount(found.track_id, weights=found.score) / np.maximum(count, 1)
    row, col = same_frame(truth, found, reach_m=True)
    overlap = overlap_3d(truth.take(row), found.take(col))
    touching = overlap > 0
    row, col, overlap = row[touching], col[touching], overlap[touching]
    return Scene(
        truth, found, ignorable, is_small(found) | in_areas(found, area), mean[found.track_id] if len(found) else np.zeros(0),
        row, col, overlap, overlap >= iou,
    )  # fmt: skip


def with_neighbors(category: str) -> list[str]:
    """The category and the one that looks like it, whose labels are no errors."""
    return [category, NEIGHBORS.get(category, category)]


def is_ignorable(truth: Boxes, category: str) -> Mask:
    """Which labels (A,) need not be found: too much of them is hidden or cut off, or they are of the neighboring category."""
    return (truth.occlusion > MAX_OCCLUSION) | (truth.truncation > MAX_TRUNCATION) | (truth.category != category)


def is_small(found: Boxes) -> Mask:
    """Which boxes (B,) are too low in the image to be errors."""
    return np.asarray(np.abs(found.box_px[:, 3] - found.box_px[:, 1]) <= MIN_HEIGHT_PX)


def _shifted(boxes: Boxes, begin: int, sequence: int) -> Boxes:
    columns = {**vars(boxes), "frame": boxes.frame + begin, "track_id": boxes.track_id + sequence * 10_000_000}
    return Boxes(**columns)


def _in_order(boxes: Boxes) -> Boxes:
    boxes = boxes.take(np.lexsort([boxes.track_id, boxes.frame]))
    _, index = np.unique(boxes.track_id, return_inverse=True)
    return Boxes(**{**vars(boxes), "track_id": index.astype(np.int64)})


def same_frame(a: Boxes, b: Boxes, *, reach_m: bool) -> tuple[Index, Index]:
    """All pairs of rows of the same frame, by row of `a`; `b` is sorted by frame; with `reach_m` only those whose boxes can touch."""
    first, last = np.searchsorted(b.frame, a.frame, "left"), np.searchsorted(b.frame, a.frame, "right")
    count = last - first
    row = np.repeat(np.arange(len(a)), count)
    col = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    if reach_m:
        gap = a.bottom_m[row] - b.bottom_m[col]
        reach = np.hypot(*a.size_hwl_m[row, 1:].T) / 2 + np.hypot(*b.size_hwl_m[col, 1:].T) / 2
        near = np.hypot(gap[:, 0], gap[:, 2]) <= reach
        row, col = row[near], col[near]
    return row, col


def in_areas(found: Boxes, area: Boxes) -> Mask:
    """Which found boxes lie by more than half in an area without labels, in the image."""
    area = area.take(np.argsort(area.frame, kind="stable"))
    row, col = same_frame(found, area, reach_m=False)
    a, b = found.box_px[row], area.box_px[col]
    common = np.clip(np.minimum(a[:, 2:], b[:, 2:]) - np.maximum(a[:, :2], b[:, :2]), 0, None).prod(1)
    own = (a[:, 2:] - a[:, :2]).prod(1)
    inside = np.zeros(len(found), dtype=bool)
    inside[row[common > DONT_CARE_SHARE * own]] = True
    return inside


class Matcher:
    """Assignment of found boxes to labels at any threshold; frames whose candidates are the same are solved once."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        frame = scene.truth.frame[scene.row]
        cuts = np.flatnonzero(np.diff(frame)) + 1
        self.spans = list(zip(np.r_[0, cuts], np.r_[cuts, len(frame)])) if len(frame) else []
        self.known: dict[tuple[int, bytes], Index] = {}

    def match(self, threshold: float) -> Index:
        """Row of the found box of every label (A,), -1 for none: most pairs, then the greatest overlap, frame by frame."""
        match = np.full(len(self.scene.truth), -1, dtype=np.int64)
        keep = self.scene.near & (self.scene.score[self.scene.col] >= threshold)
        for a, b in self.spans:
            key = (a, keep[a:b].tobytes())
            if key not in self.known:
                rows = a + np.flatnonzero(keep[a:b])
                # One more pair must always be worth more than any overlap.
                self.known[key] = rows[
                    assign(self.scene.row[rows], self.scene.col[rows], len(rows) + self.scene.iou[rows])
                ]
            chosen = self.known[key]
            match[self.scene.row[chosen]] = self.scene.col[chosen]
        return match
