"""Time to collision: how soon two boxes would meet at constant velocity."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, separating_axes
from log2sim.simulation.metrics.box_tracks import BoxTracks, RowIndex
from log2sim.simulation.vehicles.vehicle import Columns

HORIZON_S = 10.0
"""Constant velocity is no prediction over a longer time."""

CHUNK = 20
BLOCK = 256
"""Rows and agents of one broad phase, so that its arrays stay small."""


@dataclass(frozen=True, eq=False)
class TimesToCollision(Columns):
    """Pairs a < b (N,) on a collision course.

    Attributes
    ----------
    a, b : (N,) int
    time_s : (N,) float64
        Least time to collision.
    row : (N,) int
        The row at which it occurs.
    """

    a: RowIndex
    b: RowIndex
    time_s: Array
    row: RowIndex


def times_to_collision(boxes: BoxTracks, moves: NDArray[np.bool_], spacing_s: float) -> TimesToCollision:
    """Find the least time to collision of every pair of which at least one moves, up to `HORIZON_S`.

    Notes
    -----
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
            near = _circles_meet(dx, dy, ux, uy, boxes.radius_m[i] + boxes.radius_m[j], 0.0, HORIZON_S)
            k, i, j = k[near], i[near], j[near]
            time = time_to_touch(
                dx[near], dy[near], ux[near], uy[near],
                boxes.yaw_rad[k, i], boxes.yaw_rad[k, j], boxes.size_m[i], boxes.size_m[j],
            )  # fmt: skip
            soon = time <= HORIZON_S
            k, i, j, time = k[soon], i[soon], j[soon], time[soon]
            found.append(_least_per_pair(np.stack([i, j, time, k])[:, _same_height(boxes, climb, i, j, k, time)]))
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
        ends = (np.divide(side * reach - place, rate, out=never.copy(), where=moves) for side in (-1.0, 1.0))
        one, other = ends
        enter = np.maximum(enter, np.minimum(one, other))
        leave = np.minimum(leave, np.where(moves, np.maximum(one, other), -never))
    return enter, leave


def _same_height(
    boxes: BoxTracks, climb: Array, i: RowIndex, j: RowIndex, k: RowIndex, time_s: Array
) -> NDArray[np.bool_]:
    """Whether pairs (N,) are at the same height at rows k, or will be after a time, on a common slope."""
    apart_m = boxes.z_m[k, j] - boxes.z_m[k, i]
    then_m = apart_m + time_s * (climb[k, j] - climb[k, i])
    result: NDArray[np.bool_] = (
        np.minimum(np.abs(apart_m), np.abs(then_m)) < (boxes.size_m[i, 2] + boxes.size_m[j, 2]) / 2
    )
    return result


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
        meet = _circles_meet(
            x[j] - x[i], y[j] - y[i], ux[j] - ux[i], uy[j] - uy[i], radius[i] + radius[j], t[0, 0], HORIZON_S + t[-1, 0]
        )
        yield here[i[meet]], here[j[meet]]


def _circles_meet(
    dx: Array, dy: Array, vx: Array, vy: Array, reach: Array, begin_s: float, end_s: float
) -> NDArray[np.bool_]:
    """Whether points come nearer than `reach` (N,) between two times."""
    square, closing = vx * vx + vy * vy, -(dx * vx + dy * vy)
    t = np.clip(np.divide(closing, square, out=np.zeros_like(square), where=square > 0), begin_s, end_s)
    return (dx + t * vx) ** 2 + (dy + t * vy) ** 2 <= reach**2


def _least_per_pair(found: Array) -> Array:
    """Select from rows a, b, time and row (4, N) those with the least time of each pair, the earliest of equal ones."""
    found = found[:, np.lexsort((found[3], found[2], found[1], found[0]))]
    new = np.ones(found.shape[1], dtype=bool)
    new[1:] = (found[:2, 1:] != found[:2, :-1]).any(axis=0)
    return found[:, new]
