"""Output layouts of the YOLO family."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.errors import ConfigError
from log2sim.geometry import Array
from log2sim.perception.detect.classes import COCO_80, Classes
from log2sim.perception.detect.layout import (
    Candidates,
    Outputs,
    corners_from_centers,
    largest_output,
    single_output_shape,
)
from log2sim.perception.detect.preprocessing import Preprocessing

STRIDES = (8, 16, 32)

# Median offset in cells up to which outputs count as undecoded: offsets are a few cells, decoded centers span the input.
MAX_OFFSET_CELLS = 24.0


def cell_count(size: tuple[int, int]) -> int:
    """Count the cells of all strides in an input of (width, height) px."""
    return sum((size[0] // s) * (size[1] // s) for s in STRIDES)


@dataclass(frozen=True)
class Yolox:
    """YOLOX before decoding: (1, cells, 5 + C), offsets in cells, logarithms of sizes, objectness, class scores."""

    name: str = "yolox"
    preprocessing: Preprocessing = Preprocessing("corner", rgb=False, unit=False, default_px=416)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        shape = single_output_shape(outputs)
        if shape is None or shape[0] != cell_count(size) or shape[1] < 6:
            return False
        return bool(np.median(np.abs(largest_output(outputs)[0, :, :2])) < MAX_OFFSET_CELLS)

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return int(largest_output(outputs).shape[2]) - 5

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        raw = largest_output(outputs)[0]
        if len(raw) != cell_count(size):
            raise ConfigError(
                f"layout yolox: expected {cell_count(size)} rows for an input of {size}; found {len(raw)}"
            )
        row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
        cell, stride = cell_grid(size)
        picked = raw[row].astype(np.float64)
        with np.errstate(over="ignore"):  # an infinite size is dropped with the other boxes that are not finite
            extent = np.exp(picked[:, 2:4]) * stride[row, None]
        center = (picked[:, :2] + cell[row]) * stride[row, None]
        return Candidates(corners_from_centers(np.concatenate([center, extent], axis=1)), score, category)


def cell_grid(size: tuple[int, int]) -> tuple[Array, Array]:
    """Build cell indices (N, 2) u, v and strides (N,) in px, row by row, fine strides first."""
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
    preprocessing: Preprocessing
    # Boxes a cell by which the layout is recognized; 0: only a layout given by name.
    anchors: int = 0
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        shape = single_output_shape(outputs)
        return shape is not None and self.anchors > 0 and shape[0] == self.anchors * cell_count(size) and shape[1] > 5

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return int(largest_output(outputs).shape[2]) - 5

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        raw = largest_output(outputs)[0]
        row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
        return Candidates(corners_from_centers(raw[row, :4].astype(np.float64)), score, category)


@dataclass(frozen=True)
class Yolov8:
    """YOLOv8, v9, 11, 12: columns (1, 4 + C, N) of center, size in px of the input, and class scores."""

    name: str = "yolov8"
    preprocessing: Preprocessing = Preprocessing("center", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        shape = single_output_shape(outputs)
        return shape is not None and shape[1] == cell_count(size) and shape[0] > 4

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return int(largest_output(outputs).shape[1]) - 4

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        raw = largest_output(outputs)[0].T
        row, score, category = classes.best(raw[:, 4:], min_score)
        return Candidates(corners_from_centers(raw[row, :4].astype(np.float64)), score, category)


@dataclass(frozen=True)
class Yolov10:
    """YOLOv10 and other end-to-end exports: rows (1, N, 6) of u0, v0, u1, v1 in px of the input, score, class id."""

    name: str = "yolov10"
    preprocessing: Preprocessing = Preprocessing("center", rgb=True, unit=True)  # noqa: RUF009
    default_min_score: float = 0.4
    default_classes: Classes = COCO_80

    def matches(self, outputs: Outputs, size: tuple[int, int]) -> bool:
        """Return whether outputs of a gray image have this layout."""
        shape = single_output_shape(outputs)
        return shape is not None and shape[1] == 6 and shape[0] not in (cell_count(size), 3 * cell_count(size))

    def class_count(self, outputs: Outputs) -> int | None:
        """Return the number of classes; None where the output holds class ids."""
        return None

    def decode(self, outputs: Outputs, size: tuple[int, int], classes: Classes, min_score: float) -> Candidates:
        """Decode the boxes of score `min_score` and higher."""
        raw = largest_output(outputs)[0].astype(np.float64)
        category = classes.categories_of(raw[:, 5])
        keep = (raw[:, 4] >= min_score) & (category != "")
        return Candidates(raw[keep, :4], raw[keep, 4], category[keep])
