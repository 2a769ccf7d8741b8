"""Detectors of somebody else: their faults become one line each, and plain functions become detectors."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim import registry
from log2sim.datatypes import CATEGORIES, Detections, Frame
from log2sim.errors import Log2SimError, PluginError
from log2sim.plugin_checks import DETECT, require_members

MEMBERS = ("name", "default_min_score", "detect")
ROW = "x0, y0, x1, y1 in px, score, category"

ImageFunction = Callable[[NDArray[np.uint8]], Any]
"""Takes a picture (H, W, 3) uint8 BGR and returns rows of `ROW`, or `Detections`."""


class _WrongRows(PluginError):
    """A function returned something else than rows; who it was and where is added to the message."""


@dataclass(frozen=True, eq=False)
class CheckedDetector:
    """A detector of somebody else; what it raises and what it returns is checked.

    Attributes
    ----------
    inner : Detector
    source : str
        How messages name it.
    """

    inner: Any
    source: str

    @property
    def name(self) -> str:
        """Name in the provenance of a scenario."""
        return str(self.inner.name)

    @property
    def default_min_score(self) -> float:
        """Score in [0, 1] below which boxes are more often wrong than useful."""
        return float(self.inner.default_min_score)

    @property
    def cache_key(self) -> str | None:
        """What its result depends on besides the picture; None where it does not say, so that nothing of it is cached."""
        return getattr(self.inner, "cache_key", None)

    def detect(self, frame: Frame) -> Detections:
        """Detect road users in one frame.

        Raises
        ------
        PluginError
            When the detector raises something, or returns no `Detections` of known categories.
        """
        try:
            found = self.inner.detect(frame)
        except _WrongRows as error:
            raise PluginError(f"{self._where(frame)}: {error}") from None
        except (Log2SimError, MemoryError):
            raise
        except Exception as error:
            raise PluginError(f"{self._where(frame)}: {registry.say_exception(error)}") from error
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
    """A detector made of a function of a picture.

    Attributes
    ----------
    function : callable
    min_score : float
        Boxes with lower scores are left out.
    name : str
    default_min_score : float
    """

    function: ImageFunction
    min_score: float = 0.0
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

        Raises
        ------
        PluginError
            When it returns something else than rows of `ROW` or `Detections`.
        """
        image = frame.image().copy()  # a function may draw on what it gets
        with self._lock:
            answer = self.function(image)
        found = answer if isinstance(answer, Detections) else detections_of(answer)
        defect = find_defect(found)
        if defect is not None:
            raise _WrongRows(defect)
        order = np.argsort(-found.score, kind="stable")
        kept = found.take(order[found.score[order] >= self.min_score])
        return replace(kept, traffic_lights=found.traffic_lights)


def checked(detector: Any, source: str) -> CheckedDetector:
    """Return a detector of somebody else whose faults are told in one line each that begins with `source`.

    Raises
    ------
    PluginError
        When it lacks a member of `Detector`, or its `detect` cannot be called.
    """
    require_members(detector, MEMBERS, DETECT, source)
    return CheckedDetector(detector, source)


def detections_of(rows: Any) -> Detections:
    """Return rows of x0, y0, x1, y1 in px, score, category as detections.

    Raises
    ------
    PluginError
        For anything else.
    """
    if isinstance(rows, (str, bytes)) or not isinstance(rows, (Sequence, np.ndarray)):
        raise _WrongRows(f"returned {type(rows).__name__}, expected a list of rows of {ROW}, or Detections")
    if not len(rows):
        return Detections.empty()
    numbers, categories = [], []
    for k, row in enumerate(rows):
        try:
            *values, category = row
            numbers.append([float(value) for value in values])
        except (TypeError, ValueError):
            raise _WrongRows(f"row {k} is {row!r:.80}, expected {ROW}") from None
        if len(values) != 5 or not isinstance(category, str):
            raise _WrongRows(f"row {k} is {row!r:.80}, expected {ROW}")
        categories.append(str(category))
    columns = np.array(numbers)
    return Detections(columns[:, :4], columns[:, 4], np.array(categories, dtype=np.str_))


def find_defect(found: Detections) -> str | None:
    """Return what cannot be true of detections; None where nothing is wrong."""
    count = len(found.score)
    if np.shape(found.box_px) != (count, 4) or np.shape(found.category) != (count,):
        return (
            f"box_px has the shape {np.shape(found.box_px)} and category {np.shape(found.category)} for {count} scores"
        )
    for k, category in enumerate(found.category):
        if category not in CATEGORIES:
            hint = registry.nearest(str(category), list(CATEGORIES))
            return f"row {k}: unknown category '{category}'{hint}; known: {', '.join(CATEGORIES)}"
    box, score = np.asarray(found.box_px, dtype=np.float64), np.asarray(found.score, dtype=np.float64)
    right = np.isfinite(box).all(axis=1) & (box[:, 2] > box[:, 0]) & (box[:, 3] > box[:, 1])
    if not right.all():
        k = int(np.argmin(right))
        return f"row {k}: the box is {box[k].tolist()}, expected x0 < x1 and y0 < y1"
    right = (score >= 0) & (score <= 1)
    if not right.all():
        k = int(np.argmin(right))
        return f"row {k}: the score is {score[k]:g}, expected a number from 0 to 1"
    return None
