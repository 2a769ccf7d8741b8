"""Yaw and extents of points on rectangles that are known exactly."""

from __future__ import annotations

import numpy as np
import pytest

from log2sim.perception.boxes import extents, fit_yaw, rotate

QUARTER = np.pi / 2


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


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_the_fit_turns_with_the_points(seed):
    rng = np.random.default_rng(seed)
    xy, first = l_shape(seed=seed), None
    for angle in rng.uniform(-np.pi, np.pi, 8):
        error = (fit_yaw(rotate(xy, angle))[0] - angle) % QUARTER
        first = error if first is None else first
        assert apart(error, first) < np.deg2rad(1.0)


def test_one_stray_point_does_not_turn_the_box():
    xy = rotate(np.vstack([l_shape(), [[-1.5, 3.5]]]), 0.4)
    assert apart(fit_yaw(xy)[0], 0.4) < np.deg2rad(1.5)


def test_extents_without_trim_are_the_exact_ends_along_and_across():
    corners = np.array([[0.0, 0], [4, 0], [4, 2], [0, 2], [1, 1]])
    low, high = extents(rotate(corners, 0.7), 0.7, trim=0.0)
    np.testing.assert_allclose(low, [0, 0], atol=1e-12)
    np.testing.assert_allclose(high, [4, 2], atol=1e-12)
