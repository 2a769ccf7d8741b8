"""Late fusion: which image box and which box of a sweep are one object, its score, and what only one sensor sees."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from worlds import camera_ahead, cloud_at, outline_px, scan, standing

from log2sim.datatypes import Boxes3D, Detections, Measurements
from log2sim.geometry import NS_PER_S
from log2sim.perception.lidar.cloud import Cloud
from log2sim.perception.lidar.measure import PAIR_WEIGHTS, Pairs, match_boxes, measure
from log2sim.perception.lidar.projection import View

CAMERA = camera_ahead()
VIEW = View(CAMERA, NS_PER_S, CAMERA.mount_T_cam)
CAR = (4.4, 1.85, 1.6)


def in_sweep(*places: tuple[float, float], category: str = "car", score: float = 0.8, yaw_deg: float = 0.0) -> Boxes3D:
    """Boxes of a sweep on the ground."""
    m = len(places)
    center = np.array([(x, y, CAR[2] / 2) for x, y in places]).reshape(-1, 3)
    return Boxes3D(
        np.full(m, NS_PER_S), center, np.tile(CAR, (m, 1)), np.full(m, np.deg2rad(yaw_deg)), np.full(m, 0.9),
        np.full(m, category, dtype="<U16"), np.full(m, score), np.full(m, 50),
    )  # fmt: skip


def in_image(*places: tuple[float, float], category: str = "car", score: float = 0.7) -> Detections:
    """Exact image boxes of cars at places."""
    box = np.array([outline_px(CAMERA, CAMERA.mount_T_cam, standing(x, y, size_m=CAR)) for x, y in places])
    return Detections(box.reshape(-1, 4), np.full(len(places), score), np.full(len(places), category))


def cloud_of(world: NDArray[np.float64] | None = None) -> Cloud:
    """The cloud of points (N, 3) on flat ground; none by default."""
    return cloud_at(np.zeros((0, 3)) if world is None else world, stamp_ns=NS_PER_S, sensor=(0.0, 0.0, 1.9))


def joined(
    boxes: Boxes3D, found: Detections, view: View = VIEW, world: NDArray[np.float64] | None = None
) -> Measurements:
    return measure([(view, found, cloud_of(world))], boxes, cloud_of(world))


def matched(boxes: Boxes3D, found: Detections) -> Pairs:
    rows = measure([(VIEW, found, None)])
    return match_boxes(boxes, rows, np.zeros(len(rows), np.intp), [VIEW])


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
    found = matched(in_sweep(*places), in_image(*places[::-1]))
    assert sorted(zip(found.box.tolist(), found.image.tolist())) == [(0, 2), (1, 1), (2, 0)]
    assert (found.iou > 0.9).all()
    twice = matched(in_sweep((20.3, 2.1), (20, 2)), in_image((20, 2)))
    assert (twice.box.tolist(), twice.image.tolist()) == ([1], [0])


def test_the_category_of_the_image_counts_only_where_the_boxes_agree() -> None:
    loose = in_image((20, 3.2), category="truck")
    assert 0.3 <= matched(in_sweep((20, 2)), loose).iou[0] < 0.5
    assert joined(in_sweep((20, 2)), loose).category.tolist() == ["car"]


def test_a_box_that_no_image_shows_keeps_its_score_in_view_and_outside() -> None:
    """Detectors in images miss the same object in image after image: the judge counts misses by track."""
    assert joined(in_sweep((20, 2), (-20, 2), (20, 60), score=0.6), in_image()).score.tolist() == [0.6] * 3


def test_a_box_in_both_takes_its_points_from_the_image_boxes_of_others() -> None:
    cars = [standing(14, 0, 20), standing(21, 3, 20)]
    world, owner = scan(cars, azimuth_deg=(-40, 40), steps=(400, 60))
    found = in_image((14, 0), (21, 3))
    found.box_px[:] = [outline_px(CAMERA, CAMERA.mount_T_cam, car) for car in cars]
    rows = joined(in_sweep((14, 0), yaw_deg=20), found, world=world)
    assert rows.camera.tolist() == ["front", "front"]
    assert np.isfinite(rows.box_yaw_rad).tolist() == [True, False]
    for car, cluster in zip((0, 1), rows.cluster):
        assert (owner[cKDTree(world).query(cluster[:, :3])[1]] == car).mean() > 0.9


def test_two_even_chances_that_agree_are_three_to_one() -> None:
    assert PAIR_WEIGHTS.score(0.5, 0.5, 0.7) == pytest.approx(0.75, abs=0.01)
    better = [PAIR_WEIGHTS.score(0.6, 0.5, 0.7), PAIR_WEIGHTS.score(0.5, 0.6, 0.7), PAIR_WEIGHTS.score(0.5, 0.5, 0.8)]
    assert min(better) > 0.75
    assert PAIR_WEIGHTS.score(1.0, 1.0, 1.0) < 1


@pytest.mark.parametrize("turn_deg", [37.0, 90.0, 180.0])
def test_turning_the_world_changes_no_match_and_no_score(turn_deg: float) -> None:
    turn = np.deg2rad(turn_deg)
    c, s = np.cos(turn), np.sin(turn)
    places = [(20.0, 2.0), (26.0, -5.0), (-9.0, 4.0)]
    turned = [(c * x - s * y, s * x + c * y) for x, y in places]
    camera = camera_ahead(yaw_rad=turn)
    view = View(camera, NS_PER_S, camera.mount_T_cam)
    rows = in_image(*places[:2])
    here, there = joined(in_sweep(*places), rows), joined(in_sweep(*turned, yaw_deg=turn_deg), rows, view)
    np.testing.assert_allclose(there.score, here.score, atol=1e-9)
    assert there.camera.tolist() == here.camera.tolist()
