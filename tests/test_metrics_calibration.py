"""Calibration of confidences and sigmas: closed forms, and draws from what they claim."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from log2sim.evaluation.metrics.correctness import normalized_errors, reliability


def test_the_calibration_error_of_two_bins_by_hand():
    confidence = np.array([0.25, 0.25, 0.25, 0.25, 0.95, 1.0])
    table = reliability(confidence, np.array([True, False, False, False, True, False]))
    assert table["count"] == 6
    # The first bin is right as often as it says; of the last, 0.975 on average, one of two is.
    assert table["expected_calibration_error"] == pytest.approx(2 / 6 * (0.975 - 0.5))
    low, high = table["bins"][2], table["bins"][9]
    assert (low["count"], low["mean_confidence"], low["right"]) == (4, 0.25, 0.25)
    assert (high["count"], high["mean_confidence"], high["right"]) == (2, 0.975, 0.5)
    assert [b["right"] for b in table["bins"]].count(None) == 8


def test_over_and_underconfidence_in_different_bins_do_not_cancel():
    confidence, right = np.array([0.1, 0.9]), np.array([True, False])
    assert reliability(confidence, right)["expected_calibration_error"] == pytest.approx(0.9)


def test_without_anything_there_is_no_error():
    table = reliability(np.zeros(0), np.zeros(0, dtype=bool))
    assert (table["count"], table["expected_calibration_error"]) == (0, None)
    nothing = normalized_errors(np.zeros((0, 2)), np.zeros(0))
    assert (nothing["count"], nothing["nees"], nothing["median"], nothing["within_95"]) == (0, None, None, None)


def test_what_is_right_as_often_as_it_claims_is_calibrated():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(size=100_000)
    calibrated = reliability(confidence, rng.uniform(size=100_000) < confidence)
    assert calibrated["expected_calibration_error"] < 0.01
    overconfident = reliability(confidence, rng.uniform(size=100_000) < confidence**2)
    # The integral of c - c^2 over 0 to 1.
    assert overconfident["expected_calibration_error"] == pytest.approx(1 / 6, abs=0.01)


@given(st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=40))
def test_the_error_is_a_share_and_every_row_is_in_one_bin(rows):
    confidence, right = np.array([c for c, _ in rows]), np.array([r for _, r in rows])
    table = reliability(confidence, right)
    assert 0 <= table["expected_calibration_error"] <= 1
    assert sum(b["count"] for b in table["bins"]) == len(rows) == table["count"]
    for b in table["bins"]:
        if b["count"]:
            assert b["low"] <= b["mean_confidence"] + 1e-9
            assert b["mean_confidence"] <= b["high"] + 1e-9
    # The bins' mean is at least the difference of the means of all.
    assert table["expected_calibration_error"] >= abs(confidence.mean() - right.mean()) - 1e-9


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_errors_drawn_from_their_sigma_have_a_nees_of_one(factor):
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.05, 2.0, size=50_000)
    found = normalized_errors(factor * sigma[:, None] * rng.normal(size=(50_000, 2)), sigma)
    assert found["nees"] == pytest.approx(factor**2, rel=0.03)
    assert found["median"] == pytest.approx(np.log(2) * factor**2, rel=0.03)
    # A Rayleigh distribution: P(r < R) = 1 - exp(-R^2 / 2).
    assert found["within_95"] == pytest.approx(1 - 0.05 ** (1 / factor**2), abs=0.01)


def test_a_sigma_of_zero_is_counted_apart():
    found = normalized_errors(np.array([[3.0, 4.0], [1.0, 0.0]]), np.array([5.0, 0.0]))
    assert (found["count"], found["without_sigma"], found["nees"]) == (1, 1, 0.5)


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_errors_along_one_axis_have_a_nees_of_one_too(factor):
    rng = np.random.default_rng(2)
    sigma = rng.uniform(0.01, 0.2, size=50_000)
    found = normalized_errors(factor * (sigma * rng.normal(size=50_000))[:, None], sigma)
    assert found["nees"] == pytest.approx(factor**2, rel=0.03)
    # The square of the median of |x| for a standard normal x, and P(|x| < 1.96 / factor).
    assert found["median"] == pytest.approx(0.6745**2 * factor**2, rel=0.04)
    assert found["within_95"] == pytest.approx({0.5: 0.99991, 2.0: 0.6729}[factor], abs=0.01)


def test_errors_that_do_not_count_and_sigmas_that_are_unknown_are_in_no_figure():
    found = normalized_errors(np.array([[np.nan], [1.0], [1.0]]), np.array([1.0, np.nan, 2.0]))
    assert (found["count"], found["without_sigma"], found["nees"]) == (1, 1, 0.25)
