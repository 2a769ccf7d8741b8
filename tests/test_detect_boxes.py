"""Boxes after the model: suppression, tiles, riders."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from log2sim.datatypes import GROUP_OF, Detections, Turn
from log2sim.geometry import box_iou
from log2sim.perception.detect.layouts import InputSpec, Preprocessing
from log2sim.perception.detect.onnx_detector import (
    OVERLAP,
    Tile,
    join_riders,
    merge,
    plan_tiles,
    suppress,
    tiles_of_turn,
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


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(5))
def test_suppression_equals_its_definition(seed: int) -> None:
    d = crowd(seed)
    kept = suppress(d, 0.3)
    expected = d.take(suppressed_by_definition(d, 0.3))
    assert len(kept) < len(d)
    np.testing.assert_array_equal(kept.box_px, expected.box_px)


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


@pytest.mark.parametrize("tiles", [2, 3, 5])
def test_two_turns_search_every_tile_and_both_search_what_is_watched(tiles: int) -> None:
    planned = plan_tiles(1920, 1080, tiles, None)
    nothing = np.zeros((0, 4))
    even, odd = (tiles_of_turn(planned, Turn(number, nothing)) for number in (6, 7))
    assert sorted([*even[1:], *odd[1:]], key=lambda tile: tile.u0) == planned[1:]
    assert even[0] == odd[0] == planned[0]
    rng = np.random.default_rng(tiles)
    u0, v0 = rng.uniform(0, 1900, 20), rng.uniform(400, 700, 20)
    for watched in np.stack([u0, v0, u0 + 20, v0 + 60], axis=1):
        for number in (0, 1):
            chosen = tiles_of_turn(planned, Turn(number, watched[None]))
            assert any(tile.u0 <= watched[0] and watched[2] <= tile.u1 for tile in chosen[1:])
    assert tiles_of_turn(planned[:2], Turn(1, nothing)) == planned[:2]  # one tile has nothing to take turns with


def test_boxes_cut_by_an_inner_border_are_dropped_and_those_at_the_picture_border_stay() -> None:
    left, right = Tile(0, 0, 100, 100), Tile(60, 0, 160, 100)
    cut = detections(("car", 0.9, (70, 10, 99.5, 40)))
    full = detections(("car", 0.8, (70, 10, 130, 40)))
    at_border = detections(("car", 0.7, (0, 50, 30, 90)))
    merged = merge([(left, cut), (right, full), (left, at_border)], 160, 100, 0.5)
    assert merged.box_px.tolist() == [[70, 10, 130, 40], [0, 50, 30, 90]]


def test_rider_and_bicycle_become_a_cyclist_around_both() -> None:
    joined = join_riders(detections(("pedestrian", 0.6, (20, 0, 50, 90)), ("bicycle", 0.8, (10, 50, 62, 100))))
    assert joined.category.tolist() == ["cyclist"]
    assert joined.box_px.tolist() == [[10, 0, 62, 100]]
    assert joined.score.tolist() == [0.8]


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
