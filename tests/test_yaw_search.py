"""Yaws of many clusters at once are those of each alone."""

from __future__ import annotations

import numpy as np

from log2sim.perception.boxes import correct_yaws, rotate

LENGTH_M, WIDTH_M, NOISE_M = 4.4, 1.85, 0.02


def side_points(rng, count, yaw_rad):
    """Points on the long and the short side of a rectangle far from the origin."""
    along = rng.random(count) < LENGTH_M / (LENGTH_M + WIDTH_M)
    x, y = rng.uniform(0, LENGTH_M, count) * along, rng.uniform(0, WIDTH_M, count) * ~along
    return rotate(np.stack([x, y], axis=1) + rng.normal(0, NOISE_M, (count, 2)), yaw_rad) + rng.uniform(-80, 80, 2)


def test_rough_yaws_are_corrected_where_enough_points_show_the_sides():
    rng = np.random.default_rng(4)
    yaw = np.array([0.3, -2.0, 1.1, 2.9])
    count = np.array([200, 400, 29, 90])
    points = np.concatenate([side_points(rng, n, angle) for n, angle in zip(count, yaw)])
    corrected = correct_yaws(points, count, yaw + 0.1)
    assert np.abs(corrected - yaw)[[0, 1, 3]].max() < np.deg2rad(1.5)
    assert corrected[2] == yaw[2] + 0.1
