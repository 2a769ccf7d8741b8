"""The figures of one class: by match, difficulty, range and number of points, and the calibration of its scores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.calibration import calibration
from log2sim.evaluation.detection.image_views import ImageViews
from log2sim.evaluation.detection.matching import Criterion, Matches, Pairs, assign, candidate_pairs
from log2sim.evaluation.detection.precision import operating_point, precision_recall, rates
from log2sim.evaluation.detection.protocols import DIFFICULTIES, MIN_POINTS, ObjectClass
from log2sim.geometry import wrap_angle

Mask = NDArray[np.bool_]
RANGES_M = ((0.0, 15.0), (15.0, 30.0), (30.0, 50.0), (50.0, np.inf))
POINTS = ((MIN_POINTS, 9), (10, 19), (20, 49), (50, np.inf), (20, np.inf))
"""The last one joins the two before."""


@dataclass(frozen=True, eq=False)
class ClassBoxes:
    """Found and true boxes of one class.

    Attributes
    ----------
    found, truth : SceneBoxes
        M found and L true boxes; true ones are ignored where they never count.
    far : (M,) bool
        Found boxes out of range, which are not false where they match nothing.
    unlabeled : (M,) bool
        Those where nothing was labeled, likewise.
    found_views, truth_views : ImageViews or None
        In the reference camera, for KITTI's difficulties.
    occlusion : (L,) int64 or None
        As the log states it.
    """

    found: SceneBoxes
    truth: SceneBoxes
    far: Mask
    unlabeled: Mask
    found_views: ImageViews | None = None
    truth_views: ImageViews | None = None
    occlusion: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Objects:
    """Some objects of a class, such as those of one difficulty: the same rows, of which others are ignored.

    Attributes
    ----------
    name : str
    boxes : ClassBoxes
    found, truth : SceneBoxes
    elsewhere : (M,) bool
        Found boxes that are not false where they match nothing, since they are out of range or of other objects.
    """

    name: str
    boxes: ClassBoxes
    found: SceneBoxes
    truth: SceneBoxes
    elsewhere: Mask

    def matches(self, pairs: Pairs, criterion: Criterion) -> Matches:
        """Match them; boxes where nothing was labeled are not false."""
        found = assign(self.found, self.truth, pairs, criterion)
        return found.excusing(self.elsewhere).excusing(self.boxes.unlabeled)


def class_figures(boxes: ClassBoxes, of_class: ObjectClass, min_score: float) -> dict[str, Any]:
    """Compute all figures of a class.

    Parameters
    ----------
    boxes : ClassBoxes
    of_class : ObjectClass
        The first of its criteria is that of the tables by range and by points.
    min_score : float
        Score from which boxes are reported, for precision and recall.
    """
    pairs = {c: candidate_pairs(boxes.found, boxes.truth, c) for c in of_class.criteria}
    everything, main = all_objects(boxes), of_class.criteria[0]

    def rows(some: Iterator[Objects], *criteria: Criterion) -> list[dict[str, Any]]:
        return [figures(o, pairs[c], c, min_score) for o in some for c in criteria]

    matches = everything.matches(pairs[main], main)
    return {
        "categories": list(of_class.categories),
        "ignored_kinds": list(of_class.ignored_kinds),
        "figures": rows(iter((everything, *difficulties(boxes))), *of_class.criteria),
        "by_range": rows(by_range(boxes), main),
        "by_points": None if boxes.truth.points is None else rows(by_points(boxes), main),
        "calibration": {"match": match_entry(main), **calibration(everything.found, matches)},
    }


def all_objects(boxes: ClassBoxes) -> Objects:
    """Select all objects with enough points."""
    few = np.zeros(len(boxes.truth), dtype=bool) if boxes.truth.points is None else boxes.truth.points < MIN_POINTS
    return Objects("all", boxes, boxes.found, boxes.truth.ignoring(few), boxes.far)


def difficulties(boxes: ClassBoxes) -> Iterator[Objects]:
    """Select the objects of each of KITTI's difficulties, whatever their number of points; none without views."""
    if boxes.found_views is None or boxes.truth_views is None or boxes.occlusion is None:
        return
    for level in DIFFICULTIES:
        truth = boxes.truth.ignoring(level.ignores_truth(boxes.truth_views, boxes.occlusion))
        found = boxes.found.ignoring(level.ignores_found(boxes.found_views))
        yield Objects(level.name, boxes, found, truth, boxes.far)


