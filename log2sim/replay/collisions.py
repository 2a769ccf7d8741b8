"""Overlaps of oriented boxes over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CHUNK = 20
"""Samples that share one broad phase."""

SAME_CONTACT_S = 0.5  # contacts of a pair that are nearer in time are one collision
LOG_WINDOW_S = 0.5  # a replayed collision is the log's when the log's boxes overlap this near in time,
LOG_MARGIN_M = 0.1  # or pass with less room than this, which is less than boxes err by


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of A agents at S times: centers, yaw and speed (S, A), NaN in `x_m` where an agent is absent; sizes (A, 3)."""

    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    size_m: Array


def overlaps(boxes: Boxes, moves: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Sample, agent and agent (first index the lower) of every overlap of two boxes of which one moves.

    Notes
    -----
    Broad phase: bounding circles' axis-aligned hulls over `CHUNK` samples. Narrow phase: separating axes of the two
    rectangles (Gottschalk et al., 1996) and the vertical extents. Boxes that only touch do not overlap. Cost: A^2
    comparisons a chunk, then the pairs in reach.
    """
    radius = np.hypot(boxes.size_m[:, 0], boxes.size_m[:, 1]) / 2
    found: list[tuple[NDArray[np.intp], ...]] = []
    for begin in range(0, len(boxes.x_m), CHUNK):
        part = slice(begin, begin + CHUNK)
        i, j = _in_reach(boxes.x_m[part], boxes.y_m[part], radius, moves)
        s, k = np.nonzero(~np.isnan(boxes.x_m[part][:, i] + boxes.x_m[part][:, j]))
        s, a, b = s + begin, i[k], j[k]
        hit = _box_overlap(boxes, s, a, b)
        found.append((s[hit], a[hit], b[hit]))
    if not found:
        none = np.zeros(0, dtype=np.intp)
        return none, none, none
    sample, first, second = (np.concatenate([f[c] for f in found]) for c in range(3))
    return sample, first, second


def _in_reach(x: Array, y: Array, radius: Array, moves: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs (P,), (P,) whose hulls over the samples meet, at least one of them moving."""
    present = np.flatnonzero(~np.isnan(x).all(axis=0))
    low = np.stack([np.nanmin(c[:, present], axis=0) - radius[present] for c in (x, y)])
    high = np.stack([np.nanmax(c[:, present], axis=0) + radius[present] for c in (x, y)])
    order = np.argsort(low[0], kind="stable")
    low, high, present = low[:, order], high[:, order], present[order]
    # Sorted by their lower end, the boxes that may meet box k in x are those up to the last one beginning before its end.
    reach = np.searchsorted(low[0], high[0], side="right")
    count = np.maximum(reach - np.arange(len(present)) - 1, 0)
    a = np.repeat(np.arange(len(present)), count)
    b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(count) - count, count)
    meet = (low[1, a] <= high[1, b]) & (low[1, b] <= high[1, a]) & (moves[present[a]] | moves[present[b]])
    pair = np.sort(np.stack([present[a[meet]], present[b[meet]]]), axis=0)
    return pair[0], pair[1]


def _box_overlap(boxes: Boxes, s: NDArray[np.intp], a: NDArray[np.intp], b: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Whether boxes a and b (N,) overlap at samples s (N,)."""
    dx, dy = boxes.x_m[s, b] - boxes.x_m[s, a], boxes.y_m[s, b] - boxes.y_m[s, a]
    size_a, size_b = boxes.size_m[a], boxes.size_m[b]
    vertical = np.abs(boxes.z_m[s, b] - boxes.z_m[s, a]) < (size_a[:, 2] + size_b[:, 2]) / 2
    return vertical & rectangles_overlap(dx, dy, boxes.yaw_rad[s, a], boxes.yaw_rad[s, b], size_a, size_b)


def rectangles_overlap(
    dx: Array, dy: Array, yaw_a: Array, yaw_b: Array, size_a: Array, size_b: Array
) -> NDArray[np.bool_]:
    """Whether rectangles overlap (N,): `dx`, `dy` lead from a to b, sizes (N, 2 or more) are length and width."""
    turn = yaw_b - yaw_a
    c, s = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    apart = np.zeros(len(dx), dtype=bool)
    for yaw, own, other in ((yaw_a, size_a, size_b), (yaw_b, size_b, size_a)):
        along, across = dx * np.cos(yaw) + dy * np.sin(yaw), dy * np.cos(yaw) - dx * np.sin(yaw)
        apart |= np.abs(along) >= (own[:, 0] + other[:, 0] * c + other[:, 1] * s) / 2
        apart |= np.abs(across) >= (own[:, 1] + other[:, 0] * s + other[:, 1] * c) / 2
    return ~apart


def collisions(
    replayed: Boxes, logged: Boxes, moves: NDArray[np.bool_], t_s: Array, ids: Sequence[str]
) -> list[dict[str, Any]]:
    """Collisions of a replay in order of time: the pair, first and last contact, relative speed, and if the log has it."""
    grown = replace(logged, size_m=logged.size_m + np.array([LOG_MARGIN_M, LOG_MARGIN_M, 0.0]))
    log_sample, log_a, log_b = overlaps(grown, moves)
    known: dict[tuple[int, int], Array] = {}
    for pair in set(zip(log_a.tolist(), log_b.tolist())):
        known[pair] = t_s[log_sample[(log_a == pair[0]) & (log_b == pair[1])]]
    sample, first, second = overlaps(replayed, moves)
    events: list[dict[str, Any]] = []
    for a, b in sorted(set(zip(first.tolist(), second.tolist()))):
        contact = np.sort(sample[(first == a) & (second == b)])
        for run in np.split(contact, np.flatnonzero(np.diff(t_s[contact]) > SAME_CONTACT_S) + 1):
            begin, end = float(t_s[run[0]]), float(t_s[run[-1]])
            logged_at = known.get((a, b), np.zeros(0))
            shared = bool(np.any((logged_at >= begin - LOG_WINDOW_S) & (logged_at <= end + LOG_WINDOW_S)))
            events.append(
                {
                    "agents": [ids[a], ids[b]],
                    "t_s": round(begin, 6),
                    "until_s": round(end, 6),
                    "relative_speed_mps": round(_relative_speed(replayed, int(run[0]), a, b), 3),
                    "in_log": shared,
                }
            )
    return sorted(events, key=lambda e: (e["t_s"], e["agents"]))


def _relative_speed(boxes: Boxes, s: int, a: int, b: int) -> float:
    va, vb = (boxes.speed_mps[s, k] * np.exp(1j * boxes.yaw_rad[s, k]) for k in (a, b))
    return float(abs(va - vb))
