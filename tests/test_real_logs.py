"""Recorded logs with their own labels as detector: lower limits that a change must not fall below."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from plain_settings import AGENTS_ALONE

from log2sim import Config, open_log, reconstruct
from log2sim.errors import LogError
from log2sim.evaluation.metrics.evaluator import evaluate
from log2sim.evaluation.metrics.truth import truth_from_log
from log2sim.files.documents import check
from log2sim.logs.excerpt import cut_log

pytestmark = [pytest.mark.slow, pytest.mark.real]


def figures(path: Path, **less: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Metrics of vehicles within 30 m, and report, of a reconstruction from the log's own boxes."""
    log = cut_log(open_log(path), stop_s=4.0)
    result = reconstruct(log, Config.load(detect={"name": "labels"}, **less))
    check(result.report, "report-1", LogError)
    used = [str(c["name"]) for c in result.scenario.cameras if c["used"]]
    found = evaluate(result.scenario, truth_from_log(log, cameras=used), max_range_m=30.0, categories=("vehicle",))
    return found, result.report


def test_pandaset_with_six_cameras(real_data: Path) -> None:
    found, report = figures(real_data / "pandaset/002", **AGENTS_ALONE)
    assert found["recall"] >= 0.9
    assert found["precision"] >= 0.8
    assert found["position_median_m"] <= 0.35
    assert found["id_switches"] <= 1
    assert found["ego"]["position_rmse_m"] <= 0.05
    assert len(report["detections"]) == 6
    assert report["unreadable"] == {}


def test_kitti_tracking(real_data: Path) -> None:
    found, report = figures(real_data / "kitti_tracking")
    assert found["recall"] >= 0.9
    assert found["precision"] >= 0.9
    assert found["position_median_m"] <= 0.4
    assert report["unreadable"] == {}
