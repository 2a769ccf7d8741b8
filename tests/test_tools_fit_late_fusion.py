"""The tool that fits the weights of late fusion: known weights are found again, and pairs of a scene are told right from wrong."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from worlds import tiny_toml

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
from fits import late_fusion as fit_late_fusion

pytestmark = pytest.mark.slow


def test_pairs_of_labels_are_right(tmp_path: Path) -> None:
    scene = tmp_path / "tiny.toml"
    scene.write_text(tiny_toml(), encoding="utf-8")
    x, right = fit_late_fusion.pairs_of(scene, "labels", "lidar:labels", 1)
    assert len(x) > 15
    assert right.mean() > 0.95
    assert (x[:, 3] > 0.3).all()
