"""The roadside paper's method: channels, targets, network, losses, layout for decoding by votes, boxes around clusters, table."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="training needs the extra 'train'")
pytest.importorskip("onnx")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))

import torch
from lidar_networks import INFO
from lidar_training import fitting, real_logs
from lidar_training.clouds import CATEGORIES, Sample, write_shard
from zou2021 import network as mixing
from zou2021 import network as z
from zou2021 import table_rows
from zou2021.cluster_boxes import ClusterBoxDetector
from zou2021.network import IGNORED, CellTargets, cell_targets, export_zou2021

from log2sim.config import LidarConfig
from log2sim.datatypes import Boxes3D
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.logs.opening import open_log
from log2sim.perception.detect3d.boxes import decode_votes
from log2sim.perception.detect3d.detectors import open_network
from log2sim.perception.detect3d.network import NetworkInfo, load_network, rasterize
from log2sim.perception.lidar.cloud import Cloud

# Threads that wait for a busy core are slower than one.
torch.set_num_threads(1)

BOXES = np.array(
    [[4.0, 3.0, 0.8, 4.5, 1.8, 1.6, 0.4], [-6.0, 5.0, 1.6, 9.0, 2.5, 3.2, -2.0], [2.0, -5.0, 0.86, 0.6, 0.6, 1.72, 1.0],
     [-5.0, -6.0, 0.8, 1.8, 0.7, 1.6, 2.8]]
)  # fmt: skip
NAMES = ("car", "truck", "pedestrian", "cyclist")
LOW = np.array([-12.0, -9.0])
CELLS = (128, 112)
LAID_OUT = NetworkInfo.model_validate({**INFO, "cell_m": z.CELL_M, "stride": 1})


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


@pytest.fixture(scope="module")
def grid(sample: Sample) -> np.ndarray:
    return rasterize(sample.xyz_m, cell_m=z.CELL_M, low=LOW, shape=CELLS)


@pytest.fixture(scope="module")
def targets(sample: Sample, grid: np.ndarray) -> CellTargets:
    return cell_targets([sample], [LOW], grid[None], z.CELL_M)


class Perfect(torch.nn.Module):
    """What the network would answer if it knew the targets."""

    def __init__(self, targets: CellTargets) -> None:
        super().__init__()
        label = targets.label.clamp(min=0)
        logits = 9.0 * torch.nn.functional.one_hot(label, 6).permute(0, 3, 1, 2).float()
        self.out = torch.cat([targets.offset, logits, targets.height, targets.heading], dim=1)

    def forward(self, grid: Any) -> Any:
        return self.out


def test_the_eight_channels_say_what_the_paper_names(grid: np.ndarray) -> None:
    out = z.PaperGrid()(torch.from_numpy(grid[None]))[0].numpy()
    assert out.shape == (8, *CELLS)
    filled = grid[3] > 0
    np.testing.assert_array_equal(out[7], filled)
    np.testing.assert_allclose(out[0], 2 * grid[0])
    np.testing.assert_array_equal(out[4:6], 0)
    x, y = (np.arange(n) + 0.5 - n / 2 for n in CELLS)
    np.testing.assert_allclose(out[2], np.arctan2(y[None, :], x[:, None]) / np.pi, atol=1e-6)
    np.testing.assert_allclose(out[3] * z.DISTANCE_UNIT_M, np.hypot(y[None, :], x[:, None]) * z.CELL_M, atol=1e-4)


@pytest.mark.slow
def test_a_part_of_a_window_has_the_directions_and_distances_of_the_whole(grid: np.ndarray) -> None:
    whole = z.PaperGrid()(torch.from_numpy(grid[None]))
    part = torch.from_numpy(grid[None, :, 16:80, 32:96])
    middle = torch.tensor([[(64 - 48) * z.CELL_M, (56 - 64) * z.CELL_M]])
    torch.testing.assert_close(z.PaperGrid()(part, middle), whole[:, :, 16:80, 32:96])


def test_targets_are_the_classes_of_the_points_in_cells_that_are_not_empty(grid: np.ndarray, targets: Any) -> None:
    label = targets.label[0].numpy()
    np.testing.assert_array_equal(label == IGNORED, grid[3] == 0)
    for box, expected in zip(BOXES, (z.SMALL, z.LARGE, z.PEDESTRIAN, z.TWO_WHEELER), strict=True):
        i, j = ((box[:2] - LOW) / z.CELL_M).astype(int)
        assert label[i, j] == expected
        middle = LOW + (np.array([i, j]) + 0.5) * z.CELL_M
        np.testing.assert_allclose(targets.offset[0, :, i, j], box[:2] - middle, atol=1e-5)
        assert float(targets.height[0, 0, i, j]) == pytest.approx(box[5], abs=1e-5)
        np.testing.assert_allclose(targets.heading[0, :, i, j], (np.cos(box[6]), np.sin(box[6])), atol=1e-6)
    assert set(np.unique(label)) == {IGNORED, z.GROUND, z.LARGE, z.SMALL, z.TWO_WHEELER, z.PEDESTRIAN}


def test_users_with_few_points_are_not_judged(sample: Sample, grid: np.ndarray) -> None:
    few = Sample(sample.xyz_m, sample.boxes, sample.category, np.array([1500, 1500, 3, 1500]))
    label = cell_targets([few], [LOW], grid[None], z.CELL_M).label[0].numpy()
    i, j = ((BOXES[2, :2] - LOW) / z.CELL_M).astype(int)
    assert label[i, j] == IGNORED


def test_perfect_answers_are_decoded_to_the_boxes(grid: np.ndarray, targets: CellTargets) -> None:
    maps = z.LaidOut(Perfect(targets))(torch.from_numpy(grid[None]))[0].numpy()
    found = decode_votes(maps, grid, LAID_OUT, LOW)
    order = [found.category.tolist().index(n) for n in NAMES]
    assert len(found) == len(NAMES)
    np.testing.assert_allclose(found.center_m[order], BOXES[:, :3], atol=0.02)
    np.testing.assert_allclose(found.yaw_rad[order], BOXES[:, 6], atol=1e-3)
    np.testing.assert_allclose(found.size_m[order, 2], BOXES[:, 5], atol=0.01)
    sizes = [z.CLASS_SIZES_M[k - z.LARGE][:2] for k in (z.SMALL, z.LARGE, z.PEDESTRIAN, z.TWO_WHEELER)]
    np.testing.assert_allclose(found.size_m[order, :2], sizes, rtol=1e-5)


def test_the_loss_is_least_for_perfect_answers_and_ignores_empty_cells(targets: CellTargets) -> None:
    perfect = Perfect(targets).out
    best = z.loss_of_cells(perfect, targets)[1]
    assert best["height"] == best["heading"] == best["offset"] == 0
    assert best["class"] < 1e-4
    empty = (targets.label == IGNORED)[:, None]
    assert z.loss_of_cells(torch.where(empty, torch.tensor(5.0), perfect), targets)[1] == best
    for part, channels in (("offset", z.OFFSET), ("height", z.HEIGHT), ("heading", z.HEADING), ("class", z.CLASSES)):
        wrong = perfect.clone()
        wrong[:, channels] += torch.randn(wrong[:, channels].shape, generator=torch.Generator().manual_seed(0)) * 9
        assert z.loss_of_cells(wrong, targets)[1][part] > best[part] + 0.1


def test_smooth_l1_is_smooth_where_it_turns_linear() -> None:
    x = torch.tensor([0.0, 0.005, 0.01, 0.02], requires_grad=True)
    y = z.smooth_l1(x)
    y.sum().backward()
    np.testing.assert_allclose(y.detach(), [0, 0.00125, 0.005, 0.015], atol=1e-7)
    np.testing.assert_allclose(x.grad, [0, 0.5, 1, 1], atol=1e-5)


@pytest.mark.slow
def test_a_toy_learns_one_scene_is_exported_and_finds_its_objects(sample: Sample, grid: Any, tmp_path: Path) -> None:
    torch.manual_seed(0)
    network = z.Zou2021Network(0.25)
    batch, goal = torch.from_numpy(grid[None]), cell_targets([sample], [LOW], grid[None], z.CELL_M)
    losses: list[float] = []

    def step(n: Any, rng: np.random.Generator, _: int) -> Any:
        loss, parts = z.loss_of_cells(n(batch), goal)
        losses.append(float(loss.detach()))
        return loss, parts

    fitting.fit(network, step, fitting.FitPlan(100, peak_rate=5e-3))
    assert losses[-1] - losses_floor() < 0.2 * (losses[0] - losses_floor())
    path = tmp_path / "zou2021.onnx"
    export_zou2021(network, path, {"steps": 100})
    maps = load_network(path).run(grid)
    assert maps.shape == (25, *CELLS)
    found = decode_votes(maps, grid, load_network(path).info, LOW)
    off = np.hypot(*(found.center_m[:, None, :2] - BOXES[None, :, :2]).T).min(axis=1)
    assert np.all(off < 0.7)
    with open(path, "rb") as file:
        assert b"log2sim.lidar" in file.read()
    detector = open_network(path, LidarConfig(decode="centers"), name="zou2021")
    assert len(detector.detect(cloud_of(sample.xyz_m))) == 0


def losses_floor() -> float:
    """The constants of the paper's total."""
    return z.PARTS * float(np.log(1 / z.PARTS**2 + 1)) / 2


