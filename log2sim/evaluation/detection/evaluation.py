"""A boxes file against the labels of a log: average precision, precision and recall, calibration of scores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.detection.boxes import DetectedBoxes, SceneBoxes
from log2sim.evaluation.detection.protocols import (
    DIFFICULTIES,
    MIN_POINTS,
    PROTOCOLS,
    Criterion,
    Matches,
    ObjectClass,
    assign_boxes,
    candidate_pairs,
)
from log2sim.evaluation.detection.truth import ImageViews, image_views, truth_of_sweeps
from log2sim.evaluation.metrics.comparison import MIN_REGION_SHARE
from log2sim.evaluation.metrics.correctness import RANGES_M, reliability
from log2sim.evaluation.metrics.table import columns_text, percent, verdict_text
from log2sim.evaluation.road import cell
from log2sim.files.plugins import nearest
from log2sim.geometry import Array, wrap_angle

ROUNDING = 1e-9
SAMPLES = 40  # steps of recall of KITTI's published program
NUSCENES_FLOOR = 0.1  # nuScenes leaves out what lies below this precision and this recall


@dataclass(frozen=True, eq=False)
class PrecisionRecall:
    """Precision and recall at each distinct score, greatest first."""

    score: Array  # (K,) boxes of this score and above are reported
    # precision, recall: (K,)
    precision: Array
    recall: Array
    truths: int  # number of counted true boxes

    def best_precision(self, recall: Array) -> Array:
        """Return the greatest precision at or beyond recalls (R,), 0 where none is reached."""
        at_least = np.maximum.accumulate(self.precision[::-1])[::-1]
        k = np.searchsorted(self.recall, recall - ROUNDING)
        return np.where(k < len(at_least), np.append(at_least, 0.0)[k], 0.0)

    def average(self, recall_points: int = 40) -> float | None:
        """Average the best precision over recalls; None without true boxes.

        `recall_points`: 40: recalls 1/40 to 1, KITTI's rule since 2019, which drops the first of 41 points (Simonelli
        et al., ICCV 2019); 11: recalls 0 to 1 (PASCAL VOC; Everingham et al., IJCV 2010), KITTI's rule before.
        """
        if recall_points not in (40, 11):
            raise ValueError(f"recall_points is {recall_points}, expected 40 or 11")
        at = np.arange(1, 41) / 40 if recall_points == 40 else np.arange(11) / 10
        return float(self.best_precision(at).mean()) if self.truths else None

    def nuscenes_average(self) -> float | None:
        """Average as nuScenes does (Caesar et al., CVPR 2020, section 3.1); None without true boxes.

        Over recalls 0.11 to 1 in steps of 0.01, of the precision above 0.1, scaled to 1. The precision is the best one at or
        beyond each recall; nuScenes interpolates between neighbors instead.
        """
        if not self.truths:
            return None
        above = np.maximum(self.best_precision(np.arange(11, 101) / 100) - NUSCENES_FLOOR, 0)
        return min(float(above.mean() / (1 - NUSCENES_FLOOR)), 1.0)

    def sampled_average(self, recall_points: int = 40) -> float | None:
        """Average as KITTI's published program does; None without true boxes.

        The program looks at no more than 41 of the scores of right boxes, those at which the recall is nearest to 0, 1/40 and
        so on; points that are not reached count 0, and the last right box counts as one more point, which adds up to 1/40. With
        fewer than 40 true boxes even a perfect detector gets less than 1: take `average` for small sets, and this figure to
        compare with published ones.
        """
        if not self.truths:
            return None
        right = np.round(self.recall * self.truths).astype(np.int64)
        of_curve = np.repeat(np.arange(len(self.score)), np.diff(right, prepend=0))
        sampled, reached, aim = np.zeros(SAMPLES + 1), 0, 0.0
        for n, k in enumerate(of_curve.tolist(), start=1):
            here, following = n / self.truths, (n + 1) / self.truths
            if n < len(of_curve) and following - aim < aim - here:
                continue
            sampled[reached] = self.precision[k]
            reached += 1
            aim += 1 / SAMPLES  # summed as there, since rounding decides where two scores are equally near
        best = np.maximum.accumulate(sampled[::-1])[::-1]
        return float(best[1:].mean() if recall_points == 40 else best[::4].mean())


def precision_recall(found: SceneBoxes, matches: Matches) -> PrecisionRecall:
    """Compute the curve of matched boxes; boxes of equal score come together."""
    rows = np.flatnonzero(matches.right | matches.false)
    rows = rows[np.argsort(-found.score[rows], kind="stable")]
    score = found.score[rows]
    last = np.flatnonzero(np.append(score[1:] != score[:-1], len(score) > 0))
    right = np.cumsum(matches.right[rows])[last]
    recall = right / matches.truths if matches.truths else np.zeros(len(last))
    return PrecisionRecall(score[last], right / (last + 1), recall, matches.truths)


def operating_point(found: SceneBoxes, matches: Matches, min_score: float) -> dict[str, Any]:
    """Count what is right when only boxes of at least a score are reported.

    Returns "true_positives", "false_positives", "false_negatives", and "precision", "recall", "f1" and
    "precision_times_recall", which are None where nothing was reported or nothing was there to be found. Some authors
    call the last one mean average precision, which it is not: it is one point of the curve.
    """
    reported = found.score >= min_score
    right, false = (int(np.count_nonzero(rows & reported)) for rows in (matches.right, matches.false))
    return detection_rates(right, false, matches.truths - right)


def detection_rates(right: int, false: int, missed: int) -> dict[str, Any]:
    """Compute the figures of `operating_point` from its counts."""
    precision = right / (right + false) if right + false else None
    recall = right / (right + missed) if right + missed else None
    both = precision is not None and recall is not None
    return {
        "true_positives": right, "false_positives": false, "false_negatives": missed, "precision": precision, "recall": recall,
        "f1": 2 * right / (2 * right + false + missed) if both else None,
        "precision_times_recall": precision * recall if precision is not None and recall is not None else None,
    }  # fmt: skip


def calibration(found: SceneBoxes, matches: Matches) -> dict[str, Any]:
    """Compare scores with the share of right boxes.

    Returns "boxes", "expected_calibration_error" (None without boxes), and "bins" of equal width from 0 to 1 with
    "low", "high", "boxes", "mean_score" and "precision" (None in empty bins).

    See `reliability`. Ignored boxes are left out.
    """
    judged = matches.right | matches.false
    table = reliability(found.score[judged], matches.right[judged])
    names = {"count": "boxes", "mean_confidence": "mean_score", "right": "precision"}
    bins = [{names.get(key, key): value for key, value in b.items()} for b in table["bins"]]
    error = table["expected_calibration_error"]
    return {"boxes": table["count"], "expected_calibration_error": error, "bins": bins}


Mask = NDArray[np.bool_]
POINTS = ((MIN_POINTS, 9), (10, 19), (20, 49), (50, np.inf), (20, np.inf))  # the last one joins the two before


@dataclass(frozen=True, eq=False)
class BothBoxes:
    """Found and true boxes, of all classes or of one."""

    found: SceneBoxes  # M boxes
    truth: SceneBoxes  # L boxes; of one class, those are ignored that never count
    far: Mask  # (M,) found boxes out of range, which are not false where they match nothing
    region_share: Array  # (M,) share of found boxes where nothing was labeled
    kind: NDArray[np.str_]  # (L,) the log's own word
    occlusion: NDArray[np.int64]  # (L,) as the log states it
    # In the reference camera, for KITTI's difficulties.
    found_views: ImageViews | None = None
    truth_views: ImageViews | None = None
    max_region_share: float = MIN_REGION_SHARE  # found boxes with more are not false where they match nothing

    def take(self, mine: Any, true: Any) -> BothBoxes:
        """Take some found and some true boxes."""
        views, true_views = self.found_views, self.truth_views
        return BothBoxes(
            self.found.take(mine), self.truth.take(true), self.far[mine], self.region_share[mine], self.kind[true],
            self.occlusion[true], views and views.take(mine), true_views and true_views.take(true),
        )  # fmt: skip


def class_figures(boxes: BothBoxes, of_class: ObjectClass, min_score: float) -> dict[str, Any]:
    """Compute all figures of a class.

    `of_class`: the first of its criteria is that of the tables by range and by points. `min_score`: score from which
    boxes are reported, for precision and recall.

    Of all objects and of parts of them, such as those of one difficulty, the others are ignored, and a found box that matches
    nothing is false in its own part: its range, or its number of points where that was counted. KITTI's difficulties count
    objects with any number of points, the rest those with enough.
    """
    found, truth, far, main = boxes.found, boxes.truth, boxes.far, of_class.criteria[0]
    pairs = {c: candidate_pairs(found, truth, c) for c in of_class.criteria}
    unlabeled = boxes.region_share > boxes.max_region_share  # found where nothing was labeled: not false
    enough = truth if truth.points is None else truth.ignoring(truth.points < MIN_POINTS)

    def figures(name: str, mine: SceneBoxes, true: SceneBoxes, elsewhere: Mask, criterion: Criterion) -> dict[str, Any]:
        # By KITTI's published program what is found in regions without labels is false, too: it compares 3D boxes of these
        # regions, which do not exist.
        matched = assign_boxes(mine, true, pairs[criterion], criterion).excusing(elsewhere)
        matches = matched.excusing(unlabeled)
        curve, published = precision_recall(mine, matches), precision_recall(mine, matched)
        rows = np.flatnonzero(matches.right & (mine.score >= min_score))
        turned = wrap_angle(mine.box[rows, 6] - true.box[matches.truth[rows], 6])
        views = boxes.found_views is not None
        of_program = {f"ap_r{n}_published": published.sampled_average(n) for n in (40, 11)} if views else {}
        return {
            "objects": name, "match": asdict(criterion), "truths": matches.truths, "ap_r40": curve.average(40),
            "ap_r11": curve.average(11),
            "ap_nuscenes": curve.nuscenes_average() if criterion.measure == "center_m" else None,
            **of_program, **operating_point(mine, matches, min_score),
            "heading_over_90_deg": float((np.abs(turned) > np.pi / 2).mean()) if len(rows) else None,
        }  # fmt: skip

    rows = [figures("all", found, enough, far, c) for c in of_class.criteria]
    if boxes.found_views is not None and boxes.truth_views is not None:
        for level in DIFFICULTIES:
            views, small = boxes.truth_views, boxes.found_views.height_px < level.min_height_px
            hard = (views.height_px <= level.min_height_px) | (views.truncation > level.max_truncation)
            true = truth.ignoring(hard | (boxes.occlusion > level.max_occlusion))
            mine = found.ignoring(small)
            rows += [figures(level.name, mine, true, far, c) for c in of_class.criteria]
    by_range, by_points = [], []
    for low, high in RANGES_M:
        beyond, elsewhere = ((b.range_m < low) | (b.range_m >= high) for b in (truth, found))
        name = f"{low:g}-{high:g} m" if np.isfinite(high) else f"{low:g}+ m"
        by_range.append(figures(name, found, enough.ignoring(beyond), far | elsewhere, main))
    if truth.points is not None:
        for low, high in POINTS:
            outside = (truth.points < low) | (truth.points > high)
            own = found.points
            elsewhere = np.zeros(len(found), dtype=bool) if own is None else (own < low) | (own > high)
            name = f"{low}-{high} points" if np.isfinite(high) else f"{low}+ points"
            by_points.append(figures(name, found, truth.ignoring(outside), far | elsewhere, main))
    matches = assign_boxes(found, enough, pairs[main], main).excusing(far).excusing(unlabeled)
    return {
        "categories": list(of_class.categories),
        "ignored_kinds": list(of_class.ignored_kinds),
        "figures": rows,
        "by_range": by_range,
        "by_points": None if truth.points is None else by_points,
        "calibration": {"match": asdict(main), **calibration(found, matches)},
    }


def overall(classes: Mapping[str, Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Add up the counts of classes, each by its own first match, for all objects and for each range and number of points.

    Categories whose group is among the classes count once.
    """
    members = {name: set(figures["categories"]) for name, figures in classes.items()}
    part = {name for name, own in members.items() if any(own < other for other in members.values())}
    whole = [figures for name, figures in classes.items() if name not in part]
    counts: dict[str, list[int]] = {}
    for figures in whole:
        for row in (figures["figures"][0], *figures["by_range"], *(figures["by_points"] or [])):
            sums = counts.setdefault(row["objects"], [0, 0, 0])
            for k, key in enumerate(("true_positives", "false_positives", "false_negatives")):
                sums[k] += row[key]
    return [{"objects": name, "truths": c[0] + c[2], **detection_rates(*c)} for name, c in counts.items()]


