"""Models whose tires slip, against the published package, SciPy, closed forms and themselves at small steps."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from replay_maneuvers import agent_from
from scipy.integrate import solve_ivp

from log2sim.simulation.vehicles.single_track import (
    Chassis,
    Slips,
    StepInput,
    linear_displacement,
    linear_slips,
    step_dynamic,
    step_single_track,
)
from log2sim.simulation.vehicles.vehicle import (
    GRAVITY_MPS2,
    PUBLISHED,
    VehicleControls,
    VehicleState,
    parameters_for,
    published_parameters,
    step_bicycle,
)

BMW = published_parameters(2, rear_axle_offset_m=1.4)
CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])
STEPS = {"single-track": (step_single_track, BMW), "dynamic": (step_dynamic, CAR)}
ALL_STEPS = {**STEPS, "kinematic": (step_bicycle, CAR)}
ALL = pytest.mark.parametrize("name", ALL_STEPS)


def vehicle(**columns):
    values = {f.name: np.zeros(1) for f in fields(VehicleState)}
    return VehicleState(**{**values, **{k: np.array([v], dtype=float) for k, v in columns.items()}})


def command(pedal=0.0, steer=0.0, reverse=False):
    return VehicleControls(np.array([pedal], float), np.array([steer], float), np.array([reverse]))


def stack(state):
    return np.array([getattr(state, f.name) for f in fields(state)])


def run(step, parameters, state, controls, duration_s, dt_s):
    """States (S, 8) at the begin and after every step; `controls` is a command or a function of time."""
    at = controls if callable(controls) else lambda t: controls
    states = [state]
    for k in range(round(duration_s / dt_s)):
        states.append(step(states[-1], at(k * dt_s), parameters, dt_s))
    return np.array([stack(s)[:, 0] for s in states])


def xy_error(states, fine):
    """Largest distance between two runs at the times of the first."""
    every = (len(fine) - 1) // (len(states) - 1)
    return float(np.hypot(*(states - fine[::every])[:, :2].T).max())


# The published model


def published(vehicle_number):
    package = pytest.importorskip("vehiclemodels", reason="needs commonroad-vehicle-models, the published model")
    module = __import__(f"{package.__name__}.parameters_vehicle{vehicle_number}", fromlist=["x"])
    return getattr(module, f"parameters_vehicle{vehicle_number}")()


@pytest.mark.parametrize("number", PUBLISHED)
def test_parameters_are_the_published_ones(number):
    theirs, ours = published(number), published_parameters(number, rear_axle_offset_m=1.0)
    assert ours.wheelbase_m[0] == pytest.approx(theirs.a + theirs.b, rel=1e-12)
    assert ours.cg_to_rear_m[0] == pytest.approx(theirs.b, rel=1e-12)
    assert ours.cg_height_m[0] == pytest.approx(theirs.h_s, rel=1e-12)
    assert ours.gyration_m2[0] == pytest.approx(theirs.I_z / theirs.m, rel=1e-12)
    assert ours.friction[0] == pytest.approx(theirs.tire.p_dy1, rel=1e-12)
    assert ours.front_stiffness_1prad[0] == pytest.approx(-theirs.tire.p_ky1 / theirs.tire.p_dy1, rel=1e-12)
    assert ours.max_steer_rad[0] == pytest.approx(theirs.steering.max, rel=1e-12)
    assert ours.max_steer_rate_radps[0] == pytest.approx(theirs.steering.v_max, rel=1e-12)
    assert ours.max_brake_mps2[0] == pytest.approx(theirs.longitudinal.a_max, rel=1e-12)
    assert PUBLISHED[number].length_m == theirs.l
    assert PUBLISHED[number].width_m == theirs.w


def linear_rates(number, state, steer_rate, accel, h):
    """Rates of the published states (x, y, steer, speed, yaw, yaw rate, slip angle), from one short step of ours."""
    p = published_parameters(number, rear_axle_offset_m=1.0)
    to_rear, wheelbase = float(p.cg_to_rear_m[0]), float(p.wheelbase_m[0])
    _, _, steer, speed, yaw, yaw_rate, slip = state
    rear = slip - to_rear * yaw_rate / speed
    slips = Slips(np.array([rear]), np.array([rear + wheelbase * yaw_rate / speed - steer]))
    speed1, steer1 = speed + h * accel, steer + h * steer_rate
    motion = StepInput(
        *(np.array([v]) for v in (speed, speed1, h * (speed + speed1) / 2, steer, (steer + steer1) / 2, steer1))
    )
    after = linear_slips(slips, motion, p, Chassis.of(p), h)
    chord, angle, turn = (float(v[0]) for v in linear_displacement(slips, after, motion, p))
    curvature = float(after.front[0] - after.rear[0] + steer1) / wheelbase
    later = [chord * math.cos(yaw + angle), chord * math.sin(yaw + angle), h * steer_rate, h * accel, turn]
    later += [speed1 * curvature - yaw_rate, float(after.rear[0]) + to_rear * curvature - slip]
    return np.array(later) / h


@pytest.mark.parametrize("number", PUBLISHED)
def test_the_right_hand_side_is_the_published_one(number):
    theirs = published(number)
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

    rng = np.random.default_rng(number)
    for _ in range(10):
        speed = rng.uniform(3.0, 40.0)
        state = [0.0, 0.0, rng.normal(0, 0.1), speed, rng.uniform(-3, 3), rng.normal(0, 0.5), rng.normal(0, 0.1)]
        steer_rate, accel = rng.uniform(-0.3, 0.3), rng.uniform(-9.0, 2.0)  # within the published limits
        rates = linear_rates(number, state, steer_rate, accel, 1e-7)
        np.testing.assert_allclose(rates, vehicle_dynamics_st(state, [steer_rate, accel], theirs), rtol=1e-3, atol=1e-3)


@pytest.mark.parametrize("accel", [-3.0, 3.0])
def test_backward_the_forces_of_the_published_model_oppose_the_slip_as_well(accel):
    """The published equations with the tires' forces, and only these, by the size of the speed, solved by SciPy."""
    p, steer, to_rear = BMW, 0.15, float(BMW.cg_to_rear_m[0])
    wheelbase, inertia, height = float(p.wheelbase_m[0]), float(p.gyration_m2[0]), float(p.cg_height_m[0])
    to_front, stiffness = wheelbase - to_rear, float(p.friction[0] * p.rear_stiffness_1prad[0]) / wheelbase

    def rates(_, state):
        _, _, speed, yaw, yaw_rate, slip = state
        front_slip, rear_slip = slip + to_front * yaw_rate / speed - steer, slip - to_rear * yaw_rate / speed
        side = math.copysign(1.0, speed)
        front = -side * stiffness * (GRAVITY_MPS2 * to_rear - accel * height) * front_slip
        rear = -side * stiffness * (GRAVITY_MPS2 * to_front + accel * height) * rear_slip
        twist = (to_front * front - to_rear * rear) / inertia
        course = yaw + slip
        return [
            speed * math.cos(course),
            speed * math.sin(course),
            accel,
            yaw_rate,
            twist,
            (front + rear) / speed - yaw_rate,
        ]

    start = vehicle(speed_mps=-6.0, steer_rad=steer, pedal_mps2=-accel)
    end = run(step_single_track, p, start, command(-accel, steer, True), 1.0, 0.005)[-1]
    start = [to_rear, 0.0, -6.0, 0.0, 0.0, 0.0]  # the yaw rate and the lateral velocity are zero
    solved = solve_ivp(rates, (0, 1.0), start, method="Radau", rtol=1e-9, atol=1e-11).y[:, -1]
    cg = end[0] + to_rear * math.cos(end[2]), end[1] + to_rear * math.sin(end[2])
    np.testing.assert_allclose(cg, solved[:2], atol=1e-3)
    np.testing.assert_allclose([end[3], end[2], end[7]], solved[2:5], atol=5e-4)
    assert end[6] == pytest.approx(end[3] * solved[5] - to_rear * solved[4], abs=5e-4)


