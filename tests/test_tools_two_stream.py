"""The fusion paper's two-stream network: maps, anchors in both inputs, crops, loss, boxes, comparison on pairs."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import torch
from lidar_training import fitting, real_logs, two_stream
from lidar_training.two_stream import Pair, pair_of

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Camera, project_boxes, rotation_from_rpy, transform
from log2sim.perception.lidar.cloud import Cloud

# Threads that wait for a busy core are slower than one.
torch.set_num_threads(1)

K = np.array([[300.0, 0, 300], [0, 300.0, 90], [0, 0, 1]])
SIZE_PX = (180, 600)
# x, y, height of the center, length, width, height, heading, in a frame that looks along x.
BOXES = np.array([[12.2, 2.1, 0.8, 4.4, 1.8, 1.6, 0.2], [20.0, -4.0, 0.8, 4.6, 1.9, 1.6, 1.5], [9.0, -2.0, 0.86, 0.7, 0.6, 1.72, 0.0]])  # fmt: skip
NAMES = ["car", "car", "pedestrian"]
SLOPE = 0.02


def world(yaw: float = 0.6) -> tuple[real_logs.LogSweep, np.ndarray, np.ndarray]:
    """A sweep on a slope, a picture, and the pose of a camera that looks along `yaw`."""
    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(0, 40, 9000), rng.uniform(-15, 15, 9000), rng.normal(0, 0.01, 9000)])
    parts, image = [flat], np.full((*SIZE_PX, 3), 90, np.uint8)
    for x, y, z, length, width, height, turn in BOXES:
        p = rng.uniform(-0.5, 0.5, (300, 3)) * (length, width, height)
        c, s = np.cos(turn), np.sin(turn)
        parts.append(np.column_stack([x + p[:, 0] * c - p[:, 1] * s, y + p[:, 0] * s + p[:, 1] * c, z + p[:, 2]]))
    height = np.concatenate(parts)[:, 2].astype(np.float32)
    xyz = np.concatenate(parts) + np.concatenate(parts)[:, :1] * [0, 0, SLOPE]
    turn = rotation_from_rpy(0, 0, yaw)
    origin = np.array([50.0, -20.0, 3.0])
    cloud = Cloud(
        7, origin, (xyz @ turn.T).astype(np.float32), np.zeros(len(xyz), np.float32),
        np.array([0, 0, 1.7], np.float32), height < 0.1, height,
    )  # fmt: skip
    rows = BOXES.copy()
    rows[:, 2] += SLOPE * rows[:, 0]
    rows[:, :3] = rows[:, :3] @ turn.T
    rows[:, 6] += yaw
    truth = SceneBoxes.of(rows, NAMES, points=np.full(len(rows), 300))
    cam = turn @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    for k in range(len(BOXES)):
        u0, v0, u1, v1 = _outline(rows[k], transform(cam, [0, 0, 1.6])).astype(int)
        image[max(v0, 0) : v1, max(u0, 0) : u1] = (250, 40 * k, 30)
    return real_logs.LogSweep(cloud, truth, ()), image, transform(cam, origin + np.array([0, 0, 1.6]))


def _outline(box: np.ndarray, cloud_T_cam: np.ndarray) -> np.ndarray:
    camera = Camera("c", SIZE_PX[1], SIZE_PX[0], K, "map", np.eye(4))
    return project_boxes(box[None, :3], box[None, 3:6], box[6:7], camera, np.linalg.inv(cloud_T_cam)).box_px[0]


@pytest.fixture(scope="module")
def pair() -> Pair:
    sweep, image, map_T_cam = world()
    return pair_of(sweep, image, K, map_T_cam)


@pytest.mark.slow
def test_a_toy_learns_one_pair_is_exported_and_finds_its_objects(pair: Pair, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = two_stream.TwoStream(((8, 1), (16, 1)))
    batch = two_stream.Batch.of(two_stream.inputs_of(pair))
    losses: list[float] = []

    def step(n: Any, rng: np.random.Generator, _: int) -> Any:
        loss, parts = two_stream.loss_of_anchors(*batch.run(n), batch)
        losses.append(float(loss.detach()))
        return loss, parts

    fitting.fit(network, step, fitting.FitPlan(70, peak_rate=5e-3))
    assert losses[-1] < 0.1 * losses[0]
    two_stream.export_two_stream(network, tmp_path / "two.onnx")
    search = two_stream.TwoStreamDetector.open(tmp_path / "two.onnx")
    found = search(pair)
    best = found.take(np.argsort(-found.score)[: len(NAMES)])
    assert sorted(best.category.tolist()) == sorted(NAMES)
    row = two_stream.compare({"toy": search}, [pair])["toy"]
    assert row["car"]["IoU BEV > 0.5"] == 1.0
    assert row["car"]["truths"] == 2
