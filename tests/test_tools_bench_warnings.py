"""Warnings in labeled drives: the figures, and the scenarios that are made of KITTI's labels."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tools"))

from benchmarks import warnings as bench_warnings  # noqa: E402

pytestmark = pytest.mark.slow

FRAMES, SPEED_MPS = 30, 10.0
CALIBRATION = """P2: 700 0 600 0 0 700 180 0 0 0 1 0
R_rect 1 0 0 0 1 0 0 0 1
Tr_velo_cam 0 -1 0 0 0 0 -1 0 1 0 0 0
Tr_imu_velo 1 0 0 0 0 1 0 0 0 0 1 0
"""


@pytest.fixture
def drive(tmp_path: Path) -> Path:
    """The ego goes north at 10 m/s; a car drives 20 m before its camera and 3 m to the left, one stands on the right."""
    motion, labels = [], []
    for k in range(FRAMES):
        y = SPEED_MPS * 0.1 * k
        motion.append(f"{0.1 * k} 100 {y} 1.65 0 0 {np.sqrt(0.5)} {np.sqrt(0.5)}")
        labels.append(f"{k} 1 Car 0 0 0 0 0 0 0 1.5 1.8 4.4 -3 1.65 20 {-np.pi / 2}")
        labels.append(f"{k} 2 Van 0 0 0 0 0 0 0 2.0 1.9 5.0 6 1.65 {50 - y} {-np.pi / 2}")
        labels.append(f"{k} -1 DontCare -1 -1 -10 0 0 9 9 -1 -1 -1 -1000 -1000 -1000 -10")
    for name, lines in {"ego_motion": motion, "label_02": labels}.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / "0003.txt").write_text("\n".join(lines) + "\n")
    (tmp_path / "calib").mkdir()
    (tmp_path / "calib" / "0003.txt").write_text(CALIBRATION)
    return tmp_path


def test_the_figures_count_warnings_a_minute(
    drive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "argv", ["bench_warnings.py", str(drive)])
    bench_warnings.main()
    out = capsys.readouterr().out
    assert "0003" in out
    assert "3 s driven: 0 warnings, 0.00 a minute" in out
