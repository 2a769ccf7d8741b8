"""tools/bench.py poses: figures against closed forms, and its table of a log."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from localization_worlds import BEND, HOUSES, LIDAR, drive

from log2sim.datatypes import Labels
from log2sim.geometry import PoseTrack, rotation_from_rpy, transform
from log2sim.logs.native.writer import write_log

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from benchmarks import poses as bench_poses


def straight(step_m: float, bend_rad: float = 0.0) -> PoseTrack:
    """Eleven poses a second apart, each turned by an angle against the one before."""
    motion = transform(rotation_from_rpy(0.0, 0.0, bend_rad), np.array([step_m, 0.0, 0.0]))
    poses = [np.eye(4)]
    for _ in range(10):
        poses.append(poses[-1] @ motion)
    return PoseTrack(np.arange(11, dtype=np.int64) * 10**9, np.stack(poses), max_gap_s=2.0)


def test_a_path_in_another_frame_has_no_error_but_where_it_is_placed() -> None:
    true = straight(1.0, 0.1)
    moved = transform(rotation_from_rpy(0.1, 0.0, 1.0), np.array([0.0, 5.0, 0.0])) @ true.map_T_ego
    errors = bench_poses.path_errors(PoseTrack(true.t_ns, moved), true)
    assert errors["ate_m"] == pytest.approx(0.0, abs=1e-9)
    assert errors["rpe_m"] == pytest.approx(0.0, abs=1e-9)
    assert errors["as_placed_m"] > 1.0


def test_a_path_that_is_too_long_by_a_tenth() -> None:
    errors = bench_poses.path_errors(straight(1.1), straight(1.0))
    assert errors["rpe_m"] == pytest.approx(0.1)
    assert errors["rpe_deg"] == pytest.approx(0.0, abs=1e-6)
    # Positions along the line are off by 0.1 k from the middle: the RMS of -0.5, -0.4 .. 0.5.
    assert errors["ate_m"] == pytest.approx(np.sqrt(np.mean((np.arange(-5, 6) * 0.1) ** 2)))


def test_scatter_is_of_labeled_vehicles_that_stand() -> None:
    rows = 20
    t_ns = np.tile(np.arange(rows, dtype=np.int64) * 10**8, 2)
    track = np.repeat(["a", "b"], rows)
    parked = np.column_stack([np.where(np.arange(rows) % 2, 0.1, -0.1), np.zeros(rows), np.zeros(rows)])
    driven = np.column_stack([np.arange(rows) * 0.5, np.zeros((rows, 2))])
    labels = Labels(
        t_ns,
        track,
        np.full(2 * rows, "car"),
        np.concatenate([parked, driven]),
        np.ones((2 * rows, 3)),
        np.zeros(2 * rows),
    )
    assert bench_poses.standing_vehicles({"given": labels}) == {"a": {"given": pytest.approx(0.1)}}


@pytest.mark.slow
def test_the_table_of_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    sparse = {**LIDAR, "channels": 16, "azimuth_step_deg": 2.0}
    log, _ = drive(HOUSES, BEND, duration_s=1.5, sigma_m=0.4, angle_deg=0.2, lidars=[sparse], observe=True)
    write_log(log, tmp_path / "log")
    out = tmp_path / "figures.json"
    monkeypatch.setattr(sys, "argv", ["bench_poses.py", str(tmp_path / "log"), "--every", "--out", str(out)])
    assert bench_poses.main() == 0
    figures = json.loads(out.read_text())
    assert figures["surfaces"]["lidar"]["apart_m"] < figures["surfaces"]["given"]["apart_m"]
    assert len(figures["parked"]) == 4
    printed = capsys.readouterr().out
    assert "auto takes lidar: upright surfaces differ in sweeps 0.7 s apart" in printed
    assert "4 of them were labeled once in the map of the given poses" in printed  # synthetic labels are exact


def test_a_log_that_cannot_be_opened_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_poses.py", str(tmp_path / "none")])
    assert bench_poses.main() == 3
    assert capsys.readouterr().err.startswith("bench_poses: ")
