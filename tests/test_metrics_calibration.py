"""Calibration of confidences and sigmas: closed forms, and draws from what they claim."""

from __future__ import annotations

import numpy as np
import pytest

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


def test_what_is_right_as_often_as_it_claims_is_calibrated():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(size=100_000)
    calibrated = reliability(confidence, rng.uniform(size=100_000) < confidence)
    assert calibrated["expected_calibration_error"] < 0.01
    overconfident = reliability(confidence, rng.uniform(size=100_000) < confidence**2)
    # The integral of c - c^2 over 0 to 1.
    assert overconfident["expected_calibration_error"] == pytest.approx(1 / 6, abs=0.01)


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_errors_drawn_from_their_sigma_have_a_nees_of_one(factor):
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.05, 2.0, size=50_000)
    found = normalized_errors(factor * sigma[:, None] * rng.normal(size=(50_000, 2)), sigma)
    assert found["nees"] == pytest.approx(factor**2, rel=0.03)
    assert found["median"] == pytest.approx(np.log(2) * factor**2, rel=0.03)
    # A Rayleigh distribution: P(r < R) = 1 - exp(-R^2 / 2).
    assert found["within_95"] == pytest.approx(1 - 0.05 ** (1 / factor**2), abs=0.01)
