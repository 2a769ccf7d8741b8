"""Poses on the command line: reconstruct, detect and evaluate with those of the log and with others."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from command_line import run
from localization_worlds import BEND, HOUSES, LIDAR, drive

from log2sim import Scenario
from log2sim.errors import LogError
from log2sim.files.documents import check
from log2sim.logs.native.writer import write_log

SPARSE = {**LIDAR, "channels": 16, "azimuth_step_deg": 2.0}


@pytest.fixture(scope="module")
def noisy(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive whose GNSS is off by 0.4 m, with labels."""
    log, _ = drive(HOUSES, BEND, duration_s=1.2, sigma_m=0.4, angle_deg=0.3, seed=3, lidars=[SPARSE], observe=True)
    folder = tmp_path_factory.mktemp("noisy") / "drive"
    write_log(log, folder)
    return folder


@pytest.fixture(scope="module")
def by_lidar(noisy: Path) -> Path:
    out = noisy.parent / "lidar.json"
    ran = run(
        "reconstruct", noisy, "--detector", "lidar:labels", "--poses", "lidar", "--out", out, "--report",
        noisy.parent / "report.json",
    )  # fmt: skip
    assert ran.code == 0, ran.err
    assert "poses: lidar (as requested)\n" in ran.out
    return out


def test_the_report_says_where_the_poses_come_from(noisy: Path, by_lidar: Path) -> None:
    report = json.loads((noisy.parent / "report.json").read_text())
    check(report, "report-1", LogError)
    assert report["poses"]["source"] == "lidar"
    assert report["poses"]["estimate"]["lidar"] == "top"
    assert report["poses"]["estimate"]["poses"] == 12
    assert Scenario.load(by_lidar).ego.quality["source"] == "LiDAR odometry"


def test_evaluate_places_the_labels_by_the_poses_of_the_scenario(noisy: Path, by_lidar: Path) -> None:
    out = noisy.parent / "metrics.json"
    assert run("evaluate", by_lidar, "--truth", noisy, "--out", out, "--overwrite").code == 0
    same = json.loads(out.read_text())
    assert run("evaluate", by_lidar, "--truth", noisy, "--poses", "given", "--out", out, "--overwrite").code == 0
    other = json.loads(out.read_text())
    assert same["ego"]["position_rmse_m"] < 0.1 < other["ego"]["position_rmse_m"]
