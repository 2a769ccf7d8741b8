"""Training of LiDAR networks: toys learn, go on from files, are exported and find; the shipped kind and those of two papers."""

from __future__ import annotations

import copy
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from training.clouds import CATEGORIES, Sample, write_shard
from worlds import cloud_at

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Camera, project_boxes, rotation_from_rpy, transform, wrap_angle
from log2sim.perception.detect3d.network import load_network, open_session

pytestmark = pytest.mark.slow
pytest.importorskip("onnx", reason="needs the extra 'train'")


@pytest.fixture(autouse=True)
def torch() -> Any:
    """Loaded by tests that run, not by those that are collected; threads that wait for a busy core are slower than one."""
    torch = pytest.importorskip("torch", reason="needs the extra 'train'")
    torch.set_num_threads(1)
    torch.manual_seed(0)
    return torch


def test_a_toy_learns_to_find_people(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A quarter of a minute from nothing: centers of people on fresh scenes are found first; chance finds one in hundreds."""
    from training import lidar

    monkeypatch.setattr(lidar, "PER_SHARD", 40)
    monkeypatch.setitem(lidar.CELLS, "roadside", 128)
    rounds = [lidar.Round(5, 40, 200)]
    lidar.generate("roadside", tmp_path / "data", 40, 5)
    lidar.fit("roadside", tmp_path / "data", tmp_path, rounds)
    lidar.fit_quantized("roadside", tmp_path / "data", tmp_path, rounds, 50)
    lidar.finish("roadside", tmp_path, rounds, 50, examples=24)
    card = json.loads((tmp_path / "roadside.json").read_text())
    assert card["simulated"]["pedestrian"]["average_precision"] > 0.08
    assert (tmp_path / "roadside.onnx").stat().st_size < 700_000


def test_targets_of_the_second_stage_make_boxes_the_true_ones() -> None:
    from test_box_refinement import boxes_at
    from training.refinement import targets_of

    from log2sim.perception.detect3d.refinement import corrected

    rng = np.random.default_rng(3)
    low, high = [-20, -20, 0.5, 0.5, 0.5, 0.5, -3.1], [20, 20, 2, 8, 3, 3, 3.1]
    truth = rng.uniform(low, high, (50, 7))
    off = rng.uniform(-1, 1, (50, 7)) * [1, 1, 0.5, 0, 0, 0, 0.7]
    found = truth + off
    found[:, 3:6] *= rng.uniform(0.6, 1.6, (50, 3))
    found[::2, 6] += np.pi
    boxes = boxes_at(found.tolist())
    target = targets_of(boxes, truth)
    out = np.column_stack([np.ones(50), target[:, :8], 4 * target[:, 8] - 2, np.zeros(50)])
    again = corrected(boxes, out, {"vehicle": ["car"]})
    np.testing.assert_allclose(np.column_stack([again.center_m, again.size_m]), truth[:, :6], atol=1e-9)
    np.testing.assert_allclose(wrap_angle(again.yaw_rad - truth[:, 6]), 0, atol=1e-9)


def test_reshaped_objects_fill_their_boxes_as_before_and_what_is_around_keeps_its_distance() -> None:
    from training.refinement import reshaped

    rng = np.random.default_rng(4)
    truth = rng.uniform([-1, -1, 0.5, 0.5, 0.5, 1.0, -3], [1, 1, 1, 8, 3, 3, 3], (40, 7))
    # Corners of the boxes, points inside, and points half a meter outside a side.
    u = np.concatenate([np.stack(np.meshgrid(*[[-1, 1]] * 3), -1).reshape(-1, 3), rng.uniform(-1, 1, (30, 3))])

    def at(box: Any, u: Any, beyond_m: float = 0.0) -> Any:
        x, y, z = ((u * box[:, None, 3:6]) / 2 + np.array([beyond_m, 0, 0])).transpose(2, 0, 1)
        c, s = np.cos(box[:, 6:]), np.sin(box[:, 6:])
        return np.stack([x * c - y * s, x * s + y * c, z], axis=2) + box[:, None, :3]

    side = np.array([[1.0, 0.3, 0.0]])
    xyz = np.concatenate([at(truth, u), at(truth, side, 0.5)], axis=1).astype(np.float32)
    flat, after = xyz.reshape(-1, 3), truth.copy()
    center = reshaped(flat, np.repeat(np.arange(40), len(u) + 1), after, truth[:, :3].copy(), rng)
    factor = after[:, 3:6] / truth[:, 3:6]
    assert 0.02 < np.log(factor).std() < 0.12
    np.testing.assert_allclose(center, after[:, :3], atol=1e-6)
    c, s = np.cos(after[:, 6, None]), np.sin(after[:, 6, None])
    dx, dy, dz = (flat.reshape(xyz.shape) - after[:, None, :3]).transpose(2, 0, 1)
    local = np.stack([dx * c + dy * s, dy * c - dx * s, dz], axis=2)
    new = local / (after[:, None, 3:6] / 2)
    # Corners move inward by a quarter at most, never in height.
    assert (np.abs(new[:, :8]) < 1 + 1e-4).all()
    assert (new[:, :8] * u[:8] > 0.7).all()
    np.testing.assert_allclose(new[:, :8, 2], np.broadcast_to(u[:8, 2], (40, 8)), atol=1e-4)
    assert np.abs(new[:, 8:-1]).max() < 1 + 1e-4
    assert np.abs(new[:, 8:-1, :2] - u[8:, :2]).max() > 0.05
    # As far from the side, which is rounder now.
    np.testing.assert_allclose(local[:, -1, 0] - after[:, 3] / 2, 0.5, atol=0.12)


def test_a_toy_of_the_second_stage_learns_which_boxes_hold_objects(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, torch: Any
) -> None:
    """In a quarter of a minute, from a few scenes, on others: places take more steps."""
    from training import refinement
    from training.fitting import FitPlan

    from log2sim.config import LidarConfig
    from log2sim.perception.detect3d.detectors import WEIGHTS, open_network

    first = tmp_path / "first.onnx"
    first.write_bytes((WEIGHTS / "roadside.onnx").read_bytes())
    monkeypatch.setattr(refinement, "PER_SHARD", 20)
    refinement.generate("roadside", first, tmp_path, 20, 5)
    plan = FitPlan(150, 5, refinement.RATE, tmp_path / "refinement.pt", 100)
    weights = refinement.train("roadside", tmp_path, 20, plan, None, None)
    # What goes on from these for a step at hardly any rate is the same.
    still = FitPlan(1, 5, 1e-9, warm_up_steps=1)
    again = refinement.train("roadside", tmp_path, 20, still, None, tmp_path / "refinement.pt")
    torch.testing.assert_close(again["boxes.0.weight"], weights["boxes.0.weight"], atol=1e-3, rtol=0)
    refinement.finish("roadside", first, tmp_path, weights, {"seed": 5}, 4)
    card = json.loads((tmp_path / "roadside.boxes.json").read_text())
    assert card["simulated"]["scenes"] == 4
    monkeypatch.setattr(refinement, "PER_SHARD", 6)
    refinement.generate("roadside", first, tmp_path, 6, 6)
    with np.load(refinement.shard_path(tmp_path, "roadside", 6, 0)) as data:
        shard = {name: data[name] for name in data.files}
    points, box, *targets = refinement.drawn(shard, np.arange(len(shard["matched"])), np.random.default_rng(0))
    network: Any = open_network(tmp_path / "roadside.onnx", LidarConfig(), name="x").refinement
    found = torch.from_numpy(network.run(points.numpy(), box.numpy()).astype(np.float32))
    nothing = torch.zeros_like(found)
    nothing[:, -3] = 1.0
    errors, none = (refinement.loss_of(out, *targets)[1] for out in (found, nothing))
    assert errors["object"] < 0.6 * none["object"]


def test_training_goes_on_from_the_network_in_a_file(tmp_path: Path, torch: Any) -> None:
    """A network that is read back computes what it did before it was quantized, on other grids than those that its layers' moments and steps were taken
    from, and so does a wider one.
    """
    from training.export import description, export_onnx, import_onnx, widened
    from training.network import BevNetwork
    from training.quantization import quantize_kernels, quantized_network

    network = BevNetwork((16, 24, 32, 40))
    for layer in network.modules():
        if isinstance(layer, torch.nn.BatchNorm2d):
            for values in (layer.weight.data, layer.running_var):
                values.uniform_(0.5, 2.0)
            for values in (layer.bias.data, layer.running_mean):
                values.uniform_(-0.5, 0.5)
    grids = torch.rand(6, 12, 64, 64)
    quantized = quantized_network(network).train()
    with torch.no_grad():
        quantized(grids[:4])
    torch.save({"mean": quantized.state_dict()}, tmp_path / "x.pt")
    export_onnx(tmp_path / "x.pt", tmp_path / "x.onnx", description("vehicle", 0.25, 40.0))
    again = import_onnx(tmp_path / "x.onnx", grids[:4])
    with torch.no_grad():
        expected = network.eval()(grids[4:])
        spread = expected.std((0, 2, 3))
        session = open_session(tmp_path / "x.onnx", 1_000_000, "network")
        (in_file,) = session.run(["maps"], {"grid": grids[4:].numpy()})
        # In training a layer is normalized by the batch, whose moments are those that were put in.
        training, before = copy.deepcopy(again).train()(grids[:4]), network(grids[:4])
        for one, other in ((again(grids[4:]), expected), (torch.from_numpy(in_file), expected), (training, before)):
            assert ((one - other).std((0, 2, 3)) < 0.1 * spread).all()
        # Where nothing is, integers are what they were in training, to the last step.
        quantize_kernels(quantized.eval())
        empty = torch.zeros(1, 12, 64, 64)
        np.testing.assert_allclose(
            session.run(["maps"], {"grid": empty.numpy()})[0], quantized(empty), rtol=0, atol=1e-5
        )
        wide = widened(again, (16, 40, 48, 64))
        np.testing.assert_allclose(wide(grids[4:]), again(grids[4:]), rtol=0, atol=1e-4 * float(expected.abs().max()))
        assert (wide.down8[0][0].weight[32:] != 0).any()  # the new channels can learn
    assert (tmp_path / "x.onnx").stat().st_size < 0.35 * (tmp_path / "x.pt").stat().st_size


def test_a_bicycle_without_rider_is_no_person_but_may_be_a_two_wheeler(torch: Any) -> None:
    from training.network import GROUPS, targets_of

    boxes = np.array([[2, 2, 0.5, 1.8, 0.6, 1.1, 0.3], [-6, 2, 0.8, 0.7, 0.7, 1.7, 0.0]], np.float32)
    category = np.array([CATEGORIES.index("bicycle"), CATEGORIES.index("pedestrian")])
    sample = Sample(np.zeros((0, 3), np.float32), boxes, category, np.array([50, 50]))
    targets = targets_of([sample], [np.array([-16.0, -16.0])], 128, 0.25)
    left_out = {group: int((targets.considered[0, k] == 0).sum()) for k, group in enumerate(GROUPS)}
    assert left_out["two_wheeler"] > 3
    assert left_out["pedestrian"] == left_out["vehicle"] == 0
    assert targets.heat[0].amax((1, 2)).tolist() == [0, 0, 1]


def points_in(boxes: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points all over the inside of boxes (M, 7), `count` in each."""
    parts = []
    for x, y, z, length, width, height, yaw in boxes:
        p = rng.uniform(-0.5, 0.5, (count, 3)) * (length, width, height)
        c, s = np.cos(yaw), np.sin(yaw)
        parts.append(np.column_stack([x + p[:, 0] * c - p[:, 1] * s, y + p[:, 0] * s + p[:, 1] * c, z + p[:, 2]]))
    return np.concatenate(parts)


def test_the_network_of_cells_and_votes_is_trained_from_shards_and_exported(tmp_path: Path) -> None:
    from training import zou2021

    rng, names = np.random.default_rng(0), ("car", "truck", "pedestrian", "cyclist")
    boxes = np.array(
        [[4.0, 3.0, 0.8, 4.5, 1.8, 1.6, 0.4], [-6.0, 5.0, 1.6, 9.0, 2.5, 3.2, -2.0], [2.0, -5.0, 0.86, 0.6, 0.6, 1.72, 1.0],
         [-5.0, -6.0, 0.8, 1.8, 0.7, 1.6, 2.8]]
    )  # fmt: skip
    ground = np.column_stack([rng.uniform(-11.9, 11.9, (6000, 2)), rng.normal(0, 0.02, 6000)])
    xyz = np.concatenate([ground, points_in(boxes, 1500, rng)]).astype(np.float32)
    category = np.array([CATEGORIES.index(n) for n in names], np.int64)
    sample = Sample(xyz, boxes.astype(np.float32), category, np.full(4, 1500))
    (tmp_path / "data").mkdir()
    write_shard(tmp_path / "data" / "roadside-1-0000.npz", [sample, sample])
    path = zou2021.main([tmp_path / "data"], tmp_path / "out", steps=2, share=0.1)
    info = load_network(path).info
    assert info.card == {"steps": 2, "seed": 1, "share": 0.1, "samples": 2}
    assert info.stride == 1
    assert (tmp_path / "out" / "checkpoint.pt").exists()


K = np.array([[300.0, 0, 300], [0, 300.0, 90], [0, 0, 1]])
SIZE_PX = (180, 600)
# x, y, height of the center, length, width, height, heading, in a frame that looks along x.
BOXES = np.array([[12.2, 2.1, 0.8, 4.4, 1.8, 1.6, 0.2], [20.0, -4.0, 0.8, 4.6, 1.9, 1.6, 1.5], [9.0, -2.0, 0.86, 0.7, 0.6, 1.72, 0.0]])  # fmt: skip
NAMES = ["car", "car", "pedestrian"]
SLOPE = 0.02


def pair_of_a_slope(yaw: float = 0.6) -> Any:
    """A sweep on a slope and a picture of a camera that looks along `yaw`."""
    from training import real_logs, two_stream

    rng = np.random.default_rng(3)
    flat = np.column_stack([rng.uniform(0, 40, 9000), rng.uniform(-15, 15, 9000), rng.normal(0, 0.01, 9000)])
    xyz = np.concatenate([flat, points_in(BOXES, 300, rng)])
    height, xyz = xyz[:, 2], xyz + xyz[:, :1] * [0, 0, SLOPE]
    turn = rotation_from_rpy(0, 0, yaw)
    origin = np.array([50.0, -20.0, 3.0])
    cloud = cloud_at(xyz @ turn.T, height, stamp_ns=7, origin=origin, sensor=(0.0, 0.0, 1.7))
    rows = BOXES.copy()
    rows[:, 2] += SLOPE * rows[:, 0]
    rows[:, :3] = rows[:, :3] @ turn.T
    rows[:, 6] += yaw
    truth = SceneBoxes.of(rows, NAMES, points=np.full(len(rows), 300))
    cam = turn @ np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    camera, cam_T_cloud = (
        Camera("c", SIZE_PX[1], SIZE_PX[0], K, "map", np.eye(4)),
        np.linalg.inv(transform(cam, [0, 0, 1.6])),
    )
    image = np.full((*SIZE_PX, 3), 90, np.uint8)
    for k, outline in enumerate(project_boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], camera, cam_T_cloud).box_px):
        u0, v0, u1, v1 = outline.astype(int)
        image[max(v0, 0) : v1, max(u0, 0) : u1] = (250, 40 * k, 30)
    sweep = real_logs.LogSweep(cloud, truth, ())
    return two_stream.pair_of(sweep, image, K, transform(cam, origin + np.array([0, 0, 1.6])))


