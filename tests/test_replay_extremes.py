"""Followers at the limits: each case against a closed form, the same case elsewhere, or what physics allows."""

from __future__ import annotations

from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import OFFSET_M, agent_from, driven, ramp, scenario_of

from log2sim.errors import ScenarioError
from log2sim.geometry import wrap_angle
from log2sim.simulation.feasible_trajectory import LOCK_SHARE
from log2sim.simulation.follower import ControllerMemory, follow_vehicles
from log2sim.simulation.runner import replay
from log2sim.simulation.vehicles.parameters import parameters_for
from log2sim.simulation.vehicles.vehicle import VehicleState, step_bicycle

STEPS_S = [0.001, 0.01, 0.1, 1.0]
LONG_STEPS_S = [0.01, 0.1, 0.25, 1.0]  # for lives too long for steps of 1 ms in a quick test
CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])
# Largest errors across and along in m.
LIMITS_M = {"kinematic": (0.1, 0.05), "dynamic": (0.1, 0.1)}
LOCK_1PM = float(np.tan(CAR.max_steer_rad[0]) / CAR.wheelbase_m[0])


def followed(agent, **options):
    result = replay(scenario_of(agent), **options)
    return result.agents[0]


def on_circle(speed, radius, duration_s, *, begin_s=0.0, rate_hz=10.0):
    """A car whose rear axle drives a circle, to the left about (0, radius); negative speeds reverse."""
    t = np.arange(round(duration_s * rate_hz) + 1) / rate_hz
    yaw = speed * t / radius
    x = radius * np.sin(yaw) + OFFSET_M * np.cos(yaw)
    y = radius * (1 - np.cos(yaw)) + OFFSET_M * np.sin(yaw)
    return agent_from(begin_s + t, x, y, yaw, np.full(len(t), float(speed)))


def off_circle(states, speed, radius, begin_s=0.0):
    """How far the rear axle is from the circle, outside positive, and how far it is behind on it; both (S,)."""
    x = states.x_m - OFFSET_M * np.cos(states.yaw_rad)
    y = states.y_m - OFFSET_M * np.sin(states.yaw_rad) - radius
    angle = np.arctan2(x, -y)
    late = wrap_angle(speed * (states.t_s - begin_s) / radius - angle) * radius
    return np.hypot(x, y) - radius, late


def shifted(agent, *, x=0.0, y=0.0, t=0.0):
    w = agent.waypoints
    return changed(agent, waypoints=changed(w, x_m=w.x_m + x, y_m=w.y_m + y, t_s=w.t_s + t))


# Speeds.


@pytest.mark.parametrize("dt_s", STEPS_S)
def test_a_vehicle_that_stands_does_not_move_at_all(dt_s):
    t = np.arange(51) * 0.1
    r = followed(agent_from(t, 0 * t + 3.0, 0 * t - 2.0, 0 * t + 2.5, 0 * t), dt_s=dt_s)
    np.testing.assert_allclose(r.x_m, 3.0, atol=1e-6)
    np.testing.assert_allclose(r.y_m, -2.0, atol=1e-6)
    np.testing.assert_allclose(r.yaw_rad, 2.5, atol=1e-6)
    assert np.all(r.speed_mps == 0)


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
def test_a_stop_stays_a_stop_without_creeping_or_turning_the_wheels_back_and_forth(dt_s):
    agent = driven(lambda t: ramp(t, (0, 8), (4, 0), (30, 0)), lambda s: np.full_like(s, 0.08), 30.0)
    r = followed(agent, dt_s=dt_s)
    late = r.t_s >= 6.0
    assert np.hypot(r.x_m[late] - agent.waypoints.x_m[-1], r.y_m[late] - agent.waypoints.y_m[-1]).max() < 0.12
    assert np.all(r.speed_mps[late] == 0)
    assert np.ptp(r.x_m[late]) == np.ptp(r.y_m[late]) == np.ptp(r.yaw_rad[late]) == 0
    assert np.ptp(r.steer_rad[r.t_s >= 10.0]) < 1e-3


