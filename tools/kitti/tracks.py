"""Tracks of the KITTI tracking benchmark as rows of boxes: the tracker's, frame by frame or with all frames at hand, and their shapes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kitti.boxes import PERIOD_NS, Boxes, Index, Mask
from log2sim.datatypes import GROUP_OF, Measurements, Track
from log2sim.files.arrays import Columns
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.forward import (
    ACCELERATION_MPS2,
    ForwardTracker,
    first_velocity,
    measurement_noise,
    predict,
    update,
)
from log2sim.tracking.tracker import track

# Gaps up to this are bridged offline.
MAX_GAP_S = 2.0
# Offline, tracks are carried on by so many frames at both ends.
EXTENDED_FRAMES = 20
# Online, tracks of at least so many detections are carried on while they are not seen.
COAST_HITS = 3

# Sums are exact in units of one in so many.
SCALE = 1e9


@dataclass(frozen=True, eq=False)
class Rows(Columns):
    """Boxes of tracks (N,)."""

    frame: Index  # (N,)
    track: Index  # (N,)
    source: Index  # (N,): row of the detection, -1 where the box is only predicted
    model: Index  # (N,): row of the detection that tells size, height and heading
    xy_m: Array  # (N, 2): center in the map
    category: NDArray[np.str_]  # (N,)


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
        known = tracker.tracks
        coasting = np.flatnonzero((known["seen_ns"] < now_ns) & (known["hits"] >= COAST_HITS))
        number = np.concatenate([number, known["number"][coasting]])
        source = np.concatenate([source, np.full(len(coasting), -1)])
        parts.append((np.full(len(number), frame), number, source, latest[number], known["mean"][coasting, 0, :2]))
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
    t_ns = np.arange(len(measurements), dtype=np.int64) * PERIOD_NS
    tracks = track(measurements, t_ns, birth_score=0.0, max_gap_s=MAX_GAP_S, min_life_s=0.0, whole_boxes=True)
    rows_of = [t.measurements.points for t in tracks]
    paths = smooth_paths(tracks, t_ns, EXTENDED_FRAMES)
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

    Means over the detections with the category of the track, each by how likely it is one, of the ground and the heading over those
    around; online over those up to a row.
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
    key = rows.track * (int(rows.frame.max(initial=0)) + 2 * NEAR_FRAMES + 1) + rows.frame
    a = np.searchsorted(key, key - NEAR_FRAMES, "left")
    b = np.searchsorted(key, key + (0 if online else NEAR_FRAMES), "right")
    total, *sums = (s[b] - s[a] for s in map(exact_sums, [weight, *(weight * columns.T)]))
    means = np.column_stack(sums) / np.where(total > 0, total, SCALE)[:, None]
    bottom, cos, sin = np.where(total[:, None] > 0, means, columns).T
    turn = np.arctan2(sin, cos) / 2 - yaw
    yaw = yaw + np.mod(turn + np.pi / 2, np.pi) - np.pi / 2
    return np.column_stack([rows.xy_m, bottom + size[:, 2] / 2]), size, yaw


def _mean_of_track(values: Array, weight: Array, begin: Index, *, online: bool) -> Array:
    """Means (N, K) of the values of a track, online of those so far; the value itself where no weight is."""
    end = np.arange(len(begin)) if online else last_of_run(begin)
    total = sum_so_far(weight, begin)[end]
    sums = np.column_stack([sum_so_far(weight * v, begin)[end] for v in values.T])
    return np.where(total[:, None] > 0, sums / np.where(total > 0, total, 1.0)[:, None], values)


@dataclass(frozen=True, eq=False)
class Paths(Columns):
    """Smoothed states, one row a track and tick, sorted by track."""

    track: Index  # (N,)
    tick: Index  # (N,)
    row: Index  # (N,): row of the measurement in the track, -1 in a gap
    mean: Array  # (N, 4): x, y, vx, vy in the map
    covariance: Array  # (N, 4, 4)


def smooth_paths(tracks: Sequence[Track], t_ns: Index, beyond: int) -> Paths:
    """Estimate the states of all tracks at all ticks from their first to their last measurement, and `beyond` ticks before and after.

    The tracker's Kalman filter and Rauch-Tung-Striebel smoother. All tracks are processed in parallel, each from its own first tick on, so
    the number of steps is the length of the longest track.
    """
    first = np.array([t.tick[0] for t in tracks], dtype=np.int64)
    length = np.array([t.tick[-1] for t in tracks], dtype=np.int64) - first + 1
    start = np.cumsum(length) - length
    track = np.repeat(np.arange(len(tracks)), length)
    tick = np.arange(length.sum()) - start[track] + first[track]
    row = np.full(len(track), -1, dtype=np.int64)
    for k, t in enumerate(tracks):
        row[start[k] + t.tick - first[k]] = np.arange(len(t))
    group = np.array([GROUP_OF[t.category] for t in tracks])
    noise = np.array([ACCELERATION_MPS2[g] for g in group.tolist()])
    paths = Paths(track, tick, row, *_smoothed(tracks, group, noise, start, length, t_ns[tick], row >= 0))
    origin = np.repeat(np.concatenate([start + length - 1, start]), beyond)
    step = np.outer(np.repeat([1, -1], len(start)), np.arange(beyond) + 1).ravel()
    there = (tick[origin] + step >= 0) & (tick[origin] + step < len(t_ns))
    origin, later = origin[there], tick[origin[there]] + step[there]
    dt_s = (t_ns[later] - t_ns[tick[origin]]) / NS_PER_S
    predicted = predict(paths.mean[origin], paths.covariance[origin], dt_s, noise[track[origin]])
    paths = Paths.join([paths, Paths(track[origin], later, np.full(len(later), -1), *predicted)])
    return paths.take(np.lexsort([paths.tick, paths.track]))


def _smoothed(
    tracks: Sequence[Track], group: NDArray[np.str_], noise: Array, start: Index, length: Index, t_ns: Index, seen: Mask
) -> tuple[Array, Array]:
    """Smoothed states (N, 4) and covariances (N, 4, 4) of tracks whose rows begin at `start` (A,)."""
    found, at = [t.measurements for t in tracks], np.flatnonzero(seen)
    xy, r, age_s = np.zeros((len(seen), 2)), np.zeros((len(seen), 2, 2)), np.zeros(len(seen))
    xy[at] = np.concatenate([m.center_m[:, :2] for m in found])
    age_s[at] = (np.concatenate([m.t_ns for m in found]) - t_ns[at]) / NS_PER_S
    r[at] = measurement_noise(
        np.concatenate([m.covariance for m in found]), np.repeat(group, [len(t) for t in tracks]), whole_boxes=True
    )
    mean, covariance = np.zeros((len(seen), 4)), np.zeros((len(seen), 4, 4))
    ahead_mean, ahead_covariance = mean.copy(), covariance.copy()
    mean[start, :2], covariance[start, :2, :2] = xy[start], r[start]
    covariance[start, 2:, 2:] = first_velocity(np.array([m.yaw_rad[0] for m in found]), group)
    dt_s = np.diff(t_ns, prepend=0) / NS_PER_S
    for k in range(1, int(length.max(initial=0))):
        on = np.flatnonzero(length > k)
        i = start[on] + k
        ahead_mean[i], ahead_covariance[i] = predict(mean[i - 1], covariance[i - 1], dt_s[i], noise[on])
        mean[i], covariance[i] = ahead_mean[i], ahead_covariance[i]
        if len(j := i[seen[i]]):
            mean[j], covariance[j] = update(mean[j], covariance[j], xy[j], r[j], age_s[j])
    later = np.setdiff1d(np.arange(len(seen)), start)
    step, back = np.tile(np.eye(4), (len(seen), 1, 1)), np.zeros((len(seen), 4, 4))
    step[:, 0, 2] = step[:, 1, 3] = dt_s
    back[later] = np.linalg.solve(ahead_covariance[later], step[later] @ covariance[later - 1]).swapaxes(1, 2)
    for k in range(int(length.max(initial=0)) - 1, 0, -1):
        i = start[length > k] + k
        mean[i - 1] += (back[i] @ (mean[i] - ahead_mean[i])[:, :, None])[..., 0]
        covariance[i - 1] += back[i] @ (covariance[i] - ahead_covariance[i]) @ back[i].swapaxes(1, 2)
    return mean, covariance
