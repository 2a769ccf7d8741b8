"""Which vehicles stand, from what little of them shows, and which way they point on either side of traffic."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_size import measured

from log2sim.agents.standing import Side, is_static, parked_heading, robust_line, side_of_traffic
from log2sim.perception.box_fitting import rotate

TRUCK = (18.0, 2.55, 3.8)
ANGLES = st.floats(-np.pi, np.pi)


def path(x0_m: float, y0_m: float, heading_rad: float, length_m: float = 60.0) -> np.ndarray:
    """A straight path (K, 3) of x, y and heading."""
    along = np.arange(0.0, length_m, 1.5)[:, None]
    return np.hstack([
        [x0_m, y0_m] + along * [np.cos(heading_rad), np.sin(heading_rad)], np.full((len(along), 1), heading_rad),
    ])  # fmt: skip


def moved(flow: np.ndarray, turn_rad: float, shift_m: tuple[float, float] = (0.0, 0.0)) -> np.ndarray:
    """The same path in a map that is turned and shifted."""
    return np.column_stack([rotate(flow[:, :2], turn_rad) + shift_m, flow[:, 2] + turn_rad])


def mirrored(flow: np.ndarray) -> np.ndarray:
    """The same path in a mirror along x."""
    return flow * [1.0, -1.0, -1.0]


@given(turn=ANGLES, apart_m=st.floats(2.5, 12.0), x=st.floats(-1e5, 1e5), late=st.floats(0.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_oncoming_traffic_on_the_left_keeps_right_in_every_map_and_left_in_the_mirror(turn, apart_m, x, late):
    road = [path(0.0, 0.0, 0.0), path(60.0 + late, apart_m, np.pi)]
    assert side_of_traffic([moved(p, turn, (x, -x)) for p in road]) == Side.RIGHT
    assert side_of_traffic([moved(mirrored(p), turn, (x, -x)) for p in road]) == Side.LEFT


def test_traffic_that_never_meets_is_taken_to_keep_right():
    one_way, crossing, far = path(0.0, 0.0, 0.0), path(30.0, -30.0, np.pi / 2), path(60.0, 200.0, np.pi)
    for paths in ([], [one_way], [one_way, path(5.0, -3.5, 0.0)], [one_way, crossing], [one_way, far]):
        assert side_of_traffic(paths) == Side.RIGHT


def test_most_of_those_that_meet_decide():
    wrong_way = path(60.0, 3.0, np.pi)
    assert (
        side_of_traffic([path(0.0, 0.0, 0.0), path(60.0, -4.0, np.pi), path(75.0, -4.0, np.pi), wrong_way]) == Side.LEFT
    )


@given(turn=ANGLES, left_m=st.sampled_from([-9.0, -4.0, 0.5, 4.0, 9.0]), flipped=st.booleans())
@settings(max_examples=40, deadline=None)
def test_a_parked_heading_is_mirrored_with_its_world(turn, left_m, flipped):
    flow, xy, yaw = path(0.0, 0.0, 0.0), np.array([20.0, left_m]), np.pi * flipped
    right = parked_heading(yaw + turn, rotate(xy, turn), moved(flow, turn), side=Side.RIGHT)
    left = parked_heading(turn - yaw, rotate(xy * [1, -1], turn), moved(mirrored(flow), turn), side=Side.LEFT)
    assert np.cos(right - turn) == pytest.approx(np.cos(left - turn), abs=1e-6)
    assert np.cos(right - turn) == pytest.approx(1.0 if left_m < 2 else -1.0, abs=1e-6)


def test_a_robust_line_is_least_squares_without_outliers_and_hardly_moves_with_them():
    rng = np.random.default_rng(2)
    t = np.sort(rng.uniform(0, 4, 60))
    xy = np.outer(t, [1.5, -0.5]) + rng.normal(0, 0.1, (60, 2))
    _, velocity, sigma = robust_line(t, xy, np.full(60, 0.01))
    np.testing.assert_allclose(velocity, np.polyfit(t, xy, 1)[0], atol=0.02)
    assert np.abs(velocity - [1.5, -0.5]).max() < 4 * sigma
    xy[rng.choice(60, 10, replace=False)] += 8.0
    np.testing.assert_allclose(robust_line(t, xy, np.full(60, 0.01))[1], [1.5, -0.5], atol=0.1)
    assert robust_line(np.ones(5), xy[:5], np.ones(5))[2] == np.inf


def passing(speed_mps: float):
    """A long truck seen from a sensor that drives past it at 6 m/s and sees 40 degrees to either side of its left."""
    states, sensors = [], []
    for k in range(30):
        states.append((20.0 + 0.1 * k * speed_mps, 8.0, 0.0))
        sensors.append((0.6 * k, 0.0, 1.9))
    return measured(states, TRUCK, "truck", sensors=sensors)


def test_a_long_truck_of_which_ever_more_shows_stands_and_a_slow_one_does_not():
    standing, creeping = passing(0.0), passing(1.0)
    # The center that a typical length gives moves as more of the truck is seen.
    grown = standing.measurements.center_m.copy()
    grown[:, 0] = np.linspace(24.0, 20.0, 30)
    assert is_static(standing)
    object.__setattr__(standing.measurements, "center_m", grown)
    assert is_static(standing)
    assert not is_static(creeping)
