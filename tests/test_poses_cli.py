"""Poses on the command line: reconstruct, detect and evaluate with those of the log and with others."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import run
from localization_worlds import BEND, HOUSES, LIDAR, drive

from log2sim import Scenario, open_log
from log2sim.datatypes import Lidar
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.detection.boxes import DetectedBoxes
from log2sim.files.documents import check
from log2sim.localization import choice
from log2sim.localization.choice import localize_like
from log2sim.logs.native.writer import write_log
from log2sim.perception.lidar.cloud import cloud_origin

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


def test_a_truth_in_a_map_of_its_own_is_pointed_out(noisy: Path, by_lidar: Path, tmp_path: Path) -> None:
    truth = tmp_path / "truth.json"
    truth.write_bytes(by_lidar.read_bytes())
    assert "note: the scenario's poses are estimated (lidar), " in run("evaluate", by_lidar, "--truth", truth).out
    assert "note: " not in run("evaluate", by_lidar, "--truth", noisy).out


@pytest.mark.slow
def test_boxes_say_by_which_poses_they_are_placed(noisy: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    boxes = noisy.parent / "boxes.json"
    assert run("detect", noisy, "--detector", "lidar:labels", "--poses", "lidar", "--out", boxes).code == 0
    found = DetectedBoxes.load(boxes)
    assert found.poses == {"source": "lidar"}
    log = localize_like(open_log(noisy), {"poses": found.poses})
    centers = np.concatenate([b.center_m for b in found.boxes])
    assert (
        nearest_m(centers, log.labels.center_m).max() < 0.05 < nearest_m(centers, open_log(noisy).labels.center_m).max()
    )
    asked = []
    monkeypatch.setattr(choice, "localize_like", lambda log, made: asked.append(made) or localize_like(log, made))
    assert run("evaluate", boxes, "--truth", noisy).code == 0
    assert run("evaluate", boxes, "--truth", noisy, "--poses", "given").code == 0
    assert asked == [{"poses": {"source": "lidar"}}, {"poses": {"source": "given"}}]


def nearest_m(points: np.ndarray, others: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points[:, None] - others[None], axis=2).min(axis=1)


@pytest.mark.slow
def test_a_log_without_poses_needs_no_option(noisy: Path, tmp_path: Path) -> None:
    write_log(replace(open_log(noisy), ego=None, labels=None), tmp_path / "log")
    assert open_log(tmp_path / "log").ego is None
    ran = run("reconstruct", tmp_path / "log", "--detector", "lidar:vehicle", "--out", tmp_path / "s.json")
    assert ran.code == 0, ran.err
    assert "poses: lidar (the log has no poses)\n" in ran.out


@pytest.mark.parametrize("command", ["reconstruct", "detect"])
def test_unknown_poses_are_one_line(command: str, noisy: Path, tmp_path: Path) -> None:
    ran = run(command, noisy, "--poses", "gps", "--out", tmp_path / "x.json")
    assert ran.code == ConfigError.exit_code
    assert "poses" in ran.line


def test_unknown_poses_of_evaluate_are_one_line(noisy: Path, by_lidar: Path) -> None:
    ran = run("evaluate", by_lidar, "--truth", noisy, "--poses", "gps")
    assert ran.code == ConfigError.exit_code
    assert ran.line == "log2sim: --poses gps: expected given, lidar, camera, auto"


def test_a_sensor_without_a_pose_does_not_move_the_middle_of_the_others() -> None:
    log, _ = drive([], BEND, duration_s=0.3, lidars=[SPARSE])
    fixed = {"pole": Lidar("pole", "map", np.diag([1.0, 1.0, 1.0, 1.0]) + np.eye(4, k=3) * 100)}
    assert cloud_origin(type(log)("x", "y", {}, {**log.lidars, **fixed}, {}), 0)[0][0] == 100.0
