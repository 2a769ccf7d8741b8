"""Poses and clocks of roadside units, disturbed in worlds with exact truth, are found, told and corrected; nothing else is."""

from __future__ import annotations

import numpy as np
import pytest
from registration_worlds import World, WorldSpec, disturbed, draw_world, errors_of, misplaced

from log2sim.config import Config
from log2sim.datatypes import Log
from log2sim.localization.roadside import RoadRegistration, register_road
from log2sim.plan import choose_detector, select_sensors

POLE = "pole0"


@pytest.fixture(scope="module")
def street() -> World:
    """A street with buildings, moving traffic, and a LiDAR of 32 lines on a pole."""
    return draw_world(WorldSpec(kind="street", seed=5, road_lidar="level32", azimuth_step_deg=1.2, duration_s=2.0))


def register(log: Log, **asked: object) -> RoadRegistration:
    config = choose_detector(log, Config().changed(cooperation=asked) if asked else Config())
    return register_road(log, config, select_sensors(log, config), progress=lambda *_: None)


def test_a_pole_that_is_moved_turned_and_late_is_put_right(street: World) -> None:
    bad = disturbed(street.log, POLE, 0.5, 2.0, 0.2, np.random.default_rng(0))
    found = register(bad)
    away_m, turned_deg, late_s = errors_of(found.log, street.log, POLE)
    assert away_m < 0.1
    assert turned_deg < 0.3
    assert abs(late_s) < 0.02
    assert [fault.kind for fault in found.faults] == ["road_pose", "road_clock"]
    assert found.figures[0]["treatment"] == "corrected"


@pytest.mark.slow
def test_a_pose_that_contradicts_what_the_vehicle_sees_is_left_out(street: World) -> None:
    found = register(misplaced(street.log, POLE, 8.0, 90.0))
    assert [(fault.kind, fault.sensor, fault.treatment) for fault in found.faults] == [
        ("wrong_road_pose", POLE, "left_out")
    ]
