"""The tool that fits the weights of late fusion: known weights are found again, and pairs of a scene are told right from wrong."""

from __future__ import annotations

import sys
from dataclasses import astuple
from pathlib import Path

import numpy as np
import pytest
from worlds import tiny_toml

from log2sim.perception.lidar.measure import PAIR_WEIGHTS, PairWeights

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from fits import late_fusion as fit_late_fusion

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("weights", [PairWeights(-1.0, 0.5, 1.4, 3.0), PairWeights(-3.0, 1.2, 0.8, 6.0)])
def test_weights_are_found_again_from_many_pairs(weights: PairWeights) -> None:
    rng = np.random.default_rng(5)
    x = np.column_stack([
        np.ones(20_000), rng.normal(0, 1.5, (20_000, 2)), rng.uniform(0.3, 1.0, 20_000),
    ])  # fmt: skip
    right = rng.random(20_000) < 1 / (1 + np.exp(-x @ np.array(astuple(weights))))
    error = np.abs(fit_late_fusion.fit(x, right) - astuple(weights))
    assert (error < [0.5, 0.1, 0.1, 0.6]).all()


def test_without_pairs_the_weights_stay_those_of_independent_evidence() -> None:
    found = fit_late_fusion.fit(np.zeros((0, 4)), np.zeros(0, dtype=bool))
    np.testing.assert_allclose(found, astuple(PAIR_WEIGHTS), atol=1e-6)


def test_pairs_of_labels_are_right(tmp_path: Path) -> None:
    scene = tmp_path / "tiny.toml"
    scene.write_text(tiny_toml(), encoding="utf-8")
    x, right = fit_late_fusion.pairs_of(scene, "labels", "lidar:labels", 1)
    assert len(x) > 15
    assert right.mean() > 0.95
    assert (x[:, 3] > 0.3).all()