# The saturating model


def sliding_rates(_, state, p, pedal, steer):
    """The documented equations of the saturating model, for a vehicle that does not change its gear."""
    _, _, yaw, u, w, r = state
    wheelbase, to_rear = float(p.wheelbase_m[0]), float(p.cg_to_rear_m[0])
    to_front, height, mu = wheelbase - to_rear, float(p.cg_height_m[0]), float(p.friction[0])
    share = math.sqrt(1 - (pedal / (mu * GRAVITY_MPS2)) ** 2)
    load_front = (GRAVITY_MPS2 * to_rear - pedal * height) / wheelbase
    load_rear = (GRAVITY_MPS2 * to_front + pedal * height) / wheelbase

    def lateral(load, stiffness, along, across):
        return -mu * load * share * math.sin(math.atan(stiffness * across / abs(along)))

    cos, sin = math.cos(steer), math.sin(steer)
    front = lateral(
        load_front,
        float(p.front_stiffness_1prad[0]),
        u * cos + (w + wheelbase * r) * sin,
        (w + wheelbase * r) * cos - u * sin,
    )
    rear = lateral(load_rear, float(p.rear_stiffness_1prad[0]), u, w)
    r_rate = (to_front * front * cos - to_rear * rear) / float(p.gyration_m2[0])
    w_rate = front * cos + rear - u * r - to_rear * r_rate
    bend = math.tan(steer) / wheelbase
    u_rate = pedal + r * w + to_rear * (r * (r - u * bend) - bend * w_rate)
    return [u * math.cos(yaw) - w * math.sin(yaw), u * math.sin(yaw) + w * math.cos(yaw), r, u_rate, w_rate, r_rate]


