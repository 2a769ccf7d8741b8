"""Models whose tires slip, against the published package, SciPy, closed forms and themselves at small steps."""

from __future__ import annotations

import math
from dataclasses import fields, replace

import numpy as np
import pytest
from replay_maneuvers import agent_from
from scipy.integrate import solve_ivp

from log2sim.simulation.vehicles.parameters import PUBLISHED, parameters_for, published_parameters
from log2sim.simulation.vehicles.single_track import (
    Chassis,
    Slips,
    StepInput,
    linear_displacement,
    linear_slips,
    step_dynamic,
    step_single_track,
)
from log2sim.simulation.vehicles.vehicle import GRAVITY_MPS2, VehicleControls, VehicleState, step_bicycle

BMW = published_parameters(2, rear_axle_offset_m=1.4)
CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])
STEPS = {"single-track": (step_single_track, BMW), "dynamic": (step_dynamic, CAR)}
ALL_STEPS = {**STEPS, "kinematic": (step_bicycle, CAR)}
BOTH = pytest.mark.parametrize("name", STEPS)
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


def test_a_swerve_at_25_mps_is_that_of_a_high_order_integrator_on_the_published_equations():
    theirs = published(2)
    from vehiclemodels.vehicle_dynamics_st import vehicle_dynamics_st

    def pedal(t):
        return -5.0 if t >= 1.2 else 0.0

    def wanted(t):
        return 0.06 * math.sin(math.pi * math.floor(t / 0.2 + 1e-9) * 0.2)

    fast = replace(BMW, steer_lag_s=np.array([0.05]))
    dt_s = 0.02
    ours = run(step_single_track, fast, vehicle(speed_mps=25.0), lambda t: command(pedal(t), wanted(t)), 3.0, dt_s)
    rates = np.diff(ours[:, [4, 3]], axis=0) / dt_s  # what the actuators did, step by step
    state = np.array([BMW.cg_to_rear_m[0], 0.0, 0.0, 25.0, 0.0, 0.0, 0.0])
    theirs_xy = []
    for rate in rates:
        solved = solve_ivp(
            lambda t, s, u=rate: vehicle_dynamics_st(s, u, theirs),
            (0, dt_s),
            state,
            method="DOP853",
            rtol=1e-9,
            atol=1e-9,
        )
        state = solved.y[:, -1]
        theirs_xy.append(state[:2])
    to_rear = BMW.cg_to_rear_m[0]
    cg = ours[1:, :2] + to_rear * np.stack([np.cos(ours[1:, 2]), np.sin(ours[1:, 2])], axis=1)
    assert np.ptp(cg[:, 1]) > 1.0
    assert np.hypot(*(cg - theirs_xy).T).max() < 0.01


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

    end = run(
        step_single_track,
        p,
        vehicle(speed_mps=-6.0, steer_rad=steer, pedal_mps2=-accel),
        command(-accel, steer, True),
        1.0,
        0.005,
    )[-1]
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


def test_without_friction_the_momentum_stays_what_it_is():
    p = replace(CAR, friction=np.array([1e-9]))
    start = vehicle(speed_mps=20.0, lateral_mps=3.0, yaw_rate_radps=0.8, steer_rad=0.3, yaw_rad=0.4)
    states = run(step_dynamic, p, start, command(-5.0, 0.3), 3.0, 0.01)
    to_rear = float(p.cg_to_rear_m[0])
    cg = states[:, :2] + to_rear * np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], axis=1)
    along, aside = 20.0, 3.0 + 0.8 * to_rear
    velocity = [along * math.cos(0.4) - aside * math.sin(0.4), along * math.sin(0.4) + aside * math.cos(0.4)]
    np.testing.assert_allclose(cg, cg[0] + np.linspace(0, 3, len(cg))[:, None] * velocity, atol=1e-2)
    assert states[-1, 2] == pytest.approx(0.4 + 0.8 * 3.0, abs=1e-5)


def test_steady_cornering_understeers_as_the_stiffness_of_the_axles_says():
    speed, steer = 20.0, 0.01
    end = run(step_dynamic, CAR, vehicle(speed_mps=speed, steer_rad=steer), command(steer=steer), 6.0, 0.02)[-1]
    compliance = 1 / CAR.front_stiffness_1prad[0] - 1 / CAR.rear_stiffness_1prad[0]
    gradient = compliance / (CAR.friction[0] * GRAVITY_MPS2)
    assert end[7] == pytest.approx(speed * steer / (CAR.wheelbase_m[0] + gradient * speed**2), rel=3e-3)


