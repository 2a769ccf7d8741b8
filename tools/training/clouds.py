"""Simulated scenes as the clouds and truths that detectors and their evaluation take."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.protocols import MIN_POINTS
from log2sim.geometry import Array
from log2sim.perception.detect3d.network import MAX_HEIGHT_M, MIN_HEIGHT_M, rasterize
from log2sim.perception.lidar.cloud import ON_GROUND_M, Cloud, Ground, estimate_ground
from log2sim.synth.traffic import Mount, draw_scene


@dataclass(frozen=True, eq=False)
class Example:
    """A cloud as `LidarDetector.detect` takes it, and the true boxes in the same frame, whose origin is the sensor's foot."""

    cloud: Cloud
    truth: SceneBoxes
    ground_m: Array  # (M,): height of the ground under each box


def level(xyz_m: NDArray[np.float32], sensor_m: Array) -> tuple[Cloud, Ground]:
    """Level the points of a simulated sweep as the pipeline does, and return the ground as well; the origin is below the sensor."""
    ground = estimate_ground(xyz_m, np.zeros(2), 0.0)
    height = xyz_m[:, 2] - ground.at(xyz_m[:, :2])
    cloud = Cloud(
        stamp_ns=0, origin=np.zeros(3), xyz=xyz_m, t_s=np.zeros(len(xyz_m), np.float32),
        sensor=sensor_m.astype(np.float32), ground=np.abs(height) <= ON_GROUND_M, height=height,
    )  # fmt: skip
    return cloud, ground


# Kinds that training does not see: scores are calibrated on scenes that have the first of them, reports on such that have all.
CALIBRATED_KINDS = frozenset({"suitcase", "pram", "child trailer", "pillion", "caravan", "hydrant", "parasol"})
REPORTED_KINDS = frozenset(
    {"wheelchair", "umbrella", "cargo bicycle", "top box", "excavator", "clothes rail", "sign board"}
)


def draw_example(mount: Mount, seed: tuple[int, ...], without: frozenset[str] = frozenset()) -> Example:
    """Draw a scene without some kinds, cast it, level its cloud as the pipeline does, and box the road users that it shows.

    Each box is where its road user is at the mean time of the points on it.
    """
    rng = np.random.default_rng(seed)
    scene = draw_scene(mount, rng, without=without)
    returns = scene.cast(rng)
    cloud, ground = level(returns.xyz_m, scene.sensor.position_m)
    on_object = returns.hit >= 0
    count = np.bincount(returns.hit[on_object], minlength=len(scene.objects))
    total_s = np.bincount(returns.hit[on_object], returns.t_s[on_object], minlength=len(scene.objects))
    users = [k for k, o in enumerate(scene.objects) if o.category and count[k]]
    boxes = np.zeros((len(users), 7))
    for row, k in enumerate(users):
        item = scene.objects[k]
        position, yaw = item.pose_at(float(total_s[k] / count[k]))
        boxes[row] = *position[:2], position[2] + item.size_m[2] / 2, *item.size_m, yaw
    category, points = np.array([scene.objects[k].category for k in users], dtype="<U16"), count[users]
    ignored = (points < MIN_POINTS) | np.isin(category, ("bicycle", "other"))
    truth = SceneBoxes.of(boxes, category, points=points, ignored=ignored)
    return Example(cloud, truth, ground.at(truth.box[:, :2].astype(np.float32)))


STEP_M = 0.005  # of stored coordinates
KEPT_RANGE_M = 55.0
CATEGORIES = ("car", "truck", "bus", "motorcycle", "cyclist", "pedestrian", "bicycle", "other")


@dataclass(frozen=True, eq=False)
class Sample:
    """A leveled cloud and its road users."""

    xyz_m: NDArray[np.float32]  # (N, 3), m: z is the height above the estimated ground; the sensor is at x = y = 0
    boxes: NDArray[np.float32]  # (M, 7): x, y, z, length, width, height, heading
    category: NDArray[np.int64]  # (M,): index into CATEGORIES
    points: NDArray[np.int64]  # (M,)


