"""The roadside paper's method: channels, targets, network, losses, layout for decoding by votes, boxes around clusters, table."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import torch
from lidar_training.clouds import CATEGORIES, Sample, write_shard

from log2sim.perception.detect3d.network import load_network

# Threads that wait for a busy core are slower than one.
torch.set_num_threads(1)

BOXES = np.array(
    [[4.0, 3.0, 0.8, 4.5, 1.8, 1.6, 0.4], [-6.0, 5.0, 1.6, 9.0, 2.5, 3.2, -2.0], [2.0, -5.0, 0.86, 0.6, 0.6, 1.72, 1.0],
     [-5.0, -6.0, 0.8, 1.8, 0.7, 1.6, 2.8]]
)  # fmt: skip
NAMES = ("car", "truck", "pedestrian", "cyclist")


def solid_points(rng: np.random.Generator, per_box: int = 1500) -> np.ndarray:
    """Points in all boxes and on the ground around them."""
    parts = [np.column_stack([rng.uniform(-11.9, 11.9, (6000, 2)), rng.normal(0, 0.02, 6000)])]
    for x, y, z_m, length, width, height, yaw in BOXES:
        p = rng.uniform(-0.5, 0.5, (per_box, 3)) * (length, width, height)
        c, s = np.cos(yaw), np.sin(yaw)
        parts.append(np.column_stack([x + p[:, 0] * c - p[:, 1] * s, y + p[:, 0] * s + p[:, 1] * c, z_m + p[:, 2]]))
    return np.concatenate(parts).astype(np.float32)


@pytest.fixture(scope="module")
def sample() -> Sample:
    category = np.array([CATEGORIES.index(n) for n in NAMES], np.int64)
    return Sample(solid_points(np.random.default_rng(0)), BOXES.astype(np.float32), category, np.full(4, 1500))


@pytest.mark.slow
def test_one_command_trains_from_shards_and_exports(sample: Sample, tmp_path: Path) -> None:
    from lidar_training import zou2021

    (tmp_path / "data").mkdir()
    write_shard(tmp_path / "data" / "roadside-1-0000.npz", [sample, sample])
    path = zou2021.train([tmp_path / "data"], tmp_path / "out", steps=2, seed=1, start=None, share=0.1)
    info = load_network(path).info
    assert info.card == {"steps": 2, "seed": 1, "share": 0.1, "samples": 2}
    assert info.stride == 1
    assert (tmp_path / "out" / "checkpoint.pt").exists()
