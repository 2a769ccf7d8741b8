"""Test C: a vehicle that the LiDARs of both ends see from different sides: how well its boxes overlap with the true one.

Measures are the paper's and IoU. Frame: the ego drives along x at y = 0.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from benchmarks.table import markdown
from numpy.typing import NDArray

from cooperation_worlds.runs import ALONE, NAMES, agents_near, detect, perceive
from cooperation_worlds.world import (
    ROAD_LIDAR,
    VEHICLE_LIDAR,
    Array,
    Builder,
    Log,
    World,
    agents_touch,
    first_that_keeps,
    things_touch,
    visible_share,
)
from log2sim.datatypes import GROUP_OF, Boxes3D
from log2sim.geometry import NS_PER_S, rectangle_overlap

DURATION_S, STEP_S = 2.0, 0.1
GAP_M = 1.0
NEAR_M, FAR_M = 6.0, 17.5  # of the target's center from the ego's, whose LiDAR ends at 20 m
MIN_VIEW_ANGLE_RAD = np.deg2rad(50)  # between the views of both ends, at the target


def draw(seed: int) -> World:
    return first_that_keeps("overlap", 3, seed, _drawn, keeps_promise)


def keeps_promise(world: World) -> bool:
    """Return whether both ends see the target all the time, from sides that differ."""
    t_s = np.arange(0, world.scene.duration_s + 1e-9, STEP_S)
    away = world.distances_m(t_s)
    if agents_touch(world, t_s, GAP_M) or things_touch(world, t_s, GAP_M):
        return False
    ego, xy = world.moving.ego, world.target_actor.at(t_s).center_m[:, :2]
    assert ego is not None
    views = [ego.at(t_s).center_m[:, :2] - xy, np.array(world.scene.lidar[1].position_m[:2]) - xy]
    cross = views[0][:, 0] * views[1][:, 1] - views[0][:, 1] * views[1][:, 0]
    angle = np.abs(np.arctan2(cross, (views[0] * views[1]).sum(1)))
    if away.min() < NEAR_M or away.max() > FAR_M or angle.min() < MIN_VIEW_ANGLE_RAD:
        return False
    return all((visible_share(world, lidar, t_s) > 0.35).all() for lidar in (VEHICLE_LIDAR, ROAD_LIDAR))


def _drawn(out: Builder) -> World:
    rng = out.rng
    out.roads = [{"line": [[-60.0, 1.75], [60.0, 1.75]], "width_m": 7.0}]
    speed = float(rng.uniform(0.5, 6.0))
    out.drive_ego([[-speed * DURATION_S / 2, 0.0, speed], [60.0, 0.0, speed]])
    away, bearing = float(rng.uniform(7, 17)), float(rng.uniform(-2.0, 2.0))
    xy = away * np.array([np.cos(bearing), np.sin(bearing)])
    heading = float(rng.choice([0.0, np.pi, np.pi / 2, -np.pi / 2])) + float(rng.normal(0, 0.15))
    category = str(rng.choice(["car", "truck", "bus"], p=[0.85, 0.1, 0.05]))
    along = np.array([np.cos(heading), np.sin(heading)])
    shape = out.draw_shape(category)
    if rng.random() < 0.35:
        out.add("target", shape, category, pose=[*xy.tolist(), float(np.rad2deg(heading))])
    else:
        v = float(rng.uniform(0.8, 7.0))
        # Vehicles are guided at the rear axle.
        first = xy - along * (v * DURATION_S / 2 + 0.3 * shape[0][0])
        rows = [[*first.tolist(), v], [*(first + along * 60).tolist(), v]]
        out.add("target", shape, category, waypoints=rows)
    angle, reach = float(rng.uniform(-np.pi, np.pi)), float(rng.uniform(7, 26))
    pole = xy + reach * np.array([np.cos(angle), np.sin(angle)])
    for k in range(int(rng.integers(0, 4))):
        place = xy + rng.uniform(-22, 22, 2)
        if min(np.linalg.norm(place - xy), np.hypot(*place), np.linalg.norm(place - pole)) > 6.5:
            out.add(f"other_{k}", out.draw_shape("car"), "car", pose=[*place.tolist(), float(rng.uniform(-180, 180))])
    if rng.random() < 0.5:
        out.houses.append({"center": [0.0, float(rng.choice([-1, 1])) * 34.0], "size_m": [60.0, 8.0, 9.0]})
    out.scatter([[-30.0, 0.0], [30.0, 0.0]], 7.0)
    # Nothing stands where the target goes.
    out.things = [thing for thing in out.things if np.linalg.norm(thing[1] - xy) > shape[0][0] / 2 + 8]
    out.add_sensors(pole.tolist(), xy.tolist())
    return out.world(DURATION_S, "target")


MATCH_M, MIN_SCORE = 2.5, 0.3
MARGIN_S = 0.15  # at both ends of the log, where a sweep may be missing
# From here on a difference of IoU is more than the noise of a few sweeps.
WORSE_BY = 0.01


def target_boxes(world: World, t_s: Array) -> Array:
    """True boxes (T, 5: x, y, length, width, yaw) of the target."""
    actor = world.target_actor
    states = actor.at(t_s)
    size = np.tile(np.array(actor.spec.box_m[:2]), (len(t_s), 1))
    return np.column_stack([states.center_m[:, :2], size, states.yaw_rad])


def measured(world: World, log: Log, way: str) -> list[tuple[Array, Array]]:
    """Overlap and IoU (F, 2) and (T, 2) of the target, sweep by sweep and in the scenario."""
    return [(from_boxes(world, *detect(log, way)), of_scenario(world, log, way))]


def of_scenario(world: World, log: Log, way: str) -> Array:
    """Overlap and IoU (T, 2) of the agent at the target's place, 0 where there is none."""
    found = perceive(log, way, world.scene.start_ns)
    t_s = np.arange(MARGIN_S, world.scene.duration_s - MARGIN_S, STEP_S)
    truth = target_boxes(world, t_s)
    category = world.target_actor.spec.category
    best = np.zeros((len(t_s), 2))
    for agent in agents_near(found.scenario, category):
        state, there = found.at(agent, t_s)
        near = there & (np.linalg.norm(state[:, :2] - truth[:, :2], axis=1) < MATCH_M)
        size = np.tile(np.array(agent.size_m[:2]), (len(t_s), 1))
        shared = shares(np.column_stack([state[:, :2], size, state[:, 2]]), truth)
        best = np.where((near & (shared[:, 1] > best[:, 1]))[:, None], shared, best)
    return best


