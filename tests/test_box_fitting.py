"""Oriented boxes: yaw, extents, completion, against rectangles that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest
from worlds import scan, standing

from log2sim.datatypes import CATEGORIES, TYPICAL_SIZE_M
from log2sim.perception.box_fitting import (
    FACING_END,
    SIDE_END,
    align_to,
    complete_box,
    extents,
    fit_box,
    fit_yaw,
    real_ends,
    rotate,
    subsample,
)

QUARTER = np.pi / 2
FAR_M = np.array([5e5, 5e6])


def l_shape(length_m=4.4, width_m=1.85, count=120, noise_m=0.02, seed=0):
    """The near side and the rear of a box whose near rear corner is the origin, along +x and +y."""
    rng = np.random.default_rng(seed)
    on_length = rng.random(count) < length_m / (length_m + width_m)
    xy = np.where(
        on_length[:, None],
        np.stack([rng.uniform(0, length_m, count), np.zeros(count)], 1),
        np.stack([np.zeros(count), rng.uniform(0, width_m, count)], 1),
    )
    return xy + rng.normal(0, noise_m, (count, 2))


def apart(yaw, truth, period=QUARTER):
    """Smallest difference of two angles up to multiples of a period."""
    return abs((yaw - truth + period / 2) % period - period / 2)


@pytest.mark.parametrize("yaw_deg", [0, 7, 15, 30, 44.5, 45, 46, 60, 89, 91, 179, 200, 271])
@pytest.mark.parametrize("sides", ["two", "long", "short"])
def test_yaw_of_a_rectangle_is_found_whatever_sides_are_seen(yaw_deg, sides):
    xy = l_shape()
    xy = {"two": xy, "long": xy[xy[:, 1] < 0.1], "short": xy[xy[:, 0] < 0.1]}[sides]
    yaw, contrast = fit_yaw(rotate(xy, np.deg2rad(yaw_deg)))
    assert apart(yaw, np.deg2rad(yaw_deg)) < np.deg2rad(1.5)
    assert 0 <= yaw < QUARTER
    assert contrast > 0.3


@pytest.mark.parametrize("seed", range(3))
def test_the_fit_turns_with_the_points(seed):
    rng = np.random.default_rng(seed)
    xy, first = l_shape(seed=seed), None
    for angle in rng.uniform(-np.pi, np.pi, 8):
        error = (fit_yaw(rotate(xy, angle))[0] - angle) % QUARTER
        first = error if first is None else first
        assert apart(error, first) < np.deg2rad(1.0)


def test_the_fit_does_not_depend_on_where_the_points_are():
    xy = rotate(l_shape(), 0.3)
    there, contrast = fit_yaw(xy + FAR_M)
    here, same = fit_yaw(xy)
    assert there == pytest.approx(here, abs=1e-6)
    assert contrast == pytest.approx(same, abs=1e-5)


def test_the_fit_does_not_depend_on_the_order_of_few_points():
    xy = rotate(l_shape(count=100), 0.5)
    assert fit_yaw(xy[np.random.default_rng(0).permutation(100)])[0] == pytest.approx(fit_yaw(xy)[0], abs=1e-12)


def test_one_stray_point_does_not_turn_the_box():
    xy = rotate(np.vstack([l_shape(), [[-1.5, 3.5]]]), 0.4)
    assert apart(fit_yaw(xy)[0], 0.4) < np.deg2rad(1.5)


def test_a_round_cluster_has_less_contrast_than_a_box():
    angle = np.linspace(0, 2 * np.pi, 90, endpoint=False)
    ring = 0.35 * np.stack([np.cos(angle), np.sin(angle)], 1)
    assert fit_yaw(ring)[1] < 0.1 < fit_yaw(l_shape())[1]


@pytest.mark.parametrize(
    "xy",
    [np.zeros((1, 2)), np.zeros((40, 2)), np.array([[0.0, 0], [1, 1]]), np.full((5, 2), 1e7)],
    ids=["one", "coincident", "two", "far"],
)
def test_points_that_say_nothing_still_give_a_yaw_in_range(xy):
    yaw, contrast = fit_yaw(xy)
    assert 0 <= yaw < QUARTER
    assert np.isfinite(contrast)


@pytest.mark.parametrize("yaw_deg", [0.0, 20.0, 65.0])
def test_a_straight_line_gives_its_own_direction(yaw_deg):
    line = np.stack([np.linspace(0, 4, 30), np.zeros(30)], 1)
    yaw, _ = fit_yaw(rotate(line, np.deg2rad(yaw_deg)) + FAR_M)
    assert apart(yaw, np.deg2rad(yaw_deg)) < np.deg2rad(1.5)


def test_extents_without_trim_are_the_exact_ends_along_and_across():
    corners = np.array([[0.0, 0], [4, 0], [4, 2], [0, 2], [1, 1]])
    low, high = extents(rotate(corners, 0.7), 0.7, trim=0.0)
    np.testing.assert_allclose(low, [0, 0], atol=1e-12)
    np.testing.assert_allclose(high, [4, 2], atol=1e-12)


def test_trimmed_extents_ignore_a_few_stray_points():
    xy = np.random.default_rng(0).uniform([0, 0], [4, 2], (2000, 2))
    low, high = extents(np.vstack([xy, [[40.0, 40.0]] * 10]), 0.0)
    assert np.all(np.abs(low) < 0.1)
    assert np.all(np.abs(high - [4, 2]) < 0.1)


def test_rotation_is_counter_clockwise_and_undone_by_its_opposite():
    np.testing.assert_allclose(rotate(np.array([[1.0, 0.0]]), QUARTER), [[0.0, 1.0]], atol=1e-15)
    xy = np.random.default_rng(0).normal(size=(7, 2))
    np.testing.assert_allclose(rotate(rotate(xy, 1.1), -1.1), xy, atol=1e-14)


UNSEEN, RIGHT, LEFT, BOTH = (False, False), (True, False), (False, True), (True, True)


@pytest.mark.parametrize(
    ("sensor", "ends_visible", "center", "why"),
    [
        ([-10.0, -10.0], UNSEEN, [2.2, 0.9], "behind and to the right: both near sides are real"),
        ([-10.0, -10.0], BOTH, [2.2, 0.9], "what faces the sensor is surer than what is seen from the side"),
        ([10.0, 10.0], UNSEEN, [-1.2, 0.1], "ahead and to the left: the box reaches back from the far ends"),
        ([0.5, -10.0], UNSEEN, [0.5, 0.9], "beside the middle of the length, no end seen: centered"),
        ([0.5, -10.0], BOTH, [0.5, 0.9], "beside the middle of the length, both ends seen: centered"),
        ([0.5, -10.0], RIGHT, [1 + 0.08 * 1.8 - 2.2, 0.9], "from the right side of a car, its front is on the right"),
        ([0.5, -10.0], LEFT, [-0.08 * 1.8 + 2.2, 0.9], "and its rear on the left"),
        ([0.5, 10.0], LEFT, [1 + 0.08 * 1.8 - 2.2, 0.1], "from its left side, its front is on the left"),
        ([10.0, 0.5], LEFT, [-1.2, -0.08 * 1.8 + 0.9], "from ahead, its right side is on the left"),
        ([0.5, 0.5], BOTH, [0.5, 0.5], "inside what was seen: nothing says where the rest is"),
    ],
)
def test_a_box_reaches_from_its_best_end_to_where_it_was_not_seen(sensor, ends_visible, center, why):
    found, _ = complete_box(np.zeros(2), np.ones(2), np.array([4.4, 1.8]), np.array(sensor), ends_visible)
    np.testing.assert_allclose(found, center, atol=1e-12, err_msg=why)


def test_ends_seen_at_a_flat_angle_are_not_believed():
    # 10 m ahead and 0.8 m beside the middle of its width: the side is seen at 5 degrees.
    shown = real_ends(np.array([-2.0, -0.9]), np.array([2.0, 0.9]), np.array([12.0, 1.7]), BOTH)
    assert shown.tolist() == [[0, FACING_END], [SIDE_END, FACING_END]]


def test_doubt_grows_with_what_was_not_seen_and_without_a_real_end():
    size = np.array([4.4, 1.8])
    sensor = np.array([-10.0, -10.0])
    near = complete_box(np.zeros(2), np.array([3.4, 1.0]), size, sensor)[1]
    far = complete_box(np.zeros(2), np.ones(2), size, sensor)[1]
    # The sensor's 0.08 m, the uniform spread of what was added, and how much cars differ: 5 % of the length.
    np.testing.assert_allclose(far[0] ** 2, 0.08**2 + 3.4**2 / 12 + (0.05 * 4.4) ** 2)
    assert near[0] < far[0]
    lost = complete_box(np.zeros(2), np.ones(2), size, np.array([0.5, -10.0]))[1]
    assert lost[0] > 2 * far[0]


def test_what_was_seen_of_more_than_the_whole_leaves_the_noise_of_the_sensor():
    found, sigma = complete_box(np.zeros(2), np.array([5.0, 2.0]), np.array([4.4, 1.8]), np.array([-9.0, -9.0]), BOTH)
    np.testing.assert_allclose(found, [2.2, 0.9])
    np.testing.assert_allclose(sigma, 0.08)


def test_completion_is_the_same_seen_in_a_mirror():
    low, high, size, sensor = np.array([1.0, 2]), np.array([2.0, 2.5]), np.array([4.0, 2]), np.array([-3.0, 9])
    center, sigma = complete_box(low, high, size, sensor, RIGHT)
    mirrored, same = complete_box(-high, -low, size, -sensor, RIGHT)
    np.testing.assert_allclose(mirrored, -center)
    np.testing.assert_allclose(same, sigma)


PLACES = [(12, 0, 0), (12, 5, 20), (20, -6, -35), (15, 4, 90), (25, 8, 140), (9, -5, 180), (18, 0, 60), (30, 3, 10)]


@pytest.mark.parametrize(("x", "y", "yaw_deg"), PLACES)
def test_a_car_of_typical_size_is_found_where_it_stands(x, y, yaw_deg):
    car = standing(x, y, yaw_deg)
    xyz, owner = scan([car], noise_m=0.01)
    center, size, yaw, covariance = fit_box(xyz[owner == 0], np.array([0, 0, 1.9]), "car", 0.0)
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
    center, _, yaw, _ = fit_box(cluster, np.array([0, 0, 0.8]), "car", 0.0)
    assert apart(yaw, np.deg2rad(yaw_deg + turn_deg), np.pi) < np.deg2rad(3)
    assert np.hypot(*(center[:2] - rotate(np.array([12.0, 0.0]), np.deg2rad(yaw_deg)))) < 0.2


@pytest.mark.parametrize("angle", [0.0, 0.7, 2.0, -2.5])
def test_the_box_moves_and_turns_with_the_world(angle):
    xyz, owner = scan([standing(15, 5, 25)], noise_m=0.01)
    cluster, sensor, shift = xyz[owner == 0], np.array([0.0, 0, 1.9]), np.array([5e5, 5e6, 300.0])

    def moved(p):
        return np.concatenate([rotate(p[..., :2], angle), p[..., 2:]], axis=-1) + shift

    center, size, yaw, covariance = fit_box(cluster, sensor, "car", 0.0)
    center_2, size_2, yaw_2, covariance_2 = fit_box(moved(cluster), moved(sensor), "car", 300.0)
    # The search steps by two degrees and interpolates: a turn may cost a fraction of a step.
    np.testing.assert_allclose(center_2, moved(center), atol=0.05)
    np.testing.assert_allclose(size_2, size, atol=0.05)
    assert apart(yaw_2, yaw + angle, np.pi) < np.deg2rad(1)
    turn = rotate(np.eye(2), angle).T
    np.testing.assert_allclose(covariance_2, turn @ covariance @ turn.T, atol=0.03)


def test_the_covariance_is_widest_along_what_was_not_seen():
    xyz, owner = scan([standing(15, 0, 0)])
    _, _, yaw, covariance = fit_box(xyz[owner == 0], np.array([0, 0, 1.9]), "car", 0.0, BOTH)
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
        np.sqrt(np.linalg.eigvalsh(fit_box(side, np.array([0, 0, 1.9]), "car", 0.0, ends)[3]))
        for ends in (BOTH, UNSEEN)
    ]
    # Front or flank: the center lies half of the difference between length and width away.
    assert sigma[0][0] < 0.3
    assert sigma[1][0] > 0.5


@pytest.mark.parametrize("category", CATEGORIES)
@pytest.mark.parametrize("count", [1, 2, 5])
def test_a_handful_of_points_gives_a_finite_box_of_at_least_the_typical_size(category, count):
    cluster = np.array([20.0, 3, 0.5]) + np.random.default_rng(count).normal(0, 0.1, (count, 3))
    center, size, yaw, covariance = fit_box(cluster, np.array([0, 0, 1.9]), category, 0.0)
    assert np.isfinite([*center, *size, yaw, *covariance.ravel()]).all()
    assert np.all(size[:2] >= np.array(TYPICAL_SIZE_M[category])[:2])
    assert np.linalg.eigvalsh(covariance).min() > 0


def test_subsample_keeps_the_ends_the_order_and_small_sets_as_they_are():
    rows = np.arange(1000)[:, None]
    few = subsample(rows, 7)
    assert few.shape == (7, 1)
    assert (few[0, 0], few[-1, 0]) == (0, 999)
    assert (np.diff(few[:, 0]) > 0).all()
    assert subsample(rows[:7], 7) is not None
    np.testing.assert_array_equal(subsample(rows[:7], 7), rows[:7])


@pytest.mark.parametrize("period", [np.pi, QUARTER, 2 * np.pi])
def test_aligned_angles_differ_by_whole_periods_and_are_the_nearest_to_the_wanted_one(period):
    rng = np.random.default_rng(0)
    for yaw, toward in rng.uniform(-9, 9, (200, 2)):
        found = align_to(yaw, toward, period)
        assert -np.pi <= found < np.pi
        assert apart(found, yaw, period) < 1e-9
        assert apart(found, toward, 2 * np.pi) <= period / 2 + 1e-9
