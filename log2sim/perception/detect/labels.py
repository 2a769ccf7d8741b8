"""Boxes of the log instead of a detector: 2D labels of a frame, else 3D labels projected into it.

Track ids are never read: boxes are as anonymous as a model's, so that tracking has the same work to do.
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
from log2sim.geometry import Camera, inverse, project_boxes
from log2sim.perception.detect.label_motion import Boxes, boxes_at, window_ns

MIN_SIDE_PX = 6.0
STAMP_TOLERANCE_NS = 1_000_000  # labels and frames of one moment differ by rounding in some logs


@dataclass(frozen=True, eq=False)
class LabelDetector:
    """See `Detector`. Never decodes a picture."""

    log: Log
    min_score: float = 0.0
    name: str = "labels"
    default_min_score: float = 0.0

    def detect(self, frame: Frame) -> Detections:
        """Boxes of one frame, nearest first where they come from 3D labels; score 1."""
        labels = self.log.image_labels.get(frame.camera.name)
        if labels is not None:
            return boxes_of_frame(labels, frame.t_ns)
        boxes, window = self._boxes
        map_T_cam, known = self.log.map_T_sensor(frame.camera.name, frame.t_ns)
        if not len(boxes.t_ns) or not known[0]:
            return Detections.empty()
        return project_labels(boxes_at(boxes, frame.t_ns, window), frame.camera, inverse(map_T_cam[0]))

    @cached_property
    def _boxes(self) -> tuple[Boxes, int]:
        """Labels in the order of their stamps, without those that the log calls invisible, and the time to look around."""
        labels = self.log.labels
        if labels is None:
            return Boxes(np.zeros(0, np.int64), np.zeros(0, "<U16"), np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), 0
        shown = np.isin(labels.category, CATEGORIES)
        if labels.visible is not None:
            shown &= labels.visible
        everything = Boxes(labels.t_ns, labels.category, labels.center_m, labels.size_m, labels.yaw_rad)
        rows = np.flatnonzero(shown)
        return everything.take(rows[np.argsort(labels.t_ns[rows], kind="stable")]), window_ns(labels.t_ns)


def create(
    log: Log, *, min_score: float | None, max_overlap: float, tiles: Literal["auto"] | int, **_: Any
) -> LabelDetector:
    """Make the detector `labels`; `max_overlap` and `tiles` mean nothing to it.

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


def boxes_of_frame(labels: ImageLabels, t_ns: int) -> Detections:
    """The 2D labels of the frame at a stamp."""
    rows = (np.abs(labels.t_ns - t_ns) <= STAMP_TOLERANCE_NS) & np.isin(labels.category, CATEGORIES)
    box = np.asarray(labels.box_px[rows], dtype=np.float64)
    found = Detections(box, np.ones(len(box)), labels.category[rows].astype("<U16"))
    return found.take(np.all(box[:, 2:] - box[:, :2] >= MIN_SIDE_PX, axis=1))


def project_labels(boxes: Boxes, camera: Camera, cam_T_map: NDArray[np.float64]) -> Detections:
    """Boxes in a camera's picture that are large enough, nearest first.

    Hidden ones are among them: the roof LiDAR often sees what the camera does not, and points decide what is measured.
    """
    seen = project_boxes(boxes.center_m, boxes.size_m, boxes.yaw_rad, camera, cam_T_map)
    box_px = seen.box_px
    large = seen.valid.copy()
    large[seen.valid] = np.all(box_px[seen.valid, 2:] - box_px[seen.valid, :2] >= MIN_SIDE_PX, axis=1)
    kept = np.flatnonzero(large)
    kept = kept[np.argsort(seen.range_m[kept], kind="stable")]
    return Detections(box_px[kept], np.ones(len(kept)), boxes.category[kept].astype("<U16"))