AVERAGES = {
    "kitti": (("ap_r40", "AP R40"), ("ap_r11", "AP R11"), ("ap_r40_published", "publ. R40")),
    "dair": (("ap_r40", "AP R40"), ("ap_r11", "AP R11")),
    "center": (("ap_nuscenes", "AP nuSc"), ("ap_r40", "AP R40")),
}
AT_SCORE = (
    ("precision", "precis."), ("recall", "recall"), ("f1", "F1"), ("precision_times_recall", "P x R"),
    ("heading_over_90_deg", "> 90 deg"),
)  # fmt: skip


def format_verdict(result: Mapping[str, Any]) -> str:
    """Say for each class how many boxes were found, how many of the found are right, and the average precision."""
    key, title = AVERAGES[result["protocol"]][0]
    lines, shown = [], list[Any]()
    for name, figures in result["classes"].items():
        row = next((row for row in _rows(figures) if row["objects"] == "all"), None)
        if row is None or figures in shown:
            continue
        shown.append(figures)
        limit = Criterion(**row["match"])
        if not row["truths"]:
            lines.append((name, f"none labeled, {row['false_positives']} found ({limit})"))
            continue
        text = f"{percent(row['recall'])} of {row['truths']} found, {percent(row['precision'])} of the found right"
        average = "" if row[key] is None else f", {title} {row[key]:.3f}"
        turned = row["heading_over_90_deg"]
        backwards = f", {percent(turned)} backwards" if turned else ""
        lines.append((name, f"{text}{average}{backwards} ({limit})"))
    sweeps, skipped = result["sweeps"], result["sweeps_without_labels"]
    left_out = f" ({skipped} without labels left out)" if skipped else ""
    parts = [f"{sweeps} labeled sweep{'s' * (sweeps != 1)}{left_out}"]
    if result["reference_camera"] is not None:
        parts.append(f"boxes that {result['reference_camera']} shows")
        if not result["occlusion_known"]:
            parts.append("difficulties without occlusion, which the labels do not state")
    if result["max_range_m"] is not None:
        parts.append(f"up to {result['max_range_m']:g} m")
    scores = f"precision, recall and what follows at scores from {result['min_score']:g}"
    return verdict_text([*lines, ("scope", f"{'; '.join(parts)}; {scores}")])


