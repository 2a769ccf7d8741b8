"""Labels of the log instead of a detector: 2D labels of a frame, else 3D labels projected into it.

Track ids are never read: boxes are as anonymous as those of a model, so that tracking has the same task.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim import registry
from log2sim.datatypes import CATEGORIES, Detections, Frame, ImageLabels, Log
from log2sim.errors import ConfigError
from log2sim.perception.detect.label_motion import LabelBoxes, interpolate_boxes, window_ns
from log2sim.perception.lidar.projection import View, project_boxes_in_view, view_of

# Smaller boxes are left out, as detectors do not find them.
MIN_SIDE_PX = 6.0
# Stamps of labels and frames of one moment differ by rounding in some logs.
STAMP_TOLERANCE_NS = 1_000_000


@dataclass(frozen=True, eq=False)
class FrameBoxes:
    """2D labels of a camera that a detector could find, by frame.

    Attributes
    ----------
    t_ns : (L,) int64
        Never decreasing.
    boxes : Detections
        (L,), those of one stamp in the order of the labels.
    """

    t_ns: NDArray[np.int64]
    boxes: Detections

    @classmethod
    def of(cls, labels: ImageLabels) -> FrameBoxes:
        """Sort the labels of a camera and leave out categories and boxes that no detector finds."""
        large = np.all(labels.box_px[:, 2:] - labels.box_px[:, :2] >= MIN_SIDE_PX, axis=1)
        rows = np.flatnonzero(np.isin(labels.category, CATEGORIES) & large)
        rows = rows[np.argsort(labels.t_ns[rows], kind="stable")]
        box = np.asarray(labels.box_px[rows], dtype=np.float64)
        return cls(labels.t_ns[rows], Detections(box, np.ones(len(box)), labels.category[rows].astype("<U16")))

    def at(self, t_ns: int) -> Detections:
        """Return the boxes of the frame at a stamp."""
        first = np.searchsorted(self.t_ns, t_ns - STAMP_TOLERANCE_NS, side="left")
        end = np.searchsorted(self.t_ns, t_ns + STAMP_TOLERANCE_NS, side="right")
        return self.boxes.take(np.arange(first, end))


@dataclass(frozen=True, eq=False)
class LabelDetector:
    """Detector that returns the labels of a log; it never decodes an image.

    Attributes
    ----------
    log : Log
    min_score, default_min_score : float
    name : str
    """

    log: Log
    min_score: float = 0.0
    name: str = "labels"
    default_min_score: float = 0.0

    def detect(self, frame: Frame) -> Detections:
        """Return the labels of one frame with score 1, nearest first where they come from 3D labels."""
        labels = self.log.image_labels.get(frame.camera.name)
        if labels is not None:
            return self._image_boxes[frame.camera.name].at(frame.t_ns)
        boxes, window = self._boxes
        view = view_of(self.log, frame.camera.name, frame.t_ns)
        if not len(boxes.t_ns) or view is None:
            return Detections.empty()
        return project_labels(interpolate_boxes(boxes, frame.t_ns, window), view)

    @cached_property
    def _image_boxes(self) -> dict[str, FrameBoxes]:
        """2D labels by camera; sorted once, since a search of all for each frame takes time that grows with the square of the log."""
        return {camera: FrameBoxes.of(labels) for camera, labels in self.log.image_labels.items()}

    @cached_property
    def _boxes(self) -> tuple[LabelBoxes, int]:
        """Visible labels in the order of their stamps, and the time around a frame in which to search them, ns."""
        labels = self.log.labels
        if labels is None:
            return LabelBoxes(
                np.zeros(0, np.int64), np.zeros(0, "<U16"), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)
            ), 0
        shown = np.isin(labels.category, CATEGORIES)
        if labels.visible is not None:
            shown &= labels.visible
        everything = LabelBoxes(labels.t_ns, labels.category, labels.center_m, labels.size_m, labels.yaw_rad)
        rows = np.flatnonzero(shown)
        return everything.take(rows[np.argsort(labels.t_ns[rows], kind="stable")]), window_ns(labels.t_ns)


def create(
    log: Log, *, min_score: float | None, max_overlap: float, tiles: Literal["auto"] | int, **_: Any
) -> LabelDetector:
    """Make the detector `labels`; `min_score`, `max_overlap` and `tiles` have no effect on it.

    Raises
    ------
    ConfigError
        When the log has no labels.
    """
    if log.labels is None and not log.image_labels:
        others = ", ".join(name for name in registry.names("detector") if name != "labels")
        raise ConfigError(
            f"detector 'labels': log '{log.name}' ({log.format}) has no labeled boxes; "
            f"choose another detector: {others}, or the path of an ONNX file"
        )
    return LabelDetector(log)


def project_labels(boxes: LabelBoxes, view: View) -> Detections:
    """Project boxes into a frame; those that are large enough, nearest first.

    Occluded boxes are kept: a LiDAR on the roof often sees what the camera does not.
    """
    projected = project_boxes_in_view(view, boxes.center_m, boxes.size_m, boxes.yaw_rad)
    box_px = projected.box_px
    large = projected.valid.copy()
    large[projected.valid] = np.all(box_px[projected.valid, 2:] - box_px[projected.valid, :2] >= MIN_SIDE_PX, axis=1)
    kept = np.flatnonzero(large)
    kept = kept[np.argsort(projected.range_m[kept], kind="stable")]
    return Detections(box_px[kept], np.ones(len(kept)), boxes.category[kept].astype("<U16"))
