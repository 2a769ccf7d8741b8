"""Which side traffic keeps to, and which way the street goes on either side of a path."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.agents.heading import MEETING_LOG_ODDS, USUALLY_RIGHT, side_log_odds, street_log_odds
from log2sim.perception.boxes import rotate

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


USUAL = np.log(USUALLY_RIGHT / (1 - USUALLY_RIGHT))


@given(turn=ANGLES, apart_m=st.floats(2.5, 12.0), x=st.floats(-1e5, 1e5), late=st.floats(0.0, 30.0))
@settings(max_examples=40, deadline=None)
def test_oncoming_traffic_on_the_left_keeps_right_in_every_map_and_left_in_the_mirror(turn, apart_m, x, late):
    road = [path(0.0, 0.0, 0.0), path(60.0 + late, apart_m, np.pi)]
    assert side_log_odds([moved(p, turn, (x, -x)) for p in road]) == pytest.approx(USUAL + MEETING_LOG_ODDS)
    assert side_log_odds([moved(mirrored(p), turn, (x, -x)) for p in road]) == pytest.approx(USUAL - MEETING_LOG_ODDS)


@given(turn=ANGLES, left_m=st.sampled_from([-9.0, -4.0, 0.5, 3.0, 9.0]), flipped=st.booleans())
@settings(max_examples=40, deadline=None)
def test_the_direction_of_a_street_is_mirrored_with_its_world(turn, left_m, flipped):
    flow, pose = path(0.0, 0.0, 0.0), np.array([[20.0, left_m, np.pi * flipped]])
    right = street_log_odds(moved(pose, turn)[0], [moved(flow, turn)], keeps_right=True)
    left = street_log_odds(moved(mirrored(pose), turn)[0], [moved(mirrored(flow), turn)], keeps_right=False)
    assert right == pytest.approx(left, abs=1e-6)
    assert (right > 0) == ((left_m < 2) != flipped)
    # What points the other way has the opposite log-odds.
    assert street_log_odds(
        moved(pose + np.array([0, 0, np.pi]), turn)[0], [moved(flow, turn)], keeps_right=True
    ) == pytest.approx(-right, abs=1e-6)


def test_in_the_lane_of_another_one_surely_goes_its_way_and_at_its_curb_most_likely():
    def along(left_m):
        return street_log_odds(np.array([30.0, left_m, 0.0]), [path(0.0, 0.0, 0.0)], keeps_right=True)

    assert along(0.3) > along(-3.0) > 2 > 0 > along(3.0) > along(8.0)