def test_two_streams_learn_one_pair_are_exported_and_find_its_objects(tmp_path: Path) -> None:
    from training import fitting, two_stream

    pair = pair_of_a_slope()
    network = two_stream.TwoStream(((8, 1), (16, 1)))
    batch = two_stream.batch_of(two_stream.inputs_of(pair))
    losses: list[float] = []

    def step(n: Any, rng: np.random.Generator, _: int) -> Any:
        loss, parts = two_stream.loss_of_anchors(n, batch)
        losses.append(float(loss.detach()))
        return loss, parts

    fitting.fit(network, step, fitting.FitPlan(70, peak_rate=5e-3))
    assert losses[-1] < 0.1 * losses[0]
    two_stream.export_two_stream(network, tmp_path / "two.onnx")
    search = two_stream.search_by_network(tmp_path / "two.onnx")
    found = search(pair)
    best = found.take(np.argsort(-found.score)[: len(NAMES)])
    assert sorted(best.category.tolist()) == sorted(NAMES)
    row = two_stream.compare({"toy": search}, [pair])["toy"]
    assert row["car"]["IoU BEV > 0.5"] == 1.0
    assert row["car"]["truths"] == 2


def test_a_toy_learns_to_name_colors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Chance names one of ten right."""
    from training import colors

    monkeypatch.setattr(colors, "TRACKS", 60)
    colors.main(tmp_path, worlds=150, steps=100)
    card = json.loads((tmp_path / "colors.json").read_text())
    assert card["simulated"]["top1"] > 0.25
    assert (tmp_path / "colors.onnx").stat().st_size < 480_000


def test_a_toy_learns_lines_and_calibrates_whole_markings(tmp_path: Path) -> None:
    """Half a minute on one street: its lines are found in a map that was not trained on, of the same paint on another course."""
    import pickle

    from fits.line_maps import EVERYWHERE, RoadMap
    from painted_ground import Painter, line_of
    from training import markings

    from log2sim.datatypes import MapFeatures, Marking
    from log2sim.road.paint_network import find_crests, find_paint_maps, open_markings_network

    def street(seed: int, slope: float) -> RoadMap:
        painter = Painter((0.0, 60.0, -15.0, 15.0), seed=seed)
        lines = [line_of(lambda x, y=y: y + slope * (x - 30), 0, 60) for y in (-3.0, 0.0, 3.0)]
        painter.lines(lines, 0.2)
        painter.lines([np.array([[50.0, 0.3], [50.0, 2.7]])], 0.5)
        true = [Marking(f"{k}", "solid", np.column_stack([xy, 0 * xy[:, 0]]), 0.2) for k, xy in enumerate(lines)]
        stop = Marking("stop", "stop_line", np.array([[50.0, 0.3, 0.0], [50.0, 2.7, 0.0]]), 0.5)
        return RoadMap(painter.ground(), MapFeatures((*true, stop)), EVERYWHERE)

    maps, held = tmp_path / "maps", tmp_path / "held"
    for folder, seed, slope in ((maps, 1, 0.0), (maps, 2, 0.15), (held, 3, -0.1)):
        folder.mkdir(exist_ok=True)
        (folder / f"0-000{seed}.pkl").write_bytes(pickle.dumps(street(seed, slope)))
    markings.main(maps, held, tmp_path, pictures=0, steps=120)
    network, road = open_markings_network(tmp_path / "markings.onnx"), street(3, -0.1)
    assert set(network.objects) == {"stop_line", "crosswalk", "other", "border"}
    found = find_paint_maps(road.ground, network)
    crests = find_crests(found, found.lane_line, 0.5)
    away = np.abs(crests.xy_map[:, 1, None] + 0.1 * (crests.xy_map[:, :1] - 30) - [-3.0, 0.0, 3.0]).min(axis=1)
    assert len(away) > 600
    assert np.mean(away < 0.15) > 0.8
    assert json.loads((tmp_path / "markings.json").read_text())["simulated"]["solid"]["recall"] > 0.2


def test_a_white_surface_in_even_light_is_as_bright_as_the_light() -> None:
    """By spherical harmonics of second order, whichever way it faces; under half a sky it has the share that it sees of it."""
    from training.color_pictures import AREA, COSINE, HARMONICS, ROWS, _harmonics

    rng = np.random.default_rng(0)
    normals = rng.normal(size=(50, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    even = np.einsum("rc,rck->k", AREA, HARMONICS) * COSINE
    np.testing.assert_allclose(_harmonics(normals) @ even, 1.0, atol=0.02)
    above = np.einsum("rc,rck->k", AREA[ROWS // 2 :], HARMONICS[ROWS // 2 :]) * COSINE
    np.testing.assert_allclose(_harmonics(normals) @ above, (1 + normals[:, 2]) / 2, atol=0.06)
