"""Whether those in a world keep their distance."""

from __future__ import annotations

import numpy as np

from cooperation_worlds.world import Array, World
from log2sim.geometry import rectangles_overlap
from log2sim.synth.actors import Actor


def agents_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether two road users, the ego among them, come nearer to each other than a gap at times (T,)."""
    states = [(actor.at(t_s), np.tile(np.array(actor.spec.box_m[:2]) + gap_m, (len(t_s), 1))) for actor in _all(world)]
    return any(
        rectangles_overlap(
            *(other.center_m - one.center_m)[:, :2].T, one.yaw_rad, other.yaw_rad, size, other_size
        ).any()
        for k, (one, size) in enumerate(states)
        for other, other_size in states[:k]
    )


def things_touch(world: World, t_s: Array, gap_m: float) -> bool:
    """Return whether a road user may come nearer to the middle of a thing than a gap: circles around the boxes decide."""
    places = np.array([thing.position_m[:2] for thing in world.things]).reshape(-1, 2)
    for actor in _all(world):
        away = np.linalg.norm(actor.at(t_s).center_m[:, None, :2] - places, axis=2)
        if (away < np.hypot(*actor.spec.box_m[:2]) / 2 + gap_m).any():
            return True
    return False


def _all(world: World) -> tuple[Actor, ...]:
    moving = world.moving
    assert moving.ego_body is not None
    return (*moving.actors, moving.ego_body)
