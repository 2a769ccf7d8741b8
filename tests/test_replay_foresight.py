"""What reactive agents expect of others: their ways in the scenario, or their motion so far."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import agent_from, scenario_of
from replay_scenes import Speed, line
from test_prediction import circle

from log2sim.simulation.corridors import HORIZON_S, PathTable
from log2sim.simulation.reactive import MotionForesight
from log2sim.simulation.runner import replay


def turns_off(id: str) -> object:
    """A car that comes from the south at 8 m/s and turns right on 8 m before the street at y = 0."""
    t = np.arange(0, 12.05, 0.1)
    way = 8.0 * t - 50.0  # the bend begins at y = -18
    turned = np.clip(way / 8.0, 0.0, np.pi / 2)
    beyond = np.maximum(way - np.pi / 2 * 8.0, 0.0)
    x = 8.0 * (1 - np.cos(turned)) + beyond
    y = -18.0 + np.where(way < 0, way, 8.0 * np.sin(turned))
    return agent_from(t, x, y, np.pi / 2 - turned, np.full(len(t), 8.0), id=id, offset_m=0.0)


def first_brake_s(result, id: str) -> float:
    """When an agent first decelerates by more than 0.5 m/s2; inf when it never does."""
    agent = result.agent(id)
    slower = np.flatnonzero(np.diff(agent.speed_mps) / np.diff(agent.t_s) < -0.5)
    return float(agent.t_s[slower[0]]) if len(slower) else float("inf")


def test_who_does_not_turn_off_as_in_the_scenario_is_braked_for_earlier_by_those_who_see_its_motion() -> None:
    """The ego goes on into the street; by its way in the scenario it turns off before, until it has left that."""
    scene = scenario_of(turns_off("ego"), line("f", -85.0, speed=10.0, duration_s=12.0))
    options = {"model": "kinematic", "agents": "reactive", "dt_s": 0.1, "ego": Speed(lambda t: 8.0)}
    results = {f: replay(scene, foresight=f, **options) for f in ("path", "motion")}
    at = {f: first_brake_s(result, "f") for f, result in results.items()}
    assert at["motion"] < at["path"] - 0.1
    assert at["motion"] > 4.0  # the ego is within 3 s of the street from then on


def test_motion_is_extrapolated_from_the_past_alone() -> None:
    agents = [circle(20.0, 6.0), line("b", 0.0, speed=9.0)]
    foresight = MotionForesight(PathTable([a.trajectory for a in agents]), agents)
    x, y, yaw, speed = foresight.expect(np.array([0, 1]), np.array([5.05, 5.05]), np.array([1.0, 0.5]))
    angle = 6.0 / 20.0 * (5.05 + HORIZON_S)
    assert x[0] == pytest.approx(20.0 * np.cos(angle) - 20.0, abs=0.05)  # relative to the first waypoint
    assert y[0] == pytest.approx(20.0 * np.sin(angle), abs=0.05)
    assert np.diff(x[1]) == pytest.approx(0.5 * 9.0 * 0.25)
    assert np.diff(yaw[0]) == pytest.approx(6.0 / 20.0 * 0.25, rel=0.02)
    assert speed[:, 0] == pytest.approx([6.0, 4.5], rel=1e-3)
