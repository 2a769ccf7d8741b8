"""Trajectories of synthetic agents."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.errors import ConfigError
from log2sim.synth.motion import TimedPath

TURN = [[0.0, 0.0, 5.0], [30.0, 0.0, 4.0], [30.0, 30.0, 6.0]]


def turning(**changes: object) -> TimedPath:
    return TimedPath(TURN, rounding_m=26.0, where="agent 'a'", **changes)  # type: ignore[arg-type]


def test_speed_at_each_waypoint_is_the_one_asked_for() -> None:
    trajectory = turning()
    t = np.linspace(0, 20, 20001)
    way = trajectory.at(t).distance_m
    at_turn = np.argmin(np.abs(way - trajectory.path.at_waypoint_m[1]))
    assert trajectory.at(t[at_turn]).speed_mps[0] == pytest.approx(4.0, abs=0.01)


def test_a_stop_keeps_place_and_heading_and_then_goes_on() -> None:
    trajectory = TimedPath(
        [[0.0, 0.0, 4.0], [8.0, 0.0, 0.0], [16.0, 3.0, 4.0]], rounding_m=4.0, wait_s=[(1, 2.0)], where="a"
    )
    standing = trajectory.at(np.linspace(4.0, 5.9, 11))  # nearly 8 m at a mean of 2 m/s take nearly 4 s
    assert np.all(standing.speed_mps == 0)
    assert np.ptp(standing.yaw_rad) == 0
    assert np.ptp(standing.xy_m, axis=0).max() == 0
    assert trajectory.at(7.0).speed_mps[0] > 0.1
    assert trajectory.at(3.0).speed_mps[0] > 0.1


@pytest.mark.parametrize(
    ("waypoints", "message"),
    [
        ([[0, 0, 5], [20, 0, 5], [20, 20, 5]], "bends"),
        ([[0, 0, 10], [5, 0, 0]], "m/s2"),
        ([[0, 0, 0], [5, 0, 0]], "forever"),
        ([[0, 0, 1], [0, 0, 1]], "same point"),
        ([[0, 0, 1], [9, 0, -1]], "negative"),
        ([[0, 0, 1]], "two or more"),
    ],
)
def test_impossible_waypoints_name_the_agent_and_the_reason(waypoints: list[list[float]], message: str) -> None:
    with pytest.raises(ConfigError, match=f"agent 'a'.*{message}"):
        TimedPath(waypoints, rounding_m=5.0, where="agent 'a'")
