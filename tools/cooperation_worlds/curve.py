"""Test A: a car comes around a curve; the ego's LiDAR ends at 20 m, the one at the curve at 40 m: at which distances is it perceived.

Frame: the ego drives along x toward a curve that begins at x = 0; right-hand traffic.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from benchmarks.table import cell, markdown

from cooperation_worlds.runs import NAMES, agents_near, perceive
from cooperation_worlds.world import (
    ROAD_LIDAR,
    ROAD_RANGE_M,
    Array,
    Builder,
    Log,
    World,
    agents_touch,
    first_that_keeps,
    visible_share,
)

MAX_DURATION_S, STEP_S = 5.0, 0.1
GAP_M = 0.05  # between all at least
FROM_M, TO_M = 46.0, 13.0  # distances between ego and target that a variant covers, from 46 m or more to 13 m or less


def draw(seed: int) -> World:
    return first_that_keeps("range", 1, seed, _drawn, keeps_promise)


def keeps_promise(world: World) -> bool:
    """Return whether the pole sees the target wherever it is 15 to 40 m from the ego."""
    t_s = np.arange(0, world.scene.duration_s + 1e-9, STEP_S)
    away = world.distances_m(t_s)
    if agents_touch(world, t_s, GAP_M):
        return False
    between = (away > 15) & (away < 40)
    share = visible_share(world, ROAD_LIDAR, t_s[between])
    return bool(away[0] >= FROM_M and away[-1] <= TO_M and between.sum() >= 10 and (share > 0.3).all())


def _drawn(out: Builder) -> World | None:
    rng = out.rng
    lane, radius = float(rng.uniform(3.0, 3.6)), float(rng.uniform(18, 70))
    turn = float(rng.choice([-1, 1])) * min(float(rng.uniform(0.5, 1.6)), 60 / radius)
    line = _line(radius, turn)
    out.roads = [{"line": line[::5].tolist(), "width_m": round(2 * lane, 2)}]
    ego_mps, target_mps = float(rng.uniform(3.0, 7.0)), float(rng.uniform(3.0, 7.0))
    out.drive_ego(_lane(line, -lane / 2, ego_mps, _at(line, float(rng.uniform(-32, -8)))))
    out.ego["rounding_m"] = 8.0
    coming = _lane(line, lane / 2, target_mps, 0)[::-1]
    shape = out.draw_shape("car")
    # The distance along the road shrinks at both speeds; a chord is shorter than its arc.
    start = _first_beyond(coming, np.array(out.ego["waypoints"])[0, :2], FROM_M + float(rng.uniform(1.0, 4.0)))
    if start is None:
        return None
    out.add("target", shape, "car", waypoints=coming[start:], rounding_m=8.0)
    duration = min(MAX_DURATION_S, round((FROM_M + 6 - TO_M + 5) / (ego_mps + target_mps) + 0.4, 1))
    s_pole = _at(line, float(rng.uniform(-4, 14)))
    side = float(rng.choice([-1, 1]))
    pole = _beside(line, s_pole, side * (lane + float(rng.uniform(0.6, 3.0))))
    _others(out, line, lane)
    out.scatter(line[30:130], lane + 3.4)
    out.add_sensors(pole.tolist(), line[min(s_pole + 12, len(line) - 1)].tolist())
    return out.world(duration, "target")


def _line(radius: float, turn: float) -> Array:
    """Center line at every meter: 70 m straight, an arc that turns by an angle, and straight on."""
    arc = max(int(radius * abs(turn)), 1)
    bend = np.concatenate([np.zeros(70), np.full(arc, turn / arc), np.zeros(max(130 - arc, 30))])
    yaw = np.concatenate([[0.0], np.cumsum(bend)[:-1]])
    steps = np.column_stack([np.cos(yaw), np.sin(yaw)])
    begin = np.array([-70.0, 0.0])
    return begin + np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def _at(line: Array, s: float) -> int:
    return int(np.clip(round(70 + s), 0, len(line) - 2))


def _beside(line: Array, index: int, offset: float) -> Array:
    d = line[index + 1] - line[index]
    return np.asarray(line[index] + offset * np.array([-d[1], d[0]]))


def _lane(line: Array, offset: float, speed: float, start: int) -> Array:
    """Waypoints (W, 3) every 4 m along a line with an offset to its left."""
    xy = np.array([_beside(line, k, offset) for k in range(start, len(line) - 1, 4)])
    return np.column_stack([xy, np.full(len(xy), speed)])


def _first_beyond(coming: Array, ego: Array, away_m: float) -> int | None:
    """Return the waypoint of who comes that is the last beyond a distance from the ego."""
    distance = np.linalg.norm(coming[:, :2] - ego, axis=1)
    beyond = np.flatnonzero(distance >= away_m)
    index = int(beyond[-1]) if len(beyond) else None
    return index if index is not None and distance[index] < ROAD_RANGE_M + 15 and index + 3 < len(coming) else None


def _others(out: Builder, line: Array, lane: float) -> None:
    """Park cars beside the straight part, let people walk there, and put a house on a side."""
    rng = out.rng
    for k in range(int(rng.integers(0, 4))):
        car = out.draw_shape("car")
        side = float(rng.choice([-1, 1]))
        at = _beside(line, _at(line, float(rng.uniform(-30, -2))) + k, side * (lane + 0.2 + car[0][1] / 2))
        if all(np.linalg.norm(at - a["pose"][:2]) > 7 for a in out.agents if "pose" in a):
            out.add(f"parked_{k}", car, "car", pose=[*at.tolist(), 0.0])
    for k in range(int(rng.integers(0, 3))):
        side, first = float(rng.choice([-1, 1])), _at(line, float(rng.uniform(-25, 10)))
        xy = np.array([_beside(line, first + j, side * (lane + 2.6)) for j in (0, 12)])
        rows = np.column_stack([xy, [1.3, 1.3]]).tolist()
        out.add(f"walker_{k}", out.draw_shape("pedestrian"), "pedestrian", waypoints=rows)
    if rng.random() < 0.6:
        side = float(rng.choice([-1, 1]))
        size = [float(rng.uniform(10, 30)), 8.0, float(rng.uniform(5, 12))]
        out.houses.append({"center": [-25.0, side * (lane + 10)], "size_m": size})


COMPARED_S, MATCH_M = 0.2, 2.0
EDGES_M = np.arange(10.0, 51.0, 5.0)
AROUND_30_M = (27.5, 32.5)


def measured(world: World, log: Log, way: str) -> list[Array]:
    """Rows (T, 2) of times from the first tick to the last one: distance of the target, and whether it was perceived."""
    found = perceive(log, way, world.scene.start_ns)
    t_s = np.arange(world.period_s, world.scene.duration_s - world.period_s, COMPARED_S)
    target = world.target_actor
    xy, seen = target.at(t_s).center_m[:, :2], np.zeros(len(t_s), bool)
    for agent in agents_near(found.scenario, target.spec.category):
        state, there = found.at(agent, t_s)
        seen |= there & (np.linalg.norm(state[:, :2] - xy, axis=1) < MATCH_M)
    return [np.column_stack([world.distances_m(t_s), seen])]


def table(_: Sequence[World], rows: dict[str, list[Array]]) -> str:
    """Recall by distance over all variants, and the range up to which the target is perceived at least half of the time, by way."""
    spans = list(itertools.pairwise(EDGES_M))
    lines = []
    for way, of_way in rows.items():
        away, seen = np.concatenate(of_way).T
        within = [seen[(away >= low) & (away < high)] for low, high in [AROUND_30_M, *spans]]
        around, *recalls = (float(v.mean()) if len(v) else None for v in within)
        reached = next((low for (low, _), v in zip(spans, recalls) if v is not None and v < 0.5), EDGES_M[-1])
        lines.append([NAMES[way], f"{reached:.0f}", cell(around), *map(cell, recalls)])
    return markdown(["", "range m", "recall at 30 m", *(f"{low:.0f}-{high:.0f} m" for low, high in spans)], lines)