def by_range(boxes: ClassBoxes) -> Iterator[Objects]:
    """Select the objects of each range; a found box that matches nothing is false in its own range."""
    everything = all_objects(boxes)
    for low, high in RANGES_M:
        beyond, elsewhere = (((b.range_m < low) | (b.range_m >= high)) for b in (boxes.truth, boxes.found))
        yield Objects(
            f"{low:g}-{high:g} m" if np.isfinite(high) else f"{low:g}+ m",
            boxes,
            boxes.found,
            everything.truth.ignoring(beyond),
            boxes.far | elsewhere,
        )


def by_points(boxes: ClassBoxes) -> Iterator[Objects]:
    """Select the objects of each number of points; a found box that matches nothing is false where its own points are.

    Found boxes whose points were not counted are false everywhere.
    """
    assert boxes.truth.points is not None
    for low, high in POINTS:
        outside = (boxes.truth.points < low) | (boxes.truth.points > high)
        own = boxes.found.points
        elsewhere = np.zeros(len(boxes.found), dtype=bool) if own is None else (own < low) | (own > high)
        yield Objects(
            f"{low}-{high} points" if np.isfinite(high) else f"{low}+ points",
            boxes,
            boxes.found,
            boxes.truth.ignoring(outside),
            boxes.far | elsewhere,
        )


def figures(objects: Objects, pairs: Pairs, criterion: Criterion, min_score: float) -> dict[str, Any]:
    """Compute average precision, the figures at a score, and how many headings are off by more than 90 degrees."""
    matches = objects.matches(pairs, criterion)
    curve = precision_recall(objects.found, matches)
    in_images = objects.boxes.found_views is not None
    return {
        "objects": objects.name,
        "match": match_entry(criterion),
        "truths": matches.truths,
        "ap_r40": curve.average(40),
        "ap_r11": curve.average(11),
        "ap_nuscenes": curve.nuscenes_average() if criterion.measure == "center_m" else None,
        **(published(objects, pairs, criterion) if in_images else {}),
        **operating_point(objects.found, matches, min_score),
        "heading_over_90_deg": headings(objects, matches, min_score),
    }


def published(objects: Objects, pairs: Pairs, criterion: Criterion) -> dict[str, Any]:
    """Compute average precision as KITTI's published program does: sampled, and false in regions without labels too.

    Notes
    -----
    The program compares the 3D boxes of these regions, which do not exist, so that its figures for 3D boxes lack the rule.
    """
    found = assign(objects.found, objects.truth, pairs, criterion).excusing(objects.elsewhere)
    curve = precision_recall(objects.found, found)
    return {"ap_r40_published": curve.sampled_average(40), "ap_r11_published": curve.sampled_average(11)}


def headings(objects: Objects, matches: Matches, min_score: float) -> float | None:
    """Compute the share of right boxes at a score whose heading is off by more than 90 degrees; None without any."""
    rows = np.flatnonzero(matches.right & (objects.found.score >= min_score))
    off = wrap_angle(objects.found.box[rows, 6] - objects.truth.box[matches.truth[rows], 6])
    wrong = np.abs(off) > np.pi / 2
    return float(wrong.mean()) if len(rows) else None


def match_entry(criterion: Criterion) -> dict[str, Any]:
    """Return a criterion as a document."""
    return {"measure": criterion.measure, "limit": criterion.limit}


def overall(classes: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Add up the counts of classes, each by its own first match, for all objects and for each range and number of points.

    Categories whose group is among the classes count once.
    """
    members = {name: set(figures["categories"]) for name, figures in classes.items()}
    whole = [
        figures for name, figures in classes.items() if not any(members[name] < other for other in members.values())
    ]
    counts: dict[str, list[int]] = {}
    for figures in whole:
        for row in (figures["figures"][0], *figures["by_range"], *(figures["by_points"] or [])):
            sums = counts.setdefault(row["objects"], [0, 0, 0])
            for k, key in enumerate(("true_positives", "false_positives", "false_negatives")):
                sums[k] += row[key]
    return [{"objects": name, "truths": c[0] + c[2], **rates(*c)} for name, c in counts.items()]
