"""Vehicle models against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import agent_from, driven, lane_change, ramp, scenario_of

from log2sim.simulation.runner import replay
from log2sim.simulation.vehicles.single_track import SLIP_TOLERANCE_RAD
from log2sim.simulation.vehicles.vehicle import (
    GRAVITY_MPS2,
    POINT_MAX_ACCEL_MPS2,
    PUBLISHED,
    STEER_LAG_S,
    PointControls,
    PointState,
    VehicleControls,
    VehicleState,
    parameters_for,
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


def test_a_point_follows_the_parabola_and_its_acceleration_is_limited():
    state = PointState(column(1), column(2), column(3), column(-1))
    for _ in range(100):
        state = step_point(state, PointControls(column(0.5), column(-1.0)), 0.02)
    assert state.x_m[0] == pytest.approx(1 + 3 * 2 + 0.5 * 4 / 2)
    assert state.y_m[0] == pytest.approx(2 - 1 * 2 - 1.0 * 4 / 2)
    pushed = step_point(state, PointControls(column(300.0), column(400.0)), 0.1)
    gained = np.hypot(pushed.velocity_x_mps - state.velocity_x_mps, pushed.velocity_y_mps - state.velocity_y_mps)
    assert gained[0] == pytest.approx(POINT_MAX_ACCEL_MPS2 * 0.1)


SLIPPING = pytest.mark.parametrize("model", ["dynamic", "single-track"])


def cruise(speed, curvature=np.zeros_like, duration_s=8.0):
    return driven(lambda t: np.full_like(t, speed), curvature, duration_s)


def bend(radius_m):
    return lambda s: ramp(s, (20, 0), (60, 1 / radius_m), (100, 1 / radius_m), (140, 0))


def test_the_slip_expected_on_the_course_decides():
    p = parameters_for([cruise(10.0)])
    # Steady cornering at the tolerance, from the law of the tires: tan(slip) * C = f / sqrt(1 - f^2).
    force = SLIP_TOLERANCE_RAD * p.rear_stiffness_1prad[0]
    limit_mps2 = p.friction[0] * GRAVITY_MPS2 * force / np.sqrt(1 + force**2)
    for share, expected in ((0.9, "kinematic"), (1.1, "dynamic")):
        agent = replay(scenario_of(cruise(15.0, bend(15.0**2 / (share * limit_mps2))))).agents[0]
        assert agent.model == expected
        assert "rear tires slip up to 0.0" in agent.model_reason


@pytest.mark.parametrize("model", ["kinematic", "dynamic", "single-track"])
def test_a_model_that_is_asked_for_moves_every_vehicle(model):
    result = replay(scenario_of(cruise(10.0)), model=model)
    assert (result.model, result.agents[0].model, result.agents[0].model_reason) == (model, model, "asked for")


@pytest.mark.matrix
@SLIPPING
@pytest.mark.parametrize("dt_s", [0.01, 0.05])
@pytest.mark.parametrize(
    ("speed", "curvature"), [(20.0, lane_change), (20.0, bend(70.0)), (5.0, bend(9.0)), (60.0, bend(1000.0))],
    ids=["lane change at 20 m/s", "6 m/s2 sideways", "tight turn", "60 m/s"],
)  # fmt: skip
def test_vehicles_that_slip_follow_their_waypoints(model, speed, curvature, dt_s):
    metrics = replay(scenario_of(cruise(speed, curvature)), model=model, dt_s=dt_s).metrics
    assert metrics["cross_track_rms_m"] < 0.10
    assert metrics["cross_track_max_m"] < 0.35
    assert metrics["along_track_rms_m"] < 0.3
    assert metrics["speed_rms_mps"] < 0.3


def test_parameters_grow_with_the_size_and_loads_stay_on_the_wheels():
    sizes = {"car": (4.4, 1.8, 1.5), "truck": (9.0, 2.5, 3.5), "bus": (12.0, 2.5, 3.2), "motorcycle": (2.1, 0.8, 1.6), "cyclist": (1.8, 0.6, 1.8)}  # fmt: skip
    agents = [agent_from([0.0], [0.0], [0.0], [0.0], [0.0], category=c, size_m=s) for c, s in sizes.items()]
    p = parameters_for(agents)
    assert np.all(np.diff(p.gyration_m2[:3]) > 0)
    assert np.all((p.cg_to_rear_m > 0.3 * p.wheelbase_m) & (p.cg_to_rear_m < 0.7 * p.wheelbase_m))
    assert np.all(p.front_stiffness_1prad < p.rear_stiffness_1prad)  # all understeer
    assert np.all(p.cg_height_m < 0.6 * np.array([s[2] for s in sizes.values()]))


def test_the_published_model_takes_the_published_car_nearest_in_size():
    def wheelbase(length, width):
        one = [agent_from([0.0], [0.0], [0.0], [0.0], [0.0], size_m=(length, width, 1.5))]
        return float(parameters_for(one, published=True).wheelbase_m[0])

    for vehicle in PUBLISHED.values():
        near = wheelbase(vehicle.length_m + 0.01, vehicle.width_m - 0.01)
        assert near == pytest.approx(vehicle.cg_to_front_m + vehicle.cg_to_rear_m)
    bus = agent_from([0.0], [0.0], [0.0], [0.0], [0.0], category="bus", size_m=(12.0, 2.5, 3.2))
    assert parameters_for([bus], published=True).wheelbase_m == parameters_for([bus]).wheelbase_m
