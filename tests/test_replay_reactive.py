"""Reactive agents: they brake for what the log does not have, as the intelligent-driver model says, and for nothing else."""

from __future__ import annotations

from dataclasses import replace as changed
from pathlib import Path

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, agent_from, scenario_of
from replay_scenes import LENGTH_M, Speed, departure, gap, line, parked, walker

from log2sim.datatypes import Scenario, Trajectory
from log2sim.simulation.corridors import PathTable, _nearest_edge
from log2sim.simulation.policy import load_policy
from log2sim.simulation.reactive import idm_parameters, leader_demand, rate_response
from log2sim.simulation.runner import open_world, rollout
from log2sim.simulation.runner import replay as run

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing" / "truth.json"


def replay(scene, **options):
    """A replay with the fast model: what is tested here is who brakes when."""
    return run(scene, **{"model": "kinematic", **options})


def new_collisions(result):
    return [e for e in result.metrics["collisions"] if not e["in_log"]]


def stops_at(t_s, speed=25.0):
    return Speed(lambda t: speed if t < t_s else 0.0)


# The model.


@pytest.mark.slow
def test_behind_a_constant_leader_the_gap_is_that_of_the_model_in_equilibrium():
    # Acceleration 0 and equal speeds: 1 - (v / v0)^4 = ((s0 + v T) / s)^2, with the values of town traffic.
    leader_mps, s0, time_gap, v0 = 18.0, 2.0, 1.0, 25.0
    expected = (s0 + leader_mps * time_gap) / np.sqrt(1 - (leader_mps / v0) ** 4)
    scene = scenario_of(line("ego", 70, duration_s=60), line("f", 0, duration_s=60))
    result = replay(scene, ego=Speed(lambda t: leader_mps), agents="reactive", dt_s=0.1)
    assert result.agent("f").driver == "reactive"
    assert gap(result, "f")[-1] == pytest.approx(expected, abs=0.15)
    assert result.agent("f").speed_mps[-1] == pytest.approx(leader_mps, abs=0.02)
    assert gap(result, "f").min() > expected - 0.5  # no overshoot


def test_the_demand_of_a_leader_is_the_square_of_desired_to_real_gap():
    driver = idm_parameters([line("a", 0)])
    one = np.ones(1)
    # 10 m/s behind 4 m/s: s* = 2 + 10 * 1 + 10 * 6 / (2 sqrt(1.0 * 1.5))
    desired = 12 + 60 / (2 * np.sqrt(1.5))
    assert leader_demand(driver, 20 * one, 10 * one, 4 * one)[0] == pytest.approx((desired / 20) ** 2)
    assert leader_demand(driver, 20 * one, 10 * one, 60 * one)[0] == pytest.approx((2 / 20) ** 2)  # it draws away
    assert leader_demand(driver, np.inf * one, 10 * one, 4 * one)[0] == 0.0


def test_a_free_agent_goes_on_at_the_logs_rate_and_accelerates_to_it():
    driver = idm_parameters([line("a", 0)])
    one, none = np.ones(1), np.zeros(1)
    rate, slope = rate_response(driver, one, none, 10 * one, -3 * one)
    assert (rate[0], slope[0]) == (1.0, 0.0)
    rate, slope = rate_response(driver, 0.5 * one, none, 10 * one, none)
    assert slope[0] == pytest.approx((1 - 0.5**4) * 1.0 / 10)
    # The log brakes by 3 m/s2 anyway, so a demand of 2 m/s2 asks for nothing more.
    assert rate_response(driver, one, 2 * one, 10 * one, -3 * one)[1][0] == 0.0
    assert rate_response(driver, one, 5 * one, 10 * one, -3 * one)[1][0] == pytest.approx(-0.2)


# Interference.


@pytest.mark.slow
@pytest.mark.parametrize("distance_m", [6.0, 40.0])
def test_a_follower_at_25_mps_stops_behind_an_ego_that_brakes_hard(distance_m):
    scene = scenario_of(line("ego", distance_m + LENGTH_M, duration_s=16), line("f", 0, duration_s=16))
    result = replay(scene, ego=stops_at(3.0), agents="reactive", dt_s=0.05)
    f = result.agent("f")
    assert gap(result, "f").min() > 1.0
    assert new_collisions(result) == []
    assert f.speed_mps.min() > -0.05
    late = f.t_s > 13
    assert np.ptp(f.x_m[late]) < 1e-6  # it stands, and does not creep
    assert 1.0 < gap(result, "f")[-1] < 4.0
    log = replay(scene, ego=stops_at(3.0), dt_s=0.05)
    assert gap(log, "f").min() < 0
    assert new_collisions(log)