@pytest.mark.parametrize(
    ("speed", "pedal", "steer", "friction"),
    [
        (10.0, 0.0, 0.2, 1.05),
        (20.0, -4.0, 0.05, 1.05),
        (20.0, 0.0, 0.3, 1.05),
        (8.0, 0.0, 0.4, 0.1),
        (60.0, 0.0, 0.1, 0.3),
    ],
)
def test_the_saturating_model_is_that_of_scipy_on_the_documented_equations(speed, pedal, steer, friction):
    p = replace(CAR, friction=np.array([friction]))
    start = vehicle(speed_mps=speed, steer_rad=steer, pedal_mps2=pedal)
    ours = run(step_dynamic, p, start, command(pedal, steer), 2.0, 0.01)[-1]
    solved = solve_ivp(
        sliding_rates, (0, 2.0), [0, 0, 0, speed, 0, 0], method="Radau", rtol=1e-9, atol=1e-10, args=(p, pedal, steer)
    ).y[:, -1]
    assert np.hypot(ours[0] - solved[0], ours[1] - solved[1]) < 0.01
    assert ours[2] == pytest.approx(solved[2], abs=1e-3)
    np.testing.assert_allclose(ours[[3, 6, 7]], solved[3:], atol=5e-3)


def test_the_brakes_of_a_slippery_road_stop_after_a_distance_that_friction_sets():
    p = replace(CAR, friction=np.array([0.1]))
    end = run(step_dynamic, p, vehicle(speed_mps=10.0, pedal_mps2=-9.0), command(-9.0), 15.0, 0.05)[-1]
    assert end[3] == 0.0
    assert end[0] == pytest.approx(10.0**2 / (2 * 0.95 * 0.1 * GRAVITY_MPS2), abs=1e-6)
    assert end[1] == 0.0


# Both, where the equations are stiff or end


@pytest.mark.matrix
@pytest.mark.parametrize("speed", [0.01, 0.1, 0.5])
@pytest.mark.parametrize("gear", [1, -1])
def test_at_walking_pace_and_below_the_saturating_model_is_the_kinematic_bicycle(speed, gear):
    steer = float(CAR.max_steer_rad[0])
    rate = gear * speed * math.tan(steer) / float(CAR.wheelbase_m[0])
    start, controls = vehicle(speed_mps=gear * speed, steer_rad=steer, yaw_rate_radps=rate), command(steer=steer)
    slipping, rolling = (run(f, CAR, start, controls, 20.0, 0.05) for f in (step_dynamic, step_bicycle))
    assert xy_error(slipping, rolling) < 0.02 * speed**3 * 20.0  # slip grows with the square of the speed
    np.testing.assert_allclose(slipping[:, 3], rolling[:, 3], rtol=0.01 * speed**2 + 1e-12)


def some_states(rng, count):
    columns = {
        "x_m": rng.normal(0, 50, count), "y_m": rng.normal(0, 50, count), "yaw_rad": rng.uniform(-9, 9, count),
        "speed_mps": rng.choice([0.0, 0.05, -3.0, 8.0, 30.0, 60.0], count), "steer_rad": rng.normal(0, 0.2, count),
        "pedal_mps2": rng.normal(0, 3, count), "lateral_mps": rng.normal(0, 0.1, count),
        "yaw_rate_radps": rng.normal(0, 0.1, count),
    }  # fmt: skip
    return VehicleState(**columns)


@ALL
def test_turned_and_shifted_and_mirrored_vehicles_move_turned_and_shifted_and_mirrored(name):
    step, one = ALL_STEPS[name]
    rng = np.random.default_rng(3)
    state, p = some_states(rng, 40), one.take(np.zeros(40, int))
    controls = VehicleControls(rng.normal(0, 5, 40), rng.normal(0, 0.5, 40), rng.random(40) < 0.3)
    x, y, yaw, speed, steer, pedal, lateral, rate = stack(step(state, controls, p, 0.05))
    angle, cos, sin = 2.0, math.cos(2.0), math.sin(2.0)
    turned = replace(
        state,
        x_m=cos * state.x_m - sin * state.y_m + 100,
        y_m=sin * state.x_m + cos * state.y_m - 70,
        yaw_rad=state.yaw_rad + angle,
    )
    expected = [cos * x - sin * y + 100, sin * x + cos * y - 70, yaw + angle, speed, steer, pedal, lateral, rate]
    np.testing.assert_allclose(stack(step(turned, controls, p, 0.05)), expected, atol=1e-11)
    sides = ("y_m", "yaw_rad", "steer_rad", "lateral_mps", "yaw_rate_radps")
    mirrored = replace(state, **{k: -getattr(state, k) for k in sides})
    back = stack(step(mirrored, replace(controls, steer_rad=-controls.steer_rad), p, 0.05))
    np.testing.assert_allclose(back, [x, -y, -yaw, speed, -steer, pedal, -lateral, -rate], atol=1e-12)
