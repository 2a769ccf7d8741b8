"""2D boxes of road users in camera frames, by a model, by somebody else's detector, or from the labels of the log.

Track ids are never read: boxes are as anonymous as those of a model, so that tracking has the same task.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import CATEGORIES, Boxes3D, Detections, Frame, Labels, Log
from log2sim.errors import ConfigError, Log2SimError, PluginError
from log2sim.files import plugins
from log2sim.files.plugins import DETECT, require_members
from log2sim.geometry import NS_PER_S, period_of, rectangles_overlap, wrap_angle
from log2sim.logs.excerpt import STAMP_TOLERANCE_NS
from log2sim.perception.lidar.projection import project_boxes_in_view, view_of

__all__ = ["Detector", "create_detector"]


MEMBERS = ("name", "default_min_score", "detect")
ROW = "x0, y0, x1, y1 in px, score, category"

ImageFunction = Callable[[NDArray[np.uint8]], Any]
"""Takes a picture (H, W, 3) uint8 BGR and returns rows of `ROW`, or `Detections`."""


class _WrongRows(PluginError):
    """A function returned something else than rows; who it was and where is added to the message."""


@dataclass(frozen=True, eq=False)
class ForeignDetector:
    """A detector of somebody else."""

    inner: Any
    source: str  # how messages name it

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        return str(self.inner.name)

    @property
    def cache_key(self) -> str | None:
        """What its result depends on besides the record; None where it does not say, so that nothing of it is cached."""
        return getattr(self.inner, "cache_key", None)


class CheckedDetector(ForeignDetector):
    """A detector of somebody else; what it raises and what it returns is checked.

    Raises `PluginError` when it lacks a member of `Detector`, or its `detect` cannot be called.
    """

    def __post_init__(self) -> None:
        """Check the members."""
        require_members(self.inner, MEMBERS, DETECT, self.source)

    @property
    def default_min_score(self) -> float:
        """Score in [0, 1] below which boxes are more often wrong than useful."""
        return float(self.inner.default_min_score)

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame.

        Raises `PluginError` when the detector raises something, or returns no `Detections` of known categories.
        """
        try:
            found = self.inner.detect(frame)
        except _WrongRows as error:
            raise PluginError(f"{self._where(frame)}: {error}") from None
        except (Log2SimError, MemoryError):
            raise
        except Exception as error:
            raise PluginError(f"{self._where(frame)}: {plugins.exception_line(error)}") from error
        if not isinstance(found, Detections):
            raise PluginError(f"{self._where(frame)}: detect returned {type(found).__name__}, expected Detections")
        defect = find_defect(found)
        if defect is not None:
            raise PluginError(f"{self._where(frame)}: {defect}")
        return found

    def _where(self, frame: Frame) -> str:
        return f"{self.source}: camera '{frame.camera.name}' at {frame.t_ns}"


@dataclass(frozen=True, eq=False)
class FunctionDetector:
    """A detector made of a function of a picture."""

    function: ImageFunction
    min_score: float = 0.0  # boxes with lower scores are left out
    name: str = "function"
    default_min_score: float = 0.0
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False)

    @property
    def cache_key(self) -> str | None:
        """What the function states of its kind, with the score; None where it states nothing."""
        stated = getattr(self.function, "cache_key", None)
        return f"{stated} {self.min_score}" if isinstance(stated, str) else None

    def detect(self, frame: Frame) -> Detections:
        """Call the function with a copy of the picture, one call at a time.

        Raises `PluginError` when it returns something else than rows of `ROW` or `Detections`.
        """
        image = frame.image().copy()  # a function may draw on what it gets
        with self._lock:
            found = self.function(image)
        if not isinstance(found, Detections):
            if isinstance(found, (str, bytes)) or not isinstance(found, (Sequence, np.ndarray)):
                raise _WrongRows(f"returned {type(found).__name__}, expected a list of rows of {ROW}, or Detections")
            numbers, categories = np.zeros((len(found), 5)), []
            for k, row in enumerate(found):
                try:
                    *values, category = row
                    if len(values) != 5 or not isinstance(category, str):
                        raise TypeError
                    numbers[k] = [float(value) for value in values]
                except (TypeError, ValueError):
                    raise _WrongRows(f"row {k} is {row!r:.80}, expected {ROW}") from None
                categories.append(category)
            found = Detections(numbers[:, :4], numbers[:, 4], np.array(categories, dtype=np.str_))
        defect = find_defect(found)
        if defect is not None:
            raise _WrongRows(defect)
        order = np.argsort(-found.score, kind="stable")
        kept = found.take(order[found.score[order] >= self.min_score])
        return replace(kept, traffic_lights=found.traffic_lights)


