"""The fusion paper's two-stream network: maps, anchors in both inputs, crops, loss, boxes, comparison on pairs."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import torch
from lidar_training import fitting, real_logs
from two_stream import network as boxes_of
from two_stream import network as inputs
from two_stream import network as two_stream
from two_stream.network import Pair, ground_plane, pair_of, pairs_of

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Camera, project, project_boxes, rotation_from_rpy, transform
from log2sim.logs.opening import open_log
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


def test_a_pair_looks_along_x_and_its_boxes_stand_on_the_ground(pair: Pair) -> None:
    np.testing.assert_allclose(pair.boxes, BOXES, atol=0.03)
    np.testing.assert_allclose(pair.ground, [SLOPE, 0, 0], atol=2e-3)
    point = np.array([10.0, 1.0, 0.5])
    u, v, w = pair.pixel_T_cloud @ [*point, 1]
    np.testing.assert_allclose([u / w, v / w], [300 - 300 * 0.1, 90 + 300 * (1.6 - 0.5) / 10], atol=1e-6)


def test_the_ground_is_found_without_points_on_it(pair: Pair) -> None:
    none = np.zeros(len(pair.cloud.xyz), bool)
    plane = ground_plane(replace(pair.cloud, ground=none))
    np.testing.assert_allclose(plane[:2], 0)
    assert 0 < plane[2] < 1


def test_maps_hold_the_greatest_height_of_each_slice_and_the_density() -> None:
    xyz = np.array([[10.05, -3.05, 0.0], [10.1, -3.1, 0.2], [10.1, -3.1, 1.4], [69.99, 39.99, 2.29], [10, -3, 2.5], [-1, 0, 1]])  # fmt: skip
    maps = inputs.bev_maps(xyz)
    i, j = int(10.05 / 0.2), int((40 - 3.05) / 0.2)
    np.testing.assert_allclose(maps[:, i, j], [0.4 / 2.5, 0, 0, 1.6 / 2.5, 0, np.log(4) / np.log(16)], atol=1e-6)
    np.testing.assert_allclose(maps[4:, 349, 399], [2.49 / 2.5, np.log(2) / np.log(16)], atol=1e-6)
    assert np.count_nonzero(maps) == 5


def test_codes_of_boxes_are_undone(pair: Pair) -> None:
    anchors = np.array([[12, 2, 0.8, 4.5, 1.85, 1.6, 0], [20, -4, 0.8, 4.5, 1.85, 1.6, np.pi / 2]], np.float32)
    codes = inputs.encode(BOXES[:2], anchors)
    np.testing.assert_allclose(inputs.decode(codes, anchors), BOXES[:2], atol=1e-5)
    back = BOXES[:2].copy()
    back[:, 6] += np.pi
    np.testing.assert_allclose(inputs.encode(back, anchors), codes, atol=1e-6)


def test_anchors_are_where_points_are_and_every_object_has_one(pair: Pair) -> None:
    seen = inputs.inputs_of(pair)
    positive = np.flatnonzero(seen.label == inputs.POSITIVE)
    found = inputs.decode(seen.goal[positive], seen.anchors[positive])
    for box, name in zip(pair.boxes, NAMES, strict=True):
        own = found[seen.kind[positive] == inputs.CLASSES.index(name)]
        near = own[np.hypot(*(own[:, :2] - box[:2]).T) < 0.1]
        assert len(near) > 0
        np.testing.assert_allclose(near[:, :6], np.tile(box[:6], (len(near), 1)), atol=1e-4)
        np.testing.assert_allclose(np.sin(near[:, 6] - box[6]), 0, atol=1e-4)
    # Nothing beside the picture, nothing behind the last points.
    assert seen.anchors[:, 0].max() < 42.5
    assert np.all(np.abs(seen.anchors[:, 1]) <= seen.anchors[:, 0] + 4.5)


def test_anchors_are_in_the_picture_where_the_camera_shows_them(pair: Pair) -> None:
    seen = inputs.inputs_of(pair)
    rows = np.random.default_rng(0).choice(len(seen.kind), 50, replace=False)
    cam_T_cloud = transform(np.linalg.inv(K) @ pair.pixel_T_cloud[:, :3], np.linalg.inv(K) @ pair.pixel_T_cloud[:, 3])
    camera = Camera("c", SIZE_PX[1], SIZE_PX[0], K, "map", np.eye(4))
    for row in rows:
        x, y, z, *size, yaw = seen.anchors[row].astype(float)
        center = np.array([[x, y, z]])
        # Anchors stand on the plane of the ground, each corner at its own height.
        corners = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), -1).reshape(-1, 3) * size
        corners = corners @ rotation_from_rpy(0, 0, yaw).T + center
        corners[:, 2] += corners[:, :2] @ pair.ground[:2] + pair.ground[2]
        uv, _ = project(camera, corners @ cam_T_cloud[:3, :3].T + cam_T_cloud[:3, 3])
        low, high = (np.clip(e, 0, SIZE_PX[::-1]) for e in (uv.min(axis=0), uv.max(axis=0)))
        rows_columns = (seen.image_boxes[row].astype(float) + 1) / 2 * [*SIZE_PX, *SIZE_PX]
        np.testing.assert_allclose(rows_columns, [low[1], low[0], high[1], high[0]], atol=0.05)


def test_a_mirrored_pair_is_the_mirror_of_the_pair(pair: Pair) -> None:
    plain, mirror = inputs.inputs_of(pair), inputs.inputs_of(pair, mirrored=True)
    different = plain.bev[:, :, ::-1] != mirror.bev
    assert different.mean() < 1e-3  # points on the lines between cells
    np.testing.assert_allclose(plain.image[:, :, ::-1], mirror.image, atol=0.02)

    def objects(seen: inputs.Inputs, side: float) -> np.ndarray:
        rows = np.flatnonzero((seen.label == inputs.POSITIVE) & (seen.kind == 0))
        found = inputs.decode(seen.goal[rows], seen.anchors[rows]) * [1, side, 1, 1, 1, 1, side]
        found[:, 6] = np.mod(found[:, 6], np.pi)
        return np.unique(found.round(3), axis=0)

    np.testing.assert_allclose(objects(plain, 1.0), objects(mirror, -1.0), atol=2e-3)


def test_crops_sample_at_the_middles_of_their_ninths() -> None:
    rows, columns = torch.meshgrid(torch.arange(30.0), torch.arange(50.0), indexing="ij")
    features = torch.stack([rows, columns])[None]
    # Rows 6 to 12 and columns 10 to 25, whose outer edges are at -1 and 1.
    box = torch.tensor([[6 / 30, 10 / 50, 12 / 30, 25 / 50]]) * 2 - 1
    out = two_stream.crops(features, box).view(2, 3, 3)
    torch.testing.assert_close(out[0, :, 0], torch.tensor([7.0, 9.0, 11.0]) - 0.5)
    torch.testing.assert_close(out[1, 0], torch.tensor([12.5, 17.5, 22.5]) - 0.5)


def test_both_streams_reach_the_answer_and_count_the_same(pair: Pair) -> None:
    torch.manual_seed(0)
    network = two_stream.TwoStream(((4, 1), (8, 1))).eval()
    batch = two_stream.Batch.of(inputs.inputs_of(pair))
    with torch.no_grad():
        score = batch.run(network)[0]
        dark = replace(batch, image=batch.image * 0).run(network)[0]
        empty = replace(batch, bev=batch.bev * 0).run(network)[0]
    assert score.shape == batch.kind.shape
    assert not torch.allclose(score, dark)
    assert not torch.allclose(score, empty)


def test_loss_is_focal_and_smooth_l1_over_the_positive_anchors() -> None:
    none = torch.zeros(0)
    goal = torch.zeros(3, 7)
    label = torch.tensor([1, 0, -1])
    batch = two_stream.Batch(none, none, none, none, torch.zeros(3, dtype=torch.long), label, goal)
    logits, codes = torch.tensor([0.0, 1.0, 50.0]), torch.full((3, 7), 2.0)
    parts = two_stream.loss_of_anchors(logits, codes, batch)[1]
    p = 1 / (1 + np.exp(-1.0))
    assert parts["class"] == pytest.approx(-0.25 * 0.25 * np.log(0.5) - 0.75 * p**2 * np.log(1 - p), rel=1e-5)
    assert parts["box"] == pytest.approx(7 * 1.5)


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


def test_comparison_counts_cars_within_range_and_leaves_out_what_is_not_labeled(pair: Pair) -> None:
    truth = SceneBoxes.of(
        pair.truth.box[[0, 1, 0, 2]] + np.array([[0, 0], [0, 0], [6, 5], [0, 0]]) @ np.eye(2, 7),
        ["car", "car", "truck", "pedestrian"], points=[300, 3, 300, 300],
    )  # fmt: skip
    pair = replace(pair, truth=truth)

    def search(p: Pair) -> SceneBoxes:
        return SceneBoxes.of(p.truth.box[[0, 2, 3]], ["car", "car", "pedestrian"], [0.9, 0.95, 0.5])

    row = boxes_of.compare({"fixed": search}, [pair])["fixed"]
    # The truck is no false car, the car with 3 points no miss.
    assert row["car"] == {**dict.fromkeys(map(str, boxes_of.CRITERIA["car"]), 1.0), "truths": 1}
    assert row["pedestrian"]["truths"] == 1


def test_pairs_of_a_log_show_its_labels_where_its_camera_does() -> None:
    log = open_log(Path(__file__).resolve().parents[1] / "samples" / "crossing")
    sweep = real_logs.read_sweeps(log, every=40)[0]
    pair = next(pairs_of(log, "front", [sweep]))
    k = int(np.argmin(np.abs(log.streams["front"].t_ns - sweep.cloud.stamp_ns)))
    pose, _ = log.map_T_sensor("front", int(log.streams["front"].t_ns[k]))
    uv, _ = project(
        log.cameras["front"], (sweep.truth.box[:, :3] + sweep.cloud.origin - pose[0][:3, 3]) @ pose[0][:3, :3]
    )
    p = np.column_stack([pair.truth.box[:, :3], np.ones(len(pair.truth))]) @ pair.pixel_T_cloud.T
    ahead = np.isfinite(uv).all(axis=1)
    assert ahead.any()
    np.testing.assert_allclose(p[ahead, :2] / p[ahead, 2:], uv[ahead], atol=1e-4)
    assert np.all(p[~ahead, 2] < 1)
    lean = pair.in_picture_only()
    assert 0 < len(lean.cloud.xyz) < len(pair.cloud.xyz)
    np.testing.assert_array_equal(inputs.inputs_of(lean).bev, inputs.inputs_of(pair).bev)
