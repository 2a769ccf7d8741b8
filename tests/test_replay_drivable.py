"""The nearest drivable course: drivable courses stay as they are, impossible ones become drivable."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import MANEUVERS, agent_from, driven, ramp

from log2sim.datatypes import Trajectory
from log2sim.simulation.feasible_trajectory import FeasibilityLimits, _cost, _normal_equations, residual_terms
from log2sim.simulation.reference import feasible_trajectory_of, vehicle_reference

LIMITS = FeasibilityLimits(offset_m=1.3, max_curvature_1pm=0.27, max_curvature_rate_1pmps=0.37, max_accel_mps2=10.0)


def rolling_error(course):
    """How far each knot is from where a rear axle that rolls from the knot before would be, by small steps."""
    h = np.diff(course.t_s)
    parts = 200
    f = (np.arange(parts) + 0.5) / parts
    speed = course.speed_mps[:-1, None] + np.diff(course.speed_mps)[:, None] * f
    curvature = course.curvature_1pm[:-1, None] + np.diff(course.curvature_1pm)[:, None] * f
    step = h[:, None] / parts
    yaw = course.yaw_rad[:-1, None] + np.cumsum(speed * curvature * step, axis=1) - speed * curvature * step / 2
    x = course.x_m[:-1] + np.sum(speed * np.cos(yaw) * step, axis=1)
    y = course.y_m[:-1] + np.sum(speed * np.sin(yaw) * step, axis=1)
    return np.hypot(x - course.x_m[1:], y - course.y_m[1:])


def test_noise_in_position_and_heading_gives_a_course_that_rolls():
    rng = np.random.default_rng(3)
    agent = MANEUVERS["turn of radius 8 m"]()
    w = agent.waypoints
    noisy = agent_from(
        w.t_s,
        w.x_m + rng.normal(0, 0.1, len(w)),
        w.y_m + rng.normal(0, 0.1, len(w)),
        w.yaw_rad + rng.normal(0, 0.15, len(w)),
        w.speed_mps,
    )
    course, _ = feasible_trajectory_of(Trajectory.through(noisy.waypoints, 1.3), LIMITS)
    x = course.x_m + 1.3 * np.cos(course.yaw_rad) - (w.x_m - noisy.waypoints.x_m[0])[: len(course.t_s)]
    y = course.y_m + 1.3 * np.sin(course.yaw_rad) - (w.y_m - noisy.waypoints.y_m[0])[: len(course.t_s)]
    rms = np.sqrt(np.mean(x**2 + y**2))
    assert rolling_error(course).max() < 0.01
    assert rms < 0.1  # the noise is 0.14


def test_a_bend_taken_faster_than_tires_hold_is_widened_and_flagged():
    agent = driven(lambda t: np.full_like(t, 20.0), lambda s: ramp(s, (20, 0), (40, 0.04), (60, 0.04), (80, 0)), 6.0)
    path = Trajectory.through(agent.waypoints, 1.3)
    course, _ = feasible_trajectory_of(path, LIMITS)
    assert np.abs(course.speed_mps**2 * course.curvature_1pm).max() < 1.05 * LIMITS.max_lateral_mps2  # 16 in the log
    reference = vehicle_reference(path, LIMITS, accel_ahead_s=0.1, curvature_ahead_s=0.1)
    assert any("distance from what can be driven" in flag for flag in reference.flags)


@pytest.mark.parametrize("turned", [[0], [5], [20, 21, 22]])
def test_boxes_turned_back_to_front_are_outvoted(turned):
    agent = MANEUVERS["lane change"]()
    w = agent.waypoints
    yaw, speed = w.yaw_rad.copy(), w.speed_mps.copy()
    yaw[turned] += np.pi
    speed[turned] *= -1
    right, _ = feasible_trajectory_of(Trajectory.through(agent.waypoints, 1.3), LIMITS)
    course, _ = feasible_trajectory_of(
        Trajectory.through(agent_from(w.t_s, w.x_m, w.y_m, yaw, speed).waypoints, 1.3), LIMITS
    )
    np.testing.assert_allclose(course.yaw_rad, right.yaw_rad, atol=0.04)
    np.testing.assert_allclose(course.speed_mps, right.speed_mps, atol=0.1)


def test_shifting_and_turning_the_log_shifts_and_turns_the_course():
    agent = MANEUVERS["reversing"]()
    w = agent.waypoints
    turn, (east, north) = 2.5, (3e6, -2e6)
    x = east + np.cos(turn) * w.x_m - np.sin(turn) * w.y_m
    y = north + np.sin(turn) * w.x_m + np.cos(turn) * w.y_m
    one, _ = feasible_trajectory_of(Trajectory.through(agent.waypoints, 1.3), LIMITS)
    other, _ = feasible_trajectory_of(
        Trajectory.through(agent_from(w.t_s, x, y, w.yaw_rad + turn, w.speed_mps).waypoints, 1.3), LIMITS
    )
    np.testing.assert_allclose(other.x_m, np.cos(turn) * one.x_m - np.sin(turn) * one.y_m, atol=1e-4)
    np.testing.assert_allclose(other.curvature_1pm, one.curvature_1pm, atol=1e-3)


def test_band_and_gradient_are_those_of_the_residuals_derivatives_and_of_the_cost():
    rng = np.random.default_rng(0)
    state = rng.normal(0, 0.1, (4, 6)) + np.array([0, 0, 0, 3.0, 0, 0.1])
    state[:, 2] /= 1e5  # the derivatives leave out how turning shortens the chord
    told = rng.normal(0, 0.1, (4, 4)) + np.array([0, 0, 0, 3.0]), 0.1, LIMITS
    terms = residual_terms(state, *told)
    slopes, costs = np.zeros((sum(len(t.residual) for t in terms), 24)), np.zeros(24)
    for k in range(24):
        step = 1e-6 * np.eye(24)[k].reshape(4, 6)
        up, down = (residual_terms(state + s, *told) for s in (step, -step))
        slopes[:, k] = np.concatenate([a.residual - b.residual for a, b in zip(up, down)]) / 2e-6
        costs[k] = (_cost(up) - _cost(down)) / 2e-6
    weight = np.concatenate([1 / np.sqrt(1 + t.residual**2) if t.robust else np.ones(len(t.residual)) for t in terms])
    expected = slopes.T @ (weight[:, None] * slopes)
    band, gradient = _normal_equations(terms, 4)
    np.testing.assert_allclose(gradient.ravel(), costs, rtol=1e-3, atol=1e-3 * np.abs(costs).max())
    for column, lower in enumerate(band.reshape(24, 12)):
        below = expected[column : column + 12, column]
        np.testing.assert_allclose(lower[: len(below)], below, rtol=1e-6, atol=1.0)