@pytest.mark.slow
@pytest.mark.parametrize("friction", [1.05, 0.1])
def test_tires_never_bear_more_than_friction_times_weight(friction):
    p, rng = replace(CAR, friction=np.array([friction])), np.random.default_rng(1)
    for speed in (1.0, 10.0, 30.0, 60.0):
        wanted = rng.uniform([-12, -1], [8, 1], (20, 2))
        states = run(
            step_dynamic, p, vehicle(speed_mps=speed), lambda t, w=wanted: command(*w[int(t / 0.2 + 1e-9)]), 4.0, 0.01
        )
        yaw, u, side = states[:, 2], states[:, 3], states[:, 6] + CAR.cg_to_rear_m[0] * states[:, 7]
        velocity = np.stack([u * np.cos(yaw) - side * np.sin(yaw), u * np.sin(yaw) + side * np.cos(yaw)])
        force, limit = np.diff(velocity) / 0.01, friction * GRAVITY_MPS2
        middle = (yaw[1:] + yaw[:-1]) / 2
        assert np.abs(force[1] * np.cos(middle) - force[0] * np.sin(middle)).max() < 1.005 * limit
        assert np.hypot(*force).max() < 1.15 * limit  # the drive adds a seventh while the yaw rate changes


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


@pytest.mark.slow
@pytest.mark.parametrize("gear", [1, -1])
def test_at_walking_pace_the_published_model_drives_the_circle_of_small_angles(gear):
    speed, steer = 0.05, 0.2
    rate = gear * speed * steer / float(BMW.wheelbase_m[0])
    start = vehicle(speed_mps=gear * speed, steer_rad=steer, yaw_rate_radps=rate)
    states = run(step_single_track, BMW, start, command(steer=steer), 40.0, 0.05)
    turn = gear * speed * 40.0 * steer / BMW.wheelbase_m[0]
    assert states[-1, 2] == pytest.approx(turn, rel=1e-4)
    slip = steer * BMW.cg_to_rear_m[0] / BMW.wheelbase_m[0]  # of the center of gravity
    radius = gear * speed * 40.0 / turn
    cg = states[:, :2] + BMW.cg_to_rear_m[0] * np.stack([np.cos(states[:, 2]), np.sin(states[:, 2])], axis=1)
    away = [radius * (math.sin(turn + slip) - math.sin(slip)), radius * (math.cos(slip) - math.cos(turn + slip))]
    np.testing.assert_allclose(cg[-1] - cg[0], away, atol=1e-4)


# Speed, command (of time), friction, and how far in m the path at dt 10 ms and more may be from the converged one.
EXTREMES = {
    "swerve at 60 m/s": (60.0, lambda t: command(-3.0, 0.03 * math.copysign(1, math.sin(4 * t))), 1.05, 0.2),
    "full lock at 60 m/s": (60.0, lambda t: command(0.0, 1.2), 1.05, 0.1),
    "full lock at 60 m/s on ice": (60.0, lambda t: command(0.0, 1.2), 0.1, 0.1),
    "hard braking to standstill": (20.0, lambda t: command(-12.0, 0.0), 1.05, 0.001),
    "hard braking at full lock": (10.0, lambda t: command(-12.0, 1.2), 1.05, 0.03),
    "stop and go": (8.0, lambda t: command(-5.0 if t < 3 else 2.0, 0.3 if t > 3 else 0.05), 1.05, 0.01),
    "from rest at 0.2 rad": (0.0, lambda t: command(1.5, 0.2), 1.05, 0.01),
    "from rest at full lock": (0.0, lambda t: command(3.0, 1.2), 1.05, 0.03),
    "from rest on ice": (0.0, lambda t: command(6.0, 0.5), 0.1, 0.01),
    "reversing at full lock": (0.0, lambda t: command(2.0, -1.2, reverse=True), 1.05, 0.03),
    "from reverse to forward": (-3.0, lambda t: command(-4.0 if t < 2 else 2.0, 0.4), 1.05, 0.01),
}


@pytest.mark.slow
@ALL
def test_the_path_is_the_converged_one_at_every_step_in_every_extreme(name):
    step, one = ALL_STEPS[name]
    cases = EXTREMES.values()
    p = replace(one.take(np.zeros(len(cases), int)), friction=np.array([c[2] for c in cases]))

    def paths(dt_s):
        """x, y at full seconds (6, A, 2); commands change only there, so that all steps see the same."""
        state = VehicleState.zeros(len(cases))
        state.speed_mps[:] = [c[0] for c in cases]
        out = []
        for second in range(5):
            each = [c[1](second) for c in cases]
            controls = VehicleControls(
                *(np.concatenate([getattr(e, f.name) for e in each]) for f in fields(VehicleControls))
            )
            for _ in range(round(1 / dt_s)):
                state = step(state, controls, p, dt_s)
            out.append(np.stack([state.x_m, state.y_m], axis=1))
        return np.array(out)

    converged, limits = paths(0.002), np.array([c[3] for c in cases])
    for dt_s in (0.01, 0.02, 0.05, 0.2, 1.0):
        error = np.linalg.norm(paths(dt_s) - converged, axis=2).max(axis=0)
        assert {k: e for k, e, limit in zip(EXTREMES, error, limits) if e > limit} == {}


