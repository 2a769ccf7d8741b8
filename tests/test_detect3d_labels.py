"""Labels as 3D boxes of a cloud: time, range, points, and no use of ids; names of LiDAR detectors; points in boxes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from test_detect_labels import CAR, SECOND, log_with
from worlds import cloud_at

from log2sim.config import LidarConfig
from log2sim.datatypes import Boxes3D, Log
from log2sim.geometry import Array, points_in_box
from log2sim.perception.detect3d.box_points import points_of_boxes
from log2sim.perception.detect3d.detectors import create_lidar_detector
from log2sim.perception.lidar.cloud import Cloud

ORIGIN = np.array([1000.0, 2000.0, 30.0])


def cloud_of(xyz_map: Any, *, stamp_ns: int = 0, ground_z: float = 30.0) -> Cloud:
    """A cloud of points (N, 3) of the map, on a flat ground, seen from 2 m above the origin."""
    xyz = np.asarray(xyz_map, np.float64).reshape(-1, 3)
    return cloud_at(xyz - ORIGIN, xyz[:, 2] - ground_z, stamp_ns=stamp_ns, origin=ORIGIN)


def detect(log: Log, cloud: Cloud, **settings: Any) -> Boxes3D:
    return create_lidar_detector("lidar:labels", log, LidarConfig(**settings)).detect(cloud)


def test_a_label_with_points_becomes_a_box_and_one_without_does_not() -> None:
    center = (1010.0, 2000.0, 30.75)
    log = log_with((0, "car", center, CAR), (0, "car", (1020.0, 2000.0, 30.75), CAR))
    found = detect(log, cloud_of([[1009.0, 2000.5, 31.0], [1010.0, 1999.5, 30.9], [1030.0, 2000.0, 31.0]]))
    assert found.center_m.tolist() == [list(center)]
    assert (found.points.tolist(), found.score.tolist(), found.heading_score.tolist()) == ([2], [1.0], [1.0])
    assert (found.category.tolist(), found.t_ns.tolist()) == (["car"], [0])


def test_labels_move_to_the_stamp_of_the_cloud() -> None:
    log = log_with((0, "car", (1010.0, 2000.0, 30.75), CAR), (SECOND // 10, "car", (1011.0, 2000.0, 30.75), CAR))
    found = detect(log, cloud_of([[1010.5, 2000.0, 31.0]], stamp_ns=SECOND // 20))
    np.testing.assert_allclose(found.center_m, [[1010.5, 2000.0, 30.75]])
    assert found.t_ns.tolist() == [SECOND // 20]


def test_the_object_with_most_points_comes_first_and_far_ones_are_left_out() -> None:
    log = log_with(*((0, "car", (1000.0 + x, 2000.0, 30.75), CAR) for x in (10.0, 20.0, 60.0)))
    cloud = cloud_of([[1010.0, 2000.0, 31.0], [1020.0, 2000.0, 31.0], [1020.5, 2000.0, 31.0], [1060.0, 2000.0, 31.0]])
    assert detect(log, cloud).center_m[:, 0].tolist() == [1020.0, 1010.0, 1060.0]
    assert detect(log, cloud, range_m=59.0).center_m[:, 0].tolist() == [1020.0, 1010.0]


def random_boxes(rng: np.random.Generator, m: int) -> tuple[Array, Array, Array]:
    return rng.uniform(-30, 30, (m, 3)) * [1, 1, 0.05], rng.uniform(0.3, 12, (m, 3)), rng.uniform(-4, 4, m)


@pytest.mark.parametrize("scale", [0.1, 1.0, 30.0])
def test_points_of_boxes_are_those_of_each_box_alone(scale: float) -> None:
    rng = np.random.default_rng(5)
    center, size, yaw = random_boxes(rng, 40)
    center, size = center * scale, size * scale
    xyz = (rng.uniform(-35, 35, (4000, 3)) * [1, 1, 0.1] * scale).astype(np.float32)
    xyz[7] = np.nan
    usable = rng.random(4000) < 0.8
    found = points_of_boxes(xyz, center, size, yaw, usable)
    expected = [np.flatnonzero(points_in_box(xyz.astype(float), *box) & usable) for box in zip(center, size, yaw)]
    for k, index in enumerate(expected):
        assert sorted(found.point[found.box == k].tolist()) == index.tolist()
    assert found.count.tolist() == [len(e) for e in expected]
    assert sum(found.count) > 100
    z = found.mean(xyz[:, 2])
    some = found.sample(10)
    assert some.count.tolist() == [-(-len(e) // max(-(-len(e) // 10), 1)) for e in expected]
    assert set(zip(some.box.tolist(), some.point.tolist())) <= set(zip(found.box.tolist(), found.point.tolist()))
    np.testing.assert_allclose(z, [xyz[e, 2].mean(dtype=float) if len(e) else 0.0 for e in expected], atol=1e-5 * scale)
