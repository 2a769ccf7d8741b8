"""Average precision of 3D boxes: hand-made cases, shapely as oracle, invariances."""

from __future__ import annotations

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import average_precision, precision_recall
from log2sim.evaluation.detection.protocols import Criterion, match_detections
from log2sim.geometry import box_corners_bev, rectangle_overlap, upright_box_iou

CAR = [0.0, 0.0, 0.0, 4.0, 2.0, 1.5, 0.0]
IOU = Criterion("iou_3d", 0.5)


def cars(*x_m, y_m=0.0):
    boxes = np.tile(CAR, (len(x_m), 1))
    boxes[:, 0], boxes[:, 1] = x_m, y_m
    return boxes


def random_pairs(rng, count, spread_m=3.0):
    def some():
        center = rng.uniform(-spread_m, spread_m, (count, 2))
        return np.column_stack([center, rng.uniform(0.3, 9, (count, 2)), rng.uniform(-4, 4, count)])

    return some(), some()


def by_shapely(a, b):
    p, q = (shapely.polygons(box_corners_bev(r[:, :2], r[:, 2], r[:, 3], r[:, 4])) for r in (a, b))
    return shapely.area(shapely.intersection(p, q, grid_size=1e-12))


def test_the_shared_area_of_random_rectangles_is_that_of_polygons():
    a, b = random_pairs(np.random.default_rng(1), 3000)
    truth = by_shapely(a, b)
    assert (truth > 0).sum() > 1000
    assert (truth == 0).sum() > 100
    np.testing.assert_allclose(rectangle_overlap(a, b), truth, atol=1e-7)


@pytest.mark.parametrize("turn", [0.0, np.pi / 2, np.pi, 0.3, 1e-12, 1e-9, 1e-5])
@pytest.mark.parametrize(
    "shift", [(0, 0), (1, 0), (0, 1), (2, 0), (4, 0), (0, 2), (1e-12, 0), (1e-10, 1e-10), (3, -1.5)]
)
def test_rectangles_with_common_edges_and_corners_share_what_polygons_do(turn, shift):
    base = np.array([[1.0, 2.0, 4.0, 2.0, 0.7]])
    moved = base.copy()
    moved[0, :2] += np.array([[np.cos(0.7), -np.sin(0.7)], [np.sin(0.7), np.cos(0.7)]]) @ shift
    moved[0, 4] += turn
    expected = by_shapely(base, moved)
    np.testing.assert_allclose(rectangle_overlap(base, moved), expected, atol=1e-7)
    np.testing.assert_allclose(rectangle_overlap(moved, base), expected, atol=1e-7)


def test_the_iou_of_upright_boxes_counts_their_heights():
    raised = [0.0, 0, 0.5, 4, 2, 1.5, 0]
    assert upright_box_iou([CAR], [raised])[0] == pytest.approx(1.0 / 2.0)
    shorter = np.array([2.0, 0, 0, 4, 2, 1.5, 0])
    assert upright_box_iou([CAR], [shorter])[0] == pytest.approx(1 / 3)
    assert upright_box_iou([CAR], [[0.0, 0, 1.5, 4, 2, 1.5, 0]])[0] == 0


def test_the_best_score_takes_a_true_box_and_the_second_on_it_is_false():
    found = SceneBoxes.of(cars(0.3, 0.0, 20.0), score=[0.9, 0.8, 0.7])
    matches = match_detections(found, SceneBoxes.of(cars(0.0, 20.2)), IOU)
    assert matches.truth.tolist() == [0, -1, 1]
    assert matches.right.tolist() == [True, False, True]
    assert matches.false.tolist() == [False, True, False]


def test_ignored_true_boxes_excuse_one_found_box_and_count_for_nothing():
    truth = SceneBoxes.of(cars(0.0, 20.0), ignored=[False, True])
    found = SceneBoxes.of(cars(0.0, 20.0, 20.1), score=[0.5, 0.9, 0.8])
    matches = match_detections(found, truth, IOU)
    assert matches.truths == 1
    assert matches.right.tolist() == [True, False, False]
    assert matches.false.tolist() == [False, False, True]


