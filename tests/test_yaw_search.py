"""Yaws of many clusters at once are those of each alone."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from log2sim.perception import boxes
from log2sim.perception.boxes import correct_yaws, fit_yaws, rotate

LENGTH_M, WIDTH_M, NOISE_M = 4.4, 1.85, 0.02


def side_points(rng, count, yaw_rad):
    """Points on the long and the short side of a rectangle far from the origin."""
    along = rng.random(count) < LENGTH_M / (LENGTH_M + WIDTH_M)
    x, y = rng.uniform(0, LENGTH_M, count) * along, rng.uniform(0, WIDTH_M, count) * ~along
    return rotate(np.stack([x, y], axis=1) + rng.normal(0, NOISE_M, (count, 2)), yaw_rad) + rng.uniform(-80, 80, 2)


@pytest.mark.slow
@given(seed=st.integers(0, 2**32 - 1), counts=st.lists(st.integers(20, 700), min_size=1, max_size=8))
def test_clusters_are_fitted_alike_alone_and_together(seed, counts):
    rng = np.random.default_rng(seed)
    yaw = rng.uniform(-np.pi, np.pi, len(counts))
    clusters = [side_points(rng, n, angle) for n, angle in zip(counts, yaw)]
    together, count = np.concatenate(clusters), np.array(counts)
    rough = yaw + rng.uniform(-0.2, 0.2, len(counts))
    for k, points in enumerate(clusters):
        one = np.array([len(points)])
        alone, contrast = fit_yaws(points, one)
        assert np.isclose(fit_yaws(together, count)[0][k], alone[0], atol=1e-5)
        assert np.isclose(fit_yaws(together, count)[1][k], contrast[0], rtol=1e-4, atol=1e-4)
        assert np.isclose(
            correct_yaws(together, count, rough)[k], correct_yaws(points, one, rough[k : k + 1])[0], atol=1e-5
        )


def test_rough_yaws_are_corrected_where_enough_points_show_the_sides():
    rng = np.random.default_rng(4)
    yaw = np.array([0.3, -2.0, 1.1, 2.9])
    count = np.array([200, 400, 29, 90])
    points = np.concatenate([side_points(rng, n, angle) for n, angle in zip(count, yaw)])
    corrected = correct_yaws(points, count, yaw + 0.1)
    assert np.abs(corrected - yaw)[[0, 1, 3]].max() < np.deg2rad(1.5)
    assert corrected[2] == yaw[2] + 0.1


def test_the_division_into_parts_changes_nothing(monkeypatch):
    rng = np.random.default_rng(5)
    count = rng.integers(20, 400, 30)
    points = np.concatenate([side_points(rng, n, angle) for n, angle in zip(count, rng.uniform(0, 6, 30))])
    whole = fit_yaws(points, count)
    monkeypatch.setattr(boxes, "MAX_OFFSETS", 1 << 12)
    assert np.allclose(fit_yaws(points, count), whole, atol=1e-5)
