"""The second stage of LiDAR detectors: what it is given, what it changes, files that are none, and what it is good for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from lidar_networks import INFO, write_refinement
from test_detect3d_network import BOX, LOG, ORIGIN, cloud_of, solid, taller_is_hotter
from training.clouds import draw_example

from log2sim.config import LidarConfig
from log2sim.errors import ConfigError
from log2sim.geometry import Array, wrap_angle
from log2sim.perception.detect3d.boxes import LevelBoxes
from log2sim.perception.detect3d.detectors import create_lidar_detector, open_network, open_shipped
from log2sim.perception.detect3d.refinement import MOST_POINTS, box_inputs, points_around
from log2sim.perception.lidar.cloud import ON_GROUND_M


def boxes_at(rows: Sequence[Sequence[float]]) -> LevelBoxes:
    box = np.array(rows)
    one = np.ones(len(box))
    return LevelBoxes(
        box[:, :3], box[:, 3:6], box[:, 6], 0.7 * one, np.zeros(len(box), np.intp), np.full(len(box), "car"), one, -one
    )


@settings(max_examples=30, deadline=None)
@given(st.floats(-3.1, 3.1), st.floats(-30, 30), st.floats(-30, 30))
def test_inputs_do_not_depend_on_where_a_box_is_and_where_north_is(turn: float, x: float, y: float) -> None:
    """The scene turned and moved as a whole, points, box and sensor, gives the same inputs."""
    cloud, sensor = solid(*BOX[:2], yaw=BOX[6] + 0.05), np.array([1.0, 2.0])
    c, s = np.cos(turn), np.sin(turn)
    rotation = np.array([[c, -s], [s, c]])

    def inputs(points: Array, box: Sequence[float], sensor: Array) -> tuple[Array, Array]:
        xyz, boxes = points.astype(np.float32), boxes_at([box])
        pairs = points_around(xyz, boxes)
        # In one order, which the cells of the search give otherwise.
        pairs = replace(pairs, point=np.sort(pairs.point)).sample(MOST_POINTS)
        return box_inputs(xyz, pairs, pairs.count, boxes, (sensor - boxes.center_m[0, :2])[None], 64)

    moved = cloud.copy()
    moved[:, :2] = cloud[:, :2] @ rotation.T + [x, y]
    box = (*(rotation @ BOX[:2] + [x, y]), *BOX[2:6], BOX[6] + turn)
    for one, other in zip(inputs(cloud, BOX, sensor), inputs(moved, box, rotation @ sensor + [x, y])):
        assert np.isfinite(one).all()
        np.testing.assert_allclose(one, other, atol=2e-4)


def test_corrections_are_applied_to_the_boxes_of_the_first_stage(tmp_path: Path) -> None:
    """A car of the first stage is moved along its own axes, sized, turned and reversed, and becomes a cyclist; its score is that of the second stage."""
    first = taller_is_hotter(tmp_path, name="first")
    # One in nine each for the car, the motorcycle and nothing, two for the truck, four for the cyclist.
    logits = [0.0, np.log(2.0), -40.0, 0.0, np.log(4.0), -40.0]
    corrections = [*logits, 0.4, -0.2, 0.1, *np.log([1.2, 0.8, 0.9]), np.sin(0.4), np.cos(0.4), -3.0, 1.0]
    cloud = cloud_of(solid(10, 6, 2.0, 2.0, 1.9))
    before = create_lidar_detector(f"lidar:{first}", LOG, LidarConfig()).detect(cloud)
    write_refinement(tmp_path / "taller.boxes.onnx", corrections)
    detector = create_lidar_detector(f"lidar:{first}", LOG, LidarConfig())
    after = detector.detect(cloud)
    assert len(after) > 0
    away = np.hypot(*(before.center_m[:, None, :2] + [0.4, -0.2] - after.center_m[:, :2]).T)
    assert away.min(axis=1).max() < 1e-3
    np.testing.assert_allclose(after.center_m[:, 2] - ORIGIN[2], 1.1, atol=1e-3)
    np.testing.assert_allclose(after.size_m, np.tile([2.9 * 1.2, 2.9 * 0.8, 1.8], (len(after), 1)), rtol=1e-4)
    np.testing.assert_allclose(wrap_angle(after.yaw_rad - 0.2 - np.pi), 0, atol=1e-5)
    np.testing.assert_allclose(after.heading_score, 1 / (1 + np.exp(-3.0)), rtol=1e-5)
    np.testing.assert_allclose(after.score, 5 / 9, rtol=1e-5)
    assert set(after.category) == {"cyclist"}
    # Results are kept by what they depend on, the second file included.
    assert detector.cache_key != replace(detector, refinement=None).cache_key  # type: ignore[attr-defined, type-var]


def test_boxes_without_points_are_left_out_and_none_are_fine(tmp_path: Path) -> None:
    first = taller_is_hotter(tmp_path)
    write_refinement(tmp_path / "taller.boxes.onnx", [2.0, *np.zeros(12), 1.0, 1.0, 1.0])
    detector: Any = open_network(first, LidarConfig(), name="x")
    assert len(detector.detect(cloud_of(np.zeros((0, 3))))) == 0
    assert len(detector.detect(cloud_of(np.full((5, 3), np.nan)))) == 0
    xyz = solid(10, 6).astype(np.float32)
    xyz = xyz[xyz[:, 2] > ON_GROUND_M]
    boxes, inside = detector.refinement.refine(boxes_at([BOX, (30.5, 30.5, *BOX[2:])]), xyz, np.zeros((1, 2)))
    assert (len(boxes), inside.boxes) == (1, 1)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"inputs": ("points", "boxes")}, "expected inputs"),
        ({"points": 10_000}, "expected inputs"),
        ({"metadata": None}, "version"),
        ({"metadata": INFO | {"version": 2}}, "'version' is 2"),
        ({"metadata": INFO | {"groups": ["vehicle"]}}, "groups"),
        ({"metadata": INFO | {"calibration": {}}}, "calibration"),
        ({"corrections": [1.0, 2.0]}, "expected"),
    ],
)
def test_a_file_that_is_no_second_stage_is_named(tmp_path: Path, changes: dict[str, Any], message: str) -> None:
    first, arguments = taller_is_hotter(tmp_path), {"corrections": np.zeros(16), **changes}
    write_refinement(tmp_path / "taller.boxes.onnx", **arguments)
    with pytest.raises(ConfigError, match=message) as caught:
        create_lidar_detector(f"lidar:{first}", LOG, LidarConfig())
    assert "taller.boxes.onnx" in str(caught.value)


@pytest.mark.parametrize("mount", ["vehicle", "roadside"])
def test_people_and_riders_are_placed_better_than_by_the_first_stage(mount: Any) -> None:
    both = open_shipped(mount, LidarConfig())
    away: dict[bool, list[float]] = {False: [], True: []}
    for example in [draw_example(mount, (31, k)) for k in range(10)]:
        slim = np.isin(example.truth.category, ("pedestrian", "cyclist", "motorcycle"))
        true = example.truth.box[slim & (example.truth.points >= 20), :2]
        for second, detector in ((False, replace(both, refinement=None)), (True, both)):
            found = detector.detect(example.cloud)
            nearest = np.hypot(*(found.center_m[:, None, :2] - true).T).min(axis=1, initial=9.0)
            away[second] += nearest[nearest < 1.0].tolist()
    # One of eighty more or less within a meter is chance.
    assert len(away[True]) > 0.95 * len(away[False]) > 15
    assert np.median(away[True]) < 0.7 * np.median(away[False])
