"""Boxes from hand-made maps: what was encoded comes back; headings, categories, suppression, bad values."""

from __future__ import annotations

import numpy as np
import pytest
from lidar_networks import NAMES, empty_maps, encode, info
from numpy.typing import NDArray
from training.clouds import draw_example

from log2sim.config import LidarConfig
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.protocols import Criterion, match_detections
from log2sim.geometry import Array, wrap_angle
from log2sim.perception.detect3d.boxes import (
    MAX_PEAKS,
    MIN_HEAT,
    decode_centers,
    decode_votes,
    headings,
    mean_shift,
    sigmoid,
    suppress,
)
from log2sim.perception.detect3d.detectors import open_shipped

LOW = np.array([-20.0, -12.0])


SIZES = {
    "car": (4.4, 1.8, 1.5), "truck": (8.0, 2.5, 3.2), "bus": (12.0, 2.6, 3.1), "motorcycle": (2.1, 0.8, 1.5),
    "cyclist": (1.8, 0.6, 1.7), "pedestrian": (0.6, 0.7, 1.75),
}  # fmt: skip


def test_boxes_encoded_into_maps_come_back() -> None:
    rng = np.random.default_rng(3)
    maps, truth = empty_maps(80, 48), []
    for k, name in enumerate(NAMES):
        box = (-17 + 6.0 * k, rng.uniform(-10, 10), 0.8 + 0.1 * k, *SIZES[name], rng.uniform(-3.1, 3.1))
        encode(maps, box, name, low=LOW, logit=5.0 - k)
        truth.append(box)
    found = decode_centers(maps, info(), LOW)
    assert found.category.tolist() == list(NAMES)
    assert found.group.tolist() == [0, 0, 0, 1, 1, 2]
    expected = np.array(truth)
    np.testing.assert_allclose(found.center_m, expected[:, :3], atol=2e-5)
    np.testing.assert_allclose(found.size_m, expected[:, 3:6], rtol=1e-6)
    np.testing.assert_allclose(wrap_angle(found.yaw_rad - expected[:, 6]), 0, atol=1e-6)
    np.testing.assert_allclose(found.heat, 5.0 - np.arange(6))
    np.testing.assert_allclose(found.heading_score, 1.0, atol=1e-6)


def test_maps_of_another_layout_are_read_by_their_description() -> None:
    other = info(groups=["pedestrian"], cell_m=0.2, stride=4)
    maps = np.zeros((1 + 6 + 2 + 2 + 1 + 2 + 2, 4, 4), np.float32)
    maps[0] = -9
    maps[0, 1, 2] = 1.5
    maps[1:7, 1, 2] = 0.1, -0.2, 0.9, 0, 0, 0.5
    found = decode_centers(maps, other, LOW)
    np.testing.assert_allclose(found.center_m, [[-20 + 1.5 * 0.8 + 0.1, -12 + 2.5 * 0.8 - 0.2, 0.9]], atol=1e-6)
    np.testing.assert_allclose(found.size_m, [[1, 1, np.exp(0.5)]], rtol=1e-6)
    assert found.category.tolist() == ["pedestrian"]


@pytest.mark.parametrize("yaw", np.linspace(-3.1, 3.1, 9))
@pytest.mark.parametrize("p", [0.0, 0.2, 0.5, 0.9, 1.0])
def test_the_heading_points_to_the_likelier_side_and_knows_how_likely_that_is(yaw: float, p: float) -> None:
    axis = np.array([[np.sin(2 * yaw)], [np.cos(2 * yaw)]])
    direction = (2 * p - 1) * np.array([[np.sin(yaw)], [np.cos(yaw)]])
    found, score = headings(axis, direction)
    assert score[0] == pytest.approx(max(p, 1 - p))
    turned = abs(float(wrap_angle(found[0] - yaw)))
    if p != 0.5:
        assert turned == pytest.approx(0 if p > 0.5 else np.pi, abs=1e-9)
    assert -np.pi <= found[0] < np.pi


