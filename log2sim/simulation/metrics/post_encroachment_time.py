"""Post-encroachment time: the time from one agent leaving a place until another, on a crossing path, is there."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, rectangles_overlap, wrap_angle
from log2sim.simulation.metrics.box_tracks import BoxTracks, RowIndex
from log2sim.simulation.vehicles.vehicle import Columns

HORIZON_S = 10.0
CROSSING_RAD = math.radians(30.0)
"""Smaller differences of headings are those of car following, which the time to collision covers."""

COARSE, FINER, LEVELS = 64, 4, 3
"""Rows of the largest blocks, the factor by which blocks are divided, and the number of sizes."""

BATCH = 2000
"""Pairs whose times are refined together, which bounds memory."""

BLOCK_PAIRS = 20_000
"""Pairs of blocks that are divided together: each becomes up to 256 pairs of parts before its rows."""

PARTS, ZOOMS = 4, 4
"""A row is divided into so many parts so many times: 50 ms to 0.2 ms."""


@dataclass(frozen=True, eq=False)
class PostEncroachmentTimes(Columns):
    """Pairs (N,) of agents on crossing paths.

    Attributes
    ----------
    first, second : (N,) int
        The agent that was at the place first, and second.
    left_row, came_row : (N,) float64
        Fractional rows at which the first left and the second arrived.
    """

    first: RowIndex
    second: RowIndex
    left_row: Array
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
        i = self.i[:, None, None] * FINER + part[:, None]
        j = self.j[:, None, None] * FINER + part
        i, j = np.broadcast_arrays(i, j)
        k, *_ = np.nonzero(i <= j)
        return _Pairs(self.a[k], self.b[k], i[i <= j], j[i <= j])


def post_encroachment_times(boxes: BoxTracks, spacing_s: float) -> PostEncroachmentTimes:
    """Find the shortest post-encroachment time of every pair whose paths cross, up to `HORIZON_S`.

    Notes
    -----
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
    found: list[_Pairs] = []
    for pairs in _overlapping_blocks(hulls[0], _agents_that_move(boxes), lag):
        for hull in hulls[1:]:
            pairs = hull.met(pairs.divided())
        found.append(_shortest(_crossings(boxes, pairs.divided(), lag)))
    if not found:
        none = np.zeros(0, dtype=np.intp)
        return PostEncroachmentTimes(none, none, np.zeros(0), np.zeros(0))
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


def _agents_that_move(boxes: BoxTracks) -> NDArray[np.bool_]:
    """Mark (A,) the agents that change place or heading: who stays neither leaves nor arrives."""
    columns = (boxes.x_m, boxes.y_m, boxes.yaw_rad)
    changes = np.stack([np.fmax.reduce(c, axis=0) > np.fmin.reduce(c, axis=0) for c in columns])
    return np.asarray(changes.any(axis=0))


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
    count = len(boxes.x_m)
    pairs = pairs.take((pairs.i < pairs.j) & (pairs.j < count) & (pairs.j - pairs.i <= lag))
    a, b, i, j = pairs
    angle = np.abs(wrap_angle(boxes.yaw_rad[j, b] - boxes.yaw_rad[i, a]))
    pairs = pairs.take(boxes.present[i, a] & boxes.present[j, b] & (angle >= CROSSING_RAD))
    a, b, i, j = pairs
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
