"""Boxes from hand-made maps: what was encoded comes back; headings, categories, suppression, bad values."""

from __future__ import annotations

import numpy as np
import pytest
from lidar_networks import NAMES, empty_maps, encode, info

from log2sim.geometry import box_corners_bev, overlap_area, wrap_angle
from log2sim.perception.detect3d.boxes import (
    MAX_PEAKS,
    MIN_HEAT,
    LevelBoxes,
    Rectangles,
    decode_centers,
    headings,
    peaks,
    shared_area,
    sigmoid,
    suppress,
)

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


def test_cells_around_a_peak_that_mean_the_same_object_are_averaged_by_their_heat() -> None:
    maps = empty_maps(16, 16)
    encode(maps, (-18.0, -10.0, 0.8, 4.4, 1.8, 1.5, 0.0), "car", low=LOW, logit=2.0, cells=1)
    # One of the nine cells is 0.9 m higher, one is of another object, one is hardly hot.
    maps[10, 3, 3] += 0.9
    maps[8, 3, 5] += 2.0
    maps[0, 5, 5], maps[10, 5, 5] = -9.0, 9.0
    (found,) = decode_centers(maps, info(), LOW).center_m
    hot = 1 / (1 + np.exp(-2.0))
    np.testing.assert_allclose(found, [-18.0, -10.0, 0.8 + 0.9 * 0.5 / (hot + 6 * 0.5)], atol=1e-5)


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


def test_a_direction_longer_than_one_is_certain_and_no_more() -> None:
    assert headings(np.array([[0.0], [1.0]]), np.array([[0.0], [7.0]]))[1].tolist() == [1.0]


def test_values_that_no_object_has_are_cut_off_and_nan_is_left_out() -> None:
    maps = empty_maps(16, 16)
    encode(maps, (-18.0, -10.0, 1.0, 4.4, 1.8, 1.5, 0.0), "car", low=LOW)
    encode(maps, (-15.0, -8.0, 1.0, 4.4, 1.8, 1.5, 0.0), "car", low=LOW, logit=9.0)
    encode(maps, (-18.0, -8.0, 1.0, 4.4, 1.8, 1.5, 0.0), "car", low=LOW)
    maps[8:14, 4, 4] = 1e9, -1e9, 1e9, 1e9, 1e9, -1e9
    maps[11, 10, 8] = np.nan
    maps[8, 4, 8] = np.inf
    maps[2, 0, 0] = np.nan
    found = decode_centers(maps, info(), LOW)
    assert len(found) == 1
    assert np.all(np.abs(found.center_m) <= [40, 40, 5])
    assert np.all((found.size_m >= 0.1 - 1e-9) & (found.size_m <= 30 + 1e-9))


