"""Boxes of the KITTI tracking benchmark: detections, labels and results as columns, and how far 3D boxes overlap."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kitti.paths import smooth_paths
from log2sim.datatypes import Measurements
from log2sim.errors import LogError
from log2sim.geometry import NS_PER_S, Array, rectangle_overlap
from log2sim.tracking.forward import ForwardTracker
from log2sim.tracking.tracker import track

PERIOD_NS = 100_000_000

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
    top = np.maximum(a.bottom_m[:, 1] - a.size_hwl_m[:, 0], b.bottom_m[:, 1] - b.size_hwl_m[:, 0])
    height = np.clip(np.minimum(a.bottom_m[:, 1], b.bottom_m[:, 1]) - top, 0, None)
    common = rectangle_overlap(_from_above(a), _from_above(b)) * height
    union = a.size_hwl_m.prod(1) + b.size_hwl_m.prod(1) - common
    return np.divide(common, union, out=np.zeros(len(a)), where=union > 0)


def _from_above(boxes: Boxes) -> Array:
    """Rectangles (N, 5) on the camera's x-z plane, on which rotation_y, from z toward x, is clockwise."""
    return np.column_stack([boxes.bottom_m[:, [0, 2]], boxes.size_hwl_m[:, :0:-1], -boxes.yaw_rad])


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


# Gaps up to this are bridged offline.
MAX_GAP_S = 2.0
# Offline, tracks of at least so many detections with this mean score (a logit) are carried on by so many frames at both ends.
EXTENDED_HITS, EXTENDED_SCORE, EXTENDED_FRAMES = 3, 2.0, 20
# Online, tracks of at least so many detections are carried on while they are not seen.
COAST_HITS = 3

# Sums are exact in units of one in so many.
SCALE = 1e9

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Rows:
    """Boxes of tracks (N,)."""

    frame: Index  # (N,)
    track: Index  # (N,)
    source: Index  # (N,): row of the detection, -1 where the box is only predicted
    model: Index  # (N,): row of the detection that tells size, height and heading
    xy_m: Array  # (N, 2): center in the map
    category: NDArray[np.str_]  # (N,)

    def take(self, index: NDArray[np.generic]) -> Rows:
        """The rows at `index`."""
        return Rows(*(column[index] for column in vars(self).values()))


