"""Training of the LiDAR detector: samples, targets, loss, and a toy from scenes to a file that detects."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import pytest

pytest.importorskip("onnx", reason="needs the extra 'train'")

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import train_lidar  # noqa: E402


@pytest.mark.slow
def test_a_toy_learns_to_find_vehicles(tmp_path) -> None:
    """A minute from nothing: what it finds on fresh scenes is mostly right."""
    train_lidar.generate("roadside", tmp_path / "data", 100, 5)
    train_lidar.fit("roadside", tmp_path / "data", tmp_path, [train_lidar.Round(5, 100, 420)])
    train_lidar.finish("roadside", tmp_path, [train_lidar.Round(5, 100, 420)], examples=12)
    card = json.loads((tmp_path / "roadside.json").read_text())
    assert card["simulated"]["vehicle"]["average_precision"] > 0.15
    assert (tmp_path / "roadside.onnx").stat().st_size < 1_000_000