def sample_of(example: Example) -> Sample:
    """Turn an example into a sample to train on."""
    cloud, truth = example.cloud, example.truth
    xyz, boxes = cloud.xyz.copy(), truth.box.astype(np.float32)
    xyz[:, 2] = cloud.height
    boxes[:, 2] -= example.ground_m
    near = (np.abs(xyz[:, :2]) < KEPT_RANGE_M).all(axis=1) & (xyz[:, 2] > MIN_HEIGHT_M) & (xyz[:, 2] < MAX_HEIGHT_M)
    names = [c if c in CATEGORIES else "other" for c in truth.category.tolist()]
    assert truth.points is not None
    return Sample(xyz[near], boxes, np.array([CATEGORIES.index(c) for c in names], np.int64), truth.points)


def draw_sample(mount: Mount, seed: tuple[int, ...]) -> Sample:
    """Draw a scene to train on, cast it and level its cloud."""
    return sample_of(draw_example(mount, seed, CALIBRATED_KINDS | REPORTED_KINDS))


def write_shard(path: Path, samples: list[Sample]) -> None:
    """Write samples to a file, under a temporary name first."""
    temporary = path.with_suffix(".part")
    with temporary.open("wb") as file:
        np.savez(
            file,
            xyz=np.concatenate([np.rint(s.xyz_m / STEP_M).astype(np.int16) for s in samples]),
            counts=np.array([len(s.xyz_m) for s in samples]),
            boxes=np.concatenate([s.boxes for s in samples]),
            category=np.concatenate([s.category for s in samples]),
            points=np.concatenate([s.points for s in samples]),
            users=np.array([len(s.boxes) for s in samples]),
        )
    os.replace(temporary, path)


class Shard:
    """Samples of a file, decoded one by one."""

    def __init__(self, path: Path) -> None:
        with np.load(path) as data:
            self._columns = {name: data[name] for name in data.files}
        self._ends = np.cumsum(self._columns["counts"]), np.cumsum(self._columns["users"])

    def __len__(self) -> int:
        return len(self._columns["counts"])

    def __getitem__(self, k: int) -> Sample:
        c = self._columns
        p = slice(self._ends[0][k] - c["counts"][k], self._ends[0][k])
        u = slice(self._ends[1][k] - c["users"][k], self._ends[1][k])
        return Sample(
            c["xyz"][p].astype(np.float32) * np.float32(STEP_M), c["boxes"][u], c["category"][u], c["points"][u]
        )


def augmented(sample: Sample, rng: np.random.Generator) -> Sample:
    """Turn, mirror, thin out and tilt a sample a little."""
    angle, mirror = rng.uniform(-np.pi, np.pi), rng.random() < 0.5
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, s], [-s, c]], np.float32)
    xyz, boxes = sample.xyz_m.copy(), sample.boxes.copy()
    if mirror:
        xyz[:, 1] *= -1
        boxes[:, 1] *= -1
        boxes[:, 6] *= -1
    xyz[:, :2] = xyz[:, :2] @ turn
    boxes[:, :2] = boxes[:, :2] @ turn
    boxes[:, 6] += angle
    share = rng.choice([0.0, rng.uniform(0, 0.5), rng.uniform(0.5, 0.8)], p=[0.5, 0.4, 0.1])
    if share:
        xyz = xyz[rng.random(len(xyz)) >= share]
    # The estimate of the ground errs on real roads by a little more than on simulated ones.
    xyz[:, 2] += np.float32(rng.normal(0, 0.01)) + xyz[:, :2] @ rng.normal(0, 0.0005, 2).astype(np.float32)
    return Sample(xyz, boxes, sample.category, np.rint(sample.points * (1 - share)).astype(np.int64))


def window_of(rng: np.random.Generator, cells: int, cell_m: float, shift_m: float = 10.0) -> np.ndarray:
    """Draw the lower corner (2,) of a square grid around the sensor, m."""
    return np.asarray(rng.uniform(-shift_m, shift_m, 2) - cells * cell_m / 2)


def grid_of(sample: Sample, low: np.ndarray, cells: int, cell_m: float) -> NDArray[np.float32]:
    """Rasterize a sample in a square window."""
    return rasterize(sample.xyz_m, cell_m=cell_m, low=low, shape=(cells, cells))