def find_defect(found: Detections) -> str | None:
    """Return what cannot be true of detections; None where nothing is wrong."""
    count = len(found.score)
    if np.shape(found.box_px) != (count, 4) or np.shape(found.category) != (count,):
        return (
            f"box_px has the shape {np.shape(found.box_px)} and category {np.shape(found.category)} for {count} scores"
        )
    box = np.asarray(found.box_px, dtype=np.float64)
    right = np.isfinite(box).all(axis=1) & (box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1])
    if not right.all():
        k = int(np.argmin(right))
        return f"row {k}: the box is {box[k].tolist()}, expected x0 < x1 and y0 < y1"
    return find_wrong_name_or_score(found.category, found.score)


def find_wrong_name_or_score(category: NDArray[np.str_], score: NDArray[np.float64]) -> str | None:
    """Return which of the categories (N,) or scores (N,) of a detector cannot be; None where nothing is wrong."""
    for k, name in enumerate(category):
        if name not in CATEGORIES:
            hint = plugins.nearest(str(name), list(CATEGORIES))
            return f"row {k}: unknown category '{name}'{hint}; known: {', '.join(CATEGORIES)}"
    right = (np.asarray(score) >= 0) & (np.asarray(score) <= 1)
    if not right.all():
        k = int(np.argmin(right))
        return f"row {k}: the score is {score[k]:g}, expected a number from 0 to 1"
    return None


# A box without a partner on the other side of the frame is used up to this age: half a period of 10 Hz and some.
MAX_AGE_S = 0.055
# Labels at 1 Hz and denser are interpolated.
MAX_WINDOW_S = 1.1
# Labels closer in time than the period of any sensor carry a stamp each; then the sensor turns at 10 Hz.
SCATTERED_S = 0.03
SCATTERED_WINDOW_S = 0.15
# Partners are not farther apart than an object of this speed moves between their stamps.
MAX_SPEED_MPS = 50.0
# A difference in size counts this many times a distance between centers: sizes do not change, places do.
SIZE_WEIGHT = 3.0


def boxes_of_labels(labels: Labels, rows: NDArray[np.intp] | slice = slice(None)) -> Boxes3D:
    """Return labels of a log as boxes that are sure."""
    t_ns, category, one = labels.t_ns[rows], labels.category[rows], np.ones(len(labels.t_ns))[rows]
    box = labels.center_m[rows], labels.size_m[rows], labels.yaw_rad[rows]
    return Boxes3D(t_ns, *box, one, category, one, np.zeros(len(t_ns), dtype=np.int64))


def road_users(labels: Labels, usable: NDArray[np.bool_] | bool = True) -> tuple[Boxes3D, int]:
    """Return the usable labels of road users in the order of their stamps, and the time around a frame to search them in, ns."""
    rows = np.flatnonzero(np.isin(labels.category, CATEGORIES) & usable)
    boxes = boxes_of_labels(labels, rows[np.argsort(labels.t_ns[rows], kind="stable")])
    return replace(boxes, category=boxes.category.astype("<U16")), window_ns(labels.t_ns)


def window_ns(t_ns: NDArray[np.int64]) -> int:
    """Compute the time around a frame in which its labels are searched: one period of the labels, ns.

    Some logs stamp all boxes of a sweep alike, others each by its own points, from which no period can be read.
    """
    period_s = period_of(np.unique(t_ns))
    if period_s < SCATTERED_S:
        return round(SCATTERED_WINDOW_S * NS_PER_S)
    return round(min(1.05 * period_s, MAX_WINDOW_S) * NS_PER_S)


def interpolate_boxes(boxes: Boxes3D, t_ns: int, window: int) -> Boxes3D:
    """Interpolate boxes to a stamp, between the last one before and the first one after it.

    `boxes`: boxes of all stamps in ascending order. `window`: from `window_ns`.

    Partners before and after are mutual nearest neighbors in place and size: without interpolation a car at 15 m/s is
    0.75 m off between two stamps at 10 Hz. A box without a partner is kept in its place up to `MAX_AGE_S`.
    """
    low, here, high = np.searchsorted(boxes.t_ns, [t_ns - window, t_ns + 1, t_ns + window + 1])
    before = boxes.take(drop_repeated_objects(boxes, np.arange(here - 1, low - 1, -1)))
    after = boxes.take(drop_repeated_objects(boxes, np.arange(here, high)))
    i = j = np.zeros(0, np.intp)
    if len(before) and len(after):
        distance = np.linalg.norm(before.center_m[:, None] - after.center_m[None], axis=-1)
        cost = distance + SIZE_WEIGHT * np.linalg.norm(before.size_m[:, None] - after.size_m[None], axis=-1)
        reachable = distance <= MAX_SPEED_MPS * np.abs(after.t_ns[None] - before.t_ns[:, None]) / NS_PER_S
        cost = np.where((before.category[:, None] == after.category[None]) & reachable, cost, np.inf)
        own, partner = np.arange(len(before)), np.argmin(cost, axis=1)
        i = np.flatnonzero(np.isfinite(cost[own, partner]) & (np.argmin(cost, axis=0)[partner] == own))
        j = partner[i]
    first, last = (np.setdiff1d(np.arange(len(boxes)), taken) for boxes, taken in ((before, i), (after, j)))
    age = round(MAX_AGE_S * NS_PER_S)
    out = Boxes3D.join([
        interpolate_pairs(before.take(i), after.take(j), t_ns),
        before.take(first[t_ns - before.t_ns[first] <= age]),
        after.take(last[after.t_ns[last] - t_ns <= age]),
    ])  # fmt: skip
    return replace(out, t_ns=np.full(len(out), t_ns, dtype=np.int64))


