"""The networks that ship, on simulated scenes that they were not trained on."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from lidar_training.clouds import draw_example

from log2sim.config import LidarConfig
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.protocols import Criterion, match
from log2sim.geometry import wrap_angle
from log2sim.perception.detect3d.detectors import open_shipped

VEHICLES = ("car", "truck", "bus")


def vehicles(boxes: SceneBoxes) -> SceneBoxes:
    return boxes.take(np.isin(boxes.category, VEHICLES))


def found_in(example, detector) -> SceneBoxes:
    found = detector.detect(example.cloud)
    rows = np.column_stack([found.center_m, found.size_m, found.yaw_rad])
    return SceneBoxes.of(rows, found.category, found.score, points=found.points)


@pytest.fixture(scope="module", params=["vehicle", "roadside"])
def scenes(request):
    detector = open_shipped(request.param, LidarConfig())
    examples = [draw_example(request.param, (31, k)) for k in range(10)]
    return detector, examples, [found_in(e, detector) for e in examples]


def test_most_vehicles_with_many_points_are_found_and_few_are_invented(scenes) -> None:
    _, examples, found = scenes
    sure = SceneBoxes.join([vehicles(f).take(vehicles(f).score >= 0.5) for f in found])
    truth = SceneBoxes.join([vehicles(e.truth) for e in examples])
    near = truth.ignoring((truth.points < 50) | (truth.range_m > 25))
    matches = match(sure, near, Criterion("iou_bev", 0.5))
    assert matches.truths > 40
    assert matches.right.sum() / matches.truths > 0.8
    assert matches.right.sum() / (matches.right | matches.false).sum() > 0.8


def test_most_headings_point_forward(scenes) -> None:
    _, examples, found = scenes
    sure = SceneBoxes.join([vehicles(f).take(vehicles(f).score >= 0.5) for f in found])
    truth = SceneBoxes.join([vehicles(e.truth) for e in examples])
    matches = match(sure, truth, Criterion("iou_bev", 0.5))
    off = wrap_angle(sure.box[matches.right, 6] - truth.box[matches.truth[matches.right], 6])
    assert np.mean(np.abs(off) < np.pi / 2) > 0.75


def test_a_turned_scene_gives_turned_boxes(scenes) -> None:
    """By a quarter turn, which maps cells onto cells."""
    detector, examples, found = scenes
    cloud = examples[0].cloud
    xyz = np.column_stack([-cloud.xyz[:, 1], cloud.xyz[:, 0], cloud.xyz[:, 2]])
    sensor = np.array([-cloud.sensor[1], cloud.sensor[0], cloud.sensor[2]], np.float32)
    turned = detector.detect(replace(cloud, xyz=xyz, sensor=sensor))
    sure = found[0].take(found[0].score > 0.6)
    away = np.hypot(turned.center_m[:, 0] + sure.box[:, None, 1], turned.center_m[:, 1] - sure.box[:, None, 0])
    assert len(sure) > 3
    assert np.mean(away.min(axis=1) < 1.0) > 0.8
