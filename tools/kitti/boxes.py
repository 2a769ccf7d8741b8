"""Boxes of the KITTI tracking benchmark: reading, overlaps, what counts as an error, and log2sim's map frame and back."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import VEHICLE, Detections, Measurements, seen_from
from log2sim.files.arrays import Columns
from log2sim.geometry import Array, apply, box_corners, inverse, rotation_from_quaternion, transform, upright_box_iou
from log2sim.logs.kitti import labels

PERIOD_NS = 100_000_000
# The numbers by which files of detections name their categories.
DETECTION_TYPES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}
CATEGORY_OF = {"Car": "car", "Pedestrian": "pedestrian", "Cyclist": "cyclist"}
# Camera axes (x right, y down, z forward) in the axes of a car (x forward, y left, z up).
EGO_R_CAM = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
IMAGE_PX = np.array([1242.0, 375.0])
NEAR_M = 1.0
# Spread of the detected centers of labeled cars as a line over the range, taken twice as wide for what is partly hidden.
SIGMA_M, SIGMA_PER_M = 0.1, 0.004
NEIGHBORS = {"Car": "Van", "Pedestrian": "Person_sitting"}
MAX_OCCLUSION, MAX_TRUNCATION, MIN_HEIGHT_PX = 2, 0, 25.0
DONT_CARE_SHARE = 0.5

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Boxes(Columns):
    """3D boxes (N,) of one sequence, one row a box and frame, in the rectified camera's frame (x right, y down, z forward).

    `frame`, `track_id` (N,) int64, `category` (N,) str as KITTI spells it, `truncation`, `occlusion` (N,), `box_px`
    (N, 4), `size_hwl_m` (N, 3) height, width, length, `bottom_m` (N, 3) middle of the lower face, `yaw_rad`
    (N,) about the y axis (rotation_y), `score` (N,), NaN where there is none.
    """

    frame: NDArray[np.int64]
    track_id: NDArray[np.int64]
    category: NDArray[np.str_]
    truncation: Array
    occlusion: Array
    box_px: Array
    size_hwl_m: Array
    bottom_m: Array
    yaw_rad: Array
    score: Array


def read_detections(path: Path) -> Boxes:
    """Detections: frame, type, 2D box (4), score, h, w, l, x, y, z, rot_y, alpha, separated by commas or blanks."""
    rows = np.array(path.read_text().replace(",", " ").split(), np.float64).reshape(-1, 15)
    category, none = np.array([DETECTION_TYPES[int(t)] for t in rows[:, 1]], dtype="<U16"), np.full(len(rows), -1.0)
    return Boxes(
        rows[:, 0].astype(np.int64), none.astype(np.int64), category, none, none, rows[:, 2:6], rows[:, 7:10], rows[:, 10:13],
        rows[:, 13], rows[:, 6],
    )  # fmt: skip


def read_tracks(path: Path) -> Boxes:
    """Labels or results in KITTI's tracking format: 17 columns, and the score as the 18th where there is one."""
    words = [line.split() for line in path.read_text().splitlines() if line.strip()]
    rows = np.array([[*w[:2], *w[3:17], w[17] if len(w) == 18 else "nan"] for w in words], np.float64).reshape(-1, 17)
    return Boxes(
        rows[:, 0].astype(np.int64), rows[:, 1].astype(np.int64), np.array([w[2] for w in words], dtype="<U16"), rows[:, 2], rows[:, 3],
        rows[:, 5:9], rows[:, 9:12], rows[:, 12:15], rows[:, 15], rows[:, 16],
    )  # fmt: skip


def upright(boxes: Boxes) -> Array:
    """Boxes (N, 7) on axes x right, z forward, y up: center, length, width, height and yaw, which is counter-clockwise on them."""
    height = boxes.size_hwl_m[:, 0]
    x, y, z = boxes.bottom_m.T
    return np.column_stack([x, z, height / 2 - y, boxes.size_hwl_m[:, ::-1], -boxes.yaw_rad])


def overlap_3d(a: Boxes, b: Boxes) -> Array:
    """IoU (N,) in 3D of boxes with each other, row by row."""
    return upright_box_iou(upright(a), upright(b))


def same_frame(a: Boxes, b: Boxes, *, reach_m: bool) -> tuple[Index, Index]:
    """All pairs of rows of the same frame, by row of `a`; `b` is sorted by frame; with `reach_m` only those whose boxes can touch."""
    first, last = np.searchsorted(b.frame, a.frame, "left"), np.searchsorted(b.frame, a.frame, "right")
    count = last - first
    row = np.repeat(np.arange(len(a)), count)
    col = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count) + np.repeat(first, count)
    if reach_m:
        (x, z, reach), (b_x, b_z, b_reach) = (
            (*boxes.bottom_m[:, [0, 2]].T.copy(), np.hypot(*boxes.size_hwl_m[:, 1:].T) / 2) for boxes in (a, b)
        )
        near = (x[row] - b_x[col]) ** 2 + (z[row] - b_z[col]) ** 2 <= (reach[row] + b_reach[col]) ** 2
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


def with_neighbors(category: str) -> list[str]:
    """The category and the one that looks like it, whose labels are no errors."""
    return [category, NEIGHBORS.get(category, category)]


