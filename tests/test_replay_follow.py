"""Vehicles and pedestrians that follow their waypoints."""

from __future__ import annotations

from dataclasses import fields
from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, OFFSET_M, agent_from, driven, scenario_of

from log2sim.simulation.reference import GAINS, ControllerMemory, follow_vehicles
from log2sim.simulation.runner import replay
from log2sim.simulation.vehicles.vehicle import VehicleState, parameters_for

CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])

# Largest errors across and along in m and RMS error of speed in m/s: a hand's breadth, a pedal's lag.
LIMITS = {
    "straight": (0.001, 0.001, 0.001),
    "brake to stop and go": (0.001, 0.06, 0.08),
    "turn of radius 8 m": (0.05, 0.01, 0.01),
    "lane change": (0.02, 0.01, 0.01),
    "slow start from rest": (0.01, 0.06, 0.06),
    "reversing": (0.03, 0.06, 0.08),
    "60 m/s": (0.02, 0.01, 0.01),
}


def followed(agent, **options):
    result = replay(scenario_of(agent), **options)
    return result.agents[0], result.metrics["by_agent"][agent.id], result


@pytest.mark.matrix
@pytest.mark.parametrize("name", MANEUVERS)
def test_maneuvers_are_followed_within_limits(name):
    across, along, speed = LIMITS[name]
    agent, metrics, _ = followed(MANEUVERS[name](), model="kinematic")
    assert metrics["cross_track_max_m"] < across
    assert metrics["along_track_rms_m"] < along
    assert metrics["speed_rms_mps"] < speed
    assert agent.driver == "pid"
    assert agent.flags == ()


@pytest.mark.parametrize("speed", [1.0, 5.0, 15.0, 60.0])
@pytest.mark.parametrize("dt_s", [0.01, 0.1])
def test_a_push_off_the_path_dies_out_without_overshoot_to_the_other_side(speed, dt_s):
    agent = driven(lambda t: np.full_like(t, speed), np.zeros_like, 10.0)
    w = agent.waypoints
    y = np.where(w.t_s < 2.0, 0.0, 1.4)  # the log steps sideways, too little for a leap
    stepped = changed(agent, waypoints=changed(w, y_m=y))
    result, _, _ = followed(stepped, model="kinematic", dt_s=dt_s)
    late = result.t_s > 5.0
    assert np.abs(result.y_m[late] - 1.4).max() < 0.05
    assert result.y_m.max() < 1.4 + 0.15
    assert any("distance from what can be driven" in flag for flag in result.flags)


@pytest.mark.parametrize("dt_s", [0.001, 0.1, 1.0])
@pytest.mark.parametrize(("jitter_m", "limit"), [(0.0, 1e-6), (0.03, 0.1)])
def test_standing_vehicles_stay_where_they_are_while_their_boxes_jitter(jitter_m, limit, dt_s):
    x, y = np.random.default_rng(5).normal(0, jitter_m, (2, 100))
    agent = agent_from(np.arange(100) * 0.1, x, y, np.full(100, 2.0), np.zeros(100))
    result, _, _ = followed(agent, dt_s=dt_s)
    assert np.hypot(result.x_m, result.y_m).max() < limit
    assert np.abs(result.speed_mps).max() < limit
    np.testing.assert_allclose(result.yaw_rad, 2.0, atol=limit)


@pytest.mark.parametrize("later_s", [0.0, 0.017, 0.05])
def test_after_a_leap_of_the_log_the_vehicle_goes_on_where_the_log_does(later_s):
    agent = driven(lambda t: np.full_like(t, 10.0), np.zeros_like, 6.0)
    w = agent.waypoints
    t, x = w.t_s + later_s * (w.t_s > 0), w.x_m + 10 * later_s * (w.t_s > 0)
    leaping = changed(agent, waypoints=changed(w, t_s=t, x_m=x + np.where(w.t_s >= 3.0, 40.0, 0.0)))
    result, metrics, _ = followed(leaping)
    assert any(f"discontinuous at {3 + later_s:.2f} s" in flag for flag in result.flags)
    assert np.abs(result.y_m).max() < 1e-6
    assert np.abs(np.diff(result.x_m)).max() == pytest.approx(40.5, abs=0.3)
    assert metrics["along_track_rms_m"] < 0.05
    assert result.x_m[-1] == pytest.approx(40 + OFFSET_M + 10 * result.t_s[-1], abs=0.05)


def controls_at(*, x=0.0, y=0.0, yaw=0.0, speed=10.0, row=(0, 0, 0, 10, 0, 0, 1, 0), dt_s=0.01):
    """Controls and memory of a car that has just begun to follow one row of a table."""
    known = {"x_m": x, "y_m": y, "yaw_rad": yaw, "speed_mps": speed}
    state = VehicleState(*(np.array([known.get(f.name, 0.0)]) for f in fields(VehicleState)))
    return follow_vehicles(np.array(row, float)[:, None], state, ControllerMemory.fresh(1), CAR, dt_s)


def test_the_integral_grows_with_the_error_but_not_at_the_limit_of_an_actuator():
    near, far = (controls_at(x=-d, y=-d / 100)[1].integral[:, 0] for d in (0.5, 2.9))
    assert near[0] == pytest.approx(0.5 * 0.01 / (GAINS.along_s**2 * GAINS.integral_s), rel=1e-6)
    assert near[1] == pytest.approx(0.005 * 0.01 / ((10 * GAINS.across_s) ** 2 * GAINS.integral_s), rel=1e-6)
    assert far[0] == 0.0  # 2.9 m / (0.6 s)^2 is more than full throttle
    assert far[1] > 0.0
    catching_up = controls_at(x=-5.0, speed=12.5, dt_s=0.1)
    assert 0.0 < catching_up[0].pedal_mps2[0] < 3.0
    assert catching_up[1].integral[0, 0] == 0.0
    aside = controls_at(y=-6.0)[1].integral[:, 0]
    assert aside[1] == 0.0  # the wheels are at the limit of grip
