"""Boxes from votes: one cluster an object, majority of its cells, boxes averaged, nothing from the ground."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from lidar_networks import empty_maps, encode, info
from numpy.typing import NDArray

from log2sim.perception.detect3d.boxes import LevelBoxes, bandwidths_m, cluster, decode_votes, mean_shift, sigmoid

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


def test_cars_side_by_side_are_two_though_their_cells_touch() -> None:
    maps = empty_maps(40, 40)
    for y in (-1.25, 1.25):
        encode(maps, (0.1, y, 0.8, *CAR, 0.0), "car", low=LOW, cells=2)
    found = decode(maps)
    assert sorted(np.round(found.center_m[:, 1], 2).tolist()) == [-1.25, 1.25]


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


def test_ground_cells_and_empty_cells_do_not_vote() -> None:
    maps = empty_maps(40, 40)
    encode(maps, (0.2, 0.2, 0.8, *CAR, 0.0), "car", low=LOW, cells=2)
    assert len(decode(maps, top_m=0.2)) == 0
    assert len(decode(maps, top_m=0.0)) == 0
    assert len(decode(maps)) == 1


def test_a_cluster_of_a_height_that_its_group_does_not_have_is_dropped() -> None:
    maps = empty_maps(40, 40)
    encode(maps, (0.2, 0.2, 0.8, 0.6, 0.6, 3.5, 0.0), "pedestrian", low=LOW, cells=1)
    assert len(decode(maps)) == 0


def test_no_foreground_gives_no_boxes_and_nan_is_left_out() -> None:
    assert len(decode(empty_maps(32, 32))) == 0
    maps = empty_maps(32, 32)
    maps[20] = 20.0
    maps[23] = np.nan
    assert len(decode(maps)) == 0


def test_a_map_that_is_all_foreground_is_decoded_at_once() -> None:
    maps = np.random.default_rng(0).normal(0, 5, (25, 256, 256)).astype(np.float32)
    maps[19] = -9
    assert len(decode(maps)) > 10


def test_bandwidths_are_half_the_width_of_the_narrowest_category() -> None:
    np.testing.assert_allclose(bandwidths_m(info()), [0.925, 0.325, 0.35])


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


def test_clusters_do_not_depend_on_the_order_of_votes() -> None:
    rng = np.random.default_rng(7)
    vote = np.concatenate([c + rng.normal(0, 0.25, (20, 2)) for c in product((0.0, 5.0), (0.0, 5.0, 10.0))])
    group = np.repeat([0, 1, 0, 2, 0, 0], 20)
    order = rng.permutation(len(vote))
    widths = bandwidths_m(info())
    first, second = cluster(vote, group, widths), cluster(vote[order], group[order], widths)
    same = first[:, None] == first
    np.testing.assert_array_equal(same[np.ix_(order, order)], second[:, None] == second)
    assert len(set(first[group == 0].tolist())) == 4
