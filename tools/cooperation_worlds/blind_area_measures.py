"""Test B measured: when the person is first known, how far the ego still is, and whether braking then helps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cooperation_worlds.draw_blind_area import SPEED_MPS
from cooperation_worlds.runs import Found, agents_near
from cooperation_worlds.world import World
from log2sim.geometry import rectangles_overlap
from log2sim.simulation.warnings import warn

STEP_S, MATCH_M = 0.05, 1.0
# An object counts as known from its third observation on, as the warnings of a replay take it (`simulation.warnings.known`).
SWEEPS_BEFORE_KNOWN = 2
# The paper's 12.7 m from 30 km/h: a reaction of 1 s, then braking with 8 m/s2.
REACTION_S, BRAKING_MPS2 = 1.0, 8.0
STOPPING_M = SPEED_MPS * REACTION_S + SPEED_MPS**2 / (2 * BRAKING_MPS2)
AFTER_CONTACT_S = 4.0
MOMENTS = ("known_s", "warned_s")


def row(world: World, found: Found) -> dict[str, float | None]:
    """When the person is first known and first warned of, s; None where it never is before the contact."""
    known, warned = np.inf, np.inf
    t_s = np.arange(0.0, world.contact_s + 1e-9, STEP_S)
    target = next(a for a in world.moving.actors if a.spec.id == world.target)
    xy = target.at(t_s).center_m[:, :2]
    warnings = None if found.scenario is None or found.scenario.ego is None else warn(found.scenario)
    for agent in agents_near(found.scenario, target.spec.category):
        state, there = found.at(agent, t_s)
        near = there & (np.linalg.norm(state[:, :2] - xy, axis=1) < MATCH_M)
        if near.any():
            known = min(known, float(t_s[near][0]) + SWEEPS_BEFORE_KNOWN * world.period_s)
            event = warnings.of(agent.id) if warnings is not None else None
            warned = min(
                warned, event.warned.t_s + found.begin_s if event is not None and event.warned is not None else np.inf
            )
    return {name: t if t < world.contact_s else None for name, t in (("known_s", known), ("warned_s", warned))}


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


def figures(worlds: Sequence[World], rows: dict[str, list[dict[str, float | None]]]) -> dict[str, Any]:
    """Medians and least values over variants, by way; gains are over the vehicle alone."""
    before = {
        way: {name: np.array([_before(w, r[name]) for w, r in zip(worlds, of_way, strict=True)]) for name in MOMENTS}
        for way, of_way in rows.items()
    }
    out = {}
    for way, of_way in rows.items():
        known, warned = (before[way][name] for name in MOMENTS)
        gained = known - before["vehicle"]["known_s"]
        distance = known * SPEED_MPS
        out[way] = {
            "before_contact_s": float(np.median(known)),
            "distance_m": float(np.median(distance)),
            "distance_least_m": float(distance.min()),
            "from_20_m": float((distance >= 20.0).mean()),
            "gained_s": float(np.median(gained)),
            "gained_2_s": float((gained >= 2.0).mean()),
            "collisions": _collisions(worlds, [r["known_s"] for r in of_way]),
            "never": int(sum(r["known_s"] is None for r in of_way)),
            "warned_before_s": float(np.median(warned)),
            "collisions_warned": _collisions(worlds, [r["warned_s"] for r in of_way]),
            "never_warned": int(sum(r["warned_s"] is None for r in of_way)),
        }
    return out


def _before(world: World, t_s: float | None) -> float:
    return 0.0 if t_s is None else world.contact_s - t_s


def _collisions(worlds: Sequence[World], since_s: Sequence[float | None]) -> int:
    return sum(collides(w, np.inf if t is None else t) for w, t in zip(worlds, since_s, strict=True))
