"""KITTI's rules: difficulties, neighboring classes, regions without labels, and the sampling of the published program."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from log2sim.datatypes import ImageRegions, Log
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.evaluation import BothBoxes, class_figures, precision_recall
from log2sim.evaluation.detection.protocols import DIFFICULTIES, PROTOCOLS, Criterion, candidate_pairs, match_detections
from log2sim.evaluation.detection.truth import ImageViews, image_views
from log2sim.geometry import Camera, transform

pytestmark = pytest.mark.slow
CAR = PROTOCOLS["kitti"].classes[0]
NAMES = [d.name for d in DIFFICULTIES]


def row_of(x_m, **columns):
    boxes = np.tile([0.0, 0.0, 0.8, 4.0, 2.0, 1.6, 0.0], (len(x_m), 1))
    boxes[:, 0] = x_m
    return SceneBoxes.of(boxes, "car", **columns)


def views(height_px, truncation=0.0, region_share=0.0):
    count = len(height_px)
    return ImageViews(
        np.ones(count, dtype=bool),
        np.asarray(height_px, dtype=float),
        np.broadcast_to(truncation, count).astype(float),
        np.broadcast_to(region_share, count).astype(float),
    )


def figures(boxes, objects, measure="iou_3d", limit=0.7, min_score=0.0):
    rows = class_figures(boxes, CAR, min_score)["figures"]
    return next(r for r in rows if r["objects"] == objects and r["match"] == {"measure": measure, "limit": limit})


def counts(row):
    return row["truths"], row["true_positives"], row["false_positives"], row["false_negatives"]


def none(boxes):
    return np.zeros(len(boxes), dtype=bool)


def test_each_difficulty_counts_the_labels_that_it_admits():
    # From easy on: easy, 40 px itself is too low, occluded, truncated, largely occluded, half out, unknown, tiny.
    height = [41, 40, 60, 60, 60, 60, 60, 25]
    occlusion = np.array([0, 0, 1, 0, 2, 0, 3, 0])
    truncation = [0.15, 0, 0, 0.16, 0, 0.5, 0, 0]
    truth = row_of(np.arange(8) * 10.0)
    found = row_of(np.arange(8) * 10.0, score=0.9)
    sides = found, truth, none(found), np.zeros(8), np.full(8, ""), occlusion.astype(np.int64)
    boxes = BothBoxes(*sides, views(height), views(height, truncation))
    assert [counts(figures(boxes, name))[:3] for name in NAMES] == [(1, 1, 0), (4, 4, 0), (6, 6, 0)]
    assert counts(figures(boxes, "all")) == (8, 8, 0, 0)


def facing_camera(distortion=0.0):
    K = np.array([[700.0, 0, 600], [0, 700, 180], [0, 0, 1]])
    map_R_cam = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])
    return Camera("front", 1200, 370, K, "map", transform(map_R_cam, [0.0, 0.0, 1.6]))


def test_views_know_height_truncation_and_regions_without_labels():
    stamps = np.array([0, 100_000_000])
    region = ImageRegions(np.full(2, 10_000_000), np.array([[560.0, 0, 1200, 370], [0, 0, 9, 9]]))
    log = Log("made", "test", {"front": facing_camera()}, {}, {}, ignored_regions={"front": region})
    boxes = np.array([[20.0, 0, 0.8, 2, 2, 1.6, 0], [-20, 0, 0.8, 2, 2, 1.6, 0], [7, 6, 0.8, 0.01, 2, 1.6, 0]])
    seen = image_views(log, "front", stamps, SceneBoxes.of(boxes), truncation=True)
    assert seen.shown.tolist() == [True, False, True]
    assert seen.height_px[0] == pytest.approx(700 * 1.6 / 19)  # its near face, up to the horizon
    # Pixels 600 - 700/19 to 600 + 700/19, of which those right of 560 are in the region.
    assert seen.region_share[0] == 1.0
    assert seen.truncation[0] == 0
    # 5 to 7 m left at 7 m: pixels -100 to 100, half of it is outside.
    assert seen.truncation[2] == pytest.approx(0.5, abs=0.02)
    assert seen.region_share[2] == 0
    later = image_views(log, "front", stamps, SceneBoxes.of(boxes, scene=1))
    assert later.region_share.tolist() == [0, 0, 0]
    assert later.truncation.tolist() == [0, 1, 0]


def devkit(found, truth, found_ignored, truth_ignored, limit, recall_points):
    """The published rules written anew, frame by frame and threshold by threshold, as a second method."""
    pairs = candidate_pairs(found, truth, Criterion("iou_3d", limit))
    overlap = {(int(i), int(j)): v for i, j, v in zip(pairs.found, pairs.truth, pairs.value)}

    def frame(scene, threshold, by_score):
        dets = [i for i in np.flatnonzero(found.scene == scene) if found.score[i] >= threshold]
        used, right, scores = set(), 0, []
        for j in np.flatnonzero(truth.scene == scene):
            free = [i for i in dets if i not in used and (i, j) in overlap]
            if by_score:
                best = max(free, key=lambda i: found.score[i], default=None)
            else:
                valid = [i for i in free if not found_ignored[i]]
                best = max(valid, key=lambda i: overlap[i, j], default=free[0] if free else None)
            if best is None:
                continue
            used.add(best)
            if not truth_ignored[j] and not found_ignored[best]:
                right += 1
                scores.append(found.score[best])
        return right, sum(1 for i in dets if i not in used and not found_ignored[i]), scores

    scenes = np.unique(np.r_[found.scene, truth.scene])
    scores = sorted((s for k in scenes for s in frame(k, -np.inf, True)[2]), reverse=True)
    count, thresholds, recall = int((~truth_ignored).sum()), [], 0.0
    for n, score in enumerate(scores, start=1):
        left, right = n / count, (n + 1) / count if n < len(scores) else n / count
        if right - recall < recall - left and n < len(scores):
            continue
        thresholds.append(score)
        recall += 1 / 40
    precision = np.zeros(41)
    for k, threshold in enumerate(thresholds):
        sums = np.sum([frame(scene, threshold, False)[:2] for scene in scenes], axis=0)
        precision[k] = sums[0] / sums.sum()
    best = np.maximum.accumulate(precision[::-1])[::-1]
    return best[1:].mean() if recall_points == 40 else best[::4].mean()


def detector_world(seed, truths=60, scenes=8):
    """Labels with some ignored, found with noise, doubles, false boxes and ignored ones; scores that help."""
    rng = np.random.default_rng(seed)
    place = np.stack(np.meshgrid(np.arange(10) * 9.0, np.arange(10) * 7.0), -1).reshape(-1, 2)
    scene = np.sort(rng.integers(0, scenes, truths))
    spot = np.concatenate([place[rng.permutation(100)[: np.sum(scene == k)]] for k in range(scenes)])
    box = np.column_stack([spot, rng.normal(0, 0.1, truths), np.tile([4.2, 1.8, 1.5], (truths, 1)), np.zeros(truths)])
    truth = SceneBoxes.of(box, scene=scene, ignored=rng.random(truths) < 0.2)
    rows = np.flatnonzero(rng.random(truths) < 0.85)
    rows = np.r_[rows, rng.choice(rows, 8)]
    seen = box[rows] + rng.normal(0, 1, (len(rows), 7)) * [0.25, 0.1, 0.05, 0.1, 0.05, 0.05, 0.02]
    false = np.column_stack([rng.uniform(0, 80, (25, 2)), np.zeros(25), np.tile([4, 1.8, 1.5], (25, 1)), np.zeros(25)])
    score = np.r_[rng.normal(0.7, 0.15, len(rows)), rng.normal(0.4, 0.2, 25)]
    found = SceneBoxes.of(
        np.r_[seen, false], scene=np.r_[scene[rows], rng.integers(0, scenes, 25)], score=score,
        ignored=rng.random(len(score)) < 0.1,
    )  # fmt: skip
    return found, truth


@pytest.mark.parametrize("limit", [0.5, 0.7])
@pytest.mark.parametrize("recall_points", [40, 11])
@given(seed=st.integers(0, 10_000))
@settings(max_examples=12, deadline=None)
def test_the_sampled_average_is_that_of_the_published_rules(limit, recall_points, seed):
    found, truth = detector_world(seed)
    found = found.take(~found.ignored)
    expected = devkit(found, truth, found.ignored, truth.ignored, limit, recall_points)
    curve = precision_recall(found, match_detections(found, truth, Criterion("iou_3d", limit)))
    assert curve.sampled_average(recall_points) == pytest.approx(expected)
