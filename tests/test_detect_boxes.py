"""Boxes after the model: suppression, tiles, riders."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from log2sim.datatypes import GROUP_OF, Detections
from log2sim.geometry import box_iou
from log2sim.perception.detect.layouts import InputSpec, Preprocessing, resize_as_tf1
from log2sim.perception.detect.onnx_detector import (
    MAX_AUTO_TILES,
    OVERLAP,
    Tile,
    auto_tile_count,
    join_riders,
    merge,
    plan_tiles,
    suppress,
)


def detections(*rows: tuple[str, float, tuple[float, float, float, float]]) -> Detections:
    return Detections(
        np.array([r[2] for r in rows], dtype=np.float64).reshape(-1, 4),
        np.array([r[1] for r in rows], dtype=np.float64),
        np.array([r[0] for r in rows], dtype="<U16"),
    )


def crowd(seed: int, count: int = 60) -> Detections:
    rng = np.random.default_rng(seed)
    corner = rng.uniform(0, 60, (count, 2))
    box = np.concatenate([corner, corner + rng.uniform(15, 40, (count, 2))], axis=1)
    return Detections(box, rng.uniform(0.3, 1, count), rng.choice(["car", "truck", "pedestrian"], count).astype("<U16"))


def suppressed_by_definition(d: Detections, max_overlap: float) -> list[int]:
    """Pick the best box that is left, strike what overlaps it, and so on."""
    left, kept = sorted(range(len(d)), key=lambda i: -d.score[i]), []
    while left:
        best = left.pop(0)
        kept.append(best)
        same = [GROUP_OF[str(d.category[i])] == GROUP_OF[str(d.category[best])] for i in left]
        overlap = [float(box_iou(d.box_px[best], d.box_px[i])[0, 0]) for i in left]
        left = [i for i, s, o in zip(left, same, overlap, strict=True) if not (s and o > max_overlap)]
    return kept


@pytest.mark.parametrize("seed", range(5))
def test_suppression_equals_its_definition(seed: int) -> None:
    d = crowd(seed)
    kept = suppress(d, 0.3)
    expected = d.take(suppressed_by_definition(d, 0.3))
    assert len(kept) < len(d)
    np.testing.assert_array_equal(kept.box_px, expected.box_px)


def test_suppression_does_not_depend_on_the_order_of_boxes_with_equal_scores() -> None:
    d = crowd(7)
    d = Detections(d.box_px, np.full(len(d), 0.5), d.category)
    shuffled = d.take(np.random.default_rng(1).permutation(len(d)))
    np.testing.assert_array_equal(suppress(d, 0.4).box_px, suppress(shuffled, 0.4).box_px)


def test_one_vehicle_called_car_and_truck_is_one_and_a_person_before_it_stays() -> None:
    d = suppress(
        detections(
            ("car", 0.8, (0, 0, 100, 60)), ("truck", 0.7, (2, 0, 101, 62)), ("pedestrian", 0.5, (0, 0, 100, 60))
        ),
        0.5,
    )
    assert d.category.tolist() == ["car", "pedestrian"]


@pytest.mark.parametrize(("width", "height", "tiles"), [(1920, 1080, 4), (1242, 375, 3), (640, 1000, 2), (97, 31, 7)])
def test_tiles_cover_every_column_and_overlap(width: int, height: int, tiles: int) -> None:
    whole, *row = plan_tiles(width, height, tiles, None)
    assert whole == Tile(0, 0, width, height)
    assert len(row) == tiles
    assert (row[0].u0, row[-1].u1) == (0, width)
    for tile in row:
        assert 0 <= tile.v0 < tile.v1 <= height
        assert tile.v1 - tile.v0 <= tile.u1 - tile.u0
    for left, right in pairwise(row):
        assert left.u1 - right.u0 >= (OVERLAP - 0.05) * (left.u1 - left.u0)


def test_tile_is_the_part_of_the_picture_it_names() -> None:
    image = np.arange(20 * 30 * 3, dtype=np.int64).reshape(20, 30, 3).astype(np.uint8)
    part = Tile(4, 2, 11, 9).cut(image)
    assert part.shape == (7, 7, 3)
    np.testing.assert_array_equal(part[0, 0], image[2, 4])


def test_number_of_tiles_follows_from_the_shrinking() -> None:
    assert auto_tile_count(640, 416) == 1
    assert auto_tile_count(1242, 416) == 3
    assert auto_tile_count(1920, 416) == 4
    assert auto_tile_count(8000, 300) == MAX_AUTO_TILES
    assert auto_tile_count(1920, None) == 1


def test_boxes_cut_by_an_inner_border_are_dropped_and_those_at_the_picture_border_stay() -> None:
    left, right = Tile(0, 0, 100, 100), Tile(60, 0, 160, 100)
    cut = detections(("car", 0.9, (70, 10, 99.5, 40)))
    full = detections(("car", 0.8, (70, 10, 130, 40)))
    at_border = detections(("car", 0.7, (0, 50, 30, 90)))
    merged = merge([(left, cut), (right, full), (left, at_border)], 160, 100, 0.5)
    assert merged.box_px.tolist() == [[70, 10, 130, 40], [0, 50, 30, 90]]


def test_the_same_box_from_two_tiles_is_one() -> None:
    box = detections(("car", 0.9, (65, 10, 95, 40)))
    assert len(merge([(Tile(0, 0, 100, 100), box), (Tile(60, 0, 160, 100), box)], 160, 100, 0.5)) == 1


def test_rider_and_bicycle_become_a_cyclist_around_both() -> None:
    joined = join_riders(detections(("pedestrian", 0.6, (20, 0, 50, 90)), ("bicycle", 0.8, (10, 50, 62, 100))))
    assert joined.category.tolist() == ["cyclist"]
    assert joined.box_px.tolist() == [[10, 0, 62, 100]]
    assert joined.score.tolist() == [0.8]


def test_rider_on_a_motorcycle_stays_a_motorcycle() -> None:
    joined = join_riders(detections(("pedestrian", 0.9, (20, 0, 50, 90)), ("motorcycle", 0.8, (10, 40, 62, 100))))
    assert joined.category.tolist() == ["motorcycle"]


@pytest.mark.parametrize(
    "person",
    [(200, 0, 230, 90), (55, 0, 85, 90), (20, 0, 50, 130), (20, -60, 50, 60), (20, 55, 50, 100)],
    ids=["elsewhere", "beside", "nearer", "farther", "lower"],
)
def test_bicycle_without_a_rider_stays_one(person: tuple[float, float, float, float]) -> None:
    d = detections(("bicycle", 0.8, (10, 50, 62, 100)), ("pedestrian", 0.6, person))
    assert sorted(join_riders(d).category.tolist()) == ["bicycle", "pedestrian"]


@pytest.mark.parametrize(("score", "joined"), [(0.25, ["pedestrian", "bicycle"]), (0.5, ["cyclist"])])
def test_a_weak_bicycle_inside_a_person_is_a_bag(score: float, joined: list[str]) -> None:
    d = detections(("pedestrian", 0.8, (10, 0, 60, 100)), ("bicycle", score, (15, 20, 55, 98)))
    assert join_riders(d, sure_score=0.4).category.tolist() == joined
    below = detections(("pedestrian", 0.8, (10, 0, 60, 100)), ("bicycle", score, (15, 50, 55, 125)))
    assert join_riders(below, sure_score=0.4).category.tolist() == ["cyclist"]


def test_one_person_rides_one_of_two_bicycles() -> None:
    d = detections(
        ("bicycle", 0.8, (10, 50, 62, 100)), ("bicycle", 0.7, (30, 52, 85, 101)), ("pedestrian", 0.6, (18, 0, 48, 90))
    )
    joined = join_riders(d)
    assert joined.category.tolist() == ["cyclist", "bicycle"]
    assert joined.box_px[0].tolist() == [10, 0, 62, 100]


def test_second_person_beside_a_bicycle_walks() -> None:
    d = detections(
        ("bicycle", 0.8, (10, 50, 62, 100)), ("pedestrian", 0.7, (20, 0, 50, 90)), ("pedestrian", 0.6, (40, 0, 75, 90))
    )
    joined = join_riders(d)
    assert joined.category.tolist() == ["cyclist", "pedestrian"]
    assert joined.box_px[0].tolist() == [10, 0, 62, 100]


def test_parts_of_a_pair_are_dropped_and_neighbors_stay() -> None:
    d = detections(
        ("pedestrian", 0.6, (20, 0, 50, 90)),
        ("bicycle", 0.8, (10, 50, 62, 100)),
        ("bicycle", 0.7, (12, 70, 40, 99)),
        ("pedestrian", 0.5, (22, 2, 48, 40)),
        ("car", 0.5, (12, 60, 60, 98)),
        ("bicycle", 0.4, (45, 50, 99, 100)),
    )
    assert join_riders(d).category.tolist() == ["cyclist", "car", "bicycle"]


def test_tf1_resize_samples_at_the_corner() -> None:
    ramp = np.repeat(np.arange(0, 200, 2, dtype=np.uint8)[None, :, None], 100, axis=0).repeat(3, axis=2)
    small = resize_as_tf1(ramp, (40, 40))
    # Target column i samples source column 2.5 i, whose value is 5 i; centered sampling would give 5 i + 1.5.
    np.testing.assert_allclose(small[5, :, 0].astype(float), 5.0 * np.arange(40), atol=0.51)


@pytest.mark.parametrize("fit", ["corner", "center", "stretch", "tf1"])
@pytest.mark.parametrize("size", [(97, 61), (40, 200), (128, 128)])
def test_a_mark_in_the_input_maps_back_to_where_it_is_in_the_picture(fit: str, size: tuple[int, int]) -> None:
    width, height = size
    image = np.zeros((height, width, 3), dtype=np.uint8)
    u0, v0, u1, v1 = width // 4, height // 4, width // 2, height // 2
    image[v0:v1, u0:u1] = (10, 20, 250)
    spec = InputSpec("x", 256, 320, False, np.dtype(np.float32))
    tensor, placement = Preprocessing(fit, rgb=True, unit=False)(image, spec)  # type: ignore[arg-type]
    assert tensor.shape == (1, 3, 256, 320)
    rows, columns = np.nonzero(tensor[0, 0] > 180)  # red comes first
    found = placement.to_image(np.array([[columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]], float))
    assert found[0] == pytest.approx((u0, v0, u1, v1), abs=1.0)
