"""Completion of partly observed boxes, with hypothesis over extents, viewpoints and turns, and against ray casts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import apart, measured_row, scan, standing

from log2sim.perception.boxes import (
    CORNER_ROUNDING_SHARE,
    FACING_END,
    SENSOR_MOTION_M,
    complete_box,
    corner_correction,
    provisional_sizes,
    real_ends,
)

# Of the corners of a car of 1.8 m.
ROUNDING_M = CORNER_ROUNDING_SHARE * 1.8


def completed(low, high, size, sensor, ends_visible=(False, False)):
    """Center and deviation of a box over its extents, seen from a sensor."""
    return complete_box(low, high, size, real_ends(low, high, np.asarray(sensor), np.array(ends_visible)))


UNSEEN, RIGHT, LEFT, BOTH = (False, False), (True, False), (False, True), (True, True)


@pytest.mark.parametrize(
    ("sensor", "ends_visible", "center", "why"),
    [
        ([-10.0, -10.0], UNSEEN, [2.2, 0.9], "behind and to the right: both near sides are real"),
        ([-10.0, -10.0], BOTH, [2.2, 0.9], "what faces the sensor is surer than what is seen from the side"),
        ([10.0, 10.0], UNSEEN, [-1.2, 0.1], "ahead and to the left: the box reaches back from the far ends"),
        ([0.5, -10.0], UNSEEN, [0.5, 0.9], "beside the middle of the length, no end seen: centered"),
        ([0.5, -10.0], BOTH, [0.5, 0.9], "beside the middle of the length, both ends seen: centered"),
        ([0.5, -10.0], RIGHT, [1 + ROUNDING_M - 2.2, 0.9], "from the right side of a car, its front is on the right"),
        ([0.5, -10.0], LEFT, [-ROUNDING_M + 2.2, 0.9], "and its rear on the left"),
        ([0.5, 10.0], LEFT, [1 + ROUNDING_M - 2.2, 0.1], "from its left side, its front is on the left"),
        ([10.0, 0.5], LEFT, [-1.2, -ROUNDING_M + 0.9], "from ahead, its right side is on the left"),
        ([0.5, 0.5], BOTH, [0.5, 0.5], "inside what was seen: nothing says where the rest is"),
    ],
)
def test_a_box_reaches_from_its_best_end_to_where_it_was_not_seen(sensor, ends_visible, center, why):
    found, _ = completed(np.zeros(2), np.ones(2), np.array([4.4, 1.8]), sensor, ends_visible)
    np.testing.assert_allclose(found, center, atol=1e-12, err_msg=why)


def test_doubt_grows_with_what_was_not_seen_and_without_a_real_end():
    size = np.array([4.4, 1.8])
    sensor = np.array([-10.0, -10.0])
    near = completed(np.zeros(2), np.array([3.4, 1.0]), size, sensor)[1]
    far = completed(np.zeros(2), np.ones(2), size, sensor)[1]
    # The sensor's 0.08 m, the uniform spread of what was added, and how much cars differ: 5 % of the length.
    np.testing.assert_allclose(far[0] ** 2, 0.08**2 + 3.4**2 / 12 + (0.05 * 4.4) ** 2)
    assert near[0] < far[0]
    lost = completed(np.zeros(2), np.ones(2), size, np.array([0.5, -10.0]))[1]
    assert lost[0] > 2 * far[0]


# Properties

METERS = st.floats(-40.0, 40.0)
EXTENT = st.floats(0.05, 12.0)
FLAGS = st.tuples(st.booleans(), st.booleans())


@st.composite
def observations(draw):
    """Extents low, high (2,), a size that is no smaller, a viewpoint (2,) and which ends of the points are visible."""
    low = np.array([draw(METERS), draw(METERS)])
    seen = np.array([draw(EXTENT), draw(EXTENT)])
    size = seen + np.array([draw(st.floats(0.0, 8.0)), draw(st.floats(0.0, 2.0))])
    return low, low + seen, size, np.array([draw(METERS), draw(METERS)]), draw(FLAGS)


@given(observations())
def test_a_completed_box_contains_what_was_observed(seen):
    low, high, size, sensor, ends = seen
    center, sigma = completed(low, high, size, sensor, ends)
    # An end seen from the side is a rounded corner, which may lie beyond a box that has no room for it.
    corner = CORNER_ROUNDING_SHARE * size[1]
    assert np.all(center - size / 2 <= low + corner + 1e-9)
    assert np.all(center + size / 2 >= high - corner - 1e-9)
    assert np.all(np.isfinite(sigma) & (sigma > 0))


@given(observations(), st.floats(1.0, 2.0))
def test_the_best_real_end_stays_whatever_the_size(seen, factor):
    low, high, size, sensor, ends = seen
    real = real_ends(low, high, sensor, np.array(ends))
    for wanted in (size, size * [factor, 1.0]):
        center, _ = complete_box(low, high, wanted, real)
        corrected = corner_correction(low, high, real, wanted[1])
        for axis in range(2):
            if real[axis, 0] > real[axis, 1]:
                assert center[axis] - wanted[axis] / 2 == pytest.approx(corrected[0][axis], abs=1e-9)
            if real[axis, 1] > real[axis, 0]:
                assert center[axis] + wanted[axis] / 2 == pytest.approx(corrected[1][axis], abs=1e-9)


@given(observations())
def test_a_side_that_faces_the_sensor_is_real_and_the_opposite_one_does_not_face_it(seen):
    low, high, _, sensor, ends = seen
    real = real_ends(low, high, sensor, np.array(ends))
    beyond = np.stack([low - sensor, sensor - high], axis=1)
    assert (real[beyond > SENSOR_MOTION_M] == FACING_END).all()
    assert (real[beyond <= 0] != FACING_END).all()
    assert not (real == FACING_END).all(axis=1).any()


@given(st.lists(observations(), min_size=1, max_size=5))
def test_many_boxes_at_once_are_completed_as_one_by_one(several):
    low, high, size, sensor, ends = (np.array(c) for c in zip(*several))
    center, sigma = completed(low, high, size, sensor, ends)
    for k, one in enumerate(several):
        alone, same = completed(*one)
        np.testing.assert_array_equal(center[k], alone)
        np.testing.assert_array_equal(sigma[k], same)


# Ray casts


def box_of(cluster, sensor, category="car", **options):
    """Provisional center (3,), size (3,), yaw and covariance (2, 2) of the box around a cluster."""
    row = measured_row(cluster, sensor, category, **options)
    size = np.append(provisional_sizes(row)[0], row.top_m[0] - row.bottom_m[0])
    return row.center_m[0], size, row.yaw_rad[0], row.covariance[0]


PLACES = [(12, 0, 0), (12, 5, 20), (20, -6, -35), (15, 4, 90), (25, 8, 140), (9, -5, 180), (18, 0, 60), (30, 3, 10)]


@pytest.mark.parametrize(("x", "y", "yaw_deg"), PLACES)
def test_a_car_of_typical_size_is_found_where_it_stands(x, y, yaw_deg):
    car = standing(x, y, yaw_deg)
    xyz, owner = scan([car], noise_m=0.01)
    center, size, yaw, covariance = box_of(xyz[owner == 0], np.array([0, 0, 1.9]))
    assert apart(yaw, car.yaw_rad, np.pi) < np.deg2rad(4)
    assert np.hypot(*(center - car.center_m)[:2]) < 0.2
    error = (center - car.center_m)[:2]
    assert error @ np.linalg.solve(covariance, error) < 13.8  # 99.9 % of two degrees of freedom
    assert abs(size[2] - 1.6) < 0.15
    assert abs(center[2] - size[2] / 2) < 1e-9
