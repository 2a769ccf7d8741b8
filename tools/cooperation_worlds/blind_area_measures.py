"""Test B measured: when the person is first known, how far the ego still is, and whether braking then helps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cooperation_worlds.draw_blind_area import SPEED_MPS
from cooperation_worlds.runs import Found, agents_near, at
from cooperation_worlds.world import World
from log2sim.geometry import rectangles_overlap

STEP_S, MATCH_M = 0.05, 1.0
# A track counts as known once it has lasted as long as the tracker asks of it (`track.min_life_s`).
CONFIRMED_AFTER_S = 0.3
# The paper's 12.7 m from 30 km/h: a reaction of 1 s, then braking with 8 m/s2.
REACTION_S, BRAKING_MPS2 = 1.0, 8.0
STOPPING_M = SPEED_MPS * REACTION_S + SPEED_MPS**2 / (2 * BRAKING_MPS2)
AFTER_CONTACT_S = 4.0


def first_known(world: World, found: Found) -> float:
    """Time in s at which the person is known; infinite where it never is."""
    t_s = np.arange(0.0, world.contact_s + 1e-9, STEP_S)
    target = next(a for a in world.moving.actors if a.spec.id == world.target)
    xy = target.at(t_s).center_m[:, :2]
    first = np.inf
    for agent in agents_near(found.scenario, target.spec.category):
        state, there = at(agent, t_s)
        near = there & (np.linalg.norm(state[:, :2] - xy, axis=1) < MATCH_M)
        if near.any():
            first = min(first, float(t_s[near][0]) + CONFIRMED_AFTER_S)
    return first if first < world.contact_s else np.inf


def collides(world: World, known_s: float) -> bool:
    """Return whether the ego meets the person if it reacts to what it knows from `known_s` on."""
    moving = world.moving
    body = moving.ego_body
    assert body is not None
    t_s = np.arange(0.0, world.contact_s + AFTER_CONTACT_S, 0.02)
    braking = np.clip(t_s - known_s - REACTION_S, 0.0, SPEED_MPS / BRAKING_MPS2)
    # Time at which the ego, had it not braked, would have been where it is: the way lost divided by its speed.
    after = np.maximum(t_s - known_s - REACTION_S - braking, 0.0)
    lost = BRAKING_MPS2 * braking**2 / 2 + SPEED_MPS * after
    target = next(a for a in moving.actors if a.spec.id == world.target)
    ego, walker = body.at(t_s - lost / SPEED_MPS), target.at(t_s)
    apart = (walker.center_m - ego.center_m)[:, :2].T
    sizes = [np.tile(np.array(actor.spec.box_m[:2]), (len(t_s), 1)) for actor in (body, target)]
    return bool(rectangles_overlap(*apart, ego.yaw_rad, walker.yaw_rad, *sizes).any())


def row(world: World, found: dict[str, Found]) -> dict[str, Any]:
    """What each way knows and when, for one variant."""
    known = {way: first_known(world, result) for way, result in found.items()}
    return {
        way: {
            "known_s": None if np.isinf(t) else t,
            "before_contact_s": max(world.contact_s - t, 0.0),
            "distance_m": max(world.contact_s - t, 0.0) * SPEED_MPS,
            "collides": collides(world, t),
        }
        for way, t in known.items()
    }


def figures(rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Medians and least values over variants, by way; gains are over the vehicle alone."""
    out = {}
    for way in rows[0]:
        before = np.array([r[way]["before_contact_s"] for r in rows])
        distance = np.array([r[way]["distance_m"] for r in rows])
        gained = before - np.array([r["vehicle"]["before_contact_s"] for r in rows])
        out[way] = {
            "before_contact_s": float(np.median(before)),
            "distance_m": float(np.median(distance)),
            "distance_least_m": float(distance.min()),
            "from_20_m": float((distance >= 20.0).mean()),
            "gained_s": float(np.median(gained)),
            "gained_2_s": float((gained >= 2.0).mean()),
            "collisions": int(sum(r[way]["collides"] for r in rows)),
            "never": int(sum(r[way]["known_s"] is None for r in rows)),
        }
    return out
