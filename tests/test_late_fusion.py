"""Late fusion: which image box and which box of a sweep are one object, its score, and what only one sensor sees."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import camera_ahead, outline_px, rows_at, standing

from log2sim.datatypes import Boxes3D, Measurements
from log2sim.geometry import NS_PER_S
from log2sim.perception.fusion import PAIR_WEIGHTS, join_with_images, match_boxes
from log2sim.perception.lidar.projection import View

CAMERA = camera_ahead()
VIEW = View(CAMERA, NS_PER_S, CAMERA.mount_T_cam)
CAR = (4.4, 1.85, 1.6)


def in_sweep(
    *places: tuple[float, float], category: str = "car", score: float = 0.8, yaw_deg: float = 0.0
) -> Measurements:
    """Rows of boxes of a sweep on the ground, without points."""
    m = len(places)
    center = np.array([(x, y, CAR[2] / 2) for x, y in places]).reshape(-1, 3)
    boxes = Boxes3D(
        np.full(m, NS_PER_S), center, np.tile(CAR, (m, 1)), np.full(m, np.deg2rad(yaw_deg)), np.full(m, 0.9),
        np.full(m, category, dtype="<U16"), np.full(m, score), np.full(m, 50),
    )  # fmt: skip
    rows = Measurements.of_boxes(boxes, np.array([0.0, 0.0, 1.9]))
    return replace(rows, center_m=center, covariance=np.tile(np.eye(2) * 0.04, (m, 1, 1)), source=np.full(m, "lidar"))


def in_image(*places: tuple[float, float], category: str = "car", score: float = 0.7, **columns: Any) -> Measurements:
    """Rows of exact image boxes of cars at places, measured there."""
    box = np.array([outline_px(CAMERA, CAMERA.mount_T_cam, standing(x, y, size_m=CAR)) for x, y in places])
    known = {"box_px": box.reshape(-1, 4), "sensor_m": np.tile([0.0, 0.0, 1.9], (len(places), 1))}
    return rows_at(
        np.array(places).reshape(-1, 2), category, camera="front", score=score, source="lidar", **known | columns
    )


def joined(boxes: Measurements, rows: Measurements) -> Measurements:
    return join_with_images(boxes, [match_boxes(boxes, rows, VIEW)])


def test_a_box_in_both_is_one_row_with_what_both_know() -> None:
    (row,) = [joined(in_sweep((20, 2), category="truck", score=0.5), in_image((20, 2), score=0.5))]
    assert len(row) == 1
    assert row.camera.tolist() == ["front"]
    assert row.category.tolist() == ["car"]
    np.testing.assert_allclose(row.box_px, in_image((20, 2)).box_px)
    np.testing.assert_allclose(row.box_center_m, [[20, 2, 0.8]])
    assert row.score[0] > 0.75


def test_every_box_gets_its_own_partner_and_the_best_pair_is_matched_first() -> None:
    places = [(15.0, 3.0), (15.6, 0.5), (30.0, -4.0)]
    found = match_boxes(in_sweep(*places), in_image(*places[::-1]), VIEW)
    assert found.partner.tolist() == [2, 1, 0]
    assert (found.iou > 0.9).all()
    twice = match_boxes(in_sweep((20, 2), (20.3, 2.1)), in_image((20, 2)), VIEW)
    assert twice.partner.tolist() == [0, -1]


def test_the_category_of_the_image_counts_only_where_the_boxes_agree() -> None:
    loose = in_image((20, 3.2), category="truck")
    match = match_boxes(in_sweep((20, 2)), loose, VIEW)
    assert 0.3 <= match.iou[0] < 0.5
    assert joined(in_sweep((20, 2)), loose).category.tolist() == ["car"]


def test_an_object_in_view_that_the_image_misses_is_doubted_and_one_outside_is_not() -> None:
    boxes = in_sweep((20, 2), (-20, 2), (20, 60), score=0.6)
    assert match_boxes(boxes, in_image(), VIEW).height_px.tolist()[1:] == [0, 0]
    score = joined(boxes, in_image()).score
    assert score[0] < 0.5
    assert score[1:].tolist() == [0.6, 0.6]


def test_two_even_chances_that_agree_are_three_to_one() -> None:
    half, iou, near = np.array([0.5]), np.array([0.7]), np.array([0.0])
    assert PAIR_WEIGHTS.score(half, half, iou, near)[0] == pytest.approx(0.75, abs=0.01)
    better = [
        PAIR_WEIGHTS.score(half + 0.1, half, iou, near), PAIR_WEIGHTS.score(half, half + 0.1, iou, near),
        PAIR_WEIGHTS.score(half, half, iou + 0.1, near),
    ]  # fmt: skip
    assert min(better) > 0.75
    assert PAIR_WEIGHTS.score(np.ones(1), np.ones(1), np.ones(1), near)[0] < 1


@pytest.mark.parametrize("turn_deg", [37.0, 90.0, 180.0])
def test_turning_the_world_changes_no_match_and_no_score(turn_deg: float) -> None:
    turn = np.deg2rad(turn_deg)
    c, s = np.cos(turn), np.sin(turn)
    places = [(20.0, 2.0), (26.0, -5.0), (-9.0, 4.0)]
    turned = [(c * x - s * y, s * x + c * y) for x, y in places]
    camera = camera_ahead(yaw_rad=turn)
    view = View(camera, NS_PER_S, camera.mount_T_cam)
    rows = in_image(*places[:2])
    here = join_with_images(in_sweep(*places), [match_boxes(in_sweep(*places), rows, VIEW)])
    boxes = in_sweep(*turned, yaw_deg=turn_deg)
    there = join_with_images(boxes, [match_boxes(boxes, rows, view)])
    np.testing.assert_allclose(there.score, here.score, atol=1e-9)
    assert there.camera.tolist() == here.camera.tolist()
