"""Conflicts: pairs of agents with a time to collision or a post-encroachment time."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO
from log2sim.geometry import Array, rectangles_overlap, separating_axes, wrap_angle
from log2sim.simulation.metrics.collisions import CHUNK, REPLAY, BoxTracks, RowIndex, circles_meet, spacing_s

HORIZON_S = 10.0  # constant velocity is no prediction over a longer time
BLOCK = 256  # rows and agents of one broad phase, so that its arrays stay small


@dataclass(frozen=True, eq=False)
class TimesToCollision:
    """Pairs a < b (N,) on a collision course."""

    a: RowIndex
    b: RowIndex
    time_s: Array  # least time to collision
    row: RowIndex  # at which it occurs


def times_to_collision(boxes: BoxTracks, moves: NDArray[np.bool_], spacing_s: float) -> TimesToCollision:
    """Find the least time to collision of every pair of which at least one moves, up to `HORIZON_S`.

    Time-to-collision of Hayward (1972) in the plane: both boxes keep their velocity and their heading; see `time_to_touch`.
    Boxes that overlap already have none. It is evaluated at every row and ignores the road: two agents that pass each other
    in a bend count as on a collision course. Cost: the pairs in reach for every `CHUNK` rows, then those on course.
    """
    (vx, vy), climb = boxes.velocities(spacing_s), boxes.climbs(spacing_s)
    found = [np.zeros((4, 0))]
    for begin in range(0, len(boxes.x_m), CHUNK):
        rows = slice(begin, begin + CHUNK)
        for a, b in _candidate_pairs(boxes, vx[rows], vy[rows], rows, moves, spacing_s):
            k, pair = np.nonzero(boxes.present[rows][:, a] & boxes.present[rows][:, b])
            k, i, j = k + begin, a[pair], b[pair]
            dx, dy = boxes.x_m[k, j] - boxes.x_m[k, i], boxes.y_m[k, j] - boxes.y_m[k, i]
            ux, uy = vx[k, j] - vx[k, i], vy[k, j] - vy[k, i]
            near = circles_meet(dx, dy, ux, uy, boxes.radius_m[i] + boxes.radius_m[j], 0.0, HORIZON_S)
            k, i, j = k[near], i[near], j[near]
            time = time_to_touch(
                dx[near], dy[near], ux[near], uy[near],
                boxes.yaw_rad[k, i], boxes.yaw_rad[k, j], boxes.size_m[i], boxes.size_m[j],
            )  # fmt: skip
            soon = time <= HORIZON_S
            k, i, j, time = k[soon], i[soon], j[soon], time[soon]
            # Whether pairs (N,) are at the same height at rows k, or will be after a time, on a common slope.
            apart_m = boxes.z_m[k, j] - boxes.z_m[k, i]
            then_m = apart_m + time * (climb[k, j] - climb[k, i])
            height_m = (boxes.size_m[i, 2] + boxes.size_m[j, 2]) / 2
            level = np.minimum(np.abs(apart_m), np.abs(then_m)) < height_m
            found.append(_least_per_pair(np.stack([i, j, time, k])[:, level]))
    a, b, time, row = _least_per_pair(np.concatenate(found, axis=1))
    return TimesToCollision(a.astype(np.intp), b.astype(np.intp), time, row.astype(np.intp))


def time_to_touch(
    dx: Array, dy: Array, vx: Array, vy: Array, yaw_a: Array, yaw_b: Array, size_a: Array, size_b: Array
) -> Array:
    """Return the time in s (N,) until rectangles touch, inf where they never do or overlap already.

    `dx`, `dy` lead from a to b and change at `vx`, `vy`.
    """
    enter, leave = touching(dx, dy, vx, vy, yaw_a, yaw_b, size_a, size_b)
    return np.where((enter >= 0) & (enter < leave), enter, np.inf)


def touching(
    dx: Array, dy: Array, vx: Array, vy: Array, yaw_a: Array, yaw_b: Array, size_a: Array, size_b: Array
) -> tuple[Array, Array]:
    """Return the times in s (N,) from and until which rectangles touch, negative ones too; enter < leave only where they do.

    On each separating axis the projections overlap for one interval of time; the rectangles do while all four do. Exact.
    """
    enter, leave = np.full(len(dx), -np.inf), np.full(len(dx), np.inf)
    for nx, ny, reach, _ in separating_axes(yaw_a, yaw_b, size_a, size_b):
        place, rate = dx * nx + dy * ny, vx * nx + vy * ny
        moves = rate != 0
        never = np.where(np.abs(place) < reach, -np.inf, np.inf)  # of a shadow that keeps its place
        one, other = (np.divide(side * reach - place, rate, out=never.copy(), where=moves) for side in (-1.0, 1.0))
        enter = np.maximum(enter, np.minimum(one, other))
        leave = np.minimum(leave, np.where(moves, np.maximum(one, other), -never))
    return enter, leave


def _candidate_pairs(
    boxes: BoxTracks, vx: Array, vy: Array, rows: slice, moves: NDArray[np.bool_], spacing_s: float
) -> Iterator[tuple[RowIndex, RowIndex]]:
    """Yield pairs (P,), (P,) that may meet within the horizon after one of the rows.

    For these rows each agent is a circle on a straight line, large enough to contain its places and, at all its
    velocities, the places within the horizon.
    """
    from scipy.spatial import cKDTree

    here = np.flatnonzero(boxes.present[rows].any(axis=0))
    t = (np.arange(len(vx)) - (len(vx) - 1) / 2)[:, None] * spacing_s
    radius = boxes.radius_m[here]
    lines = []
    for values, velocity in ((boxes.x_m[rows][:, here], vx[:, here]), (boxes.y_m[rows][:, here], vy[:, here])):
        mean = np.nanmean(velocity, axis=0)
        start = np.nanmean(values - mean * t, axis=0)
        off = np.abs(values - mean * t - start) + HORIZON_S * np.abs(velocity - mean)
        radius = radius + np.nanmax(off, axis=0)
        lines.append((start, mean))
    (x, ux), (y, uy) = lines
    places, reach = np.stack([x, y], axis=1), radius + np.hypot(ux, uy) * (HORIZON_S + t[-1, 0])
    tree = cKDTree(places)
    for first in range(0, len(here), BLOCK):
        block = slice(first, first + BLOCK)
        within_m = np.max(reach[block]) + np.max(reach)
        found = cKDTree(places[block]).sparse_distance_matrix(tree, within_m, output_type="ndarray")
        i, j = first + found["i"], found["j"]
        pair = (j > i) & (moves[here[i]] | moves[here[j]])
        i, j = i[pair], j[pair]
        meet = circles_meet(
            x[j] - x[i], y[j] - y[i], ux[j] - ux[i], uy[j] - uy[i], radius[i] + radius[j], t[0, 0], HORIZON_S + t[-1, 0]
        )
        yield here[i[meet]], here[j[meet]]


def _least_per_pair(found: Array) -> Array:
    """Select from rows a, b, time and row (4, N) those with the least time of each pair, the earliest of equal ones."""
    found = found[:, np.lexsort((found[3], found[2], found[1], found[0]))]
    new = np.ones(found.shape[1], dtype=bool)
    new[1:] = (found[:2, 1:] != found[:2, :-1]).any(axis=0)
    return found[:, new]


# Smaller differences of headings are those of car following, which the time to collision covers.
CROSSING_RAD = math.radians(30.0)

# Rows of the largest blocks, the factor by which blocks are divided, and the number of sizes.
COARSE, FINER, LEVELS = 64, 4, 3
BATCH = 2000  # pairs whose times are refined together, which bounds memory
BLOCK_PAIRS = 20_000  # pairs of blocks that are divided together: each becomes up to 256 pairs of parts before its rows
PARTS, ZOOMS = 4, 4  # a row is divided into so many parts so many times: 50 ms to 0.2 ms


@dataclass(frozen=True, eq=False)
class PostEncroachmentTimes:
    """Pairs (N,) of agents on crossing paths."""

    first: RowIndex  # the agent that was at the place first, and second
    second: RowIndex
    left_row: Array  # fractional rows at which the first left and the second arrived
    came_row: Array


class _Pairs(NamedTuple):
    """Agents `a` and `b` (N,) in blocks or at rows `i` and `j` (N,); `a` is the first to be at the place."""

    a: RowIndex
    b: RowIndex
    i: RowIndex
    j: RowIndex

    def take(self, index: NDArray[Any] | slice) -> _Pairs:
        """Select pairs by index."""
        return _Pairs(*(column[index] for column in self))

    def divided(self) -> _Pairs:
        """Divide the blocks and return all pairs of parts in which the second agent is not before the first."""
        part = np.arange(FINER)
        i, j = self.i[:, None, None] * FINER + part[:, None], self.j[:, None, None] * FINER + part
        i, j = np.broadcast_arrays(i, j)
        k, *_ = np.nonzero(i <= j)
        return _Pairs(self.a[k], self.b[k], i[i <= j], j[i <= j])


def post_encroachment_times(boxes: BoxTracks, spacing_s: float) -> PostEncroachmentTimes:
    """Find the shortest post-encroachment time of every pair whose paths cross, up to `HORIZON_S`.

    Allen, Shin and Cooper (1978): the time from the moment when the first road user has left the area that both cover
    until the second one reaches it. Here it is the least time between two moments at which the boxes of the first and
    of the second cover a place in common. Where two paths cross that is the same, and it is also defined in bends and
    where paths merge (FHWA-HRT-08-051, 2008, likewise takes it at positions). It counts if the scenario shows the first
    leave and the second arrive, and if their headings differ there by at least `CROSSING_RAD`.

    Method: oriented rectangles around the areas that boxes sweep during 64 rows are compared, then 16 and 4 rows where these
    overlap, then the boxes; the time is refined within a row. Cost: A log A for every 64 rows, then the overlapping pairs.
    """
    lag = HORIZON_S / spacing_s
    hulls = [_SweptRectangles(boxes, COARSE // FINER**level) for level in range(LEVELS)]
    # Who changes neither place nor heading neither leaves nor arrives.
    columns = (boxes.x_m, boxes.y_m, boxes.yaw_rad)
    moves = np.any([np.fmax.reduce(c, axis=0) > np.fmin.reduce(c, axis=0) for c in columns], axis=0)
    found = [_Pairs(*np.zeros((4, 0), dtype=np.intp))]
    for pairs in _overlapping_blocks(hulls[0], moves, lag):
        for hull in hulls[1:]:
            pairs = hull.met(pairs.divided())
        found.append(_shortest(_crossings(boxes, pairs.divided(), lag)))
    pairs = _shortest(_Pairs(*(np.concatenate(column) for column in zip(*found))))
    left, came = np.zeros(len(pairs.a)), np.zeros(len(pairs.a))
    for begin in range(0, len(left), BATCH):
        part = slice(begin, begin + BATCH)
        left[part], came[part] = _refined(boxes, pairs.take(part))
    return PostEncroachmentTimes(pairs.a, pairs.b, left, came)


class _SweptRectangles:
    """Rectangles (K, A) around the area that each box sweeps during `size` rows; NaN where absent."""

    def __init__(self, boxes: BoxTracks, size: int) -> None:
        count = len(boxes.x_m)
        rows = np.minimum(np.arange(0, count, size)[:, None] + np.arange(size + 1), count - 1)
        self.size = size
        yaw = boxes.yaw_rad[rows]
        direction = np.where(boxes.present[rows], np.exp(1j * np.where(boxes.present[rows], yaw, 0.0)), 0.0).sum(axis=1)
        self.yaw_rad = np.angle(direction)
        turn = wrap_angle(yaw - self.yaw_rad[:, None])
        self.spread_rad = np.fmax.reduce(np.abs(turn), axis=1)
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        x0, y0 = (np.fmax.reduce(c[rows], axis=1) for c in (boxes.x_m, boxes.y_m))
        dx, dy = boxes.x_m[rows] - x0[:, None], boxes.y_m[rows] - y0[:, None]
        c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
        length, width, height = boxes.size_m.T
        along = _extent(dx * cos[:, None] + dy * sin[:, None], (length * c + width * s) / 2)
        across = _extent(dy * cos[:, None] - dx * sin[:, None], (width * c + length * s) / 2)
        self.low_m, self.high_m = _extent(boxes.z_m[rows], np.broadcast_to(height / 2, rows.shape + height.shape))
        u, v = (along[0] + along[1]) / 2, (across[0] + across[1]) / 2
        self.x_m, self.y_m = x0 + u * cos - v * sin, y0 + u * sin + v * cos
        self.size_m = np.stack([along[1] - along[0], across[1] - across[0]], axis=-1)
        self.radius_m = np.hypot(self.size_m[..., 0], self.size_m[..., 1]) / 2

    def met(self, pairs: _Pairs) -> _Pairs:
        """Select the pairs whose rectangles overlap in blocks `i` and `j`, with headings that may cross."""
        inside = np.maximum(pairs.i, pairs.j) < len(self.x_m)
        pairs = pairs.take(inside)
        one, two = (pairs.i, pairs.a), (pairs.j, pairs.b)
        angle = np.abs(wrap_angle(self.yaw_rad[two] - self.yaw_rad[one])) + self.spread_rad[one] + self.spread_rad[two]
        level = (self.low_m[one] < self.high_m[two]) & (self.low_m[two] < self.high_m[one])
        pairs = pairs.take(level & (angle >= CROSSING_RAD))
        one, two = (pairs.i, pairs.a), (pairs.j, pairs.b)
        meet = rectangles_overlap(
            self.x_m[two] - self.x_m[one], self.y_m[two] - self.y_m[one],
            self.yaw_rad[one], self.yaw_rad[two], self.size_m[one], self.size_m[two],
        )  # fmt: skip
        return pairs.take(meet)


def _extent(values: Array, half: Array) -> tuple[Array, Array]:
    """Return minimum and maximum (K, A) of intervals (K, R, A) around values; NaN where all are."""
    return np.fmin.reduce(values - half, axis=1), np.fmax.reduce(values + half, axis=1)


def _overlapping_blocks(hulls: _SweptRectangles, moves: NDArray[np.bool_], lag: float) -> Iterator[_Pairs]:
    """Yield the overlapping pairs of agents that move (A,), of two blocks of rows and up to `BLOCK_PAIRS` at a time."""
    from scipy.spatial import cKDTree

    count = len(hulls.x_m)
    there = [np.flatnonzero(~np.isnan(x) & moves) for x in hulls.x_m]
    trees = [cKDTree(np.stack([x[k], y[k]], axis=1)) for x, y, k in zip(hulls.x_m, hulls.y_m, there)]
    reach = [np.max(radius[k], initial=0.0) for radius, k in zip(hulls.radius_m, there)]
    for i in range(count):
        for j in range(i, min(count, i + int(lag // hulls.size) + 2)):
            found = trees[i].sparse_distance_matrix(trees[j], reach[i] + reach[j], output_type="ndarray")
            a, b = there[i][found["i"]], there[j][found["j"]]
            near = (a != b) & (found["v"] < hulls.radius_m[i, a] + hulls.radius_m[j, b])
            a, b = a[near], b[near]
            met = hulls.met(_Pairs(a, b, np.full(len(a), i), np.full(len(a), j)))
            yield from (met.take(slice(k, k + BLOCK_PAIRS)) for k in range(0, len(met.a), BLOCK_PAIRS))


def _crossings(boxes: BoxTracks, pairs: _Pairs, lag: float) -> _Pairs:
    """Select the pairs of rows at which the boxes cover a common place that one leaves before the other arrives."""
    a, b, i, j = pairs = pairs.take((pairs.i < pairs.j) & (pairs.j < len(boxes.x_m)) & (pairs.j - pairs.i <= lag))
    angle = np.abs(wrap_angle(boxes.yaw_rad[j, b] - boxes.yaw_rad[i, a]))
    a, b, i, j = pairs = pairs.take(boxes.present[i, a] & boxes.present[j, b] & (angle >= CROSSING_RAD))
    a, b, i, j = pairs = pairs.take(boxes.overlap(i, a, j, b))
    stays, was = boxes.overlap(boxes.last_row[a], a, j, b), boxes.overlap(i, a, boxes.first_row[b], b)
    return pairs.take(~stays & ~was)


def _shortest(pairs: _Pairs) -> _Pairs:
    """Select the pair of rows with the least time between them for every two agents."""
    low, high = np.minimum(pairs.a, pairs.b), np.maximum(pairs.a, pairs.b)
    pairs = pairs.take(order := np.lexsort((pairs.j, pairs.j - pairs.i, high, low)))
    low, high = low[order], high[order]
    new = np.ones(len(low), dtype=bool)
    new[1:] = (low[1:] != low[:-1]) | (high[1:] != high[:-1])
    return pairs.take(new)


def _refined(boxes: BoxTracks, pairs: _Pairs) -> tuple[Array, Array]:
    """Return fractional rows (N,), (N,): the ones nearest in time on ever finer grids around the rows found."""
    a, b, left, came = pairs.a, pairs.b, pairs.i.astype(np.float64), pairs.j.astype(np.float64)
    offset = np.arange(-PARTS, PARTS + 1)
    shape = (len(a), len(offset), len(offset))
    for zoom in range(1, ZOOMS + 1):
        step = offset / PARTS**zoom
        i = np.clip(left[:, None] + step, boxes.first_row[a][:, None], boxes.last_row[a][:, None])
        j = np.clip(came[:, None] + step, boxes.first_row[b][:, None], boxes.last_row[b][:, None])
        all_i, all_j, all_a, all_b = (
            np.broadcast_to(c, shape).ravel()
            for c in (i[:, :, None], j[:, None, :], a[:, None, None], b[:, None, None])
        )
        meets = boxes.overlap(all_i, all_a, all_j, all_b) & (all_i <= all_j)  # those who collide share a moment
        apart = np.where(meets, all_j - all_i, np.inf)
        best = np.argmin(apart.reshape(len(a), len(offset) ** 2), axis=1) + np.arange(len(a)) * len(offset) ** 2
        left, came = all_i[best], all_j[best]
    return left, came


Event = Mapping[str, Any]


def conflicts(
    boxes: BoxTracks, moves: NDArray[np.bool_], t_s: Array, ids: Sequence[str], collisions: Iterable[Event]
) -> list[dict[str, Any]]:
    """Return one record for every pair with a time to collision or a post-encroachment time, the most critical first.

    Both times of a pair with a collision that the scenario does not have are 0 when it begins; `contact` is "none", "new"
    or "scenario".
    """
    step_s = spacing_s(t_s)
    rows = np.arange(len(t_s), dtype=np.float64)
    by_pair: dict[tuple[int, int], dict[str, Any]] = {}

    def record(a: int, b: int) -> dict[str, Any]:
        pair = (min(a, b), max(a, b))
        agents = [ids[k] for k in pair]
        times = dict.fromkeys(("min_ttc_s", "min_ttc_t_s", "pet_s", "pet_t_s", "pet_first"))
        return by_pair.setdefault(pair, {"agents": agents, "ego": EGO in agents, "contact": "none", **times})

    close = times_to_collision(boxes, moves, step_s)
    for a, b, time_s, row in zip(*(c.tolist() for c in (close.a, close.b, close.time_s, close.row))):
        record(a, b).update(min_ttc_s=round(time_s, 4), min_ttc_t_s=round(float(t_s[row]), 6))
    crossed = post_encroachment_times(boxes, step_s)
    left, came = (np.interp(row, rows, t_s) for row in (crossed.left_row, crossed.came_row))
    for a, b, left_s, came_s in zip(crossed.first.tolist(), crossed.second.tolist(), left.tolist(), came.tolist()):
        record(a, b).update(pet_s=round(came_s - left_s, 4), pet_t_s=round(came_s, 6), pet_first=ids[a])
    index = {k: n for n, k in enumerate(ids)}
    for event in collisions:
        entry = record(*(index[k] for k in event["agents"]))
        if event["belongs_to"] == REPLAY and entry["contact"] != "new":
            t = event["t_s"]
            entry.update(contact="new", min_ttc_s=0.0, min_ttc_t_s=t, pet_s=0.0, pet_t_s=t, pet_first=None)
        elif event["belongs_to"] != REPLAY and entry["contact"] == "none":
            entry["contact"] = "scenario"

    def urgency(entry: Event) -> tuple[float, list[str]]:
        return min((v for v in (entry["min_ttc_s"], entry["pet_s"]) if v is not None), default=np.inf), entry["agents"]

    return sorted(by_pair.values(), key=urgency)


def most_critical(found: Iterable[Event], key: str) -> dict[str, Any] | None:
    """Return `agents`, `t_s` and value `s` of the record with the least `key` ("min_ttc" or "pet"); None without any.

    Pairs that touch in the scenario itself are left out: the errors of its boxes are larger than the gap between them.
    """
    known = [e for e in found if e[f"{key}_s"] is not None and e["contact"] != "scenario"]
    if not known:
        return None
    first = min(known, key=lambda e: (e[f"{key}_s"], e["agents"]))
    return {"s": first[f"{key}_s"], "t_s": first[f"{key}_t_s"], "agents": list(first["agents"])}
