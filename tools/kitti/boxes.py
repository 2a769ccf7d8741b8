"""Boxes of the KITTI tracking benchmark: detections, labels and results as columns, and how far 3D boxes overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.geometry import Array, box_corners_bev

SIZE_LIMIT_BYTES = 256 * 1024 * 1024
# The numbers by which files of detections name their categories.
DETECTION_TYPES = {1: "Pedestrian", 2: "Car", 3: "Cyclist"}
DETECTION_COLUMNS = 15
LABEL_COLUMNS = 17
FRAME_LIMIT = 1_000_000


@dataclass(frozen=True, eq=False)
class Boxes:
    """3D boxes (N,) of one sequence, one row a box and frame, in the rectified camera's frame (x right, y down, z forward).

    `frame`, `track_id` (N,) int64, `category` (N,) str as KITTI spells it, `truncation`, `occlusion` (N,), `alpha` (N,)
    rad, `box_px` (N, 4), `size_hwl_m` (N, 3) height, width, length, `bottom_m` (N, 3) middle of the lower face, `yaw_rad`
    (N,) about the y axis (rotation_y), `score` (N,), NaN where there is none.
    """

    frame: NDArray[np.int64]
    track_id: NDArray[np.int64]
    category: NDArray[np.str_]
    truncation: Array
    occlusion: Array
    alpha: Array
    box_px: Array
    size_hwl_m: Array
    bottom_m: Array
    yaw_rad: Array
    score: Array

    def __len__(self) -> int:
        return len(self.frame)

    def take(self, index: Any) -> Boxes:
        """The rows at `index` (integers or a mask)."""
        return Boxes(*(getattr(self, f.name)[index] for f in fields(self)))

    @classmethod
    def join(cls, parts: Sequence[Boxes]) -> Boxes:
        """Rows of several sets, one after the other."""
        return cls(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(cls)))


def read_detections(path: Path) -> Boxes:
    """Detections: frame, type, 2D box (4), score, h, w, l, x, y, z, rot_y, alpha, separated by commas or blanks."""
    rows = _numbers(path, DETECTION_COLUMNS)
    types = rows[:, 1].astype(np.int64)
    unknown = ~np.isin(types, list(DETECTION_TYPES))
    if unknown.any():
        raise LogError(f"{path}: type {types[unknown][0]}, expected one of {DETECTION_TYPES}")
    _check_boxes(path, rows[:, 0], rows[:, 7:10])
    none = np.full(len(rows), -1.0)
    return Boxes(
        frame=rows[:, 0].astype(np.int64), track_id=none.astype(np.int64),
        category=np.array([DETECTION_TYPES[int(t)] for t in types], dtype="<U16"), truncation=none, occlusion=none,
        alpha=rows[:, 14], box_px=rows[:, 2:6], size_hwl_m=rows[:, 7:10], bottom_m=rows[:, 10:13], yaw_rad=rows[:, 13],
        score=rows[:, 6],
    )  # fmt: skip


def read_tracks(path: Path) -> Boxes:
    """Labels or results in KITTI's tracking format: 17 columns, and the score as the 18th where there is one."""
    words = [line.split() for line in _text(path).splitlines() if line.strip()]
    for k, line in enumerate(words, start=1):
        if len(line) not in (LABEL_COLUMNS, LABEL_COLUMNS + 1):
            raise LogError(f"{path}, line {k}: {len(line)} columns, expected 17 of a label or 18 of a result")
    try:
        rows = np.array([[*w[:2], *w[3:17], w[17] if len(w) == 18 else "nan"] for w in words], dtype=np.float64)
    except ValueError as problem:
        raise LogError(f"{path}: {problem}; expected numbers in all columns but the third") from None
    rows = rows.reshape(-1, LABEL_COLUMNS)
    return Boxes(
        frame=rows[:, 0].astype(np.int64), track_id=rows[:, 1].astype(np.int64),
        category=np.array([w[2] for w in words], dtype="<U16"), truncation=rows[:, 2], occlusion=rows[:, 3],
        alpha=rows[:, 4], box_px=rows[:, 5:9], size_hwl_m=rows[:, 9:12], bottom_m=rows[:, 12:15], yaw_rad=rows[:, 15],
        score=rows[:, 16],
    )  # fmt: skip


def write_tracks(path: Path, boxes: Boxes) -> None:
    """Write results in KITTI's tracking format, by frame and track; written aside and renamed."""
    order = np.lexsort([boxes.track_id, boxes.frame])
    b = boxes.take(order)
    numbers = np.column_stack([b.box_px, b.size_hwl_m, b.bottom_m, b.yaw_rad, b.score])
    lines = [
        f"{f} {i} {c} {t:.0f} {o:.0f} {a:.6f} " + " ".join(f"{v:.6f}" for v in row)
        for f, i, c, t, o, a, row in zip(b.frame, b.track_id, b.category, b.truncation, b.occlusion, b.alpha, numbers)
    ]
    aside = path.with_suffix(".part")
    aside.write_text("".join(line + "\n" for line in lines), encoding="utf-8")
    aside.replace(path)