@pytest.mark.matrix
@pytest.mark.parametrize("noise_m", [0.03, 0.1])
@pytest.mark.parametrize("seed", range(3))
def test_a_vehicle_that_stands_does_not_creep_after_its_jittering_box(noise_m, seed):
    rng, t = np.random.default_rng(seed), np.arange(200) * 0.1
    x, y = rng.normal(0, noise_m, (2, 200))
    r = followed(agent_from(t, x, y, 2.0 + rng.normal(0, 0.05, 200), 0 * t))
    assert max(np.ptp(r.x_m), np.ptp(r.y_m)) < 1e-5
    assert np.hypot(r.x_m[0], r.y_m[0]) < 2 * noise_m


def test_a_short_but_fast_run_backward_is_driven_backward():
    agent = driven(lambda t: ramp(t, (0, 4), (2, 0), (2.2, 0), (2.6, -1.2)), np.zeros_like, 2.6)
    r = followed(agent)
    assert r.speed_mps[-1] == pytest.approx(-1.2, abs=0.35)
    assert r.x_m.max() - r.x_m[-1] > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", STEPS_S)
def test_60_mps_straight_on(dt_s):
    t = np.arange(51) * 0.1
    r = followed(agent_from(t, 60 * t, 0 * t, 0 * t, 0 * t + 60.0), dt_s=dt_s)
    np.testing.assert_allclose(r.x_m, 60 * r.t_s, atol=1e-3)
    np.testing.assert_allclose(r.y_m, 0.0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
@pytest.mark.parametrize("model", LIMITS_M)
def test_60_mps_in_a_wide_curve(dt_s, model):
    states = followed(on_circle(60.0, 600.0, 20.0), dt_s=dt_s, model=model)  # 6 m/s2 sideways, two thirds of the grip
    outside, late = off_circle(states, 60.0, 600.0)
    assert np.abs(outside).max() < LIMITS_M[model][0]
    assert np.abs(late).max() < LIMITS_M[model][1]
    end = states.t_s > 10.0
    assert np.abs(outside[end]).max() < 0.1
    assert np.abs(late[end]).max() < 0.05


# Directions and limits.


@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
def test_reversing_on_a_circle(dt_s):
    outside, late = off_circle(followed(on_circle(-3.0, 12.0, 15.0), dt_s=dt_s), -3.0, 12.0)
    assert np.abs(outside).max() < 0.05
    assert np.abs(late).max() < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", STEPS_S)
def test_full_lock_drives_its_circle(dt_s):
    radius = 1 / (LOCK_SHARE * LOCK_1PM)
    outside, late = off_circle(followed(on_circle(3.0, radius, 8.0), dt_s=dt_s), 3.0, radius)
    assert np.abs(outside).max() < 0.05
    assert np.abs(late).max() < 0.05


def test_beyond_full_lock_the_wheels_stay_at_it_and_the_log_is_flagged():
    agent = on_circle(3.0, 0.6 / LOCK_1PM, 10.0)
    r = followed(agent)
    assert np.abs(r.steer_rad).max() <= CAR.max_steer_rad[0] + 1e-6
    turned, pace = np.abs(np.diff(np.unwrap(r.yaw_rad))) / 0.05, np.abs(r.speed_mps[1:] + r.speed_mps[:-1]) / 2
    assert np.all(turned <= 1.01 * LOCK_1PM * pace + 1e-3)
    assert np.all(turned * pace <= 10)  # nor does it get sideways what a tire cannot give
    assert any("can be driven" in flag for flag in r.flags)


# Saturation, on a reference that no log could hide.


def chase(behind_m, speed, reference_speed, duration_s, dt_s, change=lambda c: c):
    """Columns behind_m, speed and pedal (N,) of a car that runs after a reference on a straight line."""
    state = VehicleState(
        *(np.array([v], float) for v in (-behind_m, 0, 0, speed, *[0] * (len(vars_of(VehicleState)) - 4)))
    )
    memory, out = ControllerMemory.fresh(1), []
    for k in range(round(duration_s / dt_s)):
        row = np.array([[reference_speed * k * dt_s], [0], [0], [reference_speed], [0], [0], [1], [0]], float)
        controls, memory = follow_vehicles(row, state, memory, CAR, dt_s)
        state = step_bicycle(state, controls, CAR, dt_s)
        out.append([reference_speed * (k + 1) * dt_s - state.x_m[0], state.speed_mps[0], state.pedal_mps2[0]])
    return np.array(out).T


def vars_of(kind):
    return kind.__dataclass_fields__


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", [0.005, 0.1])
def test_at_full_throttle_the_controller_does_not_wind_up(dt_s):
    behind, speed, pedal = chase(40.0, 10.0, 10.0, 25.0, dt_s)
    assert pedal.max() > 0.9 * CAR.max_throttle_mps2[0]
    assert speed.max() < 10.0 + 3.0
    assert behind.min() > -0.3
    assert np.abs(behind[-1]) < 0.1
    assert np.abs(speed[-1] - 10.0) < 0.05


@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
def test_a_log_that_accelerates_harder_than_the_car_is_followed_at_full_throttle(dt_s):
    agent = driven(lambda t: ramp(t, (0, 0), (1, 0), (3.5, 20), (16, 20)), np.zeros_like, 16.0)
    r = followed(agent, dt_s=dt_s)
    w = agent.waypoints
    ahead = r.x_m - np.interp(r.t_s, w.t_s, w.x_m)
    assert np.abs(ahead[r.t_s <= 0.8]).max(initial=0.0) < 0.02  # it stands until then
    # At 6 m/s2 where the log has 8, the car is last of all 20 (20 / 6 - 20 / 8) / 2 = 8.3 m late, and then catches up.
    late_s = 0.2  # of the pedal, and of the controls that are held for up to 0.1 s
    assert -8.3 - 20 * late_s < ahead.min() < -8.3 + 0.5
    assert np.abs(np.diff(r.speed_mps)).max() <= CAR.max_throttle_mps2[0] * np.diff(r.t_s).max() + 1e-5
    assert np.abs(ahead[-1]) < 0.1
    assert ahead.max() < 0.5


# Times.


def without(agent, gone):
    return changed(agent, waypoints=agent.waypoints.take(~gone))


@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
def test_a_gap_of_ten_seconds_is_crossed_at_the_speed_on_its_sides(dt_s):
    t = np.arange(161) * 0.1
    agent = agent_from(t, 12 * t, 0 * t, 0 * t, 0 * t + 12.0)
    r = followed(without(agent, (t > 3.0) & (t < 13.0)), dt_s=dt_s)
    np.testing.assert_allclose(r.x_m, 12 * r.t_s, atol=0.01)
    np.testing.assert_allclose(r.y_m, 0.0, atol=1e-6)


def test_a_gap_of_ten_seconds_in_a_turn_is_crossed_by_one_arc():
    agent = on_circle(5.0, 100.0, 16.0)
    t = agent.waypoints.t_s
    outside, late = off_circle(followed(without(agent, (t > 3.0) & (t < 13.0))), 5.0, 100.0)
    assert np.abs(outside).max() < 0.1  # a cubic over half a radian errs by R * 0.5^4 / 384 = 2 cm
    assert np.abs(late).max() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", [0.001, 0.01, 0.1])
def test_waypoints_a_microsecond_apart_change_nothing(dt_s):
    plain = on_circle(8.0, 30.0, 3.5)
    w = plain.waypoints
    twice = np.concatenate([w.t_s, w.t_s[20:23] + 1e-6])
    order = np.argsort(twice, kind="stable")
    k = np.concatenate([np.arange(len(w)), [20, 21, 22]])[order]
    doubled = changed(plain, waypoints=changed(w.take(k), t_s=twice[order]))
    one, other = followed(plain, dt_s=dt_s), followed(doubled, dt_s=dt_s)
    np.testing.assert_allclose(other.x_m, one.x_m, atol=0.01)
    np.testing.assert_allclose(other.y_m, one.y_m, atol=0.01)


@pytest.mark.parametrize("same_pose", [True, False])
def test_duplicate_times_are_refused_by_agent_and_index(same_pose):
    agent = on_circle(8.0, 30.0, 2.0)
    w = agent.waypoints
    t = w.t_s.copy()
    t[7] = t[6]
    x = w.x_m.copy()
    if same_pose:
        x[7] = x[6]
    with pytest.raises(ScenarioError, match=r"agent 'a': waypoints.t_s does not increase at index 7"):
        followed(changed(agent, waypoints=changed(w, t_s=t, x_m=x)))


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", STEPS_S)
@pytest.mark.parametrize("category", ["car", "pedestrian"])
def test_a_teleport_is_flagged_and_not_chased(dt_s, category):
    t = np.arange(61) * 0.1
    after = t >= 3.0
    x, y = np.where(after, 80.0, 4 * t), np.where(after, 30.0 + 4 * (t - 3.0), 0.0)
    agent = agent_from(t, x, y, np.where(after, np.pi / 2, 0.0), 0 * t + 4.0, category=category)
    r = followed(agent, dt_s=dt_s)
    assert any("discontinuous at 3.00 s" in flag for flag in r.flags)
    before = r.t_s < 3.0 - 1e-6
    np.testing.assert_allclose(r.y_m[before], 0.0, atol=1e-6)
    np.testing.assert_allclose(r.x_m[before], 4 * r.t_s[before], atol=0.05)
    later = r.t_s >= 3.05
    np.testing.assert_allclose(r.x_m[later], 80.0, atol=0.05)
    np.testing.assert_allclose(r.y_m[later], 30.0 + 4 * (r.t_s[later] - 3.0), atol=0.05)


@pytest.mark.parametrize("dt_s", STEPS_S)
def test_a_single_waypoint_is_a_state_and_not_a_way(dt_s):
    alone = agent_from([0.7], [3.0], [4.0], [0.5], [9.0])
    r = replay(scenario_of(alone, changed(on_circle(5.0, 50.0, 3.0), id="b")), dt_s=dt_s).agent("a")
    assert (r.t_s.tolist(), r.x_m.tolist(), r.y_m.tolist(), r.yaw_rad.tolist()) == ([0.7], [3.0], [4.0], [0.5])


# Invariances.


@pytest.mark.slow
@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
@pytest.mark.parametrize("model", LIMITS_M)
def test_three_rounds_through_plus_and_minus_pi(dt_s, model):
    states = followed(on_circle(10.0, 15.0, 30.0, rate_hz=4.0), dt_s=dt_s, model=model)
    outside, late = off_circle(states, 10.0, 15.0)
    assert np.abs(outside).max() < LIMITS_M[model][0]
    assert np.abs(late).max() < LIMITS_M[model][1]
    assert np.all((states.yaw_rad >= -np.pi) & (states.yaw_rad < np.pi))


def test_between_waypoints_the_logged_heading_goes_the_short_way_through_pi():
    states = followed(on_circle(10.0, 15.0, 30.0, rate_hz=4.0), mode="exact")
    np.testing.assert_allclose(wrap_angle(states.yaw_rad - 10.0 * states.t_s / 15.0), 0.0, atol=1e-5)


def test_headings_that_flicker_about_pi_are_one_heading():
    rng, t = np.random.default_rng(4), np.arange(101) * 0.1
    noise = rng.normal(0, 0.03, 101)
    x, y = 10 * t, rng.normal(0, 0.02, 101)
    east, west = agent_from(t, x, y, noise, 0 * t + 10), agent_from(t, -x, -y, np.pi + noise, 0 * t + 10)
    one, other = followed(east), followed(west)
    assert (np.diff(np.sign(west.waypoints.yaw_rad)) != 0).sum() > 20
    np.testing.assert_allclose(other.x_m, -one.x_m, atol=1e-4)
    np.testing.assert_allclose(other.y_m, -one.y_m, atol=1e-4)


@pytest.fixture
def _exact_numbers(monkeypatch):
    """States as they are, not rounded for the file."""
    monkeypatch.setattr("log2sim.simulation.runner.STATE_DIGITS", 12)


@pytest.mark.usefixtures("_exact_numbers")
@pytest.mark.parametrize("category", ["car", "pedestrian"])
def test_ten_thousand_kilometers_away_everything_is_the_same(category):
    agent = changed(on_circle(6.0, 20.0, 12.0), category=category)
    # Multiples of 2^-20 m, which a double still holds exactly at 1e7 m.
    w = agent.waypoints
    x, y = (np.round(c * 2**20) / 2**20 for c in (w.x_m, w.y_m))
    agent = changed(agent, waypoints=changed(w, x_m=x, y_m=y))
    near, far = followed(agent), followed(shifted(agent, x=1e7, y=-1e7))
    np.testing.assert_allclose(far.x_m - 1e7, near.x_m, atol=1e-6, rtol=0)
    np.testing.assert_allclose(far.y_m + 1e7, near.y_m, atol=1e-6, rtol=0)
    np.testing.assert_allclose(far.yaw_rad, near.yaw_rad, atol=1e-6)


@pytest.mark.parametrize("category", ["car", "pedestrian"])
def test_stamps_of_a_billion_seconds_are_as_good_as_any(category):
    agent = changed(on_circle(6.0, 20.0, 12.0), category=category)
    early, late = followed(agent), followed(shifted(agent, t=1e9))
    assert len(late) == len(early)
    np.testing.assert_allclose(late.t_s - 1e9, early.t_s, atol=3e-7)
    # A double near 1e9 s steps by 1.2e-7 s: 0.7 micrometers at 6 m/s, times what the tables make of it.
    np.testing.assert_allclose(late.x_m, early.x_m, atol=1e-5)
    np.testing.assert_allclose(late.y_m, early.y_m, atol=1e-5)


# Long lives.


@pytest.mark.slow
def test_after_half_an_hour_a_vehicle_is_as_near_as_in_the_first_minute():
    states = followed(on_circle(10.0, 40.0, 2000.0), dt_s=0.1)
    outside, late = off_circle(states, 10.0, 40.0)
    early, end = states.t_s < 60.0, states.t_s > 1940.0
    for error in (outside, late):
        assert np.abs(error).max() < 0.03
        assert np.abs(error[end]).max() < np.abs(error[early]).max() + 1e-3


@pytest.mark.slow
@pytest.mark.parametrize("window_s", [0.7, 7.0, 1e3])
@pytest.mark.parametrize("category", ["car", "pedestrian"])
def test_windows_of_any_length_give_the_same_states(window_s, category, monkeypatch):
    agent = driven(lambda t: 8 + 4 * np.sin(0.7 * t), lambda s: 0.04 * np.sin(s / 20), 30.0)
    scene = scenario_of(changed(agent, category=category), shifted(changed(agent, id="late"), t=3.3))
    one = replay(scene, dt_s=0.02)
    monkeypatch.setattr("log2sim.simulation.rollout.WINDOW_S", window_s)
    other = replay(scene, dt_s=0.02)
    for a, b in zip(one.agents, other.agents):
        assert a.id == b.id
        for key in a.COLUMNS:
            np.testing.assert_array_equal(getattr(b, key), getattr(a, key))
