"""Vehicles and pedestrians that follow their waypoints."""

from __future__ import annotations

from dataclasses import fields
from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, OFFSET_M, agent_from, driven, ramp, scenario_of

from log2sim.simulation.follower import GAINS, ControllerMemory, follow_points, follow_vehicles
from log2sim.simulation.runner import replay
from log2sim.simulation.vehicles.parameters import parameters_for
from log2sim.simulation.vehicles.vehicle import PointState, VehicleState, step_bicycle, step_point

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


@pytest.mark.slow
@pytest.mark.parametrize("name", ["brake to stop and go", "turn of radius 8 m", "reversing"])
def test_the_result_changes_little_when_the_step_is_halved(name):
    runs = [followed(MANEUVERS[name](), dt_s=dt)[0] for dt in (0.01, 0.005, 0.05)]
    for other, limit in ((runs[1], 0.01), (runs[2], 0.05)):
        assert len(other) == len(runs[0])
        assert np.hypot(other.x_m - runs[0].x_m, other.y_m - runs[0].y_m).max() < limit


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", [0.0005, 0.1])
def test_the_shortest_and_the_longest_step_follow_too(dt_s):
    agent = driven(lambda t: np.full_like(t, 8.0), lambda s: ramp(s, (5, 0), (9, 0.05)), 1.5)
    assert followed(agent, dt_s=dt_s)[1]["cross_track_max_m"] < 0.1


def test_a_push_off_the_path_dies_out_without_overshoot_to_the_other_side():
    agent = driven(lambda t: np.full_like(t, 8.0), np.zeros_like, 10.0)
    w = agent.waypoints
    y = np.where(w.t_s < 2.0, 0.0, 1.4)  # the log steps sideways, too little for a leap
    stepped = changed(agent, waypoints=changed(w, y_m=y))
    result, _, _ = followed(stepped, model="kinematic")
    late = result.t_s > 5.0
    assert np.abs(result.y_m[late] - 1.4).max() < 0.05
    assert result.y_m.max() < 1.4 + 0.15
    assert any("distance from what can be driven" in flag for flag in result.flags)


def test_standing_vehicles_stay_where_they_are_while_their_boxes_jitter():
    rng = np.random.default_rng(5)
    t = np.arange(100) * 0.1
    agent = agent_from(t, rng.normal(0, 0.03, 100), rng.normal(0, 0.03, 100), np.full(100, 2.0), np.zeros(100))
    result, _, _ = followed(agent)
    assert np.hypot(result.x_m, result.y_m).max() < 0.1
    assert np.abs(result.speed_mps).max() < 0.1


def test_a_heading_that_is_five_degrees_off_does_not_lead_off_the_path():
    agent = MANEUVERS["straight"]()
    w = agent.waypoints
    skewed = changed(agent, waypoints=changed(w, yaw_rad=w.yaw_rad + np.radians(5)))
    assert followed(skewed)[1]["cross_track_max_m"] < 0.08  # held, it would run 0.15 m beside


def test_a_box_that_drifts_sideways_is_followed_as_far_as_wheels_allow():
    t = np.arange(60) * 0.1
    forward = 4.0 * t
    agent = agent_from(t, forward, 0.05 * forward, np.zeros(60), np.full(60, 4.0))
    result, metrics, _ = followed(agent)
    assert metrics["cross_track_max_m"] < 0.1
    assert np.degrees(np.median(result.yaw_rad)) == pytest.approx(np.degrees(np.arctan(0.05)), abs=1.0)


def test_wheels_of_the_kinematic_model_never_slip_sideways():
    for name in ("turn of radius 8 m", "reversing"):
        agent, _, _ = followed(MANEUVERS[name](), dt_s=0.05, model="kinematic")
        rear_x, rear_y = agent.x_m - 1.3 * np.cos(agent.yaw_rad), agent.y_m - 1.3 * np.sin(agent.yaw_rad)
        mean = (np.unwrap(agent.yaw_rad)[1:] + np.unwrap(agent.yaw_rad)[:-1]) / 2
        sideways = np.diff(rear_y) * np.cos(mean) - np.diff(rear_x) * np.sin(mean)
        assert np.abs(sideways).max() < 1e-3


def test_pedestrians_may_step_sideways_and_turn_on_the_spot():
    t = np.arange(50) * 0.1
    x, y = 1.2 * t, 0.4 * np.sin(2 * t)
    agent = agent_from(t, x, y, np.full(50, 1.5), np.full(50, 0.3), category="pedestrian", size_m=(0.6, 0.6, 1.8))
    result, metrics, _ = followed(agent)
    assert result.model == "point"
    assert metrics["cross_track_max_m"] < 0.03
    assert np.hypot(result.x_m - np.interp(result.t_s, t, x), result.y_m - np.interp(result.t_s, t, y)).max() < 0.05


def test_agents_that_enter_late_start_at_their_own_pose_and_speed():
    early, late = MANEUVERS["straight"](), MANEUVERS["lane change"]()
    w = late.waypoints
    late = changed(late, id="late", waypoints=changed(w, t_s=w.t_s + 3.27, y_m=w.y_m + 50))
    result = replay(scenario_of(early, late)).agent("late")
    assert 3.27 <= result.t_s[0] < 3.33
    assert result.speed_mps[0] == pytest.approx(15.0, abs=0.05)
    first = np.interp(result.t_s[0], w.t_s + 3.27, w.x_m)
    assert result.x_m[0] == pytest.approx(first, abs=0.02)


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


