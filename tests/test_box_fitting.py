"""Yaw and extents of points on rectangles that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.perception.boxes import align_to, extents, fit_yaw, rotate, subsample

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
    assert fit_yaw(xy[np.random.default_rng(0).permutation(100)])[0] == pytest.approx(fit_yaw(xy)[0], abs=1e-6)


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
