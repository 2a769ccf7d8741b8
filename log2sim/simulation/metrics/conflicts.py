"""Conflicts: pairs of agents with a time to collision or a post-encroachment time, and whether they collide."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import EGO
from log2sim.geometry import Array
from log2sim.simulation.metrics.box_tracks import BoxTracks, spacing_s
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.metrics.post_encroachment_time import post_encroachment_times
from log2sim.simulation.metrics.time_to_collision import times_to_collision

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
        if pair not in by_pair:
            by_pair[pair] = _new_record(ids[pair[0]], ids[pair[1]])
        return by_pair[pair]

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
    return sorted(by_pair.values(), key=lambda e: (_urgency_s(e), e["agents"]))


def most_critical(found: Iterable[Event], key: str) -> dict[str, Any] | None:
    """Return `agents`, `t_s` and value `s` of the record with the least `key` ("min_ttc" or "pet"); None without any.

    Pairs that touch in the scenario itself are left out: the errors of its boxes are larger than the gap between them.
    """
    known = [e for e in found if e[f"{key}_s"] is not None and e["contact"] != "scenario"]
    if not known:
        return None
    first = min(known, key=lambda e: (e[f"{key}_s"], e["agents"]))
    return {"s": first[f"{key}_s"], "t_s": first[f"{key}_t_s"], "agents": list(first["agents"])}


def _new_record(a: str, b: str) -> dict[str, Any]:
    return {
        "agents": [a, b], "ego": EGO in (a, b), "contact": "none",
        "min_ttc_s": None, "min_ttc_t_s": None, "pet_s": None, "pet_t_s": None, "pet_first": None,
    }  # fmt: skip


def _urgency_s(entry: Event) -> float:
    return min((v for v in (entry["min_ttc_s"], entry["pet_s"]) if v is not None), default=np.inf)