def cloud_of(xyz: np.ndarray) -> Cloud:
    return Cloud(
        stamp_ns=5, origin=np.array([100.0, 50.0, 2.0]), xyz=xyz, t_s=np.zeros(len(xyz), np.float32),
        sensor=np.array([0, 0, 3.6], np.float32), ground=np.abs(xyz[:, 2]) < 0.1, height=xyz[:, 2].copy(),
    )  # fmt: skip


def test_a_box_around_a_cluster_ends_where_its_points_end(sample: Sample) -> None:
    cloud = cloud_of(sample.xyz_m)

    class Net:
        info = LAID_OUT

        def run(self, grid: np.ndarray) -> np.ndarray:
            low = np.array([-12.0, -12.0])
            goal = cell_targets([sample], [low], grid[None], z.CELL_M)
            return z.LaidOut(Perfect(goal))(torch.from_numpy(grid[None]))[0].numpy()

    found = ClusterBoxDetector("points", Net(), 12.0, 0.1).detect(cloud)  # type: ignore[arg-type]
    order = [found.category.tolist().index(n) for n in NAMES]
    # 1500 random points reach all sides but for a few centimeters; margins of cells bring no others.
    np.testing.assert_allclose(found.center_m[order] - cloud.origin, BOXES[:, :3], atol=0.06)
    longish = [0, 1, 3]  # a person is as wide as long
    np.testing.assert_allclose(found.size_m[order][longish, :2], BOXES[longish, 3:5], atol=0.08)
    off = found.yaw_rad[order][longish] - BOXES[longish, 6]
    np.testing.assert_allclose(np.sin(off), 0, atol=0.06)
    assert np.all(np.cos(off) > 0)


