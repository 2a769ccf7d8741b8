"""The boxes file, truth by sweep, and the commands that write and judge boxes."""

from __future__ import annotations

import copy
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from command_line import names, run
from hypothesis import given, settings
from hypothesis import strategies as st
from worlds import tiny_log

from log2sim.config import Config
from log2sim.datatypes import Boxes3D, ImageRegions, Labels, Log
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.detection.boxes import DetectedBoxes, SceneBoxes
from log2sim.evaluation.detection.detect_log import detect_log
from log2sim.evaluation.detection.evaluation import (
    DetectionOptions,
    evaluate_boxes,
    precision_recall,
)
from log2sim.evaluation.detection.protocols import Criterion, match_detections
from log2sim.evaluation.detection.truth import LabelTracks, labeled_sweeps, truth_of_sweeps
from log2sim.files.documents import check
from log2sim.geometry import box_corners_bev, points_in_box, rectangle_overlap, rectangles_overlap, upright_box_iou
from log2sim.perception.lidar.cloud import sweep_to_map

NS = 1_000_000_000
LABELS = Config().changed(detect={"name": "lidar:labels"}, stop_s=0.75)
"""Labels end before the last sweeps do."""


def some_boxes(count: int, t_ns: int, seed: int = 0) -> Boxes3D:
    rng = np.random.default_rng(seed)
    return Boxes3D(
        np.full(count, t_ns), rng.uniform(-1e6, 1e6, (count, 3)), rng.uniform(0.5, 9, (count, 3)),
        rng.uniform(-3, 3, count), rng.uniform(0.5, 1, count), np.array(["car", "pedestrian", "bus"])[np.arange(count) % 3],
        rng.random(count), rng.integers(0, 500, count),
    )  # fmt: skip


def some_file() -> DetectedBoxes:
    t_ns = NS * np.array([5, 6, 8])
    return DetectedBoxes(
        "drive", "lidar:test", t_ns, (some_boxes(3, 5 * NS), Boxes3D.empty(), some_boxes(1, 8 * NS, 1))
    )


def document(tmp_path: Path) -> dict[str, Any]:
    some_file().save(tmp_path / "boxes.json")
    loaded: dict[str, Any] = json.loads((tmp_path / "boxes.json").read_text())
    return loaded


def test_boxes_come_back_as_they_were(tmp_path: Path) -> None:
    saved = some_file()
    saved.save(tmp_path / "boxes.json")
    assert names(tmp_path) == ["boxes.json"]
    loaded = DetectedBoxes.load(tmp_path / "boxes.json")
    assert (loaded.log, loaded.detector, loaded.t_ns.tolist()) == ("drive", "lidar:test", saved.t_ns.tolist())
    for before, after in zip(saved.boxes, loaded.boxes, strict=True):
        for name, column in vars(before).items():
            if column is None:
                assert getattr(after, name) is None
            elif column.dtype.kind == "f":
                np.testing.assert_allclose(getattr(after, name), column, atol=0.6e-4)
            else:
                assert getattr(after, name).tolist() == column.tolist()


@pytest.mark.parametrize(
    ("place", "value", "message"),
    [
        (("frames", 0, "boxes", 1, "score"), 1.5, r"frames\[0\].boxes\[1\].score: 1.5 is greater"),
        (("frames", 0, "boxes", 1, "score"), None, r"frames\[0\].boxes\[1\].score"),
        (("frames", 0, "boxes", 0, "points"), True, r"frames\[0\].boxes\[0\].points"),
        (("frames", 0, "boxes", 2, "category"), "tank", r"frames\[0\].boxes\[2\].category: 'tank'"),
        (("frames", 0, "boxes", 0, "size_m"), [4, 0, 2], r"frames\[0\].boxes\[0\].size_m\[1\]: 0"),
        (("frames", 0, "boxes", 0, "center_m"), [4, 0], r"frames\[0\].boxes\[0\].center_m"),
        (("frames", 0, "boxes", 0, "extra"), 1, "extra"),
        (("frames", 0, "boxes"), {}, r"frames\[0\].boxes"),
        (("frames", 1, "t_ns"), "6", r"frames\[1\].t_ns"),
        (("frames", 1, "t_ns"), 5 * NS, r"frames\[1\].t_ns: .* does not follow"),
        (("frames", 2, "t_ns"), 2**70, "does not fit into 64 bits"),
        (("frames",), None, "frames"),
        (("version",), 2, "version"),
        (("format",), "else", "not a boxes file"),
    ],
)
def test_a_wrong_file_is_refused_with_the_place(
    tmp_path: Path, place: tuple[Any, ...], value: Any, message: str
) -> None:
    spoiled = document(tmp_path)
    at = spoiled
    for key in place[:-1]:
        at = at[key]
    at[place[-1]] = value
    (tmp_path / "bad.json").write_text(json.dumps(spoiled))
    with pytest.raises(LogError, match=message) as error:
        DetectedBoxes.load(tmp_path / "bad.json")
    assert str(error.value).startswith(str(tmp_path / "bad.json"))


