"""Training of the LiDAR detector: samples, targets, loss, and a toy from scenes to a file that detects."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="needs the extra 'train'")
pytest.importorskip("onnx", reason="needs the extra 'train'")

TOOLS = Path(__file__).parents[1] / "tools"
sys.path.insert(0, str(TOOLS))

import train_lidar  # noqa: E402
from lidar_training import fitting  # noqa: E402
from lidar_training.clouds import (  # noqa: E402
    CATEGORIES,
    Sample,
    Shard,
    augmented,
    draw_example,
    draw_sample,
    grid_of,
    write_shard,
)
from lidar_training.export import calibrate, describe, description, export_onnx, logistic  # noqa: E402
from lidar_training.network import (  # noqa: E402
    BOX,
    CATEGORY,
    HEAT,
    OUT_CHANNELS,
    SEGMENT,
    VOTE,
    BevNetwork,
    loss_of,
    targets_of,
)

from log2sim.config import LidarConfig  # noqa: E402
from log2sim.errors import LogError  # noqa: E402
from log2sim.perception.detect3d.boxes import decode_centers  # noqa: E402
from log2sim.perception.detect3d.detectors import open_network  # noqa: E402
from log2sim.perception.detect3d.network import NetworkInfo  # noqa: E402
from log2sim.synth.traffic_data import TrafficSettings, write_traffic  # noqa: E402

CELLS, CELL_M = 128, 0.25
LOW = np.array([-16.0, -16.0])


def sample(*rows: tuple[float, float, float, str], points: int = 50) -> Sample:
    boxes = np.array([[x, y, 0.8, 4.5, 1.8, 1.6, yaw] for x, y, yaw, _ in rows], np.float32).reshape(-1, 7)
    return Sample(
        np.zeros((0, 3), np.float32),
        boxes,
        np.array([CATEGORIES.index(c) for *_, c in rows]),
        np.full(len(rows), points),
    )


def maps_of(targets) -> np.ndarray:
    """Return maps of a network that answers exactly what the targets ask for."""
    maps = np.zeros((OUT_CHANNELS, CELLS // 2, CELLS // 2), np.float32)
    # The detector averages boxes over neighbors of a peak; where no box is asked for, this network is sure of nothing.
    heat = targets.heat[0].numpy() * targets.regressed[0].numpy()
    maps[HEAT] = np.log(np.clip(heat, 1e-3, 0.999) / (1 - np.clip(heat, 1e-3, 0.999)))
    maps[BOX], maps[14:18] = targets.box[0, :6], targets.box[0, 6:]
    for code in range(5):
        maps[CATEGORY][code] = 10.0 * (targets.category[0] == code)
    return maps


def test_decoding_undoes_the_targets() -> None:
    rows = [
        (3.1, -4.2, 0.3, "car"),
        (-8.0, 6.5, 2.8, "truck"),
        (9.4, 9.1, -1.9, "cyclist"),
        (-2.0, -9.9, -3.0, "pedestrian"),
    ]
    truth = sample(*rows)
    info = NetworkInfo.model_validate(description("vehicle", CELL_M, 16.0))
    found = decode_centers(maps_of(targets_of([truth], [LOW], CELLS, CELL_M)), info, LOW)
    strong = found.take(found.heat > 5)
    assert len(strong) == len(rows)
    for row, (x, y, yaw, category) in zip(truth.boxes, rows, strict=True):
        k = int(np.argmin(np.hypot(strong.center_m[:, 0] - x, strong.center_m[:, 1] - y)))
        assert np.allclose(strong.center_m[k], row[:3], atol=1e-3)
        assert np.allclose(strong.size_m[k], row[3:6], rtol=1e-4)
        assert np.cos(strong.yaw_rad[k] - yaw) > 0.9999
        assert strong.category[k] == category


def test_an_object_with_few_points_is_neither_asked_for_nor_punished() -> None:
    targets = targets_of([sample((0, 0, 0, "car"), points=2)], [LOW], CELLS, CELL_M)
    assert targets.heat.max() == 0
    assert 0 < (targets.considered == 0).sum() < 100
    maps = torch.zeros(1, OUT_CHANNELS, 64, 64)
    grid = torch.zeros(1, 12, CELLS, CELLS)
    quiet, _ = loss_of(maps, targets, grid)
    loud = maps.clone()
    loud[0, 0][targets.considered[0, 0] == 0] = 8.0
    assert float(loss_of(loud, targets, grid)[0]) <= float(quiet)


def test_the_loss_of_right_answers_is_lowest() -> None:
    targets = targets_of([sample((3, -4, 0.3, "car"), (-8, 6, 2.8, "pedestrian"))], [LOW], CELLS, CELL_M)
    grid = torch.ones(1, 12, CELLS, CELLS)
    right = torch.from_numpy(maps_of(targets))[None]
    for group in range(4):
        right[0, SEGMENT][group] = 10.0 * (targets.segment[0] == group)
    right[0, VOTE] = targets.vote[0]
    right[0, 18] = 6.0
    best, parts = loss_of(right, targets, grid)
    assert parts["box"] == pytest.approx(0, abs=1e-6)
    for channel in (0, 8, 11, 14, 16, 20, 23):
        worse = right.clone()
        worse[0, channel] += 15.0 if channel == 20 else 1.5  # the focal loss forgives small doubts
        assert float(loss_of(worse, targets, grid)[0]) > float(best), channel


@pytest.mark.parametrize("seed", range(3))
def test_augmentation_moves_points_and_boxes_alike(seed: int) -> None:
    """Points on a box's corner stay there, turned, mirrored and all."""
    c, s = np.cos(0.7), np.sin(0.7)
    corner = np.array([[5 + 2.25 * c - 0.9 * s, 3 + 2.25 * s + 0.9 * c, 1.0]], np.float32).repeat(200, axis=0)
    truth = sample((5, 3, 0.7, "car"), points=200)
    out = augmented(replace(truth, xyz_m=corner), np.random.default_rng(seed))
    x, y, *_, yaw = out.boxes[0]
    dx, dy = out.xyz_m[0, 0] - x, out.xyz_m[0, 1] - y
    assert abs(dx * np.cos(yaw) + dy * np.sin(yaw) - 2.25) < 1e-3
    assert abs(abs(dy * np.cos(yaw) - dx * np.sin(yaw)) - 0.9) < 1e-3


