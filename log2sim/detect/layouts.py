"""Output layouts of detection models: how each family writes boxes, scores and classes, and how to tell them apart."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from log2sim.detect.classes import COCO_80, COCO_91, Classes
from log2sim.detect.preparation import Preparation
from log2sim.errors import ConfigError
from log2sim.geometry import Array

Outputs = Mapping[str, NDArray[Any]]
STRIDES = (8, 16, 32)

# Undecoded offsets are a few cells at most, decoded centers span the input; a model's input is never this small.
LARGEST_OFFSET_CELLS = 24.0


class Candidates(NamedTuple):
    """Boxes (M, 4) u0, v0, u1, v1 in px of the model's input, scores (M,), categories (M,)."""

    box_input: Array
    score: Array
    category: NDArray[np.str_]


class Layout(Protocol):
    """One family of models. `size` is (width, height) of the input in px, `outputs` are arrays by name."""

    @property
    def name(self) -> str: ...

    @property
    def preparation(self) -> Preparation: ...

    @property
    def default_min_score(self) -> float: ...

    @property
    def default_classes(self) -> Classes: ...

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Whether outputs of a gray picture look like this layout."""
        ...

    def class_count(self, outputs: Outputs) -> int | None:
        """Number of classes; None where the output holds class ids."""
        ...

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates: ...


def cells(size: tuple[int, int]) -> int:
    """Number of cells of all strides in an input of (width, height) px."""
    return sum((size[0] // s) * (size[1] // s) for s in STRIDES)


def corners(center_and_size: Array) -> Array:
    """Boxes (M, 4) u0, v0, u1, v1 from center u, v, width, height."""
    center, half = center_and_size[:, :2], center_and_size[:, 2:4] / 2
    return np.concatenate([center - half, center + half], axis=1)


def only(outputs: Outputs) -> NDArray[Any]:
    """The largest output: some exports append intermediate ones or masks behind the one that counts."""
    return max(outputs.values(), key=lambda a: a.size)


def single(outputs: Outputs) -> tuple[int, int] | None:
    """Last two dimensions of the one output (1, a, b), None where there are more or others."""
    arrays = list(outputs.values())
    if len(arrays) != 1 or arrays[0].ndim != 3 or arrays[0].shape[0] != 1:
        return None
    return arrays[0].shape[1], arrays[0].shape[2]


def select(outputs: Outputs, name: str) -> NDArray[Any] | None:
    """An output by its name, without TensorFlow's ":0"."""
    return next((array for key, array in outputs.items() if key.split(":")[0] == name), None)


def required(outputs: Outputs, name: str) -> NDArray[Any]:
    """An output that the layout cannot do without."""
    array = select(outputs, name)
    if array is None:
        raise ConfigError(f"the model has no output '{name}'; it has {describe(outputs)}; choose another layout")
    return array


def describe(outputs: Outputs) -> str:
    """Names and shapes for messages."""
    return ", ".join(f"'{name}' {tuple(array.shape)}" for name, array in outputs.items())


@dataclass(frozen=True)
class TfOd:
    """TensorFlow object detection API: boxes v0, u0, v1, u1 in 0-1, classes as COCO ids from 1, already suppressed."""

    name: str = "tf-od"
    preparation: Preparation = Preparation("stretch", rgb=True, unit=False, default_px=None)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_91

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        return all(select(outputs, f"detection_{part}") is not None for part in ("boxes", "scores", "classes"))

    def class_count(self, outputs: Outputs) -> int | None:
        return None

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        score = required(outputs, "detection_scores")[0].astype(np.float64)
        number = select(outputs, "num_detections")
        count = len(score) if number is None else min(len(score), int(number.ravel()[0]))
        box = required(outputs, "detection_boxes")[0, :count].astype(np.float64)
        category = classes.look_up(required(outputs, "detection_classes")[0, :count])
        keep = (score[:count] >= min_score) & (category != "")
        return Candidates(from_normalized(box[keep], size), score[:count][keep], category[keep])


@dataclass(frozen=True)
class TfOdRaw:
    """The same family before its suppression: `boxes` (1, N, 4) as above and `scores` (1, N, C) after the sigmoid."""

    name: str = "tf-od-raw"
    preparation: Preparation = Preparation("tf1", rgb=True, unit=False, default_px=300)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_91

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        box, score = select(outputs, "boxes"), select(outputs, "scores")
        if box is None or score is None or box.ndim != 3 or score.ndim != 3:
            return False
        return box.shape[2] == 4 and box.shape[:2] == score.shape[:2]

    def class_count(self, outputs: Outputs) -> int | None:
        return int(required(outputs, "scores").shape[2])

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        row, score, category = classes.best(required(outputs, "scores")[0], min_score)
        return Candidates(from_normalized(required(outputs, "boxes")[0][row].astype(np.float64), size), score, category)


def from_normalized(box_vuvu: Array, size: tuple[int, int]) -> Array:
    """Boxes u0, v0, u1, v1 in px from v0, u0, v1, u1 in 0-1."""
    return box_vuvu.reshape(-1, 4)[:, [1, 0, 3, 2]] * np.array([*size, *size], dtype=np.float64)


