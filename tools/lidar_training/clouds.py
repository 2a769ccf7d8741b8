"""Simulated scenes as the clouds and truths that detectors and their evaluation take."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.protocols import MIN_POINTS
from log2sim.geometry import Array
from log2sim.perception.lidar.cloud import ON_GROUND_M, Cloud, estimate_ground
from log2sim.synth.traffic import Mount, draw_scene, labeled_cloud


@dataclass(frozen=True, eq=False)
class Example:
    """A cloud as `LidarDetector.detect` takes it, and the true boxes in the same frame, whose origin is the sensor's foot."""

    cloud: Cloud
    truth: SceneBoxes


def level(xyz_m: NDArray[np.float32], sensor_m: Array) -> Cloud:
    """Level the points of a simulated sweep as the pipeline does; the origin is below the sensor."""
    height = xyz_m[:, 2] - estimate_ground(xyz_m, np.zeros(2), 0.0).at(xyz_m[:, :2])
    return Cloud(
        stamp_ns=0, origin=np.zeros(3), xyz=xyz_m, t_s=np.zeros(len(xyz_m), np.float32),
        sensor=sensor_m.astype(np.float32), ground=np.abs(height) <= ON_GROUND_M, height=height,
    )  # fmt: skip


def draw_example(mount: Mount, seed: tuple[int, ...]) -> Example:
    """Draw a scene, cast it and level its cloud as the pipeline does."""
    rng = np.random.default_rng(seed)
    scene = draw_scene(mount, rng)
    labeled = labeled_cloud(scene, rng)
    cloud = level(labeled.xyz_m, scene.sensor.position_m)
    seen = labeled.points > 0
    ignored = (labeled.points < MIN_POINTS) | np.isin(labeled.category, ("bicycle", "other"))
    truth = SceneBoxes.of(labeled.boxes, labeled.category, points=labeled.points, ignored=ignored).take(seen)
    return Example(cloud, truth)
