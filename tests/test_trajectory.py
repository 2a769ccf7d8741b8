"""Trajectories against closed forms and their invariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.agents.candidate import Timeline
from log2sim.agents.estimate import with_observers
from log2sim.datatypes import Agent, Scenario, Trajectory, Waypoints
from log2sim.edit.apply import edit
from log2sim.edit.edits import Shift, Speed
from log2sim.geometry import Array, wrap_angle
from log2sim.logs.opening import open_log
from log2sim.tracking.forward import MAX_MISSES

finite = st.floats(-50.0, 50.0)


def waypoints(t_s: Array, x: Array, y: Array, yaw: Array, speed: Array) -> Waypoints:
    t, x, y, yaw, speed = (np.asarray(c, dtype=np.float64) + np.zeros(len(t_s)) for c in (t_s, x, y, yaw, speed))
    return Waypoints(t, x, y, 0.1 * t, yaw, speed, np.ones(len(t), bool), np.zeros(len(t)))


@st.composite
def rides(draw: st.DrawFn) -> Waypoints:
    """Waypoints of a smooth ride: an arc with constant acceleration, at irregular times."""
    count = draw(st.integers(2, 12))
    steps = draw(st.lists(st.floats(0.05, 0.5), min_size=count - 1, max_size=count - 1))
    t = np.concatenate([[0.0], np.cumsum(steps)]) + draw(st.floats(-5.0, 5.0))
    since = t - t[0]
    speed0, accel, curvature = draw(st.floats(0.0, 20.0)), draw(st.floats(0.0, 2.0)), draw(st.floats(-0.05, 0.05))
    yaw0 = draw(st.floats(-np.pi, np.pi))
    fine = np.linspace(0.0, since[-1], 4001)
    way = speed0 * fine + accel * fine**2 / 2
    yaw = yaw0 + curvature * way
    vx, vy = (speed0 + accel * fine) * np.cos(yaw), (speed0 + accel * fine) * np.sin(yaw)
    x = np.concatenate([[0.0], np.cumsum((vx[1:] + vx[:-1]) / 2 * np.diff(fine))]) + draw(finite)
    y = np.concatenate([[0.0], np.cumsum((vy[1:] + vy[:-1]) / 2 * np.diff(fine))]) + draw(finite)
    at = (np.interp(since, fine, c) for c in (x, y, yaw, speed0 + accel * fine))
    return waypoints(t, *at)


def between(w: Waypoints, count: int = 101) -> Array:
    return np.linspace(w.t_s[0], w.t_s[-1], count)


@given(rides())
@settings(max_examples=60, deadline=None)
def test_at_a_waypoint_the_state_is_the_waypoint(w: Waypoints) -> None:
    states = Trajectory.through(w).at(w.t_s)
    for key in ("x_m", "y_m", "z_m", "speed_mps"):
        np.testing.assert_allclose(getattr(states, key), getattr(w, key), atol=1e-9)
    np.testing.assert_allclose(wrap_angle(states.yaw_rad - w.yaw_rad), 0.0, atol=1e-9)


@given(rides(), finite, finite, st.floats(-np.pi, np.pi))
@settings(max_examples=60, deadline=None)
def test_a_rigid_motion_of_the_map_moves_all_states_alike(w: Waypoints, dx: float, dy: float, turn: float) -> None:
    cos, sin = np.cos(turn), np.sin(turn)
    moved = waypoints(
        w.t_s, dx + cos * w.x_m - sin * w.y_m, dy + sin * w.x_m + cos * w.y_m, w.yaw_rad + turn, w.speed_mps
    )
    a, b = (Trajectory.through(v, 1.3).at(between(w)) for v in (w, moved))
    np.testing.assert_allclose(b.x_m, dx + cos * a.x_m - sin * a.y_m, atol=1e-6)
    np.testing.assert_allclose(b.y_m, dy + sin * a.x_m + cos * a.y_m, atol=1e-6)
    np.testing.assert_allclose(wrap_angle(b.yaw_rad - a.yaw_rad - turn), 0.0, atol=1e-9)


@given(st.floats(-30.0, 30.0), st.floats(-np.pi, np.pi))
@settings(max_examples=60, deadline=None)
def test_constant_velocity_is_exact(speed: float, yaw: float) -> None:
    t = np.array([0.0, 0.1, 0.35, 1.0, 1.1])
    w = waypoints(t, 3.0 + speed * np.cos(yaw) * t, -2.0 + speed * np.sin(yaw) * t, yaw, speed)
    states = Trajectory.through(w).at(between(w))
    np.testing.assert_allclose(states.x_m, 3.0 + speed * np.cos(yaw) * between(w), atol=1e-9)
    np.testing.assert_allclose(states.y_m, -2.0 + speed * np.sin(yaw) * between(w), atol=1e-9)
    np.testing.assert_allclose(states.speed_mps, speed, atol=1e-9)


def test_a_circle_is_followed_to_a_millimeter_where_chords_cut_it_by_centimeters() -> None:
    t = np.arange(0.0, 4.01, 0.25)
    rate, radius = 0.5, 10.0
    w = waypoints(
        t, radius * np.cos(rate * t), radius * np.sin(rate * t), wrap_angle(rate * t + np.pi / 2), rate * radius
    )
    states = Trajectory.through(w).at(between(w, 1001))
    assert np.abs(np.hypot(states.x_m, states.y_m) - radius).max() < 1e-3
    assert radius * (1 - np.cos(rate * 0.125)) > 0.01


def test_before_a_discontinuity_the_agent_goes_straight_on() -> None:
    t = np.arange(0.0, 2.01, 0.1)
    w = waypoints(t, 5 * t + np.where(t > 1.05, 30.0, 0.0), 0.0, 0.0, 5.0)
    trajectory = Trajectory.through(w)
    assert trajectory.discontinuity_times() == pytest.approx([1.1])
    np.testing.assert_allclose(trajectory.at(np.array([1.05, 1.0999])).x_m, [5.25, 5.4995], atol=1e-9)
    assert trajectory.at(np.array([1.1])).x_m == pytest.approx([35.5])


SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing"


def test_a_span_goes_on_over_missed_ticks_and_ends_at_longer_gaps() -> None:
    timeline = Timeline(np.arange(40, dtype=np.int64) * 100_000_000, 0)
    tick = np.array([2, 3, 3 + MAX_MISSES + 1, 3 + 2 * (MAX_MISSES + 1) + 1])
    last = (3 + MAX_MISSES + 1) / 10
    alone = float(timeline.seconds(timeline.t_ns[tick[-1:]])[0])
    measured = SimpleNamespace(tick=tick, measurements=SimpleNamespace(seen_by=np.tile([True, False], (4, 1))))
    found = with_observers(SimpleNamespace(track=measured), agent(), timeline).observed_by
    assert found == {"vehicle": (pytest.approx((0.2, last)), (alone, alone))}


def agent() -> Agent:
    t = np.arange(0.0, 4.0)
    zero = np.zeros(4)
    w = Waypoints(t, 10 * t, zero, zero, zero, np.full(4, 10.0), np.ones(4, bool), np.full(4, 0.1))
    return Agent("car-1", "car", (4.5, 1.8, 1.5), w, observed_by={"vehicle": ((1.0, 3.0),), "road": ((0.0, 2.0),)})


def test_edits_in_time_move_the_spans(tmp_path: Path) -> None:
    log = open_log(SAMPLE)
    source = Scenario("s", 0, 3.0, (agent(),), log.map, (), (), {})
    moved = edit(source, [Shift("car-1", 1.0), Speed("car-1", 2.0)]).scenario.agents[0]
    # Later by 1 s, then twice as fast from the first waypoint on, which is at 1 s.
    assert moved.observed_by == {"vehicle": ((1.5, 2.5),), "road": ((1.0, 2.0),)}
    path = tmp_path / "s.json"
    replace(source, agents=(moved,)).save(path)
    assert Scenario.load(path).agents[0].observed_by == moved.observed_by
