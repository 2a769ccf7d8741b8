"""Evaluate a boxes file against the labels of a log by one protocol."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import ConfigError, LogError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.boxes_file import DetectedBoxes
from log2sim.evaluation.detection.class_figures import ClassBoxes, class_figures, overall
from log2sim.evaluation.detection.image_views import ImageViews, image_views
from log2sim.evaluation.detection.protocols import MIN_POINTS, PROTOCOLS, ObjectClass, Protocol
from log2sim.evaluation.detection.truth import SweepTruth, truth_of_sweeps
from log2sim.evaluation.metrics.label_coverage import MIN_REGION_SHARE
from log2sim.geometry import Array
from log2sim.registry import nearest

VERSION = 1
DEFAULT_SCORE = 0.5


@dataclass(frozen=True)
class Options:
    """What to evaluate.

    Attributes
    ----------
    protocol : str
        "kitti", "dair" or "center".
    min_score : float
        Score in [0, 1] from which boxes are reported, for precision and recall.
    max_range_m : float or None
        Objects farther away count for nothing.
    classes : sequence of str or None
        Names of classes or categories; None for all.
    """

    protocol: str
    min_score: float = DEFAULT_SCORE
    max_range_m: float | None = None
    classes: Sequence[str] | None = None

    def __post_init__(self) -> None:
        """Check the values."""
        if self.protocol not in PROTOCOLS:
            raise ConfigError(
                f"--protocol: unknown protocol '{self.protocol}'{nearest(self.protocol, list(PROTOCOLS))}; "
                f"known: {', '.join(PROTOCOLS)}"
            )
        if not 0 <= self.min_score <= 1:
            raise ConfigError(f"--score: {self.min_score:g}; expected a score from 0 to 1")
        if self.max_range_m is not None and not self.max_range_m > 0:
            raise ConfigError(f"--range: {self.max_range_m:g} m; expected more than 0")

    def chosen(self) -> tuple[ObjectClass, ...]:
        """Select the classes of the protocol.

        Raises
        ------
        ConfigError
            For a name that is neither a class of the protocol nor a category of one.
        """
        classes = PROTOCOLS[self.protocol].classes
        if self.classes is None:
            return classes
        known = list(dict.fromkeys(n for c in classes for n in (c.name, *c.categories)))
        for name in self.classes:
            if name not in known:
                raise ConfigError(
                    f"--categories: protocol '{self.protocol}' has no '{name}'{nearest(name, known)}; "
                    f"it has {', '.join(known)}"
                )
        return tuple(c for c in classes if c.name in self.classes or set(c.categories) <= set(self.classes))


def evaluate_boxes(
    detected: DetectedBoxes, log: Log, options: Options, *, progress: Callable[[int, int], None] | None = None
) -> dict[str, Any]:
    """Compute the figures of a detector on a log.

    Parameters
    ----------
    detected : DetectedBoxes
    log : Log
        With labels; its sweeps are read to count points.
    options : Options
    progress : callable, optional
        Called with (sweeps done, all sweeps).

    Returns
    -------
    dict
        A document of `schemas/detection-metrics-1.json`.

    Raises
    ------
    LogError
        For a log without labels, or none of these sweeps, and boxes of another log.
    ConfigError
        For a protocol that needs a camera and a log without.
    """
    protocol, classes = PROTOCOLS[options.protocol], options.chosen()
    if len(detected.t_ns) == 0:
        raise LogError(f"the boxes of '{detected.log}' are of no sweep at all; detect them in a log with LiDAR sweeps")
    camera = _reference_camera(log, protocol)
    truth = truth_of_sweeps(log, detected.t_ns, progress=progress)
    found = found_in_sweeps(detected, truth)
    sides = _sides(log, detected.t_ns, found, truth, camera)
    figures = {c.name: class_figures(_class_boxes(sides, c, options, protocol), c, options.min_score) for c in classes}
    return {
        "detection_metrics_version": VERSION,
        "log": detected.log,
        "truth": log.name,
        "detector": detected.detector,
        "protocol": protocol.name,
        "min_score": options.min_score,
        "max_range_m": options.max_range_m,
        "sweeps": int(truth.labeled.sum()),
        "sweeps_without_labels": int((~truth.labeled).sum()),
        "reference_camera": camera,
        "occlusion_known": None if camera is None else log.labels is not None and log.labels.occlusion is not None,
        "min_points": None if truth.boxes.points is None else MIN_POINTS,
        "overall": overall(figures),
        "classes": figures,
    }


def found_in_sweeps(detected: DetectedBoxes, truth: SweepTruth) -> SceneBoxes:
    """Collect the found boxes of the labeled sweeps; their scenes are indices of sweeps."""
    tables = []
    for k in np.flatnonzero(truth.labeled).tolist():
        b = detected.boxes[k]
        box = np.column_stack([b.center_m, b.size_m, b.yaw_rad])
        away = np.hypot(*(b.center_m[:, :2] - truth.origin_m[k, :2]).T)
        tables.append(SceneBoxes.of(box, b.category, b.score, points=b.points, range_m=away))
    joined = SceneBoxes.join(tables)
    return replace(joined, scene=np.flatnonzero(truth.labeled)[joined.scene])


@dataclass(frozen=True, eq=False)
class _Sides:
    """Found and true boxes of all classes with what the cameras say about them."""

    found: SceneBoxes
    truth: SceneBoxes
    unlabeled: Array
    kind: NDArray[np.str_]
    occlusion: NDArray[np.int64]
    found_views: ImageViews | None
    truth_views: ImageViews | None


def _reference_camera(log: Log, protocol: Protocol) -> str | None:
    """Choose the camera of the difficulties: one whose objects are labeled; None for protocols without difficulties."""
    if not protocol.of_camera:
        return None
    labeled = log.labels.cameras if log.labels is not None else None
    names = [*(labeled or ()), *([log.reference_camera] if log.reference_camera else []), *log.cameras]
    found = next((name for name in names if name in log.cameras), None)
    if found is None:
        raise ConfigError(
            f"--protocol {protocol.name}: its difficulties need a camera, and log '{log.name}' has none; "
            "choose dair or center"
        )
    return found


def _sides(log: Log, t_ns: NDArray[np.int64], found: SceneBoxes, truth: SweepTruth, camera: str | None) -> _Sides:
    """Project boxes where it is needed; with a reference camera, only what it shows is kept."""
    if camera is None:
        return _Sides(found, truth.boxes, _unlabeled(log, t_ns, found), truth.kind, truth.occlusion, None, None)
    views = image_views(log, camera, t_ns, found)
    true_views = image_views(log, camera, t_ns, truth.boxes, truncation=True)
    shown, true_shown = views.shown, true_views.shown
    return _Sides(
        found.take(shown),
        truth.boxes.take(true_shown),
        views.region_share[shown],
        truth.kind[true_shown],
        truth.occlusion[true_shown],
        views.take(shown),
        true_views.take(true_shown),
    )


def _unlabeled(log: Log, t_ns: NDArray[np.int64], found: SceneBoxes) -> Array:
    """Compute the least share (M,) of each box in regions without labels over cameras; 1 where no labeled one shows it."""
    only = None if log.labels is None else log.labels.cameras
    names = [name for name in (only if only is not None else log.ignored_regions) if name in log.cameras]
    share = np.full(len(found), np.inf)
    for name in names:
        views = image_views(log, name, t_ns, found)
        share = np.where(views.shown, np.minimum(share, views.region_share), share)
    return np.where(np.isfinite(share), share, 0.0 if only is None else 1.0)


def _class_boxes(sides: _Sides, of_class: ObjectClass, options: Options, protocol: Protocol) -> ClassBoxes:
    """Select the boxes of a class and decide what is ignored."""
    mine, true = (np.isin(b.category, of_class.categories) for b in (sides.found, sides.truth))
    far_m = np.inf if options.max_range_m is None else options.max_range_m
    limit = of_class.criteria[0].limit if protocol.of_camera else MIN_REGION_SHARE
    found, truth = sides.found.take(mine), sides.truth.take(true)
    never = (truth.range_m > far_m) | np.isin(sides.kind[true], of_class.ignored_kinds)
    return ClassBoxes(
        found,
        truth.ignoring(never),
        found.range_m > far_m,
        sides.unlabeled[mine] > limit,
        None if sides.found_views is None else sides.found_views.take(mine),
        None if sides.truth_views is None else sides.truth_views.take(true),
        sides.occlusion[true],
    )
