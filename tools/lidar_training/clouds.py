"""Simulated scenes as the clouds and truths that detectors and their evaluation take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.ground import ON_GROUND_M, estimate_ground
from log2sim.synth.traffic import Mount, TrafficScene, labeled_cloud
from log2sim.synth.traffic_random import draw_scene

GROUP_OF = {
    "car": "vehicle", "truck": "vehicle", "bus": "vehicle", "motorcycle": "two_wheeler", "cyclist": "two_wheeler",
    "bicycle": "two_wheeler", "pedestrian": "pedestrian",
}  # fmt: skip
MIN_COUNTED_POINTS = 5


@dataclass(frozen=True, eq=False)
class Example:
    """A cloud as `LidarDetector.detect` takes it, and the true boxes in the same frame, whose origin is the sensor's foot."""

    cloud: Cloud
    truth: SceneBoxes
    scene: TrafficScene


def draw_example(mount: Mount, seed: tuple[int, ...]) -> Example:
    """Draw a scene, cast it and level its cloud as the pipeline does."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(mount, rng)
    labeled = labeled_cloud(scene, rng)
    xyz = labeled.xyz_m
    height = xyz[:, 2] - estimate_ground(xyz, np.zeros(2), 0.0).at(xyz[:, :2])
    cloud = Cloud(
        stamp_ns=0, origin=np.zeros(3), xyz=xyz, t_s=np.zeros(len(xyz), np.float32),
        sensor=scene.sensor.position_m.astype(np.float32), ground=np.abs(height) <= ON_GROUND_M, height=height,
    )  # fmt: skip
    seen = labeled.points > 0
    ignored = (labeled.points < MIN_COUNTED_POINTS) | np.isin(labeled.category, ("bicycle", "other"))
    truth = SceneBoxes.of(labeled.boxes, labeled.category, points=labeled.points, ignored=ignored).take(seen)
    return Example(cloud, truth, scene)
