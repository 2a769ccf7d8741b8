"""Test B: a tall parked vehicle hides a person who walks out in front of the ego; a LiDAR on a pole sees behind it.

Measured is when the person is first known, how far the ego still is, and whether braking then helps. Frame: the ego drives along x
in the right lane, the person crosses at x = 0, right-hand traffic.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cooperation_worlds.runs import Found, agents_near
from cooperation_worlds.world import (
    ROAD_LIDAR,
    VEHICLE_LIDAR,
    Builder,
    World,
    agents_touch,
    first_that_keeps,
    visible_share,
)
from log2sim.geometry import rectangles_overlap
from log2sim.simulation.warnings import warn
from log2sim.synth.polytopes import Shape

SPEED_MPS = 30 / 3.6
CONTACT_S, AFTER_S = 5.0, 0.1
# The ego's own LiDAR could see a tenth of the person from here on, s before the contact; the paper states 1 s.
FIRST_SIGHT_S = (0.5, 1.45)
# The pole sees half of the person from here on, s before the contact.
ROAD_SIGHT_S = 4.0
GAP_M, NEAR_CONTACT_S = 0.05, 0.3  # between all others at least, and until the ego meets the walker
HIDING_HEIGHT_M = 2.2  # the LiDAR on the roof looks over what is lower


def draw_blind_area(seed: int) -> World:
    """Draw a variant that keeps what the test promises."""
    return first_that_keeps("blind_area", 2, seed, _drawn, keeps_promise)


def keeps_promise(world: World) -> bool:
    """Return whether the vehicle's LiDAR sees the person late and the road's early."""
    before = np.arange(0.0, ROAD_SIGHT_S + 0.01, 0.1)
    t_s = world.contact_s - before
    if agents_touch(world, t_s[before > NEAR_CONTACT_S], GAP_M):
        return False
    alone = visible_share(world, VEHICLE_LIDAR, t_s) > 0.1
    first = before[alone].max(initial=0.0)
    if not FIRST_SIGHT_S[0] <= first <= FIRST_SIGHT_S[1]:
        return False
    return bool((visible_share(world, ROAD_LIDAR, t_s) > 0.5).all())


def _drawn(out: Builder) -> World:
    rng = out.rng
    lane = float(rng.uniform(3.0, 3.6))
    out.roads = [{"line": [[-80.0, 0.0], [80.0, 0.0]], "width_m": round(2 * lane, 2)}]
    y_ego = -lane / 2 + float(rng.uniform(-0.3, 0.2))
    out.drive_ego(np.zeros((2, 3)))
    length = out.ego["size_m"][0]
    # The front is `reach` ahead of the rear axle, which the waypoints guide.
    reach = out.ego["rear_axle_offset_m"] + length / 2
    start = -SPEED_MPS * CONTACT_S - reach
    out.ego["waypoints"] = [[start, y_ego, SPEED_MPS], [60.0, y_ego, SPEED_MPS]]
    _park(out, lane)
    walker = out.draw_shape("pedestrian")
    walking = float(rng.uniform(1.0, 2.2))
    meets = y_ego + float(rng.uniform(-0.6, 0.4))
    x = walker[0][1] / 2
    away = walking * CONTACT_S
    rows = [[x, meets - away, walking], [x, meets + 12.0, walking]]
    out.add("walker", walker, "pedestrian", waypoints=rows)
    _others(out, lane)
    out.scatter([[-45.0, 0.0], [45.0, 0.0]], lane + 3.2)
    far = [-1, 1][int(rng.random() < 0.6)]
    pole = [float(rng.uniform(3.0, 18.0)), far * (lane + float(rng.uniform(0.6, 3.5)))]
    out.add_sensors(pole, (-4.0, meets - 3.0))
    return out.world(CONTACT_S + AFTER_S, "walker", CONTACT_S)


def _park(out: Builder, lane: float) -> None:
    """Park a tall vehicle before the crossing and others behind and beyond it; houses stand behind the sidewalk."""
    rng = out.rng
    gap = float(rng.uniform(-0.1, 0.35))
    kind, shape = _tall(out)
    x = -float(rng.uniform(0.4, 1.6)) - shape[0][0] / 2
    y = -lane - gap - shape[0][1] / 2
    turned = 180.0 if rng.random() < 0.2 else 0.0
    out.add("hiding", shape, kind, pose=[x, y, turned + float(rng.normal(0, 1.0))])
    back = x - shape[0][0] / 2
    for k in range(int(rng.integers(0, 4))):
        car = out.draw_shape("car")
        back -= float(rng.uniform(0.5, 1.6)) + car[0][0] / 2
        pose = [back, -lane - gap - car[0][1] / 2 - float(rng.uniform(0, 0.3)), float(rng.normal(0, 1.5))]
        out.add(f"parked_{k}", car, "car", pose=pose)
        back -= car[0][0] / 2
    if rng.random() < 0.4:
        car = out.draw_shape("car")
        ahead = float(rng.uniform(3.0, 6.0)) + car[0][0] / 2
        out.add("parked_ahead", car, "car", pose=[ahead, -lane - gap - car[0][1] / 2, float(rng.normal(0, 1.5))])
    for side in (-1, 1):
        if rng.random() < 0.75:
            depth, wide = float(rng.uniform(6, 12)), float(rng.uniform(30, 80))
            clear = 15.0 if side < 0 else float(rng.uniform(6, 12))
            center = [float(rng.uniform(-20, 20)), side * (lane + clear + depth / 2)]
            out.houses.append({"center": center, "size_m": [wide, depth, float(rng.uniform(5, 12))]})


def _tall(out: Builder) -> tuple[str, Shape]:
    kind = str(out.rng.choice(["car", "truck", "bus"], p=[0.5, 0.35, 0.15]))
    shape = out.draw_shape(kind)
    while shape[0][2] < HIDING_HEIGHT_M or shape[0][0] > 13:
        shape = out.draw_shape(kind)
    return kind, shape


def _others(out: Builder, lane: float) -> None:
    """Let cars come from ahead and people walk on the other sidewalk."""
    rng = out.rng
    for k in range(int(rng.integers(0, 3))):
        speed = float(rng.uniform(5, 11))
        start = float(rng.uniform(10, 30)) + 20 * k + speed * CONTACT_S
        rows = [[start, lane / 2, speed], [start - 150, lane / 2, speed]]
        out.add(f"oncoming_{k}", out.draw_shape("car"), "car", waypoints=rows)
    for k in range(int(rng.integers(0, 3))):
        heading, x = float(rng.choice([-1, 1])), float(rng.uniform(-25, 20))
        y = lane + float(rng.uniform(1.0, 3.0))
        rows = [[x, y, 1.3], [x + heading * 30, y, 1.3]]
        out.add(f"stroller_{k}", out.draw_shape("pedestrian"), "pedestrian", waypoints=rows)


STEP_S, MATCH_M = 0.05, 1.0
# An object counts as known from its third observation on, as the warnings of a replay take it (`simulation.warnings.known`).
SWEEPS_BEFORE_KNOWN = 2
# The paper's 12.7 m from 30 km/h: a reaction of 1 s, then braking with 8 m/s2.
REACTION_S, BRAKING_MPS2 = 1.0, 8.0
AFTER_CONTACT_S = 4.0
MOMENTS = ("known_s", "warned_s")


def row(world: World, found: Found) -> dict[str, float | None]:
    """When the person is first known and first warned of, s; None where it never is before the contact."""
    known, warned = np.inf, np.inf
    t_s = np.arange(0.0, world.contact_s + 1e-9, STEP_S)
    target = world.target_actor
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
    body = world.moving.ego
    assert body is not None
    t_s = np.arange(0.0, world.contact_s + AFTER_CONTACT_S, 0.02)
    braking = np.clip(t_s - known_s - REACTION_S, 0.0, SPEED_MPS / BRAKING_MPS2)
    # Time at which the ego, had it not braked, would have been where it is: the way lost divided by its speed.
    after = np.maximum(t_s - known_s - REACTION_S - braking, 0.0)
    lost = BRAKING_MPS2 * braking**2 / 2 + SPEED_MPS * after
    target = world.target_actor
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
