"""CLEAR MOT and HOTA against second implementations, closed forms and invariances."""

from __future__ import annotations

import warnings

import numpy as np
import pytest

from log2sim.evaluation.metrics.comparison import associate, mota, near_pairs, switches
from log2sim.evaluation.metrics.correctness import normalized_errors, reliability
from log2sim.evaluation.metrics.evaluator import hota


def random_tracks(seed, truths=8, others=9, ticks=40, arena_m=14.0):
    """Crossing tracks with losses, noise, swaps of identity and clutter; NaN where an agent is not there."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(0, arena_m, (truths, 1, 2)), rng.normal(0, 0.25, (truths, 1, 2))
    truth = start + velocity * np.arange(ticks)[None, :, None]
    other = np.full((others, ticks, 2), np.nan)
    who = np.arange(truths)
    for t in range(ticks):
        if rng.random() < 0.15:
            i, j = rng.choice(truths, 2, replace=False)
            who[[i, j]] = who[[j, i]]
        other[who, t] = truth[:, t] + rng.normal(0, 0.5, (truths, 2))
    other[truths:] = rng.uniform(0, arena_m, (others - truths, ticks, 2))
    truth[rng.random((truths, ticks)) < 0.15] = np.nan
    other[rng.random((others, ticks)) < 0.2] = np.nan
    return truth, other


def pairs_of(truth, other):
    same = np.ones((len(truth), len(other)), dtype=bool)
    return near_pairs(truth, other, np.full(len(truth), 2.0), same)


def there(xy):
    return np.isfinite(xy[..., 0])


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(5))
def test_counts_equal_those_of_motmetrics(seed):
    motmetrics = pytest.importorskip("motmetrics")
    # Sparse enough that no two truth agents claim the same past match: motmetrics then goes by row, we by distance.
    truth, other = random_tracks(seed, arena_m=25.0)
    accumulator = motmetrics.MOTAccumulator(auto_id=True)
    for t in range(truth.shape[1]):
        a, b = np.flatnonzero(there(truth)[:, t]), np.flatnonzero(there(other)[:, t])
        distance = np.linalg.norm(truth[a, None, t] - other[None, b, t], axis=-1)
        accumulator.update(a, b, np.where(distance <= 2.0, distance, np.nan))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        names = ["num_misses", "num_false_positives", "num_switches", "mota"]
        expected = motmetrics.metrics.create().compute(accumulator, metrics=names).iloc[0]
    match, used, _ = associate(pairs_of(truth, other), len(truth), len(other), truth.shape[1])
    missed = int((there(truth) & (match < 0)).sum())
    false = int((there(other) & ~used).sum())
    switched = int(switches(match, there(truth)).sum())
    assert (missed, false, switched) == tuple(int(expected[k]) for k in names[:3])
    assert switched > 3
    assert mota(int(there(truth).sum()), missed, false, switched) == pytest.approx(expected["mota"], abs=1e-12)


def test_hota_matches_the_identity_that_is_right_most_often_though_another_is_nearer():
    """One object for ten ticks: x is 1.2 m off for the first seven, y 0.2 m for two more, and both are there at the last."""
    x, y = np.full((2, 10), np.nan)
    x[[*range(7), 9]], y[7:] = 1.2, 0.2
    other = np.stack([np.stack([x, 0 * x], axis=-1), np.stack([y, 0 * y], axis=-1)])
    truth = np.zeros((1, 10, 2))
    found = hota(pairs_of(truth, other), there(truth), there(other))
    # Similarities are 0.4 and 0.9. At 8 of the 19 thresholds x has 8 ticks of 10 and y 2 of the 11 of it or the object; at
    # the next 10 y is left.
    of_x, of_y = 8 / 10, 2 / 11
    low, high = (8 * of_x + 2 * of_y) / 10, of_y
    assert found["ass_a"] == pytest.approx((8 * low + 10 * high) / 19)
    assert found["det_a"] == pytest.approx((8 * 10 / 11 + 10 * 2 / 19) / 19)
    assert found["hota"] == pytest.approx((8 * np.sqrt(low * 10 / 11) + 10 * np.sqrt(high * 2 / 19)) / 19)


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


def test_right_confidences_have_the_calibration_error_that_is_said_to_be_by_chance():
    rng = np.random.default_rng(0)
    confidence = rng.uniform(0, 1, 240) ** 0.5
    tables = [reliability(confidence, rng.random(240) < confidence) for _ in range(300)]
    found = np.mean([t["expected_calibration_error"] for t in tables])
    assert found == pytest.approx(tables[0]["error_by_chance"], rel=0.05)
    assert found > 0.03


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_errors_drawn_from_their_sigma_have_a_nees_of_one(factor):
    rng = np.random.default_rng(1)
    sigma = rng.uniform(0.05, 2.0, size=50_000)
    found = normalized_errors(factor * sigma[:, None] * rng.normal(size=(50_000, 2)), sigma)
    assert found["nees"] == pytest.approx(factor**2, rel=0.03)
    assert found["median"] == pytest.approx(np.log(2) * factor**2, rel=0.03)
    # A Rayleigh distribution: P(r < R) = 1 - exp(-R^2 / 2).
    assert found["within_95"] == pytest.approx(1 - 0.05 ** (1 / factor**2), abs=0.01)
