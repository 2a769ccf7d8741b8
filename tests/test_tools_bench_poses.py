"""tools/bench.py poses: figures against closed forms, and its table of a log."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest
from localization_worlds import BEND, HOUSES, LIDAR, drive

from log2sim.logs.native.writer import write_log

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from benchmarks import poses as bench_poses


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