def test_peaks_are_greatest_among_their_neighbors_and_strongest_first() -> None:
    rng = np.random.default_rng(1)
    heat = rng.normal(0, 1, (2, 30, 20)).astype(np.float32)
    group, flat = peaks(heat)
    padded = np.pad(heat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    around = np.max([padded[:, i : i + 30, j : j + 20] for i in range(3) for j in range(3)], axis=0)
    expected = {
        (g, int(i * 20 + j)) for g, i, j in np.argwhere((heat == around) & (heat >= np.log(MIN_HEAT / (1 - MIN_HEAT))))
    }
    assert set(zip(group.tolist(), flat.tolist())) == expected
    assert np.all(np.diff(heat.reshape(2, -1)[group, flat]) <= 0)


def test_no_more_peaks_are_decoded_than_a_sensor_sees_objects() -> None:
    assert len(peaks(np.full((3, 200, 200), 5.0, np.float32))[0]) == MAX_PEAKS
    assert len(decode_centers(empty_maps(32, 32), info(), LOW)) == 0


def random_rectangles(rng: np.random.Generator, n: int) -> Rectangles:
    return Rectangles(rng.uniform(-2, 2, (n, 2)), rng.uniform(0.3, 6, (n, 2)), rng.uniform(-4, 4, n))


def test_shared_area_is_that_of_the_polygons() -> None:
    rng = np.random.default_rng(2)
    a, b = random_rectangles(rng, 500), random_rectangles(rng, 500)
    expected = overlap_area(*(box_corners_bev(r.xy_m, r.size_m[:, 0], r.size_m[:, 1], r.yaw_rad) for r in (a, b)))
    assert (expected == 0).sum() > 20
    np.testing.assert_allclose(shared_area(a, b), expected, atol=1e-4)


def test_rectangles_with_edges_on_each_other_share_what_they_share() -> None:
    unit = Rectangles(np.zeros((5, 2)), np.tile([4.0, 2.0], (5, 1)), np.array([0.0, 0.3, -2.0, 0.0, 0.0]))
    turned = Rectangles(unit.xy_m, unit.size_m, unit.yaw_rad + np.array([0, np.pi, 0, 0, 0]))
    half = Rectangles(np.array([[1.0, 0.5]] * 5), unit.size_m / 2, np.zeros(5))
    np.testing.assert_allclose(shared_area(unit, turned), 8.0, atol=1e-4)
    np.testing.assert_allclose(shared_area(unit, half)[[0, 3, 4]], 2.0, atol=1e-4)
    beside = Rectangles(np.array([[4.0, 0.0]] * 5), unit.size_m, np.zeros(5))
    np.testing.assert_allclose(shared_area(unit, beside)[[0, 3]], 0.0, atol=1e-4)


def rectangles(*rows: tuple[float, ...]) -> Rectangles:
    a = np.array(rows)
    return Rectangles(a[:, :2], a[:, 2:4], a[:, 4])


def chosen(boxes: Rectangles, score: list[float], group: list[int], *, across: bool = True) -> list[int]:
    return suppress(boxes, np.array(score), np.array(group), across=across).tolist()


def test_the_stronger_of_two_boxes_on_one_ground_stays() -> None:
    cars = rectangles((0, 0, 4.4, 1.8, 0), (0.6, 0.1, 4.4, 1.8, 0.1), (0, 2.4, 4.4, 1.8, 0))
    assert chosen(cars, [0.5, 0.9, 0.7], [0, 0, 0]) == [1, 2]
    assert chosen(cars, [0.9, 0.5, 0.7], [0, 0, 0]) == [0, 2]


def test_a_suppressed_box_suppresses_nothing() -> None:
    row = rectangles((0, 0, 4, 2, 0), (2.4, 0, 4, 2, 0), (4.8, 0, 4, 2, 0))
    assert chosen(row, [0.9, 0.8, 0.7], [0, 0, 0]) == [0, 2]


def test_slender_boxes_that_cross_are_one_object() -> None:
    crossing = rectangles((0, 0, 4.0, 0.5, 0), (0.1, 0, 4.0, 0.5, np.pi / 2))
    assert shared_area(crossing.take(np.array([0])), crossing.take(np.array([1])))[0] / 3.75 < 0.2
    assert chosen(crossing, [0.9, 0.8], [1, 1]) == [0]


def test_a_person_inside_a_car_goes_and_one_beside_it_stays() -> None:
    scene = rectangles((0, 0, 4.4, 1.8, 0), (1, 0.2, 0.6, 0.6, 0), (0.5, 1.1, 0.6, 0.6, 0))
    assert chosen(scene, [0.9, 0.8, 0.8], [0, 2, 2]) == [0, 2]
    assert chosen(scene, [0.7, 0.8, 0.6], [0, 2, 2]) == [1, 2]
    assert chosen(scene, [0.9, 0.8, 0.8], [0, 2, 2], across=False) == [0, 2, 1]


def test_people_side_by_side_stay() -> None:
    assert len(chosen(rectangles((0, 0, 0.6, 0.6, 0), (0, 0.55, 0.6, 0.6, 0)), [0.9, 0.8], [2, 2])) == 2


def test_the_order_of_boxes_does_not_matter() -> None:
    rng = np.random.default_rng(4)
    boxes = Rectangles(rng.uniform(-15, 15, (60, 2)), rng.uniform(0.5, 5, (60, 2)), rng.uniform(-3, 3, 60))
    score, group = rng.choice([0.2, 0.5, 0.8], 60), rng.integers(0, 3, 60)
    kept = suppress(boxes, score, group)
    order = rng.permutation(60)
    assert order[suppress(boxes.take(order), score[order], group[order])].tolist() == kept.tolist()
    assert 5 < len(kept) < 60


def test_nothing_is_suppressed_where_there_is_nothing() -> None:
    assert chosen(Rectangles(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0)), [], []) == []
    assert chosen(rectangles((0, 0, 1, 1, 0)), [0.1], [0]) == [0]


def test_the_score_is_the_calibrated_sum() -> None:
    weights = [0.5, 2.0, -1.0, 0.25, -0.3]
    described = info(calibration={"vehicle": [0.0] * 5, "two_wheeler": weights, "pedestrian": [0.0] * 5})
    one = np.ones(2)
    boxes = LevelBoxes(
        np.ones((2, 3)), np.ones((2, 3)), one, one, np.array([1, 0]), np.array(["cyclist", "car"]), 0.7 * one, 0.2 * one
    )
    logit = 0.5 + 2 * 0.7 - 0.2 + 0.25 * np.log(41) - 0.3 * 2.5
    terms = boxes.terms(np.array([40, 40]), np.array([25.0, 25.0]))
    np.testing.assert_allclose(boxes.score(described, terms), [1 / (1 + np.exp(-logit)), 0.5])
    np.testing.assert_allclose(boxes.score(described, terms[:2])[0], 1 / (1 + np.exp(-1.9)))
    assert sigmoid(np.array([-1e9, 1e9])).tolist() == pytest.approx([0, 1])