def format_table(result: Mapping[str, Any]) -> str:
    """Format a result of `evaluate_boxes`; '-' for None.

    Left out are classes without a true and a found box, categories that are all of their group, rows without true boxes,
    and the looser limits of difficulties; the document has them.
    """
    columns = (*AVERAGES[result["protocol"]], *AT_SCORE)
    cells = [["class", "objects", "match", "truths", *(title for _, title in columns)]]
    shown: dict[str, list[Mapping[str, Any]]] = {}
    for name, figures in result["classes"].items():
        rows = _rows(figures)
        if rows and rows not in shown.values():
            shown[name] = rows
    for name, rows in shown.items():
        for row in rows:
            values = [cell(row[key], 3) for key, _ in columns]
            cells.append([name, row["objects"], str(Criterion(**row["match"])), str(row["truths"]), *values])
    if len(shown) > 1:
        for row in result["overall"]:
            if row["truths"]:
                values = [cell(row.get(key), 3) for key, _ in columns]
                cells.append(["all classes", row["objects"], "each its first", str(row["truths"]), *values])
    lines = columns_text(cells, heads=3)
    for name in shown:
        scores = result["classes"][name]["calibration"]
        if (error := scores["expected_calibration_error"]) is not None:
            where = f"{scores['boxes']} boxes, {Criterion(**scores['match'])}"
            lines.append(f"{name}: expected calibration error of the scores {error:.3f} ({where})")
    return "\n".join(lines)


