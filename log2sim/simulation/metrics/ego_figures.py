"""How an ego fared that a policy drove: its progress, its smallest gap and its hardest braking."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Trajectory
from log2sim.geometry import Array, rectangles_overlap
from log2sim.simulation.metrics.box_tracks import BoxTracks
from log2sim.simulation.reactive.path_table import PathTable
from log2sim.simulation.result import AgentReplay

MAX_PAIRS = 100_000
"""Pairs of boxes whose distance is computed at once, which bounds memory."""

MIN_SPEED_MPS = 0.05
"""Below this a vehicle stands, and what its acceleration is then is no braking."""


def ego_figures(ego: AgentReplay, index: int, boxes: BoxTracks, t_s: Array, path: Trajectory) -> dict[str, Any]:
    """Compute the figures of the ego in `metrics.ego` of `schemas/replay-1.json`.

    Parameters
    ----------
    ego : AgentReplay
    index : int
        Its column in `boxes`.
    boxes : BoxTracks
        Of all agents.
    t_s : (S,) float64, s
        Times of the rows of `boxes`.
    path : Trajectory
        Of the ego in the scenario.
    """
    table = PathTable([path])
    gone_m = 0.0
    for x, y in zip(ego.x_m.tolist(), ego.y_m.tolist()):
        gone_m = table.progress_near(0, gone_m, x, y)
    length_m = float(table.at(np.zeros(1, dtype=np.intp), np.array([path.t_s[-1]])).distance_m[0])
    steps_m = np.hypot(np.diff(ego.x_m), np.diff(ego.y_m))
    return {
        "driven_m": round(float(steps_m.sum()), 3),
        "progress_m": round(gone_m, 3),
        "path_m": round(length_m, 3),
        "min_gap": smallest_gap(boxes, index, t_s),
        "max_brake": hardest_brake(ego),
    }


def hardest_brake(ego: AgentReplay) -> dict[str, float] | None:
    """Return the largest deceleration, m/s2, and when it was; None where the ego never slows down."""
    # What the actuators do between two states shows in the speed at its end, so the larger of both speeds says if it moves.
    speed = np.abs(ego.speed_mps)
    moves = np.maximum(speed, np.r_[speed[:1], speed[:-1]]) > MIN_SPEED_MPS
    direction = np.sign(np.where(speed > MIN_SPEED_MPS, ego.speed_mps, np.r_[ego.speed_mps[:1], ego.speed_mps[:-1]]))
    brake = np.where(moves, -ego.accel_mps2 * direction, 0.0)
    k = int(np.argmax(brake)) if len(brake) else 0
    if not len(brake) or brake[k] <= 0:
        return None
    return {"mps2": round(float(brake[k]), 3), "t_s": round(float(ego.t_s[k]), 6)}


def smallest_gap(boxes: BoxTracks, index: int, t_s: Array) -> dict[str, Any] | None:
    """Return the smallest distance of an agent's box, m, from another one at the rows, of which agent (column) and when.

    It is 0 where they overlap. Boxes at different heights, as on a bridge, are not compared. None without any other agent.
    """
    rows, others = _near_pairs(boxes, index)
    if not len(rows):
        return None
    gap = np.concatenate([
        box_distances(boxes, rows[begin : begin + MAX_PAIRS], others[begin : begin + MAX_PAIRS], index)
        for begin in range(0, len(rows), MAX_PAIRS)
    ])  # fmt: skip
    k = int(np.argmin(gap))
    return {"m": round(float(gap[k]), 3), "t_s": round(float(t_s[rows[k]]), 6), "agent": int(others[k])}


def _near_pairs(boxes: BoxTracks, index: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows and agents, (P,) each, among which the nearest box is, whatever the directions of the boxes."""
    far, nearest = boxes.radius_m + boxes.radius_m[index], np.inf
    height = (boxes.size_m[:, 2] + boxes.size_m[index, 2]) / 2
    count = max(1, MAX_PAIRS // len(boxes.size_m))
    found = [np.zeros((2, 0), dtype=np.intp)]
    for begin in range(0, len(boxes.x_m), count):
        rows = slice(begin, begin + count)
        dx, dy, dz = (c[rows] - c[rows, index][:, None] for c in (boxes.x_m, boxes.y_m, boxes.z_m))
        distance = np.where(np.abs(dz) < height, np.hypot(dx, dy), np.inf)  # NaN where one of them is absent: not level
        distance[:, index] = np.inf
        nearest = min(nearest, float(distance.min(initial=np.inf)))
        row, agent = np.nonzero(np.isfinite(distance) & (distance - far <= nearest))
        found.append(np.stack([row + begin, agent]))
    rows_near, agents_near = np.concatenate(found, axis=1)
    return rows_near, agents_near


def box_distances(boxes: BoxTracks, rows: NDArray[np.intp], others: NDArray[np.intp], index: int) -> Array:
    """Return the distances (P,), m, in plan between the box of an agent and those of others at rows; 0 where they overlap."""
    a, b = np.full(len(rows), index), others
    dx, dy = (c[rows, b] - c[rows, a] for c in (boxes.x_m, boxes.y_m))
    yaw_a, yaw_b = boxes.yaw_rad[rows, a], boxes.yaw_rad[rows, b]
    size_a, size_b = boxes.size_m[a], boxes.size_m[b]
    # Of two rectangles that are apart, a corner of one is nearest to the other.
    apart = np.minimum(
        _corner_distance(dx, dy, yaw_a, yaw_b, size_a, size_b), _corner_distance(-dx, -dy, yaw_b, yaw_a, size_b, size_a)
    )
    return np.where(rectangles_overlap(dx, dy, yaw_a, yaw_b, size_a, size_b), 0.0, apart)


def _corner_distance(dx: Array, dy: Array, yaw_a: Array, yaw_b: Array, size_a: Array, size_b: Array) -> Array:
    """Return the distance (P,) of the nearest corner of rectangles b from rectangles a; `dx`, `dy` lead from a to b."""
    cos, sin = np.cos(yaw_a), np.sin(yaw_a)
    ahead, left, turn = dx * cos + dy * sin, dy * cos - dx * sin, yaw_b - yaw_a
    least = np.full(len(dx), np.inf)
    for front, side in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        u, v = front * size_b[:, 0] / 2, side * size_b[:, 1] / 2
        x, y = ahead + u * np.cos(turn) - v * np.sin(turn), left + u * np.sin(turn) + v * np.cos(turn)
        out_x, out_y = np.abs(x) - size_a[:, 0] / 2, np.abs(y) - size_a[:, 1] / 2
        least = np.minimum(least, np.hypot(np.maximum(out_x, 0.0), np.maximum(out_y, 0.0)))
    return least