@pytest.mark.slow
@BOTH
def test_halving_the_step_quarters_the_error(name):
    step, p = STEPS[name]

    def end(dt_s):
        start = vehicle(speed_mps=15.0, steer_rad=0.04, pedal_mps2=-1.0)
        return run(step, p, start, command(-1.0, 0.04), 1.6, dt_s)[-1, :3]

    converged = end(0.0003125)
    errors = [np.abs(end(dt_s) - converged).max() for dt_s in (0.01, 0.005, 0.0025)]
    assert 3.0 < errors[0] / errors[1] < 5.5
    assert 3.0 < errors[1] / errors[2] < 5.5


@pytest.mark.slow
@ALL
@pytest.mark.parametrize("friction", [1.05, 0.1])
def test_who_braked_to_standstill_stays_and_then_starts_the_right_way(name, friction):
    step, p = ALL_STEPS[name]
    p = replace(p, friction=np.array([friction]))
    stopped = vehicle(speed_mps=4.0, steer_rad=0.5)
    for _ in range(150):
        stopped = step(stopped, command(-10.0, 0.5), p, 0.05)
    assert stopped.speed_mps[0] == 0.0
    waited = step(stopped, command(-10.0, -0.5), p, 1.0)
    for key in ("x_m", "y_m", "yaw_rad", "speed_mps"):
        assert getattr(waited, key)[0] == pytest.approx(getattr(stopped, key)[0], abs=1e-12)
    for reverse, sign in ((False, 1), (True, -1)):
        away = run(step, p, waited, command(1.0, -0.3, reverse), 1.5, 0.05)
        ahead = np.diff(away[:, 0]) * np.cos(away[:-1, 2]) + np.diff(away[:, 1]) * np.sin(away[:-1, 2])
        assert np.all(sign * ahead >= -1e-9)
        assert sign * ahead.sum() > 0.3
        assert sign * (away[-1, 2] - away[0, 2]) < -0.02  # to the right, in reverse with the nose to the left


@BOTH
def test_saturated_actuators_are_those_of_the_kinematic_bicycle(name):
    step, p = STEPS[name]
    ours, bicycle = (run(f, p, vehicle(speed_mps=5.0), command(-50.0, 9.0), 1.0, 0.01) for f in (step, step_bicycle))
    np.testing.assert_allclose(ours[:, 4:6], bicycle[:, 4:6], atol=1e-9)
    assert abs(ours[:, 4]).max() <= p.max_steer_rad[0]


def some_states(rng, count):
    columns = {
        "x_m": rng.normal(0, 50, count), "y_m": rng.normal(0, 50, count), "yaw_rad": rng.uniform(-9, 9, count),
        "speed_mps": rng.choice([0.0, 0.05, -3.0, 8.0, 30.0, 60.0], count), "steer_rad": rng.normal(0, 0.2, count),
        "pedal_mps2": rng.normal(0, 3, count), "lateral_mps": rng.normal(0, 0.1, count),
        "yaw_rate_radps": rng.normal(0, 0.1, count),
    }  # fmt: skip
    return VehicleState(**columns)


def some_controls(rng, count):
    return VehicleControls(rng.normal(0, 5, count), rng.normal(0, 0.5, count), rng.random(count) < 0.3)


@ALL
def test_agents_at_once_move_as_one_by_one(name):
    step, one = ALL_STEPS[name]
    rng = np.random.default_rng(2)
    state, controls = some_states(rng, 40), some_controls(rng, 40)
    together = stack(step(state, controls, one.take(np.zeros(40, int)), 0.03))
    for k in range(40):
        alone = stack(step(state.take([k]), controls.take([k]), one, 0.03))
        np.testing.assert_allclose(together[:, k], alone[:, 0], rtol=1e-12, atol=1e-12)


@ALL
def test_turned_and_shifted_and_mirrored_vehicles_move_turned_and_shifted_and_mirrored(name):
    step, one = ALL_STEPS[name]
    rng = np.random.default_rng(3)
    state, controls, p = some_states(rng, 40), some_controls(rng, 40), one.take(np.zeros(40, int))
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