@pytest.mark.slow
def test_a_stopped_follower_drives_on_when_the_way_is_free_and_makes_up_nothing():
    scene = scenario_of(line("ego", 30, duration_s=60), line("f", 0, duration_s=60))
    go = Speed(lambda t: 25.0 if t < 3 or t > 15 else 0.0)
    result = replay(scene, ego=go, agents="reactive", dt_s=0.05)
    f = result.agent("f")
    assert f.speed_mps.min() == 0.0
    assert f.speed_mps[-1] == pytest.approx(25.0, abs=1.0)
    assert f.speed_mps.max() < 25.1
    start = f.t_s[(f.speed_mps > 0.1) & (f.t_s > 15)][0]
    assert start < 18
    jerks = np.diff(np.sign(np.diff(f.speed_mps[(f.t_s > 3) & (f.t_s < 12)])))
    assert np.count_nonzero(jerks) <= 4  # brakes once, without hunting


@pytest.mark.slow
def test_an_ego_across_the_way_is_waited_for():
    scene = scenario_of(line("ego", -20, speed=10, duration_s=12), line("c", 2, -50, 10, 12, np.pi / 2))
    ego = Speed(lambda t: 4.0)
    assert new_collisions(replay(scene, ego=ego, dt_s=0.05))
    result = replay(scene, ego=ego, agents="reactive", dt_s=0.05)
    c = result.agent("c")
    assert result.metrics["collisions"] == []
    assert c.speed_mps.min() < 8
    assert c.y_m[-1] > 20  # and then it went on
    assert np.abs(c.x_m - 2).max() < 0.01


def test_a_pedestrian_does_not_walk_into_an_ego_that_comes_later_than_in_the_log():
    scene = scenario_of(line("ego", -50, speed=20, duration_s=12), walker("p", 2, -6, 1.4, 12, np.pi / 2))
    ego = Speed(lambda t: 13.0)
    assert new_collisions(replay(scene, ego=ego, dt_s=0.05))
    result = replay(scene, ego=ego, agents="reactive", dt_s=0.05)
    assert result.metrics["collisions"] == []
    assert result.agent("p").speed_mps.min() < 0.1
    assert result.agent("p").y_m[-1] > 4


@pytest.mark.slow
def test_of_two_whose_ways_cross_the_first_in_the_log_goes_first_and_both_get_through():
    # In the log b passes the crossing at 5 s, a at 7 s; the ego holds b up until both would be there together.
    scene = scenario_of(
        line("ego", -30, speed=10, duration_s=30),
        line("b", -50, speed=10, duration_s=30),
        line("a", 0, -70, 10, 30, np.pi / 2),
    )
    held_up = Speed(lambda t: 4.0 if t < 3 else 10.0)
    result = replay(scene, ego=held_up, agents="reactive", dt_s=0.05)
    a, b = result.agent("a"), result.agent("b")
    assert new_collisions(result) == []
    assert b.t_s[b.x_m > 0][0] < a.t_s[a.y_m > 0][0]
    assert a.accel_mps2.min() < -1
    assert min(a.y_m[-1], b.x_m[-1]) > 50


@pytest.mark.slow
def test_at_the_edge_of_a_conflict_an_agent_does_not_hunt():
    scene = scenario_of(
        line("ego", 0, speed=12, duration_s=9), line("f", -25, speed=12, duration_s=9), parked("p", 80, 0),
        line("c", 40, -70, 10, 9, np.pi / 2), line("on", 150, 3.5, 12, 9, np.pi),
    )  # fmt: skip
    brakes_late = load_policy(f"{SAMPLE.parents[1]}/egos.py:BrakeInTime")
    result = run(scene, ego=brakes_late, agents="reactive", dt_s=0.02)
    c = result.agent("c")
    assert new_collisions(result) == []
    assert c.accel_mps2.min() < -0.8
    assert np.count_nonzero(np.diff((c.accel_mps2 < -0.5).astype(int)) > 0) <= 2  # brakes once, perhaps once more


# No interference.


def test_where_nobody_interferes_reactive_agents_do_exactly_as_the_log():
    agents = [changed(f(), id=name) for name, f in MANEUVERS.items()]
    scene = scenario_of(*agents)
    log, result = replay(scene, dt_s=0.05), replay(scene, agents="reactive", dt_s=0.05)
    assert {a.driver for a in result.agents} == {"reactive"}
    assert max(departure(result, log, a.id) for a in agents) < 1e-9


def test_the_sample_in_which_a_car_and_a_pedestrian_pass_within_a_hand_stays_as_it_is():
    scene = Scenario.load(SAMPLE)
    log, result = replay(scene, dt_s=0.05), replay(scene, agents="reactive", dt_s=0.05)
    assert max(departure(result, log, a.id) for a in scene.agents) < 1e-9