def test_shards_keep_samples_to_half_a_step(tmp_path) -> None:
    samples = [draw_sample("roadside", (1, k)) for k in range(2)]
    write_shard(tmp_path / "s.npz", samples)
    shard = Shard(tmp_path / "s.npz")
    assert len(shard) == 2
    for a, b in zip(samples, (shard[0], shard[1]), strict=True):
        assert np.abs(a.xyz_m - b.xyz_m).max() <= 0.0026
        assert np.array_equal(a.boxes, b.boxes)
        assert np.array_equal(a.points, b.points)
    assert grid_of(shard[0], LOW, CELLS, CELL_M).shape == (12, CELLS, CELLS)


def test_a_calibration_of_known_odds_is_found() -> None:
    rng = np.random.default_rng(0)
    features = np.column_stack([np.ones(20_000), rng.normal(0, 2, (20_000, 4))])
    weights = np.array([-0.5, 0.8, 0.3, 0.2, -0.4])
    right = rng.random(20_000) < 1 / (1 + np.exp(-features @ weights))
    assert np.allclose(logistic(features, right), weights, atol=0.06)


def test_onnx_equals_torch_and_detects_nothing_untrained(tmp_path) -> None:
    torch.manual_seed(0)
    torch.save({"mean": BevNetwork().state_dict()}, tmp_path / "c.pt")
    path = tmp_path / "n.onnx"
    export_onnx(tmp_path / "c.pt", path, description("vehicle", CELL_M, 16.0))  # raises where they differ
    example = draw_example("vehicle", (4, 4))
    assert len(open_network(path, LidarConfig(min_score=0.3), name="x").detect(example.cloud)) == 0
    info = description("vehicle", CELL_M, 16.0)
    info["calibration"] = calibrate(path, [example])
    describe(path, info)
    assert open_network(path, LidarConfig(), name="x").network.info.calibration["vehicle"] == tuple(
        info["calibration"]["vehicle"]
    )