VALUES = st.one_of(st.none(), st.booleans(), st.integers(-3, 3), st.floats(-2, 2), st.sampled_from(["car", "x"]))


@given(
    key=st.sampled_from(["center_m", "size_m", "yaw_rad", "heading_score", "category", "score", "points"]),
    value=st.one_of(VALUES, st.lists(VALUES, min_size=2, max_size=4)),
)
@settings(max_examples=150, deadline=None)
def test_checking_by_columns_accepts_what_the_schema_accepts(
    tmp_path_factory: pytest.TempPathFactory, key: str, value: Any
) -> None:
    changed = document(tmp_path_factory.mktemp("boxes"))
    changed["frames"][0]["boxes"][1][key] = value

    def accepts(function: Any, *arguments: Any) -> bool:
        try:
            function(copy.deepcopy(changed), *arguments)
        except LogError:
            return False
        return True

    assert accepts(DetectedBoxes.from_dict) == accepts(check, "boxes-1", LogError)


@pytest.fixture(scope="module")
def tiny() -> Log:
    return tiny_log()[0]


def test_truth_counts_points_and_ranges_as_one_would_by_hand(tiny: Log) -> None:
    t_ns = tiny.streams["top"].t_ns
    truth = truth_of_sweeps(tiny, t_ns)
    assert truth.labeled.all()
    assert len(truth.boxes) == 3 * len(t_ns)
    sweep = 4
    mapped = sweep_to_map(tiny, "top", tiny.streams["top"].read(sweep), compensate=True)
    assert mapped is not None
    rows = np.flatnonzero(truth.boxes.scene == sweep)
    assert len(rows) == 3
    for k in rows:
        box = truth.boxes.box[k]
        # Points within 0.2 m of the ground count for no box.
        above = mapped[0][mapped[0][:, 2] > 0.2]
        assert truth.boxes.points[k] == pytest.approx(
            points_in_box(above, box[:3], box[3:6], box[6]).sum(), rel=0.05, abs=2
        )
    ego = tiny.ego.at(int(t_ns[sweep]))[0][0, :2, 3]
    np.testing.assert_allclose(truth.boxes.range_m[rows], np.hypot(*(truth.boxes.box[rows, :2] - ego).T))


def labels_at(*stamps_s: float, track: str = "a", mps: float = 10.0) -> Labels:
    t_s, n = np.array(stamps_s), len(stamps_s)
    center = np.stack([mps * t_s, np.zeros(n), np.ones(n)], axis=1)
    yaw = np.where(t_s < 0.45, np.pi - 0.01, -np.pi + 0.01)
    return Labels(
        np.round(t_s * NS).astype(np.int64), np.full(n, track), np.full(n, "car"), center, np.ones((n, 3)), yaw
    )


