"""Followers at the limits: each case against a closed form, the same case elsewhere, or what physics allows."""

from __future__ import annotations

from dataclasses import replace as changed

import numpy as np
import pytest
from replay_maneuvers import OFFSET_M, agent_from, driven, ramp, scenario_of

from log2sim.simulation.runner import replay
from log2sim.simulation.vehicles.vehicle import parameters_for

LONG_STEPS_S = [0.01, 0.1, 0.25, 1.0]  # for lives too long for steps of 1 ms in a quick test
CAR = parameters_for([agent_from([0.0], [0.0], [0.0], [0.0], [0.0])])
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


def shifted(agent, *, x=0.0, y=0.0, t=0.0):
    w = agent.waypoints
    return changed(agent, waypoints=changed(w, x_m=w.x_m + x, y_m=w.y_m + y, t_s=w.t_s + t))


# Directions and limits.


def test_beyond_full_lock_the_wheels_stay_at_it_and_the_log_is_flagged():
    agent = on_circle(3.0, 0.6 / LOCK_1PM, 10.0)
    r = followed(agent)
    assert np.abs(r.steer_rad).max() <= CAR.max_steer_rad[0] + 1e-6
    turned, pace = np.abs(np.diff(np.unwrap(r.yaw_rad))) / 0.05, np.abs(r.speed_mps[1:] + r.speed_mps[:-1]) / 2
    assert np.all(turned <= 1.01 * LOCK_1PM * pace + 1e-3)
    assert np.all(turned * pace <= 10)  # nor does it get sideways what a tire cannot give
    assert any("can be driven" in flag for flag in r.flags)


# Saturation, on a reference that no log could hide.


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


@pytest.mark.parametrize("dt_s", LONG_STEPS_S)
def test_a_gap_of_ten_seconds_is_crossed_at_the_speed_on_its_sides(dt_s):
    t = np.arange(161) * 0.1
    agent = agent_from(t, 12 * t, 0 * t, 0 * t, 0 * t + 12.0)
    r = followed(changed(agent, waypoints=agent.waypoints.take((t <= 3.0) | (t >= 13.0))), dt_s=dt_s)
    np.testing.assert_allclose(r.x_m, 12 * r.t_s, atol=0.01)
    np.testing.assert_allclose(r.y_m, 0.0, atol=1e-6)


# Invariances.


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
