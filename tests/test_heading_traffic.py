"""Which side traffic keeps to, and which way vehicles parked on either side of it point."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.agents.heading.traffic import Side, parked_heading, side_of_traffic
from log2sim.perception.box_fitting import rotate

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


@pytest.mark.parametrize("yaw", [0.05, np.pi - 0.05])
@pytest.mark.parametrize(("left_m", "with_it"), [(-3.0, True), (-0.5, True), (4.0, False)])
@pytest.mark.parametrize("turn", [0.0, 1.0, -2.5])
def test_traffic_keeps_right_whatever_way_the_box_was_fitted(yaw, left_m, with_it, turn):
    """Right of a path eastward points east, clearly left of it points west."""
    flow = moved(path(0.0, 0.0, 0.0, 20.0), turn)
    xy = rotate(np.array([10.0, left_m]), turn)
    found = parked_heading(yaw + turn, xy, flow)
    assert np.cos(found - turn) * (1 if with_it else -1) > 0.9
    assert abs(np.sin(found - yaw - turn)) < 1e-9


def test_without_traffic_nearby_a_heading_stays_as_it_is():
    for flow in (np.zeros((0, 3)), path(500.0, 0.0, 0.0), path(0.0, 0.0, np.pi / 2, 20.0)):
        assert parked_heading(3.0, np.array([10.0, -2.0]), flow) == pytest.approx(3.0)


def test_the_nearer_path_has_more_say():
    flow = np.vstack([path(0.0, 3.0, 0.0, 20.0), path(20.0, -12.0, np.pi, 20.0)])
    assert np.cos(parked_heading(0.0, np.array([10.0, 0.5]), flow)) > 0.9