def test_a_gap_of_a_minute_is_crossed():
    agent = driven(lambda t: np.full_like(t, 10.0), np.zeros_like, 62.0, rate_hz=5.0)
    w = agent.waypoints
    keep = (w.t_s < 1.0) | (w.t_s > 61.0)
    columns = {k: v[keep] for k, v in vars(w).items() if v is not None}
    _, metrics, _ = followed(changed(agent, waypoints=type(w)(**columns)), dt_s=0.05)
    assert metrics["cross_track_max_m"] < 0.01
    assert metrics["along_track_rms_m"] < 0.05


def test_map_offsets_of_a_thousand_kilometers_change_nothing():
    agent = MANEUVERS["turn of radius 8 m"]()
    w = agent.waypoints
    far = changed(agent, waypoints=changed(w, x_m=w.x_m + 5e6, y_m=w.y_m - 3e6))
    near, away = followed(agent)[0], followed(far)[0]
    np.testing.assert_allclose(away.x_m - 5e6, near.x_m, atol=1e-5)
    np.testing.assert_allclose(away.y_m + 3e6, near.y_m, atol=1e-5)


def closed_loop(x, y, yaw, speed, reference_speed, duration_s, dt_s=0.01):
    """States (N, 4) of a car that starts off a reference which goes straight along x from 0."""
    state = VehicleState(*(np.array([v], float) for v in (x, y, yaw, speed, 0, 0, 0, 0)))
    memory, out = ControllerMemory.fresh(1), []
    for k in range(round(duration_s / dt_s)):
        stands = float(reference_speed == 0)
        row = np.array([[reference_speed * k * dt_s], [0], [0], [reference_speed], [0], [0], [1], [stands]], float)
        controls, memory = follow_vehicles(row, state, memory, CAR, dt_s)
        state = step_bicycle(state, controls, CAR, dt_s)
        out.append(
            [state.x_m[0] - reference_speed * (k + 1) * dt_s, state.y_m[0], state.yaw_rad[0], state.speed_mps[0]]
        )
    return np.array(out)


@pytest.mark.matrix
@pytest.mark.parametrize("speed", [1.0, 5.0, 15.0, 40.0, 60.0])
@pytest.mark.parametrize("dt_s", [0.01, 0.1])
def test_being_off_the_path_dies_out_at_any_speed(speed, dt_s):
    states = closed_loop(0.0, 1.0, 0.0, speed, speed, 20.0, dt_s)
    assert np.abs(states[-1, 1]) < 0.02
    assert states[:, 1].min() > -0.25  # hardly an overshoot
    assert np.abs(states[:, 1]).max() <= 1.001


def test_being_late_or_slow_is_made_up_for():
    late, slow = closed_loop(-3.0, 0.0, 0.0, 10.0, 10.0, 20.0), closed_loop(0.0, 0.0, 0.0, 7.0, 10.0, 20.0)
    for states in (late, slow):
        assert np.abs(states[-1, 0]) < 0.05
        assert states[-1, 3] == pytest.approx(10.0, abs=0.05)
        assert states[:, 0].max() < 0.6


def controls_at(*, x=0.0, y=0.0, yaw=0.0, speed=10.0, row=(0, 0, 0, 10, 0, 0, 1, 0), dt_s=0.01):
    """Controls and memory of a car that has just begun to follow one row of a table."""
    state = replace_columns(VehicleState, x_m=x, y_m=y, yaw_rad=yaw, speed_mps=speed)
    return follow_vehicles(np.array(row, float)[:, None], state, ControllerMemory.fresh(1), CAR, dt_s)


def replace_columns(kind, **values):
    return kind(*(np.array([values.get(f.name, 0.0)]) for f in fields(kind)))


def test_late_in_a_curve_the_wheels_stay_turned_as_the_curve_is():
    radius, late = 20.0, 1.5
    angle = -late / radius
    controls, _ = controls_at(
        x=radius * np.sin(angle), y=radius * (1 - np.cos(angle)), yaw=angle, row=(0, 0, 0, 10, 0, 1 / radius, 1, 0)
    )
    # What is left is the third order of the angle, not the 5.6 cm by which the tangent misses the arc.
    assert np.tan(controls.steer_rad[0]) / CAR.wheelbase_m[0] == pytest.approx(1 / radius, rel=0.01)


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


def test_a_vehicle_that_stands_where_it_should_stays_and_one_that_stopped_short_drives_up():
    assert np.all(closed_loop(-0.05, 0.0, 0.0, 0.0, 0.0, 5.0)[:, 0] == -0.05)
    assert -0.11 < closed_loop(-0.5, 0.0, 0.0, 0.0, 0.0, 10.0)[-1, 0] < 0.11


def test_a_pedestrian_off_the_path_comes_back():
    state = PointState(*(np.array([v]) for v in (1.0, -0.5, 0.0, 0.0)))
    row = np.zeros((8, 1))
    for _ in range(300):
        state = step_point(state, follow_points(row, state), 0.01)
    assert np.hypot(state.x_m[0], state.y_m[0]) < 0.01