def test_half_of_a_batch_comes_from_the_other_source(sample: Sample) -> None:
    other = Sample(sample.xyz_m[:10], sample.boxes[:1], sample.category[:1], sample.points[:1])
    batch = mixing.Mixture([[sample]], [other]).draw(np.random.default_rng(0))
    assert [len(s.boxes) for s in batch] == [4, 1, 4, 1]
    assert [len(s.boxes) for s in mixing.Mixture([[sample]]).draw(np.random.default_rng(0))] == [4] * 4


@pytest.mark.slow
def test_a_fit_that_was_cut_off_goes_on_to_the_same_weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fitting, "CHECKPOINT_S", 0.0)

    def run(checkpoint: Path, stop_at: int | None = None) -> dict[str, Any]:
        torch.manual_seed(0)
        done = 0

        def step(network: Any, rng: np.random.Generator, _: int) -> Any:
            nonlocal done
            if done == stop_at:
                raise KeyboardInterrupt
            done += 1
            x = torch.from_numpy(rng.normal(size=(8, 3)).astype(np.float32))
            loss = ((network(x)[:, 0] - x.sum(dim=1)) ** 2).mean()
            return loss, {"loss": float(loss.detach())}

        return fitting.fit(torch.nn.Linear(3, 1), step, fitting.FitPlan(40, checkpoint=checkpoint))

    whole = run(tmp_path / "a.pt")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "b.pt", stop_at=20)
    parts = run(tmp_path / "b.pt")
    for name in whole:
        torch.testing.assert_close(whole[name], parts[name], rtol=0, atol=0)


@pytest.mark.slow
def test_one_command_trains_from_shards_and_exports(sample: Sample, tmp_path: Path) -> None:
    from zou2021 import train as train_zou2021

    (tmp_path / "data").mkdir()
    write_shard(tmp_path / "data" / "roadside-1-0000.npz", [sample, sample])
    path = train_zou2021.train([tmp_path / "data"], tmp_path / "out", steps=2, seed=1, start=None, share=0.1)
    info = load_network(path).info
    assert info.card == {"steps": 2, "seed": 1, "share": 0.1, "samples": 2}
    assert info.stride == 1
    assert (tmp_path / "out" / "checkpoint.pt").exists()


def test_sweeps_of_a_log_become_samples_on_level_ground() -> None:
    log = open_log(Path(__file__).resolve().parents[1] / "samples" / "crossing")
    sweep = real_logs.read_sweeps(log, every=40)[0]
    sample = real_logs.sample_of(sweep)
    boxes = sample.boxes
    assert len(boxes) > 2
    np.testing.assert_allclose(boxes[:, 2] - boxes[:, 5] / 2, 0, atol=0.15)
    np.testing.assert_allclose(boxes[:, :2] + sweep.cloud.sensor[:2], sweep.truth.box[:, :2], atol=1e-4)
    for box, points in zip(boxes, sample.points, strict=True):
        d = sample.xyz_m[:, :2] - box[:2]
        c, s = np.cos(box[6]), np.sin(box[6])
        inside = (np.abs(d[:, 0] * c + d[:, 1] * s) < box[3] / 2) & (np.abs(d[:, 1] * c - d[:, 0] * s) < box[4] / 2)
        assert np.count_nonzero(inside & (sample.xyz_m[:, 2] > 0.1)) == pytest.approx(points, rel=0.1, abs=3)


