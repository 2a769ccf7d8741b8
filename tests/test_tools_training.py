"""Toys of the networks that tools train: they learn, are exported and detect."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Camera, project_boxes, rotation_from_rpy, transform
from log2sim.perception.detect3d.network import load_network
from log2sim.perception.lidar.cloud import Cloud

torch = pytest.importorskip("torch", reason="needs the extra 'train'")
pytest.importorskip("onnx", reason="needs the extra 'train'")

import train_lidar  # noqa: E402
from lidar_training import fitting, real_logs, two_stream  # noqa: E402
from lidar_training import two_stream_boxes as boxes_of  # noqa: E402
from lidar_training import two_stream_inputs as inputs  # noqa: E402
from lidar_training.pairs import Pair, pair_of  # noqa: E402
from lidar_training.samples import CATEGORIES, Sample, write_shard  # noqa: E402

# Threads that wait for a busy core are slower than one.
torch.set_num_threads(1)


@pytest.mark.slow
def test_a_toy_learns_to_find_vehicles(tmp_path) -> None:
    """A minute from nothing: what it finds on fresh scenes is mostly right."""
    train_lidar.generate("roadside", tmp_path / "data", 100, 5)
    train_lidar.fit("roadside", tmp_path / "data", tmp_path, [train_lidar.Round(5, 100, 420)])
    train_lidar.finish("roadside", tmp_path, [train_lidar.Round(5, 100, 420)], examples=12)
    card = json.loads((tmp_path / "roadside.json").read_text())
    assert card["simulated"]["vehicle"]["average_precision"] > 0.15
    assert (tmp_path / "roadside.onnx").stat().st_size < 1_000_000


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
    batch = two_stream.Batch.of(inputs.inputs_of(pair))
    losses: list[float] = []

    def step(n: Any, rng: np.random.Generator, _: int) -> Any:
        loss, parts = two_stream.loss_of_anchors(*batch.run(n), batch)
        losses.append(float(loss.detach()))
        return loss, parts

    fitting.fit(network, step, fitting.FitPlan(70, peak_rate=5e-3))
    assert losses[-1] < 0.1 * losses[0]
    boxes_of.export_two_stream(network, tmp_path / "two.onnx")
    search = boxes_of.TwoStreamDetector.open(tmp_path / "two.onnx")
    found = search(pair)
    best = found.take(np.argsort(-found.score)[: len(NAMES)])
    assert sorted(best.category.tolist()) == sorted(NAMES)
    row = boxes_of.compare({"toy": search}, [pair])["toy"]
    assert row["car"]["IoU BEV > 0.5"] == 1.0
    assert row["car"]["truths"] == 2


BOXES_ZOU2021 = np.array(
    [[4.0, 3.0, 0.8, 4.5, 1.8, 1.6, 0.4], [-6.0, 5.0, 1.6, 9.0, 2.5, 3.2, -2.0], [2.0, -5.0, 0.86, 0.6, 0.6, 1.72, 1.0],
     [-5.0, -6.0, 0.8, 1.8, 0.7, 1.6, 2.8]]
)  # fmt: skip


NAMES_ZOU2021 = ("car", "truck", "pedestrian", "cyclist")


def solid_points(rng: np.random.Generator, per_box: int = 1500) -> np.ndarray:
    """Points in all boxes and on the ground around them."""
    parts = [np.column_stack([rng.uniform(-11.9, 11.9, (6000, 2)), rng.normal(0, 0.02, 6000)])]
    for x, y, z_m, length, width, height, yaw in BOXES_ZOU2021:
        p = rng.uniform(-0.5, 0.5, (per_box, 3)) * (length, width, height)
        c, s = np.cos(yaw), np.sin(yaw)
        parts.append(np.column_stack([x + p[:, 0] * c - p[:, 1] * s, y + p[:, 0] * s + p[:, 1] * c, z_m + p[:, 2]]))
    return np.concatenate(parts).astype(np.float32)


@pytest.fixture(scope="module")
def sample() -> Sample:
    category = np.array([CATEGORIES.index(n) for n in NAMES_ZOU2021], np.int64)
    return Sample(solid_points(np.random.default_rng(0)), BOXES_ZOU2021.astype(np.float32), category, np.full(4, 1500))


@pytest.mark.slow
def test_one_command_trains_from_shards_and_exports(sample: Sample, tmp_path: Path) -> None:
    import train_zou2021

    (tmp_path / "data").mkdir()
    write_shard(tmp_path / "data" / "roadside-1-0000.npz", [sample, sample])
    path = train_zou2021.train([tmp_path / "data"], tmp_path / "out", steps=2, seed=1, start=None, share=0.1)
    info = load_network(path).info
    assert info.card == {"steps": 2, "seed": 1, "share": 0.1, "samples": 2}
    assert info.stride == 1
    assert (tmp_path / "out" / "checkpoint.pt").exists()