def test_an_ego_that_does_about_as_the_log_moves_nobody():
    # A platoon that is closer than the model would drive, next to oncoming and parked cars.
    ids = ["f0", "f1", "on", "beside"]
    scene = scenario_of(
        line("ego", 30, speed=20, duration_s=8),
        line("f0", 20, speed=20, duration_s=8),
        line("f1", 12, speed=20, duration_s=8),
        line("on", 250, 2.3, 20, 8, np.pi),
        line("beside", 28, -2.3, 20, 8),
        parked("p", 90, -4.2),
    )
    ego = Speed(lambda t: 20.0 + 0.2 * np.sin(2 * t))
    log, result = replay(scene, dt_s=0.05), replay(scene, ego=ego, agents="reactive", dt_s=0.05)
    assert max(departure(result, log, k) for k in ids) < 0.05


def test_who_cuts_in_at_the_same_speed_is_followed_and_not_braked_for_as_if_he_stood():
    t = np.arange(0, 12.01, 0.1)
    share = np.clip((t - 2) / 4, 0, 1)
    y = 3.5 * (1 - share**3 * (10 - 15 * share + 6 * share**2))
    cutter = agent_from(t, 40 + 20 * t, y, np.arctan2(np.gradient(y, t), 20), np.full(len(t), 20.0), id="o")
    scene = scenario_of(cutter, line("f", 0, speed=20, duration_s=12))
    world = open_world(scene, model="kinematic", dt_s=0.05, drives_ego=False, agents=["f"])
    world.traffic._distrusted[:] = True
    _, columns = rollout(world)["f"]
    # At a gap of 35.6 m the model brakes by (22 / 35.6)^2 m/s2 at first, and less the farther it falls back.
    assert -0.5 < columns[5].min() < -0.2
    assert columns[3].min() > 18


@pytest.mark.slow
def test_what_the_log_drives_into_is_braked_for():
    scene = scenario_of(line("f", 0, speed=12, duration_s=12), parked("p", 80, 0.5))
    assert replay(scene, dt_s=0.05).metrics["collisions"]
    result = replay(scene, agents="reactive", dt_s=0.05)
    assert result.metrics["collisions"] == []
    assert 1.0 < 80 - result.agent("f").x_m[-1] - LENGTH_M < 4.0
    grazing = scenario_of(line("f", 0, speed=12, duration_s=12), parked("p", 80, 1.6))
    assert departure(replay(grazing, agents="reactive"), replay(grazing), "f") < 1e-9


# Geometry.


def test_the_nearest_edge_within_a_corridor_is_that_of_the_clipped_box():
    rng = np.random.default_rng(0)
    length, width, within = 4.6, 1.9, 1.1
    u, v = np.meshgrid(np.linspace(-length / 2, length / 2, 1201), np.linspace(-width / 2, width / 2, 501))
    for yaw in [*rng.uniform(-np.pi, np.pi, 30), 0.0, np.pi / 2, -np.pi / 2]:
        left = rng.uniform(-2, 2)
        x, y = u * np.cos(yaw) - v * np.sin(yaw), left + u * np.sin(yaw) + v * np.cos(yaw)
        inside = np.abs(y) < within
        if inside.any():
            got = _nearest_edge(
                *(np.full((1, 1), c) for c in (left, np.cos(yaw), np.sin(yaw), length / 2, width / 2, within))
            )
            assert got[0, 0] == pytest.approx(x[inside].min(), abs=0.02)


def test_feet_on_a_curved_way_are_those_of_a_search_over_all_its_points():
    agent = MANEUVERS["turn of radius 8 m"]()
    path = Trajectory.through(agent.waypoints, 1.3)
    ways = PathTable([path])
    rng = np.random.default_rng(1)
    fine = np.arange(0, 8, 0.001)
    x, y, *_ = path.relative(fine)
    points = np.stack([x, y], axis=1)[rng.integers(0, len(x), 40)] + rng.uniform(-2, 2, (40, 2))
    foot = ways.foot(np.zeros(40, dtype=int), np.zeros(40), 60.0, points[:, :1], points[:, 1:])
    nearest = np.argmin(np.hypot(points[:, :1] - x, points[:, 1:] - y), axis=1)
    inner = (nearest > 0) & (nearest < len(x) - 1)
    offset = np.hypot(points[:, 0] - x[nearest], points[:, 1] - y[nearest])
    np.testing.assert_allclose(np.abs(foot.left_m[inner, 0]), offset[inner], atol=0.06)
    along = foot.distance_m[:, 0] + foot.ahead_m[:, 0]
    np.testing.assert_allclose(along[inner], 5.0 * fine[nearest][inner], atol=0.25)  # 5 m/s