def test_sweeps_between_labels_of_every_sweep_are_labeled_and_those_between_sparse_ones_are_not() -> None:
    middle = np.arange(20) * NS // 10

    def labeled(stamps: Any, period_s: float, asked: Any = middle, told: Any = None) -> list[int]:
        found = replace(labels_at(*(np.asarray(stamps) / NS)), labeled_ns=told)
        return np.flatnonzero(labeled_sweeps(found, asked, period_s)).tolist()

    dense = np.r_[middle[2:8], middle[12:15]]
    assert labeled(dense, 0.1) == list(range(2, 15))
    assert labeled(middle[[0, 5, 10]] + 3_000_000, 0.5) == [0, 5, 10]
    assert labeled(dense, 0.1, asked=middle[4:5]) == [0]
    assert labeled(dense, 0.1, told=middle[[0, 3, 19]]) == [0, 3, 19]


def test_boxes_between_labels_lie_on_the_way_of_their_track() -> None:
    t_s = np.array([0.1, 0.125, 0.27, 0.45, 0.53])
    tracks = LabelTracks.of(labels_at(0.1, 0.2, 0.3, 0.4, 0.5))
    pose, row = tracks.at(np.zeros(len(t_s), np.int64), np.round(t_s * NS).astype(np.int64))
    np.testing.assert_allclose(pose[:, 0], 10 * t_s)
    assert row.tolist() == [0, 0, 2, 3, 4]
    assert np.cos(pose[3, 3]) == pytest.approx(-1.0)  # not half way round


def test_labels_as_detector_are_found_again_by_every_protocol(tiny: Log) -> None:
    done: list[tuple[int, int]] = []
    found = detect_log(tiny, LABELS, progress=lambda *step: done.append(step)).found
    assert done[-1] == (len(found.t_ns),) * 2
    assert found.t_ns.tolist() == tiny.streams["top"].t_ns[:8].tolist()
    for protocol in ("kitti", "dair", "center"):
        result = evaluate_boxes(found, tiny, DetectionOptions(protocol))
        check(result, "detection-metrics-1", LogError)
        name = "car" if protocol == "kitti" else "vehicle"
        for class_name in (name, "pedestrian"):
            row = result["classes"][class_name]["figures"][0]
            assert row["truths"] >= 8
            assert row["precision"] == row["recall"] == row["ap_r40"] == 1
        assert result["sweeps"] == len(found.t_ns)
        assert result["sweeps_without_labels"] == 0


def moved(found: DetectedBoxes, by_m: float) -> DetectedBoxes:
    boxes = tuple(replace(b, center_m=b.center_m + np.array([by_m, 0, 0])) for b in found.boxes)
    return replace(found, boxes=boxes)


def test_what_is_out_of_range_counts_for_nothing(tiny: Log) -> None:
    found = detect_log(tiny, LABELS).found
    far = evaluate_boxes(found, tiny, DetectionOptions("center", max_range_m=13.5))
    row = far["classes"]["vehicle"]["figures"][0]
    whole = evaluate_boxes(found, tiny, DetectionOptions("center"))["classes"]["vehicle"]["figures"][0]
    assert 0 < row["truths"] < whole["truths"]
    assert row["true_positives"] == row["truths"]
    assert row["false_positives"] == 0
    astray = moved(found, 40.0)
    false = [
        evaluate_boxes(astray, tiny, DetectionOptions("center", max_range_m=m))["classes"]["vehicle"]["figures"][0][
            "false_positives"
        ]
        for m in (30.0, 100.0)
    ]
    assert false[0] == 0 < false[1]


def test_where_nothing_was_labeled_nothing_is_false(tiny: Log) -> None:
    found = moved(detect_log(tiny, LABELS).found, 5.0)
    stamps = tiny.streams["front"].t_ns
    nowhere = ImageRegions(stamps, np.tile([0.0, 0, 480, 300], (len(stamps), 1)))

    def false(log: Log, protocol: str) -> int:
        row = evaluate_boxes(found, log, DetectionOptions(protocol))["classes"]["pedestrian"]["figures"][0]
        return int(row["false_positives"])

    for protocol in ("kitti", "dair"):
        assert false(tiny, protocol) > 5
        assert false(replace(tiny, ignored_regions={"front": nowhere}), protocol) == 0
    # Labels of one camera only: a box behind it can be neither right nor false.
    behind = moved(found, -60.0)
    only = replace(tiny, labels=replace(tiny.labels, cameras=("front",)))
    rows = [
        evaluate_boxes(behind, log, DetectionOptions("dair"))["classes"]["vehicle"]["figures"][0]
        for log in (tiny, only)
    ]
    assert rows[0]["false_positives"] > 5
    assert rows[1]["false_positives"] == 0