def test_average_precision_of_a_case_by_hand():
    # 4 true boxes; found in order of score: right, false, right, right, and nothing for the fourth.
    # Precision 1 at recall .25, .5 (2/3 and 3/4 later), so best precision: 1 up to .25, 3/4 up to .75, 0 beyond.
    found = SceneBoxes.of(cars(0.0, 70.0, 10.0, 20.0), score=[0.9, 0.8, 0.7, 0.6])
    truth = SceneBoxes.of(cars(0.0, 10.0, 20.0, 30.0))
    assert average_precision(found, truth, IOU, 40) == pytest.approx((10 * 1 + 20 * 0.75 + 10 * 0) / 40)
    # 0, .1, .2 | .3 to .7 | .8, .9, 1
    assert average_precision(found, truth, IOU, 11) == pytest.approx((3 * 1 + 5 * 0.75) / 11)


def test_nuscenes_leaves_out_low_recall_and_low_precision():
    found = SceneBoxes.of(cars(0.0, 10.0), score=[0.9, 0.8])
    curve = precision_recall(found, match_detections(found, SceneBoxes.of(cars(0.0, 10.0)), Criterion("center_m", 0.5)))
    assert curve.nuscenes_average() == pytest.approx(1.0)
    # One of two found among four: precision .25 up to recall .5, which is 40 of the 90 points.
    found = SceneBoxes.of(cars(0.0, 70.0, 80.0, 90.0), score=0.5)
    curve = precision_recall(found, match_detections(found, SceneBoxes.of(cars(0.0, 10.0)), Criterion("center_m", 0.5)))
    assert curve.nuscenes_average() == pytest.approx(40 / 90 * (0.25 - 0.1) / 0.9)


def world(rng, scenes=6):
    truths, founds = [], []
    for _ in range(scenes):
        n = rng.integers(1, 9)
        box = np.column_stack(
            [rng.uniform(-40, 40, (n, 2)), rng.uniform(-1, 1, n), rng.uniform(1, 5, (n, 3)), rng.uniform(-3, 3, n)]
        )
        seen = box[rng.random(n) < 0.8] + 0.0
        seen = np.concatenate([seen, seen[:2], box[:1] + 30.0])
        seen[:, :3] += rng.normal(0, 0.25, (len(seen), 3))
        truths.append(SceneBoxes.of(box, ignored=rng.random(n) < 0.2))
        founds.append(SceneBoxes.of(seen, score=np.round(rng.random(len(seen)), 1)))
    return SceneBoxes.join(founds), SceneBoxes.join(truths)


@pytest.mark.parametrize("criterion", [IOU, Criterion("iou_bev", 0.3), Criterion("center_m", 1.0)], ids=str)
@given(seed=st.integers(0, 10_000), turn=st.floats(-3, 3), shift=st.floats(-1e4, 1e4))
@settings(max_examples=15, deadline=None)
def test_turning_and_moving_everything_changes_nothing(criterion, seed, turn, shift):
    rng = np.random.default_rng(seed)
    found, truth = world(rng)
    c, s = np.cos(turn), np.sin(turn)

    def moved(boxes):
        box = boxes.box.copy()
        box[:, :2] = box[:, :2] @ np.array([[c, s], [-s, c]]) + shift
        box[:, 2] += shift
        box[:, 6] += turn
        return SceneBoxes(boxes.scene, box, boxes.category, boxes.score, None, boxes.range_m, boxes.ignored)

    before, after = match_detections(found, truth, criterion), match_detections(moved(found), moved(truth), criterion)
    assert before.truth.tolist() == after.truth.tolist()
    np.testing.assert_allclose(before.value, after.value, atol=1e-6)


@given(seed=st.integers(0, 10_000))
@settings(max_examples=30, deadline=None)
def test_better_scores_for_right_boxes_never_lower_the_average(seed):
    rng = np.random.default_rng(seed)
    found, truth = world(rng)
    criterion = Criterion("iou_bev", 0.5)
    matches = match_detections(found, truth, criterion)
    curve = precision_recall(found, matches)
    assert np.all(np.diff(curve.recall) >= 0)
    assert np.all((curve.precision >= 0) & (curve.precision <= 1))
    raised = SceneBoxes(
        found.scene, found.box, found.category, found.score + 2.0 * matches.right, None, found.range_m, found.ignored
    )
    before, after = curve.average(), precision_recall(raised, match_detections(raised, truth, criterion)).average()
    assert (before is None and after is None) or after >= before - 1e-12
