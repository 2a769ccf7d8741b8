"""Test C measured: how well boxes overlap with the true one, by the paper's measure and by IoU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cooperation_worlds.runs import ALONE, Found, agents_near
from cooperation_worlds.world import Array, World
from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.geometry import NS_PER_S, rectangle_overlap

STEP_S, MATCH_M = 0.1, 2.5
MARGIN_S = 0.15  # at both ends of the log, where a sweep may be missing
# From here on a difference of IoU is more than the noise of a few sweeps.
WORSE_BY = 0.01


def target_boxes(world: World, t_s: Array) -> Array:
    """True boxes (T, 5: x, y, length, width, yaw) of the target."""
    actor = next(a for a in world.moving.actors if a.spec.id == world.target)
    states = actor.at(t_s)
    size = np.tile(np.array(actor.spec.box_m[:2]), (len(t_s), 1))
    return np.column_stack([states.center_m[:, :2], size, states.yaw_rad])


def of_scenario(world: World, found: Found) -> Array:
    """Overlap and IoU (T, 2) of the agent at the target's place, 0 where there is none."""
    t_s = np.arange(MARGIN_S, world.scene.duration_s - MARGIN_S, STEP_S)
    truth = target_boxes(world, t_s)
    category = next(a for a in world.moving.actors if a.spec.id == world.target).spec.category
    best = np.zeros((len(t_s), 2))
    for agent in agents_near(found.scenario, category):
        state, there = found.at(agent, t_s)
        near = there & (np.linalg.norm(state[:, :2] - truth[:, :2], axis=1) < MATCH_M)
        size = np.tile(np.array(agent.size_m[:2]), (len(t_s), 1))
        shared = shares(np.column_stack([state[:, :2], size, state[:, 2]]), truth)
        best = np.where((near & (shared[:, 1] > best[:, 1]))[:, None], shared, best)
    return best


def from_boxes(world: World, t_ns: NDArray[np.int64], boxes: Sequence[Boxes3D], min_score: float = 0.3) -> Array:
    """Overlap and IoU (F, 2) of the best-scored box at the target's place in each sweep, each at the box's own time."""
    category = next(a for a in world.moving.actors if a.spec.id == world.target).spec.category
    out = []
    for stamp, found in zip(t_ns, boxes):
        t_s = (found.t_ns - world.scene.start_ns) / NS_PER_S
        inside = MARGIN_S <= (stamp - world.scene.start_ns) / NS_PER_S <= world.scene.duration_s
        if not inside:
            continue
        truth = target_boxes(world, t_s)
        group = np.array([GROUP_OF[c] == GROUP_OF[category] for c in found.category], bool)
        near = (
            group
            & (np.linalg.norm(found.center_m[:, :2] - truth[:, :2], axis=1) < MATCH_M)
            & (found.score >= min_score)
        )
        if not near.any():
            out.append(np.zeros(2))
            continue
        k = int(np.flatnonzero(near)[found.score[near].argmax()])
        box = np.array([[*found.center_m[k, :2], *found.size_m[k, :2], found.yaw_rad[k]]])
        out.append(shares(box, truth[k : k + 1])[0])
    return np.array(out).reshape(-1, 2)


def shares(found: Array, truth: Array) -> Array:
    """Overlap (shared area over the true one, the paper's measure) and IoU (T, 2) of boxes (T, 5), pair by pair."""
    shared = rectangle_overlap(found, truth)
    area = [box[:, 2] * box[:, 3] for box in (found, truth)]
    return np.column_stack([shared / area[1], shared / (area[0] + area[1] - shared)])


def figures(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Means over variants by way, where the target is found, and the gain over the end alone that is better.

    `over_better_end` is over the end that is better on average, `over_better_by_variant` over the one that is better in each
    variant, which nobody knows beforehand; so is `worse_variants`.
    """
    table = [{way: np.reshape(of_way, (-1, 2)) for way, of_way in r.items()} for r in rows]
    means = {way: np.array([_mean(r[way]) for r in table]) for way in table[0]}
    ends = np.array([means[way][:, 1] for way in ALONE if way in means])
    better, best_on_average = np.nanmax(ends, axis=0), np.nanmean(ends, axis=1).max()
    return {
        way: {
            "found": float(np.mean([(r[way][:, 1] > 0).mean() for r in table])),
            "overlap": float(np.nanmean(m[:, 0])),
            "iou": float(np.nanmean(m[:, 1])),
            "over_better_end": float(np.nanmean(m[:, 1]) - best_on_average),
            "over_better_by_variant": float(np.nanmean(m[:, 1] - better)),
            "worse_variants": int(np.sum(m[:, 1] < better - WORSE_BY)),
            "never_found": int(np.isnan(m[:, 1]).sum()),
        }
        for way, m in means.items()
    }


def _mean(shares: Array) -> Array:
    """Return the mean overlap and IoU (2,) of the times at which the target is found; NaN without any."""
    found = shares[shares[:, 1] > 0]
    return found.mean(0) if len(found) else np.full(2, np.nan)
