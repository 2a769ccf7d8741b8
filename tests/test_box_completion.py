"""Completion of partly observed boxes, with hypothesis over extents, viewpoints and turns, and against ray casts."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from worlds import measured_row, scan, standing

from log2sim.datatypes import CATEGORIES, TYPICAL_SIZE_M
from log2sim.perception.boxes import (
    CORNER_ROUNDING_SHARE,
    FACING_END,
    SENSOR_MOTION_M,
    SIDE_END,
    complete_box,
    corner_correction,
    extents,
    oriented_covariance,
    place_boxes,
    provisional_sizes,
    real_ends,
    rotate,
)

QUARTER = np.pi / 2
# Of the corners of a car of 1.8 m.
ROUNDING_M = CORNER_ROUNDING_SHARE * 1.8


def apart(yaw, truth, period=QUARTER):
    """Smallest difference of two angles up to multiples of a period."""
    return abs((yaw - truth + period / 2) % period - period / 2)


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


def test_ends_seen_at_a_flat_angle_are_not_believed():
    # 10 m ahead and 0.8 m beside the middle of its width: the side is seen at 5 degrees.
    real = real_ends(np.array([-2.0, -0.9]), np.array([2.0, 0.9]), np.array([12.0, 1.7]), np.array(BOTH))
    assert real.tolist() == [[0, FACING_END], [SIDE_END, FACING_END]]


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


def test_what_was_seen_of_more_than_the_whole_leaves_the_noise_of_the_sensor():
    found, sigma = completed(np.zeros(2), np.array([5.0, 2.0]), np.array([4.4, 1.8]), np.array([-9.0, -9.0]), BOTH)
    np.testing.assert_allclose(found, [2.2, 0.9])
    np.testing.assert_allclose(sigma, 0.08)


def test_completion_is_the_same_seen_in_a_mirror():
    low, high, size, sensor = np.array([1.0, 2]), np.array([2.0, 2.5]), np.array([4.0, 2]), np.array([-3.0, 9])
    center, sigma = completed(low, high, size, sensor, RIGHT)
    mirrored, same = completed(-high, -low, size, -sensor, RIGHT)
    np.testing.assert_allclose(mirrored, -center)
    np.testing.assert_allclose(same, sigma)


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


@pytest.mark.parametrize("ahead_m", [-0.4, 0.0, 0.4])
@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_a_flank_that_leaves_the_field_of_view_level_with_the_sensor_does_not_end_there(ahead_m, side):
    # Of a bus at 2 m only what is ahead of the sensor is seen.
    low, high = np.array([ahead_m, 2.0]), np.array([7.0, 2.2])
    if side < 0:
        low, high = np.array([low[0], -high[1]]), np.array([high[0], -low[1]])
    real = real_ends(low, high, np.zeros(2), np.array(RIGHT if side > 0 else LEFT), min_sine=0.15)
    assert real.tolist() == [[0, SIDE_END], [FACING_END, 0] if side > 0 else [0, FACING_END]]


@given(observations(), METERS, METERS)
def test_completion_shifts_with_everything(seen, x, y):
    low, high, size, sensor, ends = seen
    shift = np.array([x, y])
    here, sigma = completed(low, high, size, sensor, ends)
    there, same = completed(low + shift, high + shift, size, sensor + shift, ends)
    near_border = np.min(np.abs(np.concatenate([sensor - low, sensor - high]))) < 1e-6
    if not near_border:
        np.testing.assert_allclose(there, here + shift, atol=1e-9)
        np.testing.assert_allclose(same, sigma, atol=1e-9)


@given(observations())
def test_completion_turned_by_half_a_turn_is_the_same_box(seen):
    low, high, size, sensor, ends = seen
    here, sigma = completed(low, high, size, sensor, ends)
    there, same = completed(-high, -low, size, -sensor, ends)
    np.testing.assert_allclose(there, -here, atol=1e-9)
    np.testing.assert_allclose(same, sigma, atol=1e-9)


@given(st.lists(observations(), min_size=1, max_size=5))
def test_many_boxes_at_once_are_completed_as_one_by_one(several):
    low, high, size, sensor, ends = (np.array(c) for c in zip(*several))
    center, sigma = completed(low, high, size, sensor, ends)
    for k, one in enumerate(several):
        alone, same = completed(*one)
        np.testing.assert_array_equal(center[k], alone)
        np.testing.assert_array_equal(sigma[k], same)


@given(st.floats(0.01, 5.0), st.floats(0.01, 5.0), st.floats(-4.0, 4.0))
def test_an_oriented_covariance_has_its_deviations_along_its_axes(along, across, yaw):
    covariance = oriented_covariance(np.array([along, across]), yaw)
    axis = np.array([np.cos(yaw), np.sin(yaw)])
    assert axis @ covariance @ axis == pytest.approx(along**2, rel=1e-6)
    assert np.linalg.det(covariance) == pytest.approx((along * across) ** 2, rel=1e-6)
    np.testing.assert_allclose(covariance, covariance.T, atol=1e-12)


def test_rows_without_points_get_no_position():
    row = measured_row(np.random.default_rng(0).normal([12.0, 3.0, 0.8], 0.3, (40, 3)))
    nothing = row.take([])
    assert len(place_boxes(nothing)) == 0
    assert place_boxes(row).source.tolist() == ["lidar"]


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


@pytest.mark.parametrize("turn_deg", np.linspace(-2, 2, 9))
@pytest.mark.parametrize("yaw_deg", [0, 90, 180, -90])
def test_a_car_ahead_seen_from_straight_behind_does_not_turn_with_a_fraction_of_a_degree(yaw_deg, turn_deg):
    # A LiDAR no higher than the car sees its rear alone.
    xyz, owner = scan([standing(12, 0, turn_deg)], sensor=(0, 0, 0.8), noise_m=0.01)
    cluster = rotate(xyz[owner == 0, :2], np.deg2rad(yaw_deg))
    cluster = np.column_stack([cluster, xyz[owner == 0, 2]])
    center, _, yaw, _ = box_of(cluster, np.array([0, 0, 0.8]))
    assert apart(yaw, np.deg2rad(yaw_deg + turn_deg), np.pi) < np.deg2rad(3)
    assert np.hypot(*(center[:2] - rotate(np.array([12.0, 0.0]), np.deg2rad(yaw_deg)))) < 0.2


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.5])
def test_the_box_moves_and_turns_with_the_world(angle):
    xyz, owner = scan([standing(15, 5, 25)], noise_m=0.01)
    cluster, sensor, shift = xyz[owner == 0], np.array([0.0, 0, 1.9]), np.array([5e5, 5e6, 300.0])

    def moved(p):
        return np.concatenate([rotate(p[..., :2], angle), p[..., 2:]], axis=-1) + shift

    center, size, yaw, covariance = box_of(cluster, sensor)
    center_2, size_2, yaw_2, covariance_2 = box_of(moved(cluster), moved(sensor), bottom_m=300.0)
    # The search steps by two degrees and interpolates: a turn may cost a fraction of a step.
    np.testing.assert_allclose(center_2, moved(center), atol=0.05)
    np.testing.assert_allclose(size_2, size, atol=0.05)
    assert apart(yaw_2, yaw + angle, np.pi) < np.deg2rad(1)
    turn = rotate(np.eye(2), angle).T
    np.testing.assert_allclose(covariance_2, turn @ covariance @ turn.T, atol=0.03)


def test_the_covariance_is_widest_along_what_was_not_seen():
    xyz, owner = scan([standing(15, 0, 0)])
    _, _, yaw, covariance = box_of(xyz[owner == 0], np.array([0, 0, 1.9]), ends_visible=BOTH)
    assert apart(yaw, 0.0, np.pi) < 0.05
    # Straight from behind the roof and the rear are seen: what remains of the length is spread evenly.
    low, high = extents(xyz[owner == 0, :2], 0.0)
    hidden_m = 4.4 - (high - low)[0]
    assert np.sqrt(covariance[0, 0]) == pytest.approx(np.hypot(hidden_m / np.sqrt(12), 0.05 * 4.4), rel=0.1)
    assert np.sqrt(covariance[1, 1]) < 0.15
    np.testing.assert_allclose(covariance, covariance.T)


def test_a_short_side_without_its_ends_may_be_a_front_or_part_of_a_flank():
    side = np.column_stack([np.full(60, 12.0), np.linspace(-0.8, 0.8, 60), np.linspace(0.3, 1.2, 60)])
    sigma = [
        np.sqrt(np.linalg.eigvalsh(box_of(side, np.array([0, 0, 1.9]), ends_visible=ends)[3]))
        for ends in (BOTH, UNSEEN)
    ]
    # Front or flank: the center lies half of the difference between length and width away.
    assert sigma[0][0] < 0.3
    assert sigma[1][0] > 0.5


@pytest.mark.parametrize("category", CATEGORIES)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_handful_of_points_gives_a_finite_box_of_at_least_the_typical_size(category, count):
    cluster = np.array([20.0, 3, 0.5]) + np.random.default_rng(count).normal(0, 0.1, (count, 3))
    center, size, yaw, covariance = box_of(cluster, np.array([0, 0, 1.9]), category)
    assert np.isfinite([*center, *size, yaw, *covariance.ravel()]).all()
    assert np.all(size[:2] >= np.array(TYPICAL_SIZE_M[category])[:2])
    assert np.linalg.eigvalsh(covariance).min() > 0
