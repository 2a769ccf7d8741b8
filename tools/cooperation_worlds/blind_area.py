"""Test B: a tall parked vehicle hides a person who walks out in front of the ego; a LiDAR on a pole sees behind it.

Measured is when the person is first known, how far the ego still is, and whether braking then helps. Frame: the ego drives along x
in the right lane, the person crosses at x = 0, right-hand traffic.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks.table import markdown

from cooperation_worlds.runs import NAMES, agents_near, perceive
from cooperation_worlds.world import (
    ROAD_LIDAR,
    VEHICLE_LIDAR,
    Array,
    Builder,
    Log,
    World,
    agents_touch,
    first_that_keeps,
    visible_share,
)
from log2sim.geometry import rectangles_overlap
from log2sim.simulation.warnings import warn

SPEED_MPS = 30 / 3.6
CONTACT_S, AFTER_S = 5.0, 0.1
# The ego's own LiDAR could see a tenth of the person from here on, s before the contact; the paper states 1 s.
FIRST_SIGHT_S = (0.5, 1.45)
# The pole sees half of the person from here on, s before the contact.
ROAD_SIGHT_S = 4.0
GAP_M, NEAR_CONTACT_S = 0.05, 0.3  # between all others at least, and until the ego meets the walker
HIDING_HEIGHT_M = 2.2  # the LiDAR on the roof looks over what is lower


def draw(seed: int) -> World:
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
    kind = str(rng.choice(["car", "truck", "bus"], p=[0.5, 0.35, 0.15]))
    shape = out.draw_shape(kind)
    while shape[0][2] < HIDING_HEIGHT_M or shape[0][0] > 13:
        shape = out.draw_shape(kind)
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
HEAD = (
    "", "known before contact s", "distance m", "least m", "20 m or more", "gained s", "2 s or more", "never known",
    "collisions, braking when known", "warned before contact s", "never warned", "collisions, braking when warned",
)  # fmt: skip


def measured(world: World, log: Log, way: str) -> list[tuple[float, float]]:
    """When the person is first known and first warned of, s; infinite where it never is before the contact."""
    found = perceive(log, way, world.scene.start_ns)
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
            if event is not None and event.warned is not None:
                warned = min(warned, event.warned.t_s + found.begin_s)
    return [(known if known < world.contact_s else np.inf, warned if warned < world.contact_s else np.inf)]


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


def table(worlds: Sequence[World], rows: dict[str, list[tuple[float, float]]]) -> str:
    """Medians and least values over variants, by way; gains are over the vehicle alone."""
    contact_s = np.array([[world.contact_s] for world in worlds])

    def before(of_way: list[tuple[float, float]]) -> Array:
        """Times (2, V) before the contact, 0 for never."""
        return np.maximum(contact_s - np.array(of_way), 0.0).T

    lines = []
    for way, of_way in rows.items():
        known, warned = before(of_way)
        gained, distance = known - before(rows["vehicle"])[0], known * SPEED_MPS
        never, hit = ([str(sum(test)) for test in tests] for tests in (
            ([not np.isfinite(r[k]) for r in of_way] for k in (0, 1)),
            ([collides(w, r[k]) for w, r in zip(worlds, of_way, strict=True)] for k in (0, 1)),
        ))  # fmt: skip
        lines.append([
            NAMES[way], f"{np.median(known):.2f}", f"{np.median(distance):.1f}", f"{distance.min():.1f}", f"{(distance >= 20.0).mean():.2f}",
            f"{np.median(gained):.2f}", f"{(gained >= 2.0).mean():.2f}", never[0], hit[0], f"{np.median(warned):.2f}", never[1], hit[1],
        ])  # fmt: skip
    return markdown(HEAD, lines)