@pytest.mark.slow
def test_a_resumed_run_gives_the_weights_of_one_that_was_not_stopped(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(train_lidar, "PER_SHARD", 2)
    monkeypatch.setattr(train_lidar, "CELLS", {"roadside": 64})
    weights = []
    for name, stops in (("whole", (4,)), ("parts", (2, 4))):
        out = tmp_path / name
        train_lidar.generate("roadside", out / "data", 4, 3)
        for k, stop in enumerate(stops):
            # The learning rate follows the number of steps in all, so a stop is a failure in the middle.
            rounds = [train_lidar.Round(3, 4, 4)]
            if k + 1 < len(stops):
                with monkeypatch.context() as patched:
                    patched.setattr(fitting, "CHECKPOINT_S", -1.0)
                    real = train_lidar.batch_of
                    calls = iter(range(100))

                    def stopping(*arguments, real=real, calls=calls, stop=stop):
                        if next(calls) == stop:
                            raise KeyboardInterrupt
                        return real(*arguments)

                    patched.setattr(train_lidar, "batch_of", stopping)
                    with pytest.raises(KeyboardInterrupt):
                        train_lidar.fit("roadside", out / "data", out, rounds)
            else:
                train_lidar.fit("roadside", out / "data", out, rounds)
        weights.append(torch.load(out / "round-1.pt", weights_only=True)["network"])
    assert all(torch.equal(a, b) for a, b in zip(weights[0].values(), weights[1].values(), strict=True))


@pytest.mark.slow
def test_a_toy_learns_to_find_vehicles(tmp_path) -> None:
    """A minute from nothing: what it finds on fresh scenes is mostly right."""
    train_lidar.generate("roadside", tmp_path / "data", 100, 5)
    train_lidar.fit("roadside", tmp_path / "data", tmp_path, [train_lidar.Round(5, 100, 420)])
    train_lidar.finish("roadside", tmp_path, [train_lidar.Round(5, 100, 420)], examples=12)
    card = json.loads((tmp_path / "roadside.json").read_text())
    assert card["simulated"]["vehicle"]["average_precision"] > 0.15
    assert (tmp_path / "roadside.onnx").stat().st_size < 1_000_000


def test_labeled_logs_are_trained_on_and_their_last_sweeps_held_out(tmp_path, monkeypatch) -> None:
    settings = TrafficSettings("roadside", 2, seed=3, layout="log2sim", duration_s=1.0, pictures=False)
    write_traffic(settings, tmp_path / "logs")
    paths, held_out = train_lidar.read_own([tmp_path / "logs"], tmp_path / "data", every=1)
    shards = [Shard(path) for path in paths]
    assert [len(shard) for shard in shards] == [8, 8]
    assert len(held_out) == 4
    # The labels are those of the generated scenes: points are in them, on the ground's level.
    one = shards[0][0]
    k = int(np.argmax(one.points))
    x, y, z, length, width, height, yaw = one.boxes[k]
    c, s = np.cos(yaw), np.sin(yaw)
    local = (one.xyz_m[:, :2] - [x, y]) @ np.array([[c, -s], [s, c]])
    inside = (np.abs(local) < np.array([length, width]) / 2 + 0.1).all(axis=1) & (
        np.abs(one.xyz_m[:, 2] - z) < height / 2 + 0.1
    )
    assert inside.sum() >= 0.9 * one.points[k]
    held = held_out[0]
    assert np.abs(held.cloud.sensor[:2]).max() == 0
    assert held.truth.range_m[np.argmax(held.truth.points)] < 30
    alone = train_lidar.Pool(tmp_path, "roadside", [train_lidar.Round(1, 0, 5)], paths)
    alone.prepare(0)
    sizes = {len(sample.xyz_m) for shard in shards for sample in (shard[k] for k in range(len(shard)))}
    assert {len(alone.draw(np.random.default_rng(k)).xyz_m) for k in range(20)} <= sizes
    monkeypatch.setattr(train_lidar, "CELLS", {"roadside": 64})
    round_ = train_lidar.Round(1, 0, 2)
    train_lidar.fit("roadside", tmp_path / "data", tmp_path, [round_], paths)
    assert (tmp_path / "round-1.pt").is_file()


def test_training_on_own_logs_alone_without_labels_is_refused(tmp_path) -> None:
    with pytest.raises(LogError):
        train_lidar.read_own([tmp_path], tmp_path / "data", every=1)