def is_ignorable(truth: Boxes, category: str) -> Mask:
    """Which labels (A,) need not be found: too much of them is hidden or cut off, or they are of the neighboring category."""
    return (truth.occlusion > MAX_OCCLUSION) | (truth.truncation > MAX_TRUNCATION) | (truth.category != category)


def is_small(found: Boxes) -> Mask:
    """Which boxes (B,) are too low in the image to be errors."""
    return np.asarray(np.abs(found.box_px[:, 3] - found.box_px[:, 1]) <= MIN_HEIGHT_PX)


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
    rows = np.loadtxt(ego_motion, ndmin=2)
    map_T_imu = transform(rotation_from_quaternion(rows[:, [7, 4, 5, 6]]), rows[:, 1:4])
    rect_T_cam = transform(c.rotation("R0_rect", "R_rect"), np.zeros(3))
    cam_T_velo, velo_T_imu = c.rigid("Tr_velo_to_cam", "Tr_velo_cam"), c.rigid("Tr_imu_to_velo", "Tr_imu_velo")
    return View(map_T_imu @ inverse(rect_T_cam @ cam_T_velo @ velo_T_imu), P)


def in_map(boxes: Boxes, view: View) -> tuple[Array, Array]:
    """Centers (N, 3) and yaws (N,) of boxes in the map."""
    pose, off = view.map_T_cam[boxes.frame], np.zeros((len(boxes), 3))
    off[:, 1] = boxes.size_hwl_m[:, 0] / 2
    ahead = np.column_stack([np.cos(boxes.yaw_rad), np.zeros(len(boxes)), -np.sin(boxes.yaw_rad)])
    heading = np.einsum("nij,nj->ni", pose[:, :3, :3], ahead)
    return apply(pose, boxes.bottom_m - off), np.arctan2(heading[:, 1], heading[:, 0])


def to_measurements(boxes: Boxes, view: View) -> Measurements:
    """Boxes as measurements in the map; `points`, which the tracker does not read, is the row."""
    n, height_m = len(boxes), boxes.size_hwl_m[:, 0]
    map_center, yaw_rad = in_map(boxes, view)
    sigma = SIGMA_M + SIGMA_PER_M * np.hypot(boxes.bottom_m[:, 0], boxes.bottom_m[:, 2])
    half_m = boxes.size_hwl_m[:, :0:-1] / 2
    category = np.array([CATEGORY_OF[c] for c in boxes.category.tolist()], dtype="<U16")
    found = Detections(boxes.box_px, 1 / (1 + np.exp(-boxes.score)), category)
    return replace(
        Measurements.unplaced(found, t_ns=0, camera="image_02", sensor_m=np.zeros(3)),
        t_ns=boxes.frame * PERIOD_NS,
        ends_visible=np.ones((n, 2), dtype=bool),
        low_m=-half_m,
        high_m=half_m,
        bottom_m=map_center[:, 2] - height_m / 2,
        top_m=map_center[:, 2] + height_m / 2,
        center_m=map_center,
        yaw_rad=yaw_rad,
        covariance=sigma[:, None, None] ** 2 * np.eye(2),
        points=np.arange(n),
        source=np.full(n, "lidar"),
        sensor_m=map_center,
        height_px_m=height_m,
        seen_by=seen_from(VEHICLE, n),
    )


def from_map(center_m: Array, size_m: Array, yaw_rad: Array, frame: NDArray[np.int64], view: View) -> dict[str, Array]:
    """Columns of `Boxes`, but for those in the image, for boxes (N,) given in the map: length, width, height and yaw about z."""
    cam_T_map = inverse(view.map_T_cam)[frame]
    bottom = apply(cam_T_map, center_m)
    bottom[:, 1] += size_m[:, 2] / 2
    course = np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad), 0 * yaw_rad])
    ahead = np.einsum("nij,nj->ni", cam_T_map[:, :3, :3], course)
    return {"size_hwl_m": size_m[:, ::-1], "bottom_m": bottom, "yaw_rad": np.arctan2(-ahead[:, 2], ahead[:, 0])}


def project(boxes: Boxes, P: Array) -> Array:
    """Image boxes (N, 4) around 3D boxes, cut at the border; NaN where less than half lies inside or a corner is too near."""
    box = upright(boxes)
    corners = box_corners(box[:, :3], box[:, 3:6], box[:, 6])
    xyz = np.stack([corners[..., 0], -corners[..., 2], corners[..., 1], np.ones(corners.shape[:2])], axis=-1)
    uvw = xyz @ P.T
    ahead = (uvw[..., 2] > NEAR_M).all(axis=1)
    uv = uvw[..., :2] / np.where(ahead[:, None], uvw[..., 2], 1.0)[..., None]
    low, high = uv.min(axis=1), uv.max(axis=1)
    cut_low, cut_high = np.clip(low, 0, IMAGE_PX - 1), np.clip(high, 0, IMAGE_PX - 1)
    inside = ahead & ((cut_high - cut_low).prod(1) >= 0.5 * (high - low).prod(1))
    return np.where(inside[:, None], np.concatenate([cut_low, cut_high], axis=1), np.nan)