def drop_repeated_objects(boxes: Boxes3D, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Drop rows of `index` that overlap an earlier row of another stamp: the same object once more.

    Two objects never share ground, so boxes of different stamps that overlap are one object seen twice.
    """
    if not len(index):
        return index
    center, size, stamp = boxes.center_m[index, :2], boxes.size_m[index], boxes.t_ns[index]
    reach = np.linalg.norm(size[:, :2], axis=1) / 2
    near = np.linalg.norm(center[:, None] - center, axis=-1) < reach[:, None] + reach
    k, m = np.nonzero(np.tril(near & (stamp[:, None] != stamp), -1))
    yaw, step = boxes.yaw_rad[index], center[m] - center[k]
    shared = rectangles_overlap(step[:, 0], step[:, 1], yaw[k], yaw[m], size[k], size[m])
    earlier = np.zeros(near.shape, dtype=bool)
    earlier[k[shared], m[shared]] = True
    kept = np.ones(len(index), dtype=bool)
    for row in np.flatnonzero(earlier.any(axis=1)):
        kept[row] = not kept[earlier[row]].any()
    return index[kept]


def interpolate_pairs(before: Boxes3D, after: Boxes3D, t_ns: int) -> Boxes3D:
    """Interpolate pairs of boxes of the same object to a stamp; sizes are those of the nearer one in time."""
    span = (after.t_ns - before.t_ns).astype(np.float64)
    fraction = (t_ns - before.t_ns).astype(np.float64) / span
    center = before.center_m + fraction[:, None] * (after.center_m - before.center_m)
    yaw = wrap_angle(before.yaw_rad + fraction * wrap_angle(after.yaw_rad - before.yaw_rad))
    size = np.where(fraction[:, None] <= 0.5, before.size_m, after.size_m)
    return replace(before, center_m=center, size_m=size, yaw_rad=np.asarray(yaw))


# Smaller boxes are left out, as detectors do not find them.
MIN_SIDE_PX = 6.0


@dataclass(frozen=True, eq=False)
class LabelDetector:
    """Detector that returns the labels of a log; it never decodes an image."""

    log: Log
    name: str = "labels"
    default_min_score: float = 0.0

    def detect(self, frame: Frame) -> Detections:
        """Return the labels of one frame with score 1, nearest first where they come from 3D labels."""
        labels = self.log.image_labels.get(frame.camera.name)
        if labels is not None:
            t_ns, found = self._image_boxes[frame.camera.name]
            first = np.searchsorted(t_ns, frame.t_ns - STAMP_TOLERANCE_NS, side="left")
            end = np.searchsorted(t_ns, frame.t_ns + STAMP_TOLERANCE_NS, side="right")
            return found.take(np.arange(first, end))
        boxes, window = self._boxes
        view = view_of(self.log, frame.camera.name, frame.t_ns)
        if not len(boxes.t_ns) or view is None:
            return Detections.empty()
        # Occluded boxes are kept: a LiDAR on the roof often sees what the camera does not.
        boxes = interpolate_boxes(boxes, frame.t_ns, window)
        projected = project_boxes_in_view(view, boxes.center_m, boxes.size_m, boxes.yaw_rad)
        kept = np.flatnonzero(projected.valid)
        kept = kept[(projected.box_px[kept, 2:] - projected.box_px[kept, :2] >= MIN_SIDE_PX).all(axis=1)]
        kept = kept[np.argsort(projected.range_m[kept], kind="stable")]
        return Detections(projected.box_px[kept], boxes.score[kept], boxes.category[kept])

    @cached_property
    def _image_boxes(self) -> dict[str, tuple[NDArray[np.int64], Detections]]:
        """2D labels that a detector could find, by camera, sorted by their stamps, which a search for each frame needs."""
        out = {}
        for camera, labels in self.log.image_labels.items():
            large = np.all(labels.box_px[:, 2:] - labels.box_px[:, :2] >= MIN_SIDE_PX, axis=1)
            rows = np.flatnonzero(np.isin(labels.category, CATEGORIES) & large)
            rows = rows[np.argsort(labels.t_ns[rows], kind="stable")]
            box, category = np.asarray(labels.box_px[rows], dtype=np.float64), labels.category[rows].astype("<U16")
            out[camera] = labels.t_ns[rows], Detections(box, np.ones(len(box)), category)
        return out

    @cached_property
    def _boxes(self) -> tuple[Boxes3D, int]:
        """Visible labels in the order of their stamps, and the time around a frame in which to search them, ns."""
        labels = self.log.labels
        if labels is None:
            return Boxes3D.empty(), 0
        return road_users(labels, True if labels.visible is None else labels.visible)


def create(
    log: Log, *, min_score: float | None, max_overlap: float, tiles: Literal["auto"] | int, **_: Any
) -> LabelDetector:
    """Make the detector `labels`; `min_score`, `max_overlap` and `tiles` have no effect on it.

    Raises `ConfigError` when the log has no labels.
    """
    if log.labels is None and not log.image_labels:
        others = ", ".join(name for name in plugins.names("detector") if name != "labels")
        raise ConfigError(
            f"detector 'labels': log '{log.name}' ({log.format}) has no labeled boxes; "
            f"choose another detector: {others}, or the path of an ONNX file"
        )
    return LabelDetector(log)


MAX_OVERLAP = 0.5
MAX_TILES = 64


class Detector(Protocol):
    """Detector of road users in one camera frame.

    One that also has a text `cache_key`, which states all that its boxes depend on besides the picture (weights, settings,
    versions), is not asked twice about one picture: they are kept in the user's cache.
    """

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        ...

    @property
    def default_min_score(self) -> float:
        """Score in [0, 1] below which boxes of this detector are more often wrong than useful."""
        ...

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame, best score first; deterministic, and may be called from threads."""
        ...


def create_detector(
    name_or_path: str,
    log: Log,
    *,
    min_score: float | None = None,
    max_overlap: float = MAX_OVERLAP,
    tiles: Literal["auto"] | int = "auto",
    layout: str | None = None,
    input_px: int | None = None,
) -> Detector:
    """Make a detector for a log.

    `name_or_path`: a registered name ("ssd-mobilenet-v2", "labels", plug-ins of others) or the path of an `.onnx` file.
    `log`: the log whose frames it will see; `labels` takes its boxes from there. `min_score`: least score in [0, 1] of a
    box, None for the detector's own default. `max_overlap`: IoU in (0, 1] above which two boxes of one group of categories
    are the same object. `tiles`: 1: the whole image only; N > 1: also N overlapping tiles; "auto": what the image's size
    asks for. `layout`: output layout of an ONNX file, where it cannot be recognized. `input_px`: side of the input of an
    ONNX file that takes any size, None for what its family takes.

    Raises `ConfigError`: an unknown name, a file that is no usable model, or a setting out of range; `MissingExtra`: the
    detector's package is not installed.
    """
    if min_score is not None and not 0 <= min_score <= 1:
        raise ConfigError(f"min_score {min_score}: expected a number from 0 to 1")
    if not 0 < max_overlap <= 1:
        raise ConfigError(f"max_overlap {max_overlap}: expected a number above 0 and up to 1")
    counted = isinstance(tiles, int) and not isinstance(tiles, bool)
    if tiles != "auto" and not (counted and 1 <= int(tiles) <= MAX_TILES):
        raise ConfigError(f"tiles {tiles!r}: expected 'auto' or a whole number from 1 to {MAX_TILES}")
    if name_or_path.lower().endswith(".onnx"):
        from log2sim.perception.detect.onnx_detector import open_onnx

        return open_onnx(
            Path(name_or_path),
            min_score=min_score,
            max_overlap=max_overlap,
            tiles=tiles,
            layout_name=layout,
            input_px=input_px,
        )
    if layout is not None:
        raise ConfigError(f"layout '{layout}': only a detector given as the path of an ONNX file takes a layout")
    if input_px is not None:
        raise ConfigError(f"input_px {input_px}: only a detector given as the path of an ONNX file takes another size")
    try:
        create = plugins.load("detector", name_or_path)
    except PluginError:
        raise
    except ConfigError as error:
        in_sweeps = ", ".join(f"lidar:{name}" for name in plugins.names("lidar_detector"))
        raise ConfigError(f"{error}; in sweeps: {in_sweeps}; or the path of an ONNX file (ending in .onnx)") from None
    with plugins.blaming("detector", name_or_path):
        detector: Detector = create(log, min_score=min_score, max_overlap=max_overlap, tiles=tiles)
    if plugins.is_built_in("detector", name_or_path):
        return detector
    return CheckedDetector(detector, plugins.plugin_label("detector", name_or_path))