def test_detect_and_evaluate_as_commands(tiny_folder: Path, tmp_path: Path) -> None:
    boxes, metrics, picture = (tmp_path / n for n in ("boxes.json", "metrics.json", "scores.png"))
    ran = run("detect", tiny_folder, "--detector", "lidar:labels", "--start", 0.3, "--stop", 0.6, "--out", boxes)
    assert ran.code == 0, ran.err
    assert "in 4 sweeps by lidar:labels" in ran.out
    assert run("validate", boxes).code == 0
    ran = run(
        "evaluate", boxes, "--truth", tiny_folder, "--protocol", "dair", "--out", metrics, "--plot", picture, "-v"
    )
    assert ran.code == 0, ran.err
    assert "IoU 3D > 0.5" in ran.out
    assert max(len(line) for line in ran.out.splitlines() if str(tmp_path) not in line) <= 100
    brief = run("evaluate", boxes, "--truth", tiny_folder, "--protocol", "dair").out
    assert ran.out.startswith(brief.rstrip("\n"))
    assert "100 % of" in brief
    assert "expected calibration error of the scores 0.000" in ran.out
    assert run("validate", metrics).code == 0
    assert picture.read_bytes()[:4] == b"\x89PNG"
    assert names(tmp_path) == ["boxes.json", "metrics.json", "scores.png"]
    assert run("evaluate", boxes, "--truth", tiny_folder, "--quiet").out == ""
    assert run("detect", tiny_folder, "--detector", "lidar:labels", "--out", boxes).code == 2


def test_a_log_of_another_time_and_one_without_labels_are_refused(tiny: Log) -> None:
    found = detect_log(tiny, LABELS).found
    later = replace(found, t_ns=found.t_ns + 3600 * NS)
    with pytest.raises(LogError, match="are both of one log"):
        evaluate_boxes(later, tiny, DetectionOptions("center"))
    with pytest.raises(LogError, match="no labeled 3D boxes"):
        evaluate_boxes(found, replace(tiny, labels=None), DetectionOptions("center"))
    with pytest.raises(LogError, match="of no sweep"):
        evaluate_boxes(replace(found, t_ns=found.t_ns[:0], boxes=()), tiny, DetectionOptions("center"))
    with pytest.raises(ConfigError, match="need a camera"):
        evaluate_boxes(found, replace(tiny, cameras={}), DetectionOptions("kitti"))


def test_options_name_what_is_wrong() -> None:
    with pytest.raises(ConfigError, match=r"'kiti' \(did you mean 'kitti'"):
        DetectionOptions("kiti")
    with pytest.raises(ConfigError, match="--score"):
        DetectionOptions("kitti", min_score=1.5)
    with pytest.raises(ConfigError, match="--range: 0 m"):
        DetectionOptions("kitti", max_range_m=0.0)
    with pytest.raises(ConfigError, match="has no 'truck'"):
        DetectionOptions("kitti", classes=["truck"]).chosen()
    assert [c.name for c in DetectionOptions("center", classes=["two_wheeler", "bus"]).chosen()] == [
        "two_wheeler",
        "bus",
    ]


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
    met = rectangles_overlap(*(b - a)[:, :2].T, a[:, 4], b[:, 4], a[:, 2:4], b[:, 2:4])
    np.testing.assert_array_equal(met, truth > 0)


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
    curve = precision_recall(found, match_detections(found, truth, IOU))
    assert curve.average(40) == pytest.approx((10 * 1 + 20 * 0.75 + 10 * 0) / 40)
    # 0, .1, .2 | .3 to .7 | .8, .9, 1
    assert curve.average(11) == pytest.approx((3 * 1 + 5 * 0.75) / 11)


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
