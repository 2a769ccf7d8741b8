"""Second stage of a LiDAR detector: a network on the points in and around each box.

Cells of a grid are as wide as a person is deep. The points themselves show more: which road user the box
holds, if any, where the sides are, and which end is the front. Such networks follow PointNet (Qi et al., CVPR 2017) and PointRCNN
(Shi et al., CVPR 2019). The size of the box is among the inputs, since points alone do not show how far they are from its
sides (Li, Wang and Wang, "LiDAR R-CNN", CVPR 2021).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from log2sim.errors import ConfigError
from log2sim.files.documents import first_problem
from log2sim.geometry import Array, wrap_angle
from log2sim.perception.detect3d.box_points import PointsOfBoxes, points_of_boxes
from log2sim.perception.detect3d.boxes import MAX_LOGIT, LevelBoxes, sigmoid
from log2sim.perception.detect3d.network import (
    MAX_HEIGHT_M,
    METADATA_LIMIT_CHARS,
    NetworkInfo,
    ScoreInfo,
    first_line,
    open_session,
)

SUFFIX = ".boxes.onnx"
METADATA_KEY = "log2sim.boxes"
MAX_FILE_BYTES = 64 * 1024**2
# Points this far outside a box are looked at, too: places of boxes err by less, and the space around distinguishes people from walls.
MARGIN_M = 0.5
# Points of a box from which those of the network are drawn.
MOST_POINTS = 256
MAX_GROUPS = 3
POINT_VALUES, BOX_VALUES = 7, 12 + MAX_GROUPS
OUTPUTS = 10  # after the logits of the categories
# A box that has to be moved by more is of another object; riders are three times as long as people, for whom the first stage may take them.
MAX_SHIFT_M, MAX_LOG_SIZE = 2.0, 1.2


@dataclass(frozen=True, eq=False)
class Refinement:
    """Loaded second stage; may be used from several threads."""

    path: Path
    info: ScoreInfo  # its groups are those of the first stage
    categories: Mapping[str, Sequence[str]]  # of each group, those of the first stage
    session: Any  # onnxruntime.InferenceSession
    points: int  # number of points of a box that the network takes

    def refine(self, boxes: LevelBoxes, xyz: NDArray[np.float32], sensors: Array) -> tuple[LevelBoxes, PointsOfBoxes]:
        """Correct boxes by their points; those without points in or around them are left out.

        `xyz`: (N, 3), m: level frame, above the ground. `sensors`: (V, 2), m: where they were measured from.

        Returns the boxes, each of its most probable group, whose heat is the logit of that, and their points.
        """
        around = points_around(xyz, boxes)
        some = np.flatnonzero(around.count > 0)
        if not len(some):
            return boxes.take(some), around.take(some)
        if len(some) < len(boxes):
            boxes, around = boxes.take(some), around.take(some)
        toward = toward_sensor(boxes, sensors)
        values = box_inputs(xyz, around.sample(MOST_POINTS), around.count, boxes, toward, self.points)
        boxes = corrected(boxes, self.run(*values), self.categories)
        return boxes, points_within(around, xyz, boxes)

    def run(self, points: NDArray[np.float32], of_box: NDArray[np.float32]) -> Array:
        """Compute logits of C categories and corrections (M, C + 10) from the inputs of M boxes; `ConfigError` when it fails."""
        try:
            (out,) = self.session.run(["corrections"], {"points": points, "box": of_box})
        except Exception as error:  # ONNX Runtime has many exceptions and no base of its own
            raise ConfigError(f"{self.path}: the network fails on {len(of_box)} boxes: {first_line(error)}") from None
        expected = len(of_box), sum(map(len, self.categories.values())) + OUTPUTS
        if out.shape != expected:
            raise ConfigError(f"{self.path}: output 'corrections' is {out.shape}, expected {expected}")
        return np.nan_to_num(np.asarray(out, np.float64))


def toward_sensor(boxes: LevelBoxes, sensors: Array) -> Array:
    """Return the ways (M, 2), m, from the centers of boxes to the nearest of the sensors (V, 2) in the plane."""
    away = sensors - boxes.center_m[:, None, :2]
    return np.asarray(away[np.arange(len(away)), np.hypot(away[..., 0], away[..., 1]).argmin(axis=1)])


def points_around(xyz: NDArray[np.float32], boxes: LevelBoxes, margin_m: float = MARGIN_M) -> PointsOfBoxes:
    """Find the points (N, 3) in boxes and up to a margin around them, at any height."""
    center, size = boxes.center_m.copy(), boxes.size_m + 2 * margin_m
    center[:, 2], size[:, 2] = 0.0, 2 * MAX_HEIGHT_M
    return points_of_boxes(xyz, center, size, boxes.yaw_rad)


def points_within(around: PointsOfBoxes, xyz: NDArray[np.float32], boxes: LevelBoxes) -> PointsOfBoxes:
    """Take those of some points that are in the boxes themselves."""
    half = boxes.size_m.T.astype(xyz.dtype) / 2
    along, across, up = np.abs(in_box_axes(xyz, around, boxes)).T
    inside = np.flatnonzero(
        (along <= half[0].take(around.box)) & (across <= half[1].take(around.box)) & (up <= half[2].take(around.box))
    )
    return PointsOfBoxes(around.box[inside], around.point[inside], around.boxes)


def in_box_axes(xyz: NDArray[np.float32], pairs: PointsOfBoxes, boxes: LevelBoxes) -> NDArray[np.float32]:
    """Express points relative to the centers of boxes, along their axes: (K, 3), m, in the precision of the points."""
    center, kind = boxes.center_m.T.astype(xyz.dtype), xyz.dtype
    c, s = (v.astype(kind).take(pairs.box) for v in (np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)))
    x, y, z = (xyz[:, axis].take(pairs.point) - center[axis].take(pairs.box) for axis in range(3))
    return np.stack([x * c + y * s, y * c - x * s, z]).T


def box_inputs(
    xyz: NDArray[np.float32], pairs: PointsOfBoxes, counts: NDArray[np.int64], boxes: LevelBoxes, toward_m: Array, points: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:  # fmt: skip
    """Make the inputs of the network for M boxes.

    `pairs`: the points around each box, at least one each. `counts`: (M,): how many points they stand for. `toward_m`: (M, 2):
    the way from the box to the sensor. `points`: how many to take, evenly over those of a box, again from the first where
    there are fewer.

    Returns (M, points, 7): x, y, z from the center along the axes of the box and height above the ground, m; x, y, z over half
    the size. (M, 15): which of three groups; heat, quality; logarithms of the numbers of points in and around the box and of its
    size; height of the center; distance from the sensor; unit vector to it in the axes of the box; how sure the heading is.
    """
    offset, size = in_box_axes(xyz, pairs, boxes), boxes.size_m
    each = counts / pairs.count
    in_box = np.bincount(pairs.box, (np.abs(offset) <= size[pairs.box] / 2).all(axis=1), minlength=pairs.boxes) * each
    number, k = pairs.count[:, None], np.arange(points)
    row = np.cumsum(number, axis=0) - number + np.where(number >= points, k * number // points, k % number)
    place = offset[row]
    height = place[..., 2] + boxes.center_m[:, None, 2]
    values = np.concatenate([place, height[..., None], place / (size[:, None] / 2)], axis=2)
    away = np.hypot(*toward_m.T)
    c, s = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
    x, y = toward_m.T / np.maximum(away, 0.1)
    of_box = np.column_stack([
        np.eye(MAX_GROUPS)[boxes.group], boxes.heat / 3, boxes.quality / 2, np.log1p(in_box) / 3, np.log1p(counts) / 3,
        np.log(size), boxes.center_m[:, 2], away / 30, x * c + y * s, y * c - x * s, 2 * boxes.heading_score - 1,
    ])  # fmt: skip
    return values.astype(np.float32), of_box.astype(np.float32)


def corrected(boxes: LevelBoxes, out: Array, categories: Mapping[str, Sequence[str]]) -> LevelBoxes:
    """Apply the outputs (M, C + 10) of the network to boxes.

    They are the logits of the C categories of all groups against no road user, the shift along the axes of the box, m, logarithms of the
    factors of its size, sine and cosine of twice the turn, the logit that front and back are not swapped, and that of the expected IoU.
    """
    names = np.array([name for group in categories.values() for name in group])
    of_group = np.repeat(np.arange(len(categories)), [len(group) for group in categories.values()])
    odds, out = np.exp(np.clip(out[:, : len(names)], -MAX_LOGIT, MAX_LOGIT)), out[:, len(names) :]
    group = (odds @ (of_group[:, None] == np.arange(len(categories)))).argmax(axis=1)
    own = odds * (of_group == group[:, None])
    c, s = np.cos(boxes.yaw_rad), np.sin(boxes.yaw_rad)
    x, y, z = np.clip(out[:, :3].T, -MAX_SHIFT_M, MAX_SHIFT_M)
    yaw = boxes.yaw_rad + np.arctan2(out[:, 6], out[:, 7]) / 2 + np.where(out[:, 8] < 0, np.pi, 0.0)
    return replace(
        boxes,
        center_m=boxes.center_m + np.stack([x * c - y * s, x * s + y * c, z], axis=1),
        size_m=boxes.size_m * np.exp(np.clip(out[:, 3:6], -MAX_LOG_SIZE, MAX_LOG_SIZE)),
        yaw_rad=np.asarray(wrap_angle(yaw)),
        heading_score=sigmoid(np.abs(out[:, 8])),
        group=group,
        category=names[own.argmax(axis=1)],
        heat=np.log(own.sum(axis=1) / (1.0 + (odds - own).sum(axis=1))),
        quality=out[:, 9],
    )


def load_refinement(path: Path, first: NetworkInfo) -> Refinement:
    """Load the second stage of a detector whose first one describes itself; `ConfigError` for a file that is none."""
    session = open_session(path, MAX_FILE_BYTES, "network for the points of boxes")
    shapes = {i.name: i.shape for i in session.get_inputs() if i.type == "tensor(float)"}
    of_points = shapes.get("points", ())
    fits = len(of_points) == 3 and isinstance(of_points[1], int) and 0 < of_points[1] <= MOST_POINTS
    if not fits or set(shapes) != {"points", "box"} or "corrections" not in [o.name for o in session.get_outputs()]:
        raise ConfigError(
            f"{path}: expected inputs 'points' (M, 1 to {MOST_POINTS}, {POINT_VALUES}) and 'box' (M, {BOX_VALUES}) and an output "
            "'corrections'"
        )
    text, where = session.get_modelmeta().custom_metadata_map.get(METADATA_KEY, "{}"), f"{path}: '{METADATA_KEY}'"
    try:
        info = ScoreInfo.model_validate_json(text[:METADATA_LIMIT_CHARS])
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_problem(error, ScoreInfo)}") from None
    if info.groups != first.groups or len(info.groups) > MAX_GROUPS:
        raise ConfigError(
            f"{where}: 'groups' are {list(info.groups)}, those of the detector {list(first.groups)}; expected the same, at most {MAX_GROUPS}"
        )
    categories = {group: first.categories[group] for group in first.groups}
    network = Refinement(path, info, categories, session, of_points[1])
    network.run(np.zeros((1, network.points, POINT_VALUES), np.float32), np.zeros((1, BOX_VALUES), np.float32))
    return network