def test_labels_of_one_camera_limit_what_is_judged_and_learned() -> None:
    log = open_log(Path(__file__).resolve().parents[1] / "samples" / "crossing")
    sweep = real_logs.read_sweeps(log, every=40)[0]
    camera = log.cameras["front"]
    shift = np.eye(4)
    shift[:3, 3] = sweep.cloud.origin
    pose, _ = log.map_T_sensor("front", sweep.cloud.stamp_ns)
    view = real_logs.LogView(camera, np.linalg.inv(pose[0]) @ shift, np.zeros((0, 4)))
    limited = real_logs.LogSweep(sweep.cloud, sweep.truth, (view,))
    axis = pose[0][:3, 2]
    ahead, behind = (pose[0][:3, 3] - sweep.cloud.origin + d * axis for d in (10.0, -10.0))
    np.testing.assert_array_equal(limited.labeled(np.stack([ahead, behind])), [True, False])
    np.testing.assert_array_equal(sweep.labeled(np.stack([ahead, behind])), [True, True])
    assert len(real_logs.sample_of(limited).xyz_m) < 0.6 * len(real_logs.sample_of(sweep).xyz_m)
    hidden = real_logs.LogView(camera, view.cam_T_cloud, np.array([[0.0, 0.0, camera.width_px, camera.height_px]]))
    assert not real_logs.LogSweep(sweep.cloud, sweep.truth, (hidden,)).labeled(ahead[None])[0]


class Fixed:
    """Detector that finds the same boxes everywhere."""

    name = "fixed"

    def __init__(self, rows: np.ndarray, categories: list[str], score: list[float]) -> None:
        self._boxes = rows, np.array(categories), np.array(score)

    def detect(self, cloud: Cloud, earlier: Any = ()) -> Boxes3D:
        rows, category, score = self._boxes
        n, one = len(rows), np.ones(len(rows))
        return Boxes3D(
            np.zeros(n, np.int64), rows[:, :3] + cloud.origin, rows[:, 3:6], rows[:, 6], one, category, score,
            np.full(n, 9),
        )  # fmt: skip


def test_figures_count_all_groups_together_at_one_score(sample: Sample) -> None:
    truth = SceneBoxes.of(BOXES, list(NAMES), points=np.full(4, 20))
    scenes = [real_logs.LogSweep(cloud_of(sample.xyz_m), truth, ())] * 2
    rows = BOXES[[0, 1, 2, 0, 3]]
    rows[3, 1] += 12
    rows[4, 0] += 0.9
    detector = Fixed(rows, ["car", "truck", "pedestrian", "car", "cyclist"], [0.9, 0.8, 0.7, 0.6, 0.3])
    result = table_rows.judged({"fixed": detector}, scenes)["fixed"]  # type: ignore[dict-item]
    f = table_rows.figures(result, table_rows.OVERLAP, 0.5)
    # Of 4 truths a scene 3 are found at .5, beside one false box; the rider is found by center only.
    assert f["truths"] == 8
    assert f["precision"] == f["recall"] == f["f1"] == 0.75
    assert f["precision_times_recall"] == 0.75**2
    assert f["average_precision"] == {"vehicle": 1.0, "two_wheeler": 0.0, "pedestrian": 1.0}
    assert f["mean_average_precision"] == pytest.approx(2 / 3)
    assert table_rows.figures(result, table_rows.CENTER, 0.2)["recall"] == 1.0
    # Only without the false box, and with all right ones.
    assert 0.6 < table_rows.best_score(result) <= 0.7 + 1e-9


def test_rows_of_the_table_are_made_once_and_written(tmp_path: Path) -> None:
    from benchmarks import zou2021 as t

    table = t.Table(tmp_path, {}, {}, {}, [], scenes=1, every=1, steps=1)
    assert table.row("a", lambda: {"value": 1}) == table.row("a", lambda: {"value": 2}) == {"value": 1}
    one = {"truths": 4, "precision": 0.5, "recall": 1.0, "f1": 2 / 3, "precision_times_recall": 0.5,
           "average_precision": {"vehicle": 0.25, "two_wheeler": None, "pedestrian": 1.0},
           "mean_average_precision": 0.625}  # fmt: skip
    figure = json.loads(json.dumps({"score": 0.35, "scenes": 7, "overlap": one, "center": one}))
    text = t.render(iter([("simulated", "votes", "KITTI", figure)]))
    row = text.splitlines()[2]
    for cell in ("KITTI (7)", ".500 / 1.00 / .667", ".250 / - / 1.00", ".625"):
        assert cell in row
