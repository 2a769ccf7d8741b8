"""Errors of a replay and collisions, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest
from replay_maneuvers import agent_from

from log2sim.datatypes import Trajectory
from log2sim.simulation.metrics.all_metrics import tracking_errors
from log2sim.simulation.metrics.collisions import SCENARIO_MARGIN_M, SCENARIO_WINDOW_S, BoxTracks, collisions

T_S = np.arange(0, 41) * 0.1


def circle(radius_m, speed):
    angle = speed * T_S / radius_m
    return agent_from(
        T_S, radius_m * np.sin(angle), radius_m * (1 - np.cos(angle)), angle, np.full(41, speed), offset_m=0
    )


@pytest.mark.parametrize("outward_m", [-0.4, 0.0, 0.7])
@pytest.mark.parametrize("late_s", [0.0, 0.32])
@pytest.mark.parametrize(("radius", "speed", "limit"), [(20.0, 6.0, 2e-3), (8.0, 12.0, 7e-3)])
def test_on_a_circle_the_error_across_is_the_difference_of_radii_however_late(outward_m, late_s, radius, speed, limit):
    path = Trajectory.through(circle(radius, speed).waypoints, 0.0)
    t = np.linspace(1.2, 2.8, 33)
    angle = speed * (t - late_s) / radius
    r = radius + outward_m
    across, _ = tracking_errors(path, t, r * np.sin(angle), radius - r * np.cos(angle))
    np.testing.assert_allclose(across, -outward_m, atol=limit)  # a left turn: outward is right; chords of 50 ms


def test_the_error_across_does_not_depend_on_the_logged_heading_of_what_moves():
    agent = agent_from(T_S, 5 * T_S, 0 * T_S, np.full(41, 0.6), np.full(41, 5.0))
    across, _ = tracking_errors(
        Trajectory.through(agent.waypoints, 0.0), np.array([2.0]), np.array([10.0]), np.array([0.5])
    )
    assert across[0] == pytest.approx(0.5, abs=1e-3)


def boxes(*tracks, z=None, size=(4.0, 2.0, 1.5)):
    """Boxes from tracks (S,) of x on one line each: y, then x."""
    x = np.array([t[1] for t in tracks], float).T
    y = np.tile(np.array([t[0] for t in tracks], float), (len(x), 1))
    zero = np.zeros_like(x)
    return BoxTracks(x, y, zero if z is None else zero + np.array(z), zero, zero + 5.0, np.tile(size, (len(tracks), 1)))


def one_contact(log_x, log_y=0.0):
    """A replayed contact at 2 s of boxes at y = 0; the log has the second box at `log_x` (S,), `log_y`."""
    t = np.arange(0, 81) * 0.05
    hit = np.where(np.abs(t - 2.0) < 0.01, 3.0, 10.0)
    events = collisions(
        boxes((0, 0 * t), (0, hit)), boxes((0, 0 * t), (log_y, log_x(t))), np.array([True, True]), t, ["a", "b"]
    )
    assert len(events) == 1
    return events[0]


def test_a_collision_is_new_unless_the_log_has_it_near_in_time_and_place():
    inside, outside = SCENARIO_WINDOW_S - 0.1, SCENARIO_WINDOW_S + 0.1

    def at(moment, gap=-1.0):
        return lambda t: np.where(np.abs(t - moment) < 0.01, 4.0 + gap, 10.0)

    assert one_contact(at(2.0 + inside))["in_log"]
    assert one_contact(at(2.0 - inside))["in_log"]
    assert not one_contact(at(2.0 + outside))["in_log"]
    assert not one_contact(at(2.0 - outside))["in_log"]
    assert one_contact(at(2.0, SCENARIO_MARGIN_M * 0.9))["in_log"]
    assert not one_contact(at(2.0, SCENARIO_MARGIN_M * 1.1))["in_log"]