@dataclass(frozen=True)
class Yolox:
    """YOLOX before decoding: (1, cells, 5 + C), offsets in cells, logarithms of sizes, objectness, class scores."""

    name: str = "yolox"
    preparation: Preparation = Preparation("corner", rgb=False, unit=False, default_px=416)  # noqa: RUF009
    default_min_score: float = 0.3
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        shape = single(outputs)
        if shape is None or shape[0] != cells(size) or shape[1] < 6:
            return False
        return bool(np.median(np.abs(only(outputs)[0, :, :2])) < LARGEST_OFFSET_CELLS)

    def class_count(self, outputs: Outputs) -> int | None:
        return int(only(outputs).shape[2]) - 5

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        raw = only(outputs)[0]
        if len(raw) != cells(size):
            raise ConfigError(f"layout yolox: expected {cells(size)} rows for an input of {size}; found {len(raw)}")
        row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
        cell, stride = grid(size)
        picked = raw[row].astype(np.float64)
        with np.errstate(over="ignore"):  # an infinite size is dropped with the other boxes that are not finite
            extent = np.exp(picked[:, 2:4]) * stride[row, None]
        center = (picked[:, :2] + cell[row]) * stride[row, None]
        return Candidates(corners(np.concatenate([center, extent], axis=1)), score, category)


def grid(size: tuple[int, int]) -> tuple[Array, Array]:
    """Cell indices (N, 2) u, v and strides (N,) in px, row by row, fine strides first."""
    cell, stride = [], []
    for s in STRIDES:
        v, u = np.mgrid[: size[1] // s, : size[0] // s]
        cell.append(np.stack([u.ravel(), v.ravel()], axis=1))
        stride.append(np.full(u.size, float(s)))
    return np.concatenate(cell).astype(np.float64), np.concatenate(stride)


@dataclass(frozen=True)
class YoloRows:
    """Decoded rows (1, N, 5 + C): center, size in px of the input, objectness, class scores (YOLOv5, v6, v7, YOLOX)."""

    name: str
    preparation: Preparation
    anchors: int = 0  # boxes a cell by which it is recognized; 0: never, `layout=` has to name it
    default_min_score: float = 0.3
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        shape = single(outputs)
        return shape is not None and self.anchors > 0 and shape[0] == self.anchors * cells(size) and shape[1] > 5

    def class_count(self, outputs: Outputs) -> int | None:
        return int(only(outputs).shape[2]) - 5

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        raw = only(outputs)[0]
        row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
        return Candidates(corners(raw[row, :4].astype(np.float64)), score, category)


@dataclass(frozen=True)
class Yolov8:
    """YOLOv8, v9, 11, 12: columns (1, 4 + C, N) of center, size in px of the input, and class scores."""

    name: str = "yolov8"
    preparation: Preparation = Preparation("center", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.3
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        shape = single(outputs)
        return shape is not None and shape[1] == cells(size) and shape[0] > 4

    def class_count(self, outputs: Outputs) -> int | None:
        return int(only(outputs).shape[1]) - 4

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        raw = only(outputs)[0].T
        row, score, category = classes.best(raw[:, 4:], min_score)
        return Candidates(corners(raw[row, :4].astype(np.float64)), score, category)


@dataclass(frozen=True)
class Yolov10:
    """YOLOv10 and other end-to-end exports: rows (1, N, 6) of u0, v0, u1, v1 in px of the input, score, class id."""

    name: str = "yolov10"
    preparation: Preparation = Preparation("center", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.3
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        shape = single(outputs)
        return shape is not None and shape[1] == 6 and shape[0] not in (cells(size), 3 * cells(size))

    def class_count(self, outputs: Outputs) -> int | None:
        return None

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        raw = only(outputs)[0].astype(np.float64)
        category = classes.look_up(raw[:, 5])
        keep = (raw[:, 4] >= min_score) & (category != "")
        return Candidates(raw[keep, :4], raw[keep, 4], category[keep])


@dataclass(frozen=True)
class RtDetr:
    """RT-DETR: boxes as center and size in 0-1; (1, 300, 4 + C) with scores, or `pred_boxes` and `logits` apart."""

    name: str = "rt-detr"
    preparation: Preparation = Preparation("stretch", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        if select(outputs, "pred_boxes") is not None and select(outputs, "logits") is not None:
            return True
        shape = single(outputs)
        return shape is not None and shape[0] == 300 and shape[1] > 6

    def class_count(self, outputs: Outputs) -> int | None:
        return int(self._parts(outputs)[1].shape[1])

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        box, class_scores = self._parts(outputs)
        row, score, category = classes.best(class_scores, min_score)
        scaled = corners(box[row].astype(np.float64)) * np.array([*size, *size], dtype=np.float64)
        return Candidates(scaled, score, category)

    @staticmethod
    def _parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]]:
        box, logits = select(outputs, "pred_boxes"), select(outputs, "logits")
        if box is not None and logits is not None:
            return box[0], 0.5 * (1 + np.tanh(0.5 * logits[0]))  # the sigmoid, without overflow
        return only(outputs)[0, :, :4], only(outputs)[0, :, 4:]


YOLOV5_PREPARATION = Preparation("center", rgb=True, unit=True)
LAYOUTS: Mapping[str, Layout] = {
    layout.name: layout
    for layout in (
        TfOd(),
        TfOdRaw(),
        Yolox(),
        YoloRows("yolov5", YOLOV5_PREPARATION, anchors=3),
        YoloRows("yolov6", YOLOV5_PREPARATION),
        YoloRows("yolox-decoded", Preparation("corner", rgb=False, unit=False, default_px=416)),
        Yolov8(),
        Yolov10(),
        RtDetr(),
    )
}


def named_layout(name: str) -> Layout:
    """The layout of a name that a user gave."""
    if name not in LAYOUTS:
        raise ConfigError(f"unknown layout '{name}'; known: {', '.join(LAYOUTS)}")
    return LAYOUTS[name]