def overlap_3d(a: Boxes, b: Boxes) -> Array:
    """IoU (N,) in 3D of boxes with each other, row by row."""
    inner = _overlap_areas(_corners(a), _corners(b))
    top = np.maximum(a.bottom_m[:, 1] - a.size_hwl_m[:, 0], b.bottom_m[:, 1] - b.size_hwl_m[:, 0])
    height = np.clip(np.minimum(a.bottom_m[:, 1], b.bottom_m[:, 1]) - top, 0, None)
    common = inner * height
    union = a.size_hwl_m.prod(1) + b.size_hwl_m.prod(1) - common
    return np.divide(common, union, out=np.zeros(len(a)), where=union > 0)


def _corners(boxes: Boxes) -> Array:
    """Corners (N, 4, 2) on the camera's x-z plane, counter-clockwise with x to the right and z up."""
    # rotation_y turns from z toward x, so it is clockwise on this plane.
    return box_corners_bev(boxes.bottom_m[:, [0, 2]], boxes.size_hwl_m[:, 2], boxes.size_hwl_m[:, 1], -boxes.yaw_rad)


def _overlap_areas(a: Array, b: Array) -> Array:
    """Area (N,) that convex counter-clockwise quadrilaterals (N, 4, 2) have in common.

    Notes
    -----
    The corners of the common polygon are corners of one inside the other and crossings of edges; sorted by angle about their
    mean, the shoelace formula gives the area. Edges that lie on each other add no crossing, but their ends are corners.
    """
    d = np.roll(a, -1, axis=1) - a
    e = np.roll(b, -1, axis=1) - b
    inside_b = np.all(_cross(e[:, None], a[:, :, None] - b[:, None]) >= -1e-9, axis=2)
    inside_a = np.all(_cross(d[:, None], b[:, :, None] - a[:, None]) >= -1e-9, axis=2)
    turn = _cross(d[:, :, None], e[:, None])
    gap = b[:, None] - a[:, :, None]
    parallel = np.abs(turn) < 1e-12
    safe = np.where(parallel, 1.0, turn)
    s, t = _cross(gap, e[:, None]) / safe, _cross(gap, d[:, :, None]) / safe
    crossing = ~parallel & (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    points = np.concatenate([a, b, (a[:, :, None] + s[..., None] * d[:, :, None]).reshape(-1, 16, 2)], axis=1)
    there = np.concatenate([inside_b, inside_a, crossing.reshape(-1, 16)], axis=1)
    count = there.sum(1)
    middle = np.where(there[..., None], points, 0).sum(1) / np.maximum(count, 1)[:, None]
    points = np.where(there[..., None], points - middle[:, None], 0.0)
    angle = np.where(there, np.arctan2(points[..., 1], points[..., 0]), np.inf)
    order = np.argsort(angle, axis=1)
    points = np.take_along_axis(points, order[..., None], axis=1)
    last = np.take_along_axis(there, order, axis=1)
    # Rows behind the polygon's corners repeat its first one, which adds nothing to the area.
    points = np.where(last[..., None], points, points[:, :1])
    area = _cross(points, np.roll(points, -1, axis=1)).sum(1) / 2
    return np.where(count >= 3, np.abs(area), 0.0)


def _cross(u: Array, v: Array) -> Array:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def _text(path: Path) -> str:
    if not path.is_file():
        raise LogError(f"{path}: no such file; expected one text file a sequence, such as 0001.txt")
    if path.stat().st_size > SIZE_LIMIT_BYTES:
        raise LogError(f"{path}: {path.stat().st_size} bytes, more than the {SIZE_LIMIT_BYTES} that it may have")
    return path.read_text(encoding="utf-8", errors="replace")


def _numbers(path: Path, columns: int) -> Array:
    lines = [line.replace(",", " ").split() for line in _text(path).splitlines() if line.strip()]
    for k, words in enumerate(lines, start=1):
        if len(words) != columns:
            raise LogError(f"{path}, line {k}: {len(words)} columns, expected {columns}")
    try:
        rows = np.array(lines, dtype=np.float64).reshape(-1, columns)
    except ValueError as problem:
        raise LogError(f"{path}: {problem}; expected {columns} numbers a line") from None
    bad = ~np.isfinite(rows).all(axis=1)
    if bad.any():
        raise LogError(f"{path}, line {int(np.argmax(bad)) + 1}: expected {columns} finite numbers")
    return rows


def _check_boxes(path: Path, frame: Array, size_m: Array) -> None:
    wrong = (frame < 0) | (frame > FRAME_LIMIT) | (frame % 1 != 0) | (size_m <= 0).any(axis=1)
    if wrong.any():
        k = int(np.argmax(wrong))
        raise LogError(
            f"{path}, line {k + 1}: frame {frame[k]:g} and size {size_m[k].tolist()}, "
            f"expected a whole number from 0 to {FRAME_LIMIT} and sizes greater than 0"
        )
