"""Networks and maps made by hand, for tests of the detection in clouds."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.detect3d.network import NetworkInfo

INFO: dict[str, Any] = {
    "version": 1,
    "name": "by hand",
    "cell_m": 0.25,
    "stride": 2,
    "range_m": 40.0,
    "groups": ["vehicle", "two_wheeler", "pedestrian"],
    "categories": {
        "vehicle": ["car", "truck", "bus"],
        "two_wheeler": ["motorcycle", "cyclist"],
        "pedestrian": ["pedestrian"],
    },
    # The score is the heat alone.
    "calibration": {group: [0.0, 1.0, 0.0, 0.0, 0.0] for group in ("vehicle", "two_wheeler", "pedestrian")},
    "min_score": {"vehicle": 0.3, "two_wheeler": 0.3, "pedestrian": 0.3},
    "card": {"seed": 1},
}
NAMES = ("car", "truck", "bus", "motorcycle", "cyclist", "pedestrian")
"""Categories in the order of groups and of their categories, as tests number them."""


def info(**changes: Any) -> NetworkInfo:
    return NetworkInfo.model_validate({**INFO, **changes})


def empty_maps(h: int, w: int) -> NDArray[np.float32]:
    """Maps (25, h, w) without any object: all heat cold, all cells background."""
    maps = np.zeros((25, h, w), np.float32)
    maps[0:3] = -9.0
    maps[19] = 9.0
    return maps


def encode(
    maps: NDArray[np.float32], box: Sequence[float], category: str, *, low: Array, cell_m: float = 0.5,
    logit: float = 4.0, front: float = 1.0, cells: int = 0,
) -> None:  # fmt: skip
    """Write one box (x, y, z, length, width, height, yaw) into maps, as its layout says, at the cell of its center.

    `front` is the length of the direction; the box is regressed from `cells` cells around too, which vote and segment.
    """
    x, y, z, *size, yaw = box
    group = 0 if category in NAMES[:3] else 1 if category in NAMES[3:5] else 2
    ci, cj = int((x - low[0]) // cell_m), int((y - low[1]) // cell_m)
    for i in range(ci - cells, ci + cells + 1):
        for j in range(cj - cells, cj + cells + 1):
            dx, dy = x - low[0] - (i + 0.5) * cell_m, y - low[1] - (j + 0.5) * cell_m
            maps[group, i, j] = logit if (i, j) == (ci, cj) else logit - 2
            if group < 2:
                maps[3 + NAMES.index(category), i, j] = 3.0
            maps[8:14, i, j] = dx, dy, z, *np.log(size)
            maps[14:16, i, j] = np.sin(2 * yaw), np.cos(2 * yaw)
            maps[16:18, i, j] = front * np.sin(yaw), front * np.cos(yaw)
            maps[18, i, j] = 1.0
            maps[19:23, i, j] = -9.0
            maps[20 + group, i, j] = 9.0
            maps[23:25, i, j] = dx, dy


def write_network(
    path: Path, metadata: str | dict[str, Any] | None = None, *, weight: Array | None = None, bias: Array | None = None,
    inputs: Sequence[Any] = (1, 12, "h", "w"), names: tuple[str, str] = ("grid", "maps"), key: str = "log2sim.lidar",
) -> Path:  # fmt: skip
    """Write a network of one pooling by the greatest of four cells and one 1 x 1 convolution, (25, 12) and (25,)."""
    from onnx import TensorProto, helper, numpy_helper, save

    weight = np.zeros((25, inputs[1])) if weight is None else weight
    bias = np.zeros(25) if bias is None else bias
    stored = [
        numpy_helper.from_array(np.asarray(weight, np.float32)[:, :, None, None], "weight"),
        numpy_helper.from_array(np.asarray(bias, np.float32), "bias"),
    ]
    nodes = [
        helper.make_node("MaxPool", [names[0]], ["pooled"], kernel_shape=[2, 2], strides=[2, 2]),
        helper.make_node("Conv", ["pooled", "weight", "bias"], [names[1]]),
    ]
    shape = [helper.make_tensor_value_info(names[0], TensorProto.FLOAT, list(inputs))]
    result = [helper.make_tensor_value_info(names[1], TensorProto.FLOAT, [1, len(weight), None, None])]
    graph = helper.make_graph(nodes, "by hand", shape, result, stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if metadata is not None:
        entry = model.metadata_props.add()
        entry.key, entry.value = key, metadata if isinstance(metadata, str) else json.dumps(metadata)
    save(model, path)
    return path


def write_refinement(
    path: Path, corrections: Array | Sequence[float], *, inputs: tuple[str, str] = ("points", "box"), points: int = 64,
    metadata: dict[str, Any] | None = INFO,
) -> Path:  # fmt: skip
    """Write a second stage that makes the same corrections to each box."""
    from onnx import TensorProto, helper, numpy_helper, save

    stored = [
        numpy_helper.from_array(np.zeros((15, len(corrections)), np.float32), "weight"),
        numpy_helper.from_array(np.asarray(corrections, np.float32), "bias"),
    ]
    nodes = [
        helper.make_node("MatMul", [inputs[1], "weight"], ["none"]),
        helper.make_node("Add", ["none", "bias"], ["corrections"]),
    ]
    shapes = [["boxes", points, 7], ["boxes", 15]]
    given = [helper.make_tensor_value_info(n, TensorProto.FLOAT, s) for n, s in zip(inputs, shapes, strict=True)]
    result = [helper.make_tensor_value_info("corrections", TensorProto.FLOAT, ["boxes", len(corrections)])]
    graph = helper.make_graph(nodes, "by hand", given, result, stored)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    if metadata is not None:
        entry = model.metadata_props.add()
        entry.key, entry.value = "log2sim.boxes", json.dumps(metadata)
    save(model, path)
    return path
