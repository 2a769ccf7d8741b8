"""Boxes from votes: one cluster an object, majority of its cells, boxes averaged, nothing from the ground."""

from __future__ import annotations

import numpy as np
import pytest
from lidar_networks import empty_maps, encode, info
from numpy.typing import NDArray

from log2sim.perception.detect3d.boxes import LevelBoxes, decode_votes, mean_shift, sigmoid

LOW = np.array([-10.0, -10.0])
CAR = (4.4, 1.8, 1.5)


def grid_of(maps: NDArray[np.float32], top_m: float = 1.5) -> NDArray[np.float32]:
    """The grid, two cells a cell of the maps, of a cloud with points of one height everywhere."""
    grid = np.zeros((12, 2 * maps.shape[1], 2 * maps.shape[2]), np.float32)
    grid[0] = top_m / 2
    return grid


def decode(maps: NDArray[np.float32], top_m: float = 1.5) -> LevelBoxes:
    return decode_votes(maps, grid_of(maps, top_m), info(), LOW)


def test_two_objects_become_two_boxes_as_encoded() -> None:
    maps = empty_maps(40, 40)
    boxes = [(-4.2, -3.1, 0.8, *CAR, 0.7), (5.3, 4.4, 0.9, 0.6, 0.7, 1.75, -2.0)]
    encode(maps, boxes[0], "car", low=LOW, cells=3)
    encode(maps, boxes[1], "pedestrian", low=LOW, cells=1)
    found = decode(maps)
    order = np.argsort(found.group)
    found = found.take(order)
    assert found.category.tolist() == ["car", "pedestrian"]
    np.testing.assert_allclose(np.column_stack([found.center_m, found.size_m, found.yaw_rad]), boxes, atol=1e-4)
    np.testing.assert_allclose(found.heading_score, 1.0, atol=1e-5)
    assert np.all(sigmoid(found.heat) > 0.999)


def test_the_majority_decides_and_the_score_is_its_mean_probability() -> None:
    maps = empty_maps(40, 40)
    encode(maps, (0.2, 0.2, 0.8, *CAR, 0.0), "car", low=LOW, cells=1)
    maps[19:23, 19:22, 19:22] = 0
    maps[20, 19:22, 19:22] = np.log(6.0)
    maps[19:23, 19, 19:21] = np.array([0, 0, np.log(6.0), 0])[:, None]
    found = decode(maps)
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