def rows_online(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """What the tracker says frame by frame, from that frame and those before it."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    tracker = ForwardTracker(birth_score=0.0, period_s=PERIOD_NS / NS_PER_S, whole_boxes=True)
    latest = np.zeros(len(boxes), dtype=np.int64)  # row of the last detection, by track
    parts: list[tuple[Index, Index, Index, Index, Array]] = []
    for frame, found in enumerate(measurements):
        now_ns = frame * PERIOD_NS
        taken, number = tracker.step(found, now_ns)
        source = first[frame] + taken
        latest[number] = source
        coasting = np.flatnonzero((tracker.seen_ns < now_ns) & (tracker.hits >= COAST_HITS))
        number = np.concatenate([number, tracker.number[coasting]])
        source = np.concatenate([source, np.full(len(coasting), -1)])
        parts.append((np.full(len(number), frame), number, source, latest[number], tracker.mean[coasting, :2]))
    frames, number, source, model, predicted = (np.concatenate(c) for c in zip(*parts))
    xy = Measurements.join(measurements).center_m[model, :2]
    xy[source < 0] = predicted
    return Rows(frames, number, source, model, xy, boxes.category[model])


def first_of_run(number: Index) -> Index:
    """Index (N,) of the first row of the run of equal numbers that each row is in."""
    fresh = np.r_[True, np.diff(number) != 0][: len(number)]
    return np.flatnonzero(fresh)[np.cumsum(fresh) - 1] if len(number) else np.zeros(0, dtype=np.int64)


def last_of_run(begin: Index) -> Index:
    """Index (N,) of the last row of each run, from that of its first row, `begin` (N,)."""
    return np.r_[np.unique(begin)[1:], len(begin)][np.cumsum(begin == np.arange(len(begin))) - 1] - 1


def sum_so_far(values: NDArray[np.generic], begin: Index) -> Array:
    """Sums (N,) from the first row of a run, `begin` (N,), to each of its rows."""
    total = exact_sums(values)
    return np.asarray((total[1:] - total[begin]) / SCALE)


def exact_sums(values: NDArray[np.generic]) -> Index:
    """Sums (N + 1,) of all values (N,) before each place, in units of 1 / `SCALE`.

    Whole numbers: differences of sums would otherwise depend, in the last digit, on what was summed before.
    """
    return np.r_[0, np.cumsum(np.round(np.asarray(values, dtype=np.float64) * SCALE).astype(np.int64))]


def rows_offline(boxes: Boxes, measurements: Sequence[Measurements]) -> Rows:
    """Stitched tracks on their smoothed paths, with the gaps and some frames before and after them."""
    first = np.searchsorted(boxes.frame, np.arange(len(measurements)))
    t_ns = np.arange(len(measurements), dtype=np.int64) * PERIOD_NS
    # The tracker does not read how many points there were, so the row of a detection travels in their place.
    marked = [replace(m, points=first[k] + np.arange(len(m))) for k, m in enumerate(measurements)]
    tracks = track(marked, t_ns, birth_score=0.0, max_gap_s=MAX_GAP_S, min_life_s=0.0, whole_boxes=True)
    rows_of = [t.measurements.points for t in tracks]
    extended = np.array([len(r) >= EXTENDED_HITS and boxes.score[r].mean() >= EXTENDED_SCORE for r in rows_of])
    paths = smooth_paths(tracks, t_ns, whole_boxes=True, beyond=np.where(extended, EXTENDED_FRAMES, 0))
    seen = paths.row >= 0
    source = np.full(len(seen), -1, dtype=np.int64)
    source[seen] = np.concatenate(rows_of)
    category = np.array([boxes.category[r][t.measurements.category == t.category][0] for r, t in zip(rows_of, tracks)])
    # What is not seen looks like the nearest detection.
    before, after = neighbors(seen, paths.track)
    nearest = np.where(paths.tick - paths.tick[before] <= paths.tick[after] - paths.tick, before, after)
    return Rows(paths.tick, paths.track, source, source[nearest], paths.mean[:, :2], category[paths.track])


def neighbors(seen: Mask, track: Index) -> tuple[Index, Index]:
    """Rows (N,) of the last detection up to each row and of the first one from it on, rows sorted by track and frame.

    Beyond the ends of a track both are the detection at that end.
    """
    at = np.arange(len(seen))
    before = np.maximum.accumulate(np.where(seen, at, -1))
    after = np.minimum.accumulate(np.where(seen, at, len(seen))[::-1])[::-1]
    no_before = (before < 0) | (track[before] != track)
    no_after = after == len(seen)
    no_after |= track[np.where(no_after, 0, after)] != track
    return np.where(no_before, after, before), np.where(no_after, before, after)


def end_rows(rows: Rows, *, online: bool) -> tuple[Index, Index]:
    """Rows (N,) of the first and the last detection of the track of each row, online of the last one so far."""
    before, after = neighbors(rows.source >= 0, rows.track)
    begin = first_of_run(rows.track)
    return after[begin], before if online else before[last_of_run(begin)]


# An object keeps its size; the ground under it and its heading are taken to be the same for so many frames before and after.
NEAR_FRAMES = 3


def smooth_shapes(rows: Rows, boxes: Boxes, measurements: Measurements, *, online: bool) -> tuple[Array, Array, Array]:
    """Centers (N, 3) and yaws (N,) in the map and sizes (N, 3) length, width, height of rows by track and frame.

    Means over the detections with the category of the track, each by how likely it is one; online over those up to a row.
    """
    chance = np.where(rows.source >= 0, 1 / (1 + np.exp(-boxes.score[rows.source])), 0.0)
    begin = first_of_run(rows.track)
    size = boxes.size_hwl_m[rows.model, ::-1].copy()
    for category in np.unique(rows.category):
        # Online a track may have had another category before.
        weight = np.where(boxes.category[rows.source] == category, chance, 0.0)
        of = rows.category == category
        size[of] = _mean_of_track(boxes.size_hwl_m[rows.model, ::-1], weight, begin, online=online)[of]
    bottom = measurements.center_m[rows.model, 2] - boxes.size_hwl_m[rows.model, 0] / 2
    yaw = measurements.yaw_rad[rows.model]
    # Twice the angle: a box is the same from the front and from behind.
    columns = np.column_stack([bottom, np.cos(2 * yaw), np.sin(2 * yaw)])
    weight = np.where(boxes.category[rows.source] == rows.category, chance, 0.0)
    bottom, cos, sin = _mean_nearby(columns, weight, rows, online=online).T
    turn = np.arctan2(sin, cos) / 2 - yaw
    yaw = yaw + np.mod(turn + np.pi / 2, np.pi) - np.pi / 2
    return np.column_stack([rows.xy_m, bottom + size[:, 2] / 2]), size, yaw


def _mean_of_track(values: Array, weight: Array, begin: Index, *, online: bool) -> Array:
    """Means (N, K) of the values of a track, online of those so far; the value itself where no weight is."""
    end = np.arange(len(begin)) if online else last_of_run(begin)
    total = sum_so_far(weight, begin)[end]
    sums = np.column_stack([sum_so_far(weight * v, begin)[end] for v in values.T])
    return np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1.0)[:, None], values)


def _mean_nearby(values: Array, weight: Array, rows: Rows, *, online: bool) -> Array:
    """Means (N, K) of the values of a track in the frames around; the value itself where no weight is."""
    key = rows.track * (int(rows.frame.max(initial=0)) + 2 * NEAR_FRAMES + 1) + rows.frame
    a = np.searchsorted(key, key - NEAR_FRAMES, "left")
    b = np.searchsorted(key, key + (0 if online else NEAR_FRAMES), "right")
    total, *sums = (s[b] - s[a] for s in map(exact_sums, [weight, *(weight * values.T)]))
    means = np.column_stack(sums) / np.where(total > 0, total, SCALE)[:, None]
    return np.where(total[:, None] > 0, means, values)