def from_boxes(world: World, t_ns: NDArray[np.int64], boxes: Sequence[Boxes3D]) -> Array:
    """Overlap and IoU (F, 2) of the best-scored box at the target's place in each sweep, each at the box's own time."""
    category = world.target_actor.spec.category
    out = []
    for stamp, found in zip(t_ns, boxes):
        t_s = (found.t_ns - world.scene.start_ns) / NS_PER_S
        if not MARGIN_S <= (stamp - world.scene.start_ns) / NS_PER_S <= world.scene.duration_s:
            continue
        truth = target_boxes(world, t_s)
        group = np.array([GROUP_OF[c] == GROUP_OF[category] for c in found.category], bool)
        away = np.linalg.norm(found.center_m[:, :2] - truth[:, :2], axis=1)
        near = group & (away < MATCH_M) & (found.score >= MIN_SCORE)
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


HEAD = ["", "of", "found", "overlap", "IoU", "over the better end", "over the better of each variant", "worse variants"]


def table(_: Sequence[World], rows: dict[str, list[tuple[Array, Array]]]) -> str:
    """Means over variants, where the target is found, box by box and as a scenario, and the gain over the end alone that is better.

    One is better on average, another one in each variant, which nobody knows beforehand; a variant is worse than the latter.
    """
    lines = []
    for k, of in enumerate(("boxes", "scenario")):
        found = {way: [np.reshape(r[k], (-1, 2)) for r in of_way] for way, of_way in rows.items()}
        hits = {way: [s[s[:, 1] > 0] for s in of_way] for way, of_way in found.items()}
        means = {way: np.array([s.mean(0) if len(s) else np.full(2, np.nan) for s in of]) for way, of in hits.items()}
        ends = np.array([means[way][:, 1] for way in ALONE if way in means])
        better, best_on_average = np.nanmax(ends, axis=0), np.nanmean(ends, axis=1).max()
        for way, m in means.items():
            share = np.mean([(s[:, 1] > 0).mean() for s in found[way]])
            overlap, iou = np.nanmean(m, axis=0)
            gains = iou - best_on_average, np.nanmean(m[:, 1] - better)
            worse = int(np.sum(m[:, 1] < better - WORSE_BY))
            measures = [f"{share:.2f}", f"{overlap:.3f}", f"{iou:.3f}", *(f"{g:+.3f}" for g in gains)]
            lines.append([NAMES[way], of, *measures, str(worse)])
    return markdown(HEAD, lines)
