"""Vehicle models against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import agent_from

from log2sim.simulation.vehicles.parameters import STEER_LAG_S, parameters_for
from log2sim.simulation.vehicles.vehicle import (
    POINT_MAX_ACCEL_MPS2,
    PointControls,
    PointState,
    VehicleControls,
    VehicleState,
    step_bicycle,
    step_point,
)

CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])


def column(value):
    return np.array([value], dtype=np.float64)


def at_rest(*, speed=0.0, steer=0.0, pedal=0.0):
    return VehicleState(
        column(0), column(0), column(0), column(speed), column(steer), column(pedal), column(0), column(0)
    )


def command(*, pedal=0.0, steer=0.0, reverse=False):
    return VehicleControls(column(pedal), column(steer), np.array([reverse]))


def run(state, controls, duration_s, dt_s):
    for _ in range(round(duration_s / dt_s)):
        state = step_bicycle(state, controls, CAR, dt_s)
    return state


@pytest.mark.parametrize("dt_s", [0.001, 0.01, 0.1, 1.0])
@pytest.mark.parametrize("speed", [0.3, 5.0, 60.0])
def test_constant_steering_drives_a_circle_of_wheelbase_over_tangent(dt_s, speed):
    steer = 0.2
    radius = CAR.wheelbase_m[0] / np.tan(steer)
    turned = speed * 4.0 / radius
    state = run(at_rest(speed=speed, steer=steer), command(steer=steer), 4.0, dt_s)
    assert state.yaw_rad[0] == pytest.approx(turned, abs=1e-9)
    assert state.x_m[0] == pytest.approx(radius * np.sin(turned), abs=1e-6)
    assert state.y_m[0] == pytest.approx(radius * (1 - np.cos(turned)), abs=1e-6)


@pytest.mark.parametrize("dt_s", [0.003, 0.01, 0.09])
def test_braking_stops_after_the_stopping_distance_and_stays(dt_s):
    speed, brake = 10.0, 5.0
    state = run(at_rest(speed=speed, pedal=-brake), command(pedal=-brake), 3.0, dt_s)
    assert state.speed_mps[0] == 0.0
    assert state.x_m[0] == pytest.approx(speed**2 / (2 * brake), abs=1e-6)


def test_the_wheels_turn_no_faster_than_their_rate_and_no_further_than_the_lock():
    early = run(at_rest(), command(steer=5.0), 0.2, 0.01)
    late = run(at_rest(), command(steer=5.0), 5.0, 0.01)
    assert early.steer_rad[0] == pytest.approx(0.2 * CAR.max_steer_rate_radps[0], abs=1e-9)
    assert late.steer_rad[0] == pytest.approx(CAR.max_steer_rad[0], abs=1e-6)
    assert np.all(CAR.steer_lag_s == STEER_LAG_S)


def test_a_step_in_one_or_in_two_halves_is_the_same_while_the_steering_is_constant():
    state = at_rest(speed=20.0, steer=0.05, pedal=2.0)
    controls = command(pedal=2.0, steer=0.05)
    one = step_bicycle(state, controls, CAR, 0.02)
    half = step_bicycle(state, controls, CAR, 0.01)
    two = step_bicycle(half, controls, CAR, 0.01)
    for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
        assert getattr(one, key)[0] == pytest.approx(getattr(two, key)[0], abs=1e-5)
    assert half.x_m[0] == pytest.approx(20.0 * 0.01, rel=1e-2)


def test_a_point_follows_the_parabola_and_its_acceleration_is_limited():
    state = PointState(column(1), column(2), column(3), column(-1))
    for _ in range(100):
        state = step_point(state, PointControls(column(0.5), column(-1.0)), 0.02)
    assert state.x_m[0] == pytest.approx(1 + 3 * 2 + 0.5 * 4 / 2)
    assert state.y_m[0] == pytest.approx(2 - 1 * 2 - 1.0 * 4 / 2)
    pushed = step_point(state, PointControls(column(300.0), column(400.0)), 0.1)
    gained = np.hypot(pushed.velocity_x_mps - state.velocity_x_mps, pushed.velocity_y_mps - state.velocity_y_mps)
    assert gained[0] == pytest.approx(POINT_MAX_ACCEL_MPS2 * 0.1)
