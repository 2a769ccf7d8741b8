"""Recorded logs with their own labels as detector: lower limits that a change must not fall below."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from log2sim import Config, open_log, reconstruct
from log2sim.errors import LogError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.files.documents import check

pytestmark = [pytest.mark.slow, pytest.mark.real]


def figures(path: Path, *, max_range_m: float, categories: tuple[str, ...]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics and report of a reconstruction from the log's own boxes."""
    log = open_log(path)
    result = reconstruct(log, Config.load(detect={"name": "labels"}))
    check(result.report, "report-1", LogError)
    used = [str(c["name"]) for c in result.scenario.cameras if c["used"]]
    found = evaluate(result.scenario, truth_from_log(log, cameras=used), max_range_m=max_range_m, categories=categories)
    return found, result.report


def test_pandaset_with_six_cameras(real_data: Path) -> None:
    found, report = figures(real_data / "pandaset/002", max_range_m=30.0, categories=("vehicle",))
    assert found["recall"] >= 0.9
    assert found["precision"] >= 0.8
    assert found["position_median_m"] <= 0.35
    assert found["id_switches"] <= 1
    assert found["ego"]["position_rmse_m"] <= 0.05
    assert len(report["detections"]) == 6
    assert report["unreadable"] == {}


def test_kitti_tracking(real_data: Path) -> None:
    found, report = figures(real_data / "kitti_tracking", max_range_m=30.0, categories=("vehicle",))
    assert found["recall"] >= 0.9
    assert found["precision"] >= 0.9
    assert found["position_median_m"] <= 0.4
    assert report["unreadable"] == {}
