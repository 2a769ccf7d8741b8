"""Scene files and random variants of the tests of vehicle-road cooperation: they load, repeat, and hide what they promise to hide."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from cooperation_worlds import blind_area, curve, hidden_traffic, overlap
from cooperation_worlds.blind_area import FIRST_SIGHT_S, ROAD_SIGHT_S
from cooperation_worlds.hidden_traffic import HiddenTraffic, sweeps
from cooperation_worlds.world import ROAD_LIDAR, VEHICLE_LIDAR, World, cast

from log2sim.datatypes import Boxes3D
from log2sim.synth.traffic_data import START_NS

DRAW = {"range": curve.draw, "blind_area": blind_area.draw, "overlap": overlap.draw}
SEEDS = (1, 5)  # the first one drawn for 5 shows the walker too early


@cache
def drawn(test: str, seed: int) -> World:
    """Draw a world once for all tests."""
    return DRAW[test](seed)


def points_on_target(world: World, lidar: str, t_s: float) -> int:
    """Count the returns of the target in a sweep that ends at a time; what no ray reaches is hidden."""
    spec = next(s for s in world.scene.lidar if s.name == lidar)
    stamp = world.scene.start_ns + round(t_s * 1e9)
    returns, _ = cast(world, world.moving, spec, stamp, np.random.default_rng(0))
    index = [a.id for a in world.scene.agent].index(world.target)
    return int((returns.hit == index).sum())


@pytest.mark.slow
@pytest.mark.matrix
@pytest.mark.parametrize("seed", SEEDS)
def test_the_walker_hides_from_the_vehicle_and_not_from_the_pole(seed: int) -> None:
    world = drawn("blind_area", seed)
    # A sweep ends a period after it begins.
    before = np.arange(FIRST_SIGHT_S[1] + 0.1, ROAD_SIGHT_S, 0.6)
    alone = [points_on_target(world, VEHICLE_LIDAR, world.contact_s - b) for b in before]
    road = [points_on_target(world, ROAD_LIDAR, world.contact_s - b) for b in before]
    assert max(alone) <= 5
    assert min(road) >= 8
    assert points_on_target(world, VEHICLE_LIDAR, world.contact_s) > 20


@pytest.mark.slow
def test_true_boxes_of_random_traffic_score_1_and_those_of_the_vehicle_alone_less() -> None:
    traffic = hidden_traffic.drawn(3, 0)
    stamps = traffic.log.streams[VEHICLE_LIDAR].t_ns
    boxes = [true_boxes(traffic, int(stamp) - 30_000_000) for stamp in stamps]
    everything = sweeps(traffic, stamps, boxes)
    hidden = np.concatenate([s["vehicle"][2] for s in everything])
    counted = ~np.concatenate([s["vehicle"][1].ignored for s in everything])
    figures = hidden_traffic.figures(
        {"all": everything, "nothing": sweeps(traffic, stamps, [Boxes3D.empty()] * len(stamps))}
    )
    assert figures["ap"]["vehicle"] == {"all": 1.0, "nothing": 0.0}
    assert (hidden & counted).sum() < counted.sum()


def true_boxes(traffic: HiddenTraffic, t_ns: int) -> Boxes3D:
    """Make what a perfect detector finds at a time, as it moved until then."""
    users = [o for o in traffic.run.at((t_ns - START_NS) / 1e9).objects if o.category]
    size = np.array([o.size_m for o in users])
    center = np.array([o.position_m for o in users]) + size * [0, 0, 0.5]
    some, yaw = np.ones(len(users)), np.array([o.yaw_rad for o in users])
    category = np.array([o.category for o in users], dtype="<U16")
    return Boxes3D(np.full(len(users), t_ns), center, size, yaw, some, category, some, some.astype(np.int64))
