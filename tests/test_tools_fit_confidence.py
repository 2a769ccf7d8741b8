"""The tool that fits confidence: known weights are found again, signs are kept, and simulated detectors err as they should."""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from fits import confidence as fit_confidence
from fits import confidence_logs

from log2sim.datatypes import Frame

pytestmark = pytest.mark.slow


def test_weights_are_found_again_from_many_agents():
    rng = np.random.default_rng(3)
    x, true = rng.normal(0, [1.0, 2.0, 0.5], (20_000, 3)), np.array([0.8, -0.4, 0.0])
    right = rng.random(len(x)) < 1 / (1 + np.exp(-(0.3 + x @ true)))
    bias, weights = fit_confidence.fit_weights(x, right.astype(float), np.ones(len(x)), [1, -1, 0])
    np.testing.assert_allclose([bias, *weights], [0.3, *true], atol=0.08)


def test_a_weight_against_its_reason_is_zero():
    rng = np.random.default_rng(4)
    x = rng.normal(size=(2000, 2))
    right = rng.random(len(x)) < 1 / (1 + np.exp(-(x @ [1.0, 1.0])))
    _, weights = fit_confidence.fit_weights(x, right.astype(float), np.ones(len(x)), [1, -1])
    assert weights[0] > 0.5
    assert weights[1] == 0


def test_weights_of_variances_are_found_again_and_make_the_normalized_error_one():
    rng = np.random.default_rng(5)
    terms = rng.gamma(1.0, 1.0, (50_000, 3)) * [0.01, 1.0, 20.0]
    true = np.array([2.0, 0.05, 1e-7])
    squared = terms @ true * rng.normal(size=len(terms)) ** 2
    found = fit_confidence.fit_variances(terms, squared, np.full(3, 1e-7))
    np.testing.assert_allclose(found[:2], true[:2], rtol=0.15)
    assert np.mean(squared / (terms @ found)) == pytest.approx(1.0, abs=0.03)
    assert fit_confidence.fit_variances(terms, squared, np.array([3.0, 1e-7, 1e-7]))[0] >= 3.0


@pytest.mark.slow
def test_agents_of_a_synthetic_log_are_rated_and_its_detector_errs(tmp_path):
    log, scene = confidence_logs.make_log(1, 8)
    detector = confidence_logs.SimulatedDetector(log, scene, 3)
    camera, stamp = log.cameras["camera"], int(log.streams["camera"].t_ns[3])
    frame = Frame(camera, stamp, lambda: np.zeros((camera.height_px, camera.width_px, 3), np.uint8))
    one, two = detector.detect(frame), detector.detect(frame)
    np.testing.assert_array_equal(one.box_px, two.box_px)
    assert len(one)
    assert one.score.min() >= confidence_logs.MIN_SCORE
    cases = pickle.loads(pickle.dumps(confidence_logs.cases_of(1, 8)))
    agents = [agent for case in cases for agent in fit_confidence.agents_of(case)]
    assert [sum(a.lidar == lidar for a in agents) > 3 for lidar in (True, False)] == [True, True]
    assert all(0 <= a.right <= 1 and a.ticks > 0 for a in agents)
    x = fit_confidence.matrix_of(agents)
    assert np.isfinite(x).all()
    tables, by_kind = fit_confidence.fit_all(agents)
    p = fit_confidence.probabilities(agents, tables)
    assert ((p > 0) & (p < 1)).all()
    assert set(by_kind) == {"position", "yaw", "speed"}