def _rows(figures: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """Select the rows of a class."""
    limit = figures["calibration"]["match"]["limit"]
    everything = [row for row in figures["figures"] if row["objects"] == "all"]
    parts = [row for row in figures["figures"] if row["objects"] != "all" and row["match"]["limit"] == limit]
    parts += [*figures["by_range"], *(figures["by_points"] or [])]
    if not any(row["truths"] for row in (*everything, *parts)):
        # Only false boxes, which one match tells as well as all.
        return [row for row in everything[:1] if row["false_positives"]]
    return [*everything, *(row for row in parts if row["truths"])]


VERSION = 1
DEFAULT_SCORE = 0.5


@dataclass(frozen=True)
class DetectionOptions:
    """What to evaluate."""

    protocol: str  # "kitti", "dair" or "center"
    min_score: float = DEFAULT_SCORE  # score in [0, 1] from which boxes are reported, for precision and recall
    max_range_m: float | None = None  # objects farther away count for nothing
    classes: Sequence[str] | None = None  # names of classes or categories; None for all

    def __post_init__(self) -> None:
        """Check the values."""
        if self.protocol not in PROTOCOLS:
            hint = f"{nearest(self.protocol, list(PROTOCOLS))}; known: {', '.join(PROTOCOLS)}"
            raise ConfigError(f"--protocol: unknown protocol '{self.protocol}'{hint}")
        if not 0 <= self.min_score <= 1:
            raise ConfigError(f"--score: {self.min_score:g}; expected a score from 0 to 1")
        if self.max_range_m is not None and not self.max_range_m > 0:
            raise ConfigError(f"--range: {self.max_range_m:g} m; expected more than 0")

    def chosen(self) -> tuple[ObjectClass, ...]:
        """Select the classes of the protocol.

        Raises `ConfigError` for a name that is neither a class of the protocol nor a category of one.
        """
        classes = PROTOCOLS[self.protocol].classes
        if self.classes is None:
            return classes
        known = list(dict.fromkeys(n for c in classes for n in (c.name, *c.categories)))
        for name in self.classes:
            if name not in known:
                hint = f"{nearest(name, known)}; it has {', '.join(known)}"
                raise ConfigError(f"--categories: protocol '{self.protocol}' has no '{name}'{hint}")
        return tuple(c for c in classes if c.name in self.classes or set(c.categories) <= set(self.classes))


def evaluate_boxes(
    detected: DetectedBoxes, log: Log, options: DetectionOptions, *, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Compute the figures of a detector on a log.

    `log`: with labels; its sweeps are read to count points. `progress`: called with (sweeps done, all sweeps). Returns
    a document of `schemas/detection-metrics-1.json`. Raises `LogError` for a log without labels, or none of these
    sweeps, and boxes of another log. Raises `ConfigError` for a protocol that needs a camera and a log without.
    """
    protocol, classes = PROTOCOLS[options.protocol], options.chosen()
    if len(detected.t_ns) == 0:
        raise LogError(f"the boxes of '{detected.log}' are of no sweep at all; detect them in a log with LiDAR sweeps")
    camera = None
    if protocol.of_camera:  # the difficulties are those in a camera whose objects are labeled
        labeled = log.labels.cameras if log.labels is not None else None
        names = [*(labeled or ()), log.reference_camera, *log.cameras]
        camera = next((name for name in names if name in log.cameras), None)
        if camera is None:
            raise ConfigError(
                f"--protocol {protocol.name}: its difficulties need a camera, and log '{log.name}' has none; "
                "choose dair or center"
            )
    truth = truth_of_sweeps(log, detected.t_ns, progress=progress)
    # Collect the found boxes of the labeled sweeps; their scenes are indices of sweeps.
    tables = []
    for k in np.flatnonzero(truth.labeled).tolist():
        b = detected.boxes[k]
        box = np.column_stack([b.center_m, b.size_m, b.yaw_rad])
        away = np.hypot(*(b.center_m[:, :2] - truth.origin_m[k, :2]).T)
        tables.append(SceneBoxes.of(box, b.category, b.score, points=b.points, range_m=away))
    joined = SceneBoxes.join(tables)
    found = replace(joined, scene=np.flatnonzero(truth.labeled)[joined.scene])
    # With a reference camera, only what it shows is kept.
    limit_m = np.inf if options.max_range_m is None else options.max_range_m
    far, true = found.range_m > limit_m, truth.boxes.ignoring(truth.boxes.range_m > limit_m)
    if camera is None:
        boxes = BothBoxes(found, true, far, _unlabeled(log, detected.t_ns, found), truth.kind, truth.occlusion)
    else:
        views = image_views(log, camera, detected.t_ns, found)
        true_views = image_views(log, camera, detected.t_ns, true, truncation=True)
        boxes = BothBoxes(found, true, far, views.region_share, truth.kind, truth.occlusion, views, true_views)
        boxes = boxes.take(views.shown, true_views.shown)
    figures = {}
    for c in classes:
        own = boxes.take(*(np.isin(b.category, c.categories) for b in (boxes.found, boxes.truth)))
        # By KITTI's rule, as much of a box may lie in regions without labels as boxes have to overlap.
        limit = MIN_REGION_SHARE if own.found_views is None else c.criteria[0].limit
        own = replace(own, truth=own.truth.ignoring(np.isin(own.kind, c.ignored_kinds)), max_region_share=limit)
        figures[c.name] = class_figures(own, c, options.min_score)
    return {
        "detection_metrics_version": VERSION, "log": detected.log, "truth": log.name, "detector": detected.detector,
        "protocol": protocol.name, "min_score": options.min_score, "max_range_m": options.max_range_m,
        "sweeps": int(truth.labeled.sum()), "sweeps_without_labels": int((~truth.labeled).sum()),
        "reference_camera": camera,
        "occlusion_known": None if camera is None else log.labels is not None and log.labels.occlusion is not None,
        "min_points": None if truth.boxes.points is None else MIN_POINTS, "overall": overall(figures),
        "classes": figures,
    }  # fmt: skip


def _unlabeled(log: Log, t_ns: NDArray[np.int64], found: SceneBoxes) -> Array:
    """Compute the least share (M,) of each box in regions without labels over cameras; 1 where no labeled one shows it."""
    only = None if log.labels is None else log.labels.cameras
    names = [name for name in (only if only is not None else log.ignored_regions) if name in log.cameras]
    share = np.full(len(found), np.inf)
    for name in names:
        views = image_views(log, name, t_ns, found)
        share = np.where(views.shown, np.minimum(share, views.region_share), share)
    return np.where(np.isfinite(share), share, 0.0 if only is None else 1.0)
