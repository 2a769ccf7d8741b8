"""Test A measured: at which distances from the ego the target is perceived."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np

from cooperation_worlds.draw_range import distances_m
from cooperation_worlds.runs import Found, agents_near
from cooperation_worlds.world import Array, World

STEP_S, MATCH_M = 0.2, 2.0
EDGES_M = np.arange(10.0, 51.0, 5.0)
AROUND_30_M = (27.5, 32.5)


def perceived(world: World, found: Found) -> Array:
    """Rows (T, 2) of times from the first tick to the last one: distance of the target, and whether it was perceived."""
    t_s = np.arange(world.period_s, world.scene.duration_s - world.period_s, STEP_S)
    target = next(a for a in world.moving.actors if a.spec.id == world.target)
    xy, seen = target.at(t_s).center_m[:, :2], np.zeros(len(t_s), bool)
    for agent in agents_near(found.scenario, target.spec.category):
        state, there = found.at(agent, t_s)
        seen |= there & (np.linalg.norm(state[:, :2] - xy, axis=1) < MATCH_M)
    return np.column_stack([distances_m(world, t_s), seen])


def figures(rows: Sequence[Array]) -> dict[str, object]:
    """Recall by distance over all variants, and the range up to which the target is perceived at least half of the time."""
    table = np.concatenate(rows)
    by_bin = {}
    for low, high in itertools.pairwise(EDGES_M):
        inside = (table[:, 0] >= low) & (table[:, 0] < high)
        by_bin[f"{low:.0f}-{high:.0f}"] = float(table[inside, 1].mean()) if inside.any() else None
    inside = (table[:, 0] >= AROUND_30_M[0]) & (table[:, 0] < AROUND_30_M[1])
    reached = float(EDGES_M[0])
    for high, recall in zip(EDGES_M[1:], by_bin.values()):
        if recall is not None and recall < 0.5:
            break
        reached = float(high)
    return {
        "range_m": reached,
        "recall_30m": float(table[inside, 1].mean()),
        "variants_30m": float(np.mean([_all_seen(r) for r in rows if _crosses(r)])),
        "recall_by_distance": by_bin,
    }


def _crosses(rows: Array) -> bool:
    return bool(((rows[:, 0] >= AROUND_30_M[0]) & (rows[:, 0] < AROUND_30_M[1])).any())


def _all_seen(rows: Array) -> bool:
    inside = (rows[:, 0] >= AROUND_30_M[0]) & (rows[:, 0] < AROUND_30_M[1])
    return bool(rows[inside, 1].all())
