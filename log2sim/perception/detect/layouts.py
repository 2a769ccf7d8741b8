"""Table of output layouts, and those of the TensorFlow object detection API and of RT-DETR."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect.classes import COCO_80, COCO_91, Classes
from log2sim.perception.detect.layout import (
    Candidates,
    Layout,
    Outputs,
    corners_from_centers,
    find_output,
    largest_output,
    required_output,
    single_output_shape,
)
from log2sim.perception.detect.preprocessing import Preprocessing
from log2sim.perception.detect.yolo import YoloRows, Yolov8, Yolov10, Yolox


@dataclass(frozen=True)
class TfOd:
    """TensorFlow object detection API: boxes v0, u0, v1, u1 in 0-1, classes as COCO ids from 1, already suppressed."""

    name: str = "tf-od"
    preprocessing: Preprocessing = Preprocessing("stretch", rgb=True, unit=False, default_px=None)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_91

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        return all(find_output(outputs, f"detection_{part}") is not None for part in ("boxes", "scores", "classes"))

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return None

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        score = required_output(outputs, "detection_scores")[0].astype(np.float64)
        number = find_output(outputs, "num_detections")
        count = len(score) if number is None else min(len(score), int(number.ravel()[0]))
        box = required_output(outputs, "detection_boxes")[0, :count].astype(np.float64)
        category = classes.categories_of(required_output(outputs, "detection_classes")[0, :count])
        keep = (score[:count] >= min_score) & (category != "")
        return Candidates(from_normalized(box[keep], size), score[:count][keep], category[keep])


@dataclass(frozen=True)
class TfOdRaw:
    """The same family before its suppression: `boxes` (1, N, 4) as above and `scores` (1, N, C) after the sigmoid."""

    name: str = "tf-od-raw"
    preprocessing: Preprocessing = Preprocessing("tf1", rgb=True, unit=False, default_px=300)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_91

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        box, score = find_output(outputs, "boxes"), find_output(outputs, "scores")
        if box is None or score is None or box.ndim != 3 or score.ndim != 3:
            return False
        return box.shape[2] == 4 and box.shape[:2] == score.shape[:2]

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return int(required_output(outputs, "scores").shape[2])

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        row, score, category = classes.best(required_output(outputs, "scores")[0], min_score)
        return Candidates(
            from_normalized(required_output(outputs, "boxes")[0][row].astype(np.float64), size), score, category
        )


def from_normalized(box_vuvu: Array, size: tuple[int, int]) -> Array:
    """Convert boxes from v0, u0, v1, u1 in 0-1 to u0, v0, u1, v1 in px."""
    return box_vuvu.reshape(-1, 4)[:, [1, 0, 3, 2]] * np.array([*size, *size], dtype=np.float64)


@dataclass(frozen=True)
class RtDetr:
    """RT-DETR: boxes as center and size in 0-1; (1, 300, 4 + C) with scores, or `pred_boxes` and `logits` apart."""

    name: str = "rt-detr"
    preprocessing: Preprocessing = Preprocessing("stretch", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        if find_output(outputs, "pred_boxes") is not None and find_output(outputs, "logits") is not None:
            return True
        shape = single_output_shape(outputs)
        return shape is not None and shape[0] == 300 and shape[1] > 6

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return int(self._parts(outputs)[1].shape[1])

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        box, class_scores = self._parts(outputs)
        row, score, category = classes.best(class_scores, min_score)
        scaled = corners_from_centers(box[row].astype(np.float64)) * np.array([*size, *size], dtype=np.float64)
        return Candidates(scaled, score, category)

    @staticmethod
    def _parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]]:
        box, logits = find_output(outputs, "pred_boxes"), find_output(outputs, "logits")
        if box is not None and logits is not None:
            return box[0], 0.5 * (1 + np.tanh(0.5 * logits[0]))  # sigmoid without overflow
        return largest_output(outputs)[0, :, :4], largest_output(outputs)[0, :, 4:]


YOLOV5_PREPROCESSING = Preprocessing("center", rgb=True, unit=True)
LAYOUTS: Mapping[str, Layout] = {
    layout.name: layout
    for layout in (
        TfOd(),
        TfOdRaw(),
        Yolox(),
        YoloRows("yolov5", YOLOV5_PREPROCESSING, anchors=3),
        YoloRows("yolov6", YOLOV5_PREPROCESSING),
        YoloRows("yolox-decoded", Preprocessing("corner", rgb=False, unit=False, default_px=416)),
        Yolov8(),
        Yolov10(),
        RtDetr(),
    )
}


def named_layout(name: str) -> Layout:
    """Return the layout of a name, or raise `ConfigError`."""
    if name not in LAYOUTS:
        raise ConfigError(f"unknown layout '{name}'; known: {', '.join(LAYOUTS)}")
    return LAYOUTS[name]
