"""Inputs and output layouts of detection models, and their classes."""

from __future__ import annotations

import ast
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUPS
from log2sim.errors import ConfigError
from log2sim.geometry import Array

# Gray value around a letterboxed image that the YOLO family is trained with.
LETTERBOX_GRAY = 114


@dataclass(frozen=True)
class InputSpec:
    """Image input of a model."""

    name: str
    height_px: int | None  # None where the model takes any size
    width_px: int | None  # None where the model takes any size
    channels_last: bool  # (1, H, W, 3) instead of (1, 3, H, W)
    dtype: np.dtype[Any]


@dataclass(frozen=True, eq=False)
class Placement:
    """Placement of the image in the input: `uv_input = uv_image * scale + shift_px`."""

    scale: Array  # (2,)
    shift_px: Array  # (2,)
    input_px: tuple[int, int]  # width and height of the input

    def to_image(self, box_input: Array) -> Array:
        """Convert boxes (M, 4) from px of the input to px of the image."""
        return (box_input - np.tile(self.shift_px, 2)) / np.tile(self.scale, 2)


@dataclass(frozen=True)
class Preprocessing:
    """Preprocessing of a family of models."""

    # "corner", "center": letterbox, with gray around; "stretch"; "tf1": stretch with the sampling of TensorFlow 1
    fit: Literal["corner", "center", "stretch", "tf1"]
    rgb: bool  # channel order RGB instead of BGR
    unit: bool  # values 0-1 instead of 0-255; never for integer inputs
    default_px: int | None = 640  # side of the input of a model that takes any size, None for the image's own

    def __call__(self, image_bgr: NDArray[np.uint8], spec: InputSpec) -> tuple[NDArray[Any], Placement]:
        """Convert an image (H, W, 3) uint8 BGR to the input (1, 3, h, w) or (1, h, w, 3), with its placement there."""
        import cv2

        height, width = image_bgr.shape[:2]
        size = (spec.width_px or self.default_px or width, spec.height_px or self.default_px or height)
        image, shift, inner = image_bgr, (0, 0), size
        if self.fit in ("corner", "center"):
            ratio = min(size[0] / width, size[1] / height)
            inner = (max(1, min(size[0], round(width * ratio))), max(1, min(size[1], round(height * ratio))))
            shift = ((size[0] - inner[0]) // 2, (size[1] - inner[1]) // 2) if self.fit == "center" else (0, 0)
            image = np.full((size[1], size[0], 3), LETTERBOX_GRAY, dtype=np.uint8)
            image[shift[1] : shift[1] + inner[1], shift[0] : shift[0] + inner[0]] = cv2.resize(image_bgr, inner)
        elif self.fit == "tf1" and size != (width, height):
            # Output pixel i samples the input at i * in / out: pixel centers are at the corner instead of the middle. SSD models
            # of that time were trained so; other sampling moves their scores by up to 0.27.
            source_from_target = np.array([[width / size[0], 0, 0], [0, height / size[1], 0]])
            flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
            image = cv2.warpAffine(image, source_from_target, size, flags=flags, borderMode=cv2.BORDER_REPLICATE)  # type: ignore[assignment]
        elif size != (width, height):
            image = cv2.resize(image, size)  # type: ignore[assignment]
        placement = Placement(np.array([inner[0] / width, inner[1] / height]), np.array(shift, np.float64), size)
        if self.rgb:
            image = cv2.cvtColor(image, cv2.COLOR_BGR2RGB)  # type: ignore[assignment]  # in a tenth of the time of a NumPy copy
        if not spec.channels_last:
            image = image.transpose(2, 0, 1)
        tensor = np.ascontiguousarray(image[None], dtype=spec.dtype)
        if self.unit and spec.dtype.kind == "f":
            tensor /= 255
        return tensor, placement


# A train is no road user that a vehicle model could replay, and detectors see one in many a facade.
CATEGORY_OF_NAME: Mapping[str, str] = {
    "car": "car", "van": "car", "pickup": "car", "suv": "car", "vehicle": "car",
    "truck": "truck", "lorry": "truck", "bus": "bus",
    "motorcycle": "motorcycle", "motorbike": "motorcycle", "motorcyclist": "motorcycle", "motor": "motorcycle",
    "bicycle": "bicycle", "bike": "bicycle", "cyclist": "cyclist", "bicyclist": "cyclist", "rider": "cyclist",
    "person": "pedestrian", "pedestrian": "pedestrian", "people": "pedestrian",
    "traffic light": "traffic_light", "traffic_light": "traffic_light", "traffic signal": "traffic_light",
}  # fmt: skip

TRAFFIC_LIGHT = "traffic_light"
"""No road user, but what traffic goes by: a group of its own."""

NAMES_LIMIT_CHARS = 1_000_000


@dataclass(frozen=True)
class Classes:
    """Category of each class index of a model; indices that are left out are no road users."""

    category_of: Mapping[int, str]

    def best(self, class_scores: Array, min_score: float) -> tuple[NDArray[np.intp], Array, NDArray[np.str_]]:
        """Choose categories from scores (N, C): at most one a row and group, so that a rider does not hide the bicycle.

        `class_scores` (N, C) float. `min_score`: rows whose best score of a group is lower are left out. Returns `row`
        (M,) int; `score` (M,) float64; `category` (M,) str.
        """
        rows, scores, categories = [], [], []
        # Few rows of thousands reach the score.
        likely = np.unique(np.flatnonzero(np.ravel(class_scores >= min_score)) // max(class_scores.shape[1], 1))
        of_likely = class_scores[likely]
        for members in (*GROUPS.values(), (TRAFFIC_LIGHT,)):
            columns = [i for i, name in self.category_of.items() if name in members and i < class_scores.shape[1]]
            if not columns:
                continue
            part = of_likely[:, columns]
            best = np.argmax(part, axis=1)
            top = part[np.arange(len(part)), best]
            row = np.flatnonzero(top >= min_score)
            rows.append(likely[row])
            scores.append(top[row].astype(np.float64))
            categories.append(np.array([self.category_of[i] for i in columns], dtype="<U16")[best[row]])
        if not rows:
            return np.zeros(0, np.intp), np.zeros(0), np.zeros(0, "<U16")
        return np.concatenate(rows), np.concatenate(scores), np.concatenate(categories)

    def categories_of(self, class_id: NDArray[np.number]) -> NDArray[np.str_]:
        """Return the categories (N,) of class indices (N,), "" where the class is no road user."""
        # Some exporters write ids as floats; NaN has no category.
        return np.array([self.category_of.get(i, "") for i in np.asarray(class_id, float).tolist()], dtype="<U16")


COCO_80 = Classes({0: "pedestrian", 1: "bicycle", 2: "car", 3: "motorcycle", 5: "bus", 7: "truck", 9: TRAFFIC_LIGHT})
COCO_91 = Classes({1: "pedestrian", 2: "bicycle", 3: "car", 4: "motorcycle", 6: "bus", 8: "truck", 10: TRAFFIC_LIGHT})
COCO_90 = Classes({i - 1: category for i, category in COCO_91.category_of.items()})
BY_COUNT: Mapping[int, Classes] = {80: COCO_80, 90: COCO_90, 91: COCO_91}


def choose_classes(names: str | None, count: int | None, default: Classes, where: str) -> Classes:
    """Find out the classes of a model: by the names in its metadata, else by their number.

    `names`: the entry `names` of the ONNX metadata: a Python literal, list or dict by index, as Ultralytics writes it.
    `count`: of classes in the output, None where that holds class ids; then `default` holds. `where`: the file.
    """
    if names is None and count is not None and count not in BY_COUNT:
        raise ConfigError(
            f"{where}: {count} classes without names; expected 80, 90 or 91 (COCO), or the entry 'names' in the "
            "model's metadata, such as {0: 'car', 1: 'pedestrian'}"
        )
    if names is None:
        return default if count is None else BY_COUNT[count]
    try:
        if len(names) > NAMES_LIMIT_CHARS:
            raise ValueError(f"{len(names)} characters")
        value = ast.literal_eval(names)
        items = value.items() if isinstance(value, dict) else enumerate(value)
        by_index = {int(i): str(name).strip().lower() for i, name in items}
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError) as error:
        raise ConfigError(f"{where}: metadata 'names' is no list or dict of class names: {error}") from None
    known = {i: CATEGORY_OF_NAME[name] for i, name in by_index.items() if name in CATEGORY_OF_NAME}
    if not set(known.values()) - {TRAFFIC_LIGHT}:
        listed, names_known = ", ".join(list(by_index.values())[:8]), ", ".join(CATEGORY_OF_NAME)
        raise ConfigError(f"{where}: none of its classes is a road user ({listed}); known: {names_known}")
    return Classes(known)


Outputs = Mapping[str, NDArray[Any]]


class Candidates(NamedTuple):
    """Decoded boxes before suppression."""

    box_input: Array  # (M, 4): u0, v0, u1, v1 in px of the model's input
    score: Array  # (M,)
    category: NDArray[np.str_]  # (M,)


Size = tuple[int, int]


@dataclass(frozen=True)
class Layout:
    """Output layout of one family of models; sizes are (width, height) of the input in px."""

    name: str  # by which a user chooses it
    preprocessing: Preprocessing  # that the models were trained with
    # Whether outputs of a gray image have this layout: with their `single_output_shape` and the number of cells of the input
    matches: Callable[[Outputs, tuple[int, int], int], bool] = field(repr=False)
    class_count: Callable[[Outputs], int | None] = field(repr=False)  # None where the output holds class ids
    # Boxes of a score and higher.
    decode: Callable[[Outputs, Size, Classes, float], Candidates] = field(repr=False)
    default_classes: Classes = COCO_80  # of a model whose output holds class ids without names
    default_min_score: float = 0.4  # in [0, 1], below which boxes are more often wrong than useful


def corners_from_centers(center_and_size: Array) -> Array:
    """Convert boxes (M, 4) from center u, v, width, height to u0, v0, u1, v1."""
    center, half = center_and_size[:, :2], center_and_size[:, 2:4] / 2
    return np.concatenate([center - half, center + half], axis=1)


def largest_output(outputs: Outputs) -> NDArray[Any]:
    """Return the largest output; some exports append intermediate outputs or masks to the detections."""
    return max(outputs.values(), key=lambda a: a.size)


def single_output_shape(outputs: Outputs) -> tuple[int, int]:
    """Return the last two dimensions of a single output (1, a, b); zeros for other or more outputs."""
    shapes = [array.shape for array in outputs.values()]
    return shapes[0][1:] if len(shapes) == 1 and len(shapes[0]) == 3 and shapes[0][0] == 1 else (0, 0)


def find_output(outputs: Outputs, name: str) -> NDArray[Any] | None:
    """Find an output by its name without TensorFlow's ":0"; None if there is none."""
    return next((array for key, array in outputs.items() if key.split(":")[0] == name), None)


def _has(outputs: Outputs, *names: str) -> bool:
    return all(find_output(outputs, name) is not None for name in names)


def required_output(outputs: Outputs, name: str) -> NDArray[Any]:
    """Return an output by its name, or raise `ConfigError`."""
    array = find_output(outputs, name)
    if array is None:
        raise ConfigError(
            f"the model has no output '{name}'; it has {describe_outputs(outputs)}; choose another layout"
        )
    return array


def describe_outputs(outputs: Outputs) -> str:
    """Format names and shapes of outputs for messages."""
    return ", ".join(f"'{name}' {tuple(array.shape)}" for name, array in outputs.items())


STRIDES = (8, 16, 32)

# Median offset in cells up to which outputs count as undecoded: offsets are a few cells, decoded centers span the input.
MAX_OFFSET_CELLS = 24.0


def cell_count(size: tuple[int, int]) -> int:
    """Count the cells of all strides in an input of (width, height) px."""
    return sum((size[0] // s) * (size[1] // s) for s in STRIDES)


def _from_yolox(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Decode rows (1, cells, 5 + C): offsets in cells, logarithms of sizes, objectness, class scores (YOLOX)."""
    raw = largest_output(outputs)[0]
    if len(raw) != cell_count(size):
        raise ConfigError(f"layout yolox: expected {cell_count(size)} rows for an input of {size}; found {len(raw)}")
    row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
    # Cells are numbered row by row, those of fine strides first.
    grids = [np.mgrid[: size[1] // s, : size[0] // s][::-1].reshape(2, -1).T for s in STRIDES]
    cell = np.concatenate(grids).astype(np.float64)
    stride = np.repeat(np.array(STRIDES, float), [len(g) for g in grids])
    picked = raw[row].astype(np.float64)
    with np.errstate(over="ignore"):  # an infinite size is dropped with the other boxes that are not finite
        extent = np.exp(picked[:, 2:4]) * stride[row, None]
    center = (picked[:, :2] + cell[row]) * stride[row, None]
    return Candidates(corners_from_centers(np.concatenate([center, extent], axis=1)), score, category)


def _from_rows(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Take rows (1, N, 5 + C): center, size in px of the input, objectness, class scores (YOLOv5, v6, v7, YOLOX)."""
    raw = largest_output(outputs)[0]
    row, score, category = classes.best(raw[:, 5:] * raw[:, 4:5], min_score)
    return Candidates(corners_from_centers(raw[row, :4].astype(np.float64)), score, category)


def _count_in_rows(outputs: Outputs) -> int:
    return int(largest_output(outputs).shape[2]) - 5


def _from_yolov8(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Take columns (1, 4 + C, N): center, size in px of the input, class scores (YOLOv8, v9, 11, 12)."""
    raw = largest_output(outputs)[0].T
    row, score, category = classes.best(raw[:, 4:], min_score)
    return Candidates(corners_from_centers(raw[row, :4].astype(np.float64)), score, category)


def _from_yolov10(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Take rows (1, N, 6): u0, v0, u1, v1 in px of the input, score, class id (YOLOv10, other end-to-end exports)."""
    raw = largest_output(outputs)[0].astype(np.float64)
    category = classes.categories_of(raw[:, 5])
    keep = (raw[:, 4] >= min_score) & (category != "")
    return Candidates(raw[keep, :4], raw[keep, 4], category[keep])


def _from_tf_od(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Decode TensorFlow's object detection API: boxes v0, u0, v1, u1 in 0-1, classes as COCO ids from 1, suppressed."""
    score = required_output(outputs, "detection_scores")[0].astype(np.float64)
    number = find_output(outputs, "num_detections")
    count = len(score) if number is None else min(len(score), int(number.ravel()[0]))
    box = required_output(outputs, "detection_boxes")[0, :count].astype(np.float64)
    category = classes.categories_of(required_output(outputs, "detection_classes")[0, :count])
    keep = (score[:count] >= min_score) & (category != "")
    return Candidates(from_normalized(box[keep], size), score[:count][keep], category[keep])


def _is_tf_od_raw(outputs: Outputs, shape: tuple[int, int], cells: int) -> bool:
    box, score = find_output(outputs, "boxes"), find_output(outputs, "scores")
    if box is None or score is None or box.ndim != 3 or score.ndim != 3:
        return False
    return box.shape[2] == 4 and box.shape[:2] == score.shape[:2]


def _from_tf_od_raw(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Decode that API before its suppression: `boxes` (1, N, 4) likewise, and `scores` (1, N, C) after the sigmoid."""
    row, score, category = classes.best(required_output(outputs, "scores")[0], min_score)
    box = required_output(outputs, "boxes")[0][row].astype(np.float64)
    return Candidates(from_normalized(box, size), score, category)


def from_normalized(box_vuvu: Array, size: Size) -> Array:
    """Convert boxes from v0, u0, v1, u1 in 0-1 to u0, v0, u1, v1 in px."""
    return box_vuvu.reshape(-1, 4)[:, [1, 0, 3, 2]] * np.array([*size, *size], dtype=np.float64)


def _from_rt_detr(outputs: Outputs, size: Size, classes: Classes, min_score: float) -> Candidates:
    """Decode RT-DETR: center and size in 0-1; (1, 300, 4 + C) with scores, or `pred_boxes` and `logits` apart."""
    box, class_scores = _rt_detr_parts(outputs)
    row, score, category = classes.best(class_scores, min_score)
    scaled = corners_from_centers(box[row].astype(np.float64)) * np.array([*size, *size], dtype=np.float64)
    return Candidates(scaled, score, category)


def _rt_detr_parts(outputs: Outputs) -> tuple[NDArray[Any], NDArray[Any]]:
    if _has(outputs, "pred_boxes", "logits"):
        logits = required_output(outputs, "logits")[0]
        return required_output(outputs, "pred_boxes")[0], 0.5 * (1 + np.tanh(0.5 * logits))  # sigmoid without overflow
    return largest_output(outputs)[0, :, :4], largest_output(outputs)[0, :, 4:]


_CENTERED = Preprocessing("center", rgb=True, unit=True)
_CORNER = Preprocessing("corner", rgb=False, unit=False, default_px=416)
_STRETCHED = Preprocessing("stretch", rgb=True, unit=False, default_px=None)
_AS_TF1 = Preprocessing("tf1", rgb=True, unit=False, default_px=300)
LAYOUTS: Mapping[str, Layout] = {
    layout.name: layout
    for layout in (
        Layout(
            "tf-od", _STRETCHED,
            lambda outputs, shape, cells: _has(outputs, "detection_boxes", "detection_scores", "detection_classes"),
            lambda outputs: None, _from_tf_od, COCO_91,
        ),
        Layout(
            "tf-od-raw", _AS_TF1, _is_tf_od_raw, lambda outputs: int(required_output(outputs, "scores").shape[2]),
            _from_tf_od_raw, COCO_91,
        ),
        Layout(
            "yolox", _CORNER,
            lambda outputs, shape, cells: shape[0] == cells and shape[1] > 5
            and bool(np.median(np.abs(largest_output(outputs)[0, :, :2])) < MAX_OFFSET_CELLS),
            _count_in_rows, _from_yolox,
        ),
        Layout(
            "yolov5", _CENTERED, lambda outputs, shape, cells: shape[0] == 3 * cells and shape[1] > 5, _count_in_rows,
            _from_rows,
        ),
        # Only where they are given by name.
        Layout("yolov6", _CENTERED, lambda outputs, shape, cells: False, _count_in_rows, _from_rows),
        Layout("yolox-decoded", _CORNER, lambda outputs, shape, cells: False, _count_in_rows, _from_rows),
        Layout(
            "yolov8", _CENTERED, lambda outputs, shape, cells: shape[1] == cells and shape[0] > 4,
            lambda outputs: int(largest_output(outputs).shape[1]) - 4, _from_yolov8,
        ),
        Layout(
            "yolov10", _CENTERED, lambda outputs, shape, cells: shape[1] == 6 and shape[0] not in (cells, 3 * cells),
            lambda outputs: None, _from_yolov10,
        ),
        Layout(
            "rt-detr", Preprocessing("stretch", rgb=True, unit=True),
            lambda outputs, shape, cells: _has(outputs, "pred_boxes", "logits") or (shape[0] == 300 and shape[1] > 6),
            lambda outputs: int(_rt_detr_parts(outputs)[1].shape[1]), _from_rt_detr,
        ),
    )
}  # fmt: skip