def test_peaks_are_greatest_among_neighbors_of_the_same_center_and_strongest_first() -> None:
    rng = np.random.default_rng(1)
    maps = empty_maps(30, 20)
    maps[:3] = rng.normal(-2, 1, (3, 30, 20))
    # The same box relative to each cell, so wide that all neighbors mean one object.
    maps[8:14] = np.arange(6)[:, None, None]
    found = decode_centers(maps, info(), LOW)
    padded = np.pad(maps[:3], ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    around = np.max([padded[:, i : i + 30, j : j + 20] for i in range(3) for j in range(3)], axis=0)
    likely = maps[:3] >= np.log(MIN_HEAT / (1 - MIN_HEAT))
    np.testing.assert_allclose(found.heat, np.sort(maps[:3][likely & (maps[:3] == around)])[: -MAX_PEAKS - 1 : -1])
    maps[8:14] = 0  # a width of 1 m, and centers as far apart as cells, 0.5 m
    found = decode_centers(maps, info(), LOW)
    np.testing.assert_allclose(found.heat, np.sort(maps[:3][likely])[: -MAX_PEAKS - 1 : -1])


def test_people_side_by_side_are_two() -> None:
    maps = empty_maps(80, 48)
    people = [(0.2, 0.2, 0.9, *SIZES["pedestrian"], 0.3), (0.2, 0.8, 0.9, *SIZES["pedestrian"], 2.0)]
    encode(maps, people[0], "pedestrian", low=LOW, logit=5.0, cells=1)
    encode(maps, people[1], "pedestrian", low=LOW, logit=2.5)
    found = decode_centers(maps, info(), LOW)
    np.testing.assert_allclose(found.center_m, [person[:3] for person in people], atol=1e-5)
    np.testing.assert_allclose(found.heat, [5.0, 2.5])


def rectangles(*rows: tuple[float, ...]) -> Array:
    return np.array(rows)


def chosen(boxes: Array, score: list[float], group: list[int], *, across: bool = True) -> list[int]:
    return suppress(boxes, np.array(score), np.array(group), across=across).tolist()


def test_the_stronger_of_two_boxes_on_one_ground_stays() -> None:
    cars = rectangles((0, 0, 4.4, 1.8, 0), (0.6, 0.1, 4.4, 1.8, 0.1), (0, 2.4, 4.4, 1.8, 0))
    assert chosen(cars, [0.5, 0.9, 0.7], [0, 0, 0]) == [1, 2]
    assert chosen(cars, [0.9, 0.5, 0.7], [0, 0, 0]) == [0, 2]


def test_a_suppressed_box_suppresses_nothing() -> None:
    row = rectangles((0, 0, 4, 2, 0), (2.4, 0, 4, 2, 0), (4.8, 0, 4, 2, 0))
    assert chosen(row, [0.9, 0.8, 0.7], [0, 0, 0]) == [0, 2]


def test_a_person_inside_a_car_goes_and_one_beside_it_stays() -> None:
    scene = rectangles((0, 0, 4.4, 1.8, 0), (1, 0.2, 0.6, 0.6, 0), (0.5, 1.1, 0.6, 0.6, 0))
    assert chosen(scene, [0.9, 0.8, 0.8], [0, 2, 2]) == [0, 2]
    assert chosen(scene, [0.7, 0.8, 0.6], [0, 2, 2]) == [1, 2]
    assert chosen(scene, [0.9, 0.8, 0.8], [0, 2, 2], across=False) == [0, 2, 1]


def test_the_order_of_boxes_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    boxes = np.column_stack([rng.uniform(-15, 15, (60, 2)), rng.uniform(0.5, 5, (60, 2)), rng.uniform(-3, 3, 60)])
    score, group = rng.choice([0.2, 0.5, 0.8], 60), rng.integers(0, 3, 60)
    kept = suppress(boxes, score, group)
    order = rng.permutation(60)
    assert order[suppress(boxes[order], score[order], group[order])].tolist() == kept.tolist()
    assert 5 < len(kept) < 60


LOW_VOTES = np.array([-10.0, -10.0])
CAR = (4.4, 1.8, 1.5)


def grid_of(maps: NDArray[np.float32], top_m: float = 1.5) -> NDArray[np.float32]:
    """The grid, two cells a cell of the maps, of a cloud with points of one height everywhere."""
    grid = np.zeros((12, 2 * maps.shape[1], 2 * maps.shape[2]), np.float32)
    grid[0] = top_m / 2
    return grid


def test_the_majority_decides_and_the_score_is_its_mean_probability() -> None:
    maps = empty_maps(40, 40)
    encode(maps, (0.2, 0.2, 0.8, *CAR, 0.0), "car", low=LOW_VOTES, cells=1)
    maps[19:23, 19:22, 19:22] = 0
    maps[20, 19:22, 19:22] = np.log(6.0)
    maps[19:23, 19, 19:21] = np.array([0, 0, np.log(6.0), 0])[:, None]
    found = decode_votes(maps, grid_of(maps, 1.5), info(), LOW_VOTES)
    assert found.category.tolist() == ["car"]
    # Six ninths of the cells give the class 6 / 9, one third of the remaining ones 1 / 9.
    assert sigmoid(found.heat)[0] == pytest.approx((7 * 6 / 9 + 2 * 1 / 9) / 9)


def exact_mode(vote: NDArray[np.float64], start: NDArray[np.float64], h: float) -> NDArray[np.float64]:
    """Mean shift by its definition."""
    x = start
    for _ in range(200):
        weight = np.exp(-np.sum((vote - x) ** 2, axis=1) / (2 * h * h))
        x = weight @ vote / weight.sum()
    return x


def test_mean_shift_finds_the_modes_of_the_definition() -> None:
    rng = np.random.default_rng(6)
    centers = np.array([[0.0, 0.0], [4.0, 1.0], [-3.0, 5.0]])
    vote = np.concatenate([c + rng.normal(0, 0.3, (30, 2)) for c in centers]) + 1000.0
    mode, index = mean_shift(vote, 0.9)
    for k in range(3):
        own = index[30 * k : 30 * (k + 1)]
        expected = exact_mode(vote, vote[30 * k], 0.9)
        assert np.linalg.norm(mode[own] - expected, axis=1).max() < 0.25


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
    examples = [draw_example(request.param, (31, k)) for k in range(7)]
    return detector, examples, [found_in(e, detector) for e in examples]


def test_most_vehicles_with_many_points_are_found_and_few_are_invented(scenes) -> None:
    _, examples, found = scenes
    sure = SceneBoxes.join([vehicles(f).take(vehicles(f).score >= 0.5) for f in found])
    truth = SceneBoxes.join([vehicles(e.truth) for e in examples])
    near = truth.ignoring((truth.points < 50) | (truth.range_m > 25))
    matches = match_detections(sure, near, Criterion("iou_bev", 0.5))
    assert matches.truths > 25
    assert matches.right.sum() / matches.truths > 0.75
    # What is found farther away, or by few points, is no invention.
    every = match_detections(sure, truth, Criterion("iou_bev", 0.5))
    assert every.right.sum() / (every.right | every.false).sum() > 0.8


def test_most_headings_point_forward(scenes) -> None:
    _, examples, found = scenes
    sure = SceneBoxes.join([vehicles(f).take(vehicles(f).score >= 0.5) for f in found])
    truth = SceneBoxes.join([vehicles(e.truth) for e in examples])
    matches = match_detections(sure, truth, Criterion("iou_bev", 0.5))
    off = wrap_angle(sure.box[matches.right, 6] - truth.box[matches.truth[matches.right], 6])
    assert np.mean(np.abs(off) < np.pi / 2) > 0.75
