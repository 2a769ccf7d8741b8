"""Conversion of the frozen graph of SSD-MobileNetV2 (COCO, 2018) to ONNX, with boxes decoded, without suppression.

Nodes between the preprocessed picture and the two concatenated outputs are translated one by one, constants folded.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from log2sim.perception.detect.ssd_graph import Node, read_graph

if TYPE_CHECKING:
    import onnx

OPSET = 13
IR_VERSION = 8
INPUT_PX = 300
# Classes by their column among the 91 of the graph, 0 of which is the background: those that are no road users are left out,
# and with them most of the work, since classes are chosen for each of thousands of boxes.
CLASS_NAMES = {
    1: "person", 2: "bicycle", 3: "car", 4: "motorcycle", 6: "bus", 8: "truck", 10: "traffic light",
}  # fmt: skip
GRAPH_CLASSES = 91
CLASS_HEAD = "/ClassPredictor/"
SCALED, SHIFTED = "Preprocessor/mul/x", "Preprocessor/sub/y"
PICTURE = "Preprocessor/sub"
ENCODED_BOXES, CLASS_LOGITS = "concat", "concat_1"

# ssd_anchor_generator of the model's pipeline configuration.
FEATURE_CELLS = (19, 10, 5, 3, 2, 1)
MIN_SCALE, MAX_SCALE = 0.2, 0.95
CENTER_VARIANCE, SIZE_VARIANCE = 0.1, 0.2


class Converter:
    """Translation of the graph from its outputs back to the image, collecting ONNX nodes and constants."""

    def __init__(self, nodes: dict[str, Node]) -> None:
        from onnx import helper, numpy_helper

        self._helper, self._numpy_helper = helper, numpy_helper
        self._nodes = nodes
        self._constants: dict[str, NDArray[Any] | None] = {}
        self._translated: dict[str, str] = {PICTURE: "picture_nchw"}
        self.initializers: list[Any] = []
        self.onnx_nodes: list[Any] = []

    def add(self, op: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Append one ONNX node and return the name of its output."""
        self.onnx_nodes.append(self._helper.make_node(op, inputs, [output], **attributes))
        return output

    def store(self, name: str, value: NDArray[Any] | np.generic) -> str:
        """Append one constant and return its name."""
        self.initializers.append(self._numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def constant(self, name: str) -> NDArray[Any] | None:
        """Return the value of a node that depends on constants only, else None."""
        if name not in self._constants:
            self._constants[name] = self._fold(self._nodes[name])
        return self._constants[name]

    def required(self, name: str) -> NDArray[Any]:
        """Return the value of a node that has to be constant, or raise `ValueError`."""
        value = self.constant(name)
        if value is None:
            raise ValueError(f"node '{name}' is not constant")
        return value

    def _fold(self, node: Node) -> NDArray[Any] | None:
        if node.op == "Const":
            return node.tensor("value")
        if node.op == "Identity":
            return self.constant(node.inputs[0])
        if node.op not in ("Mul", "Add", "Sub", "Rsqrt") or PICTURE in (node.name, *node.inputs):
            return None
        values = [self.constant(name) for name in node.inputs]
        known = [v for v in values if v is not None]
        if len(known) < len(values):
            return None
        if node.op == "Rsqrt":
            return np.asarray(np.float32(1) / np.sqrt(known[0]), dtype=np.float32)
        operation = {"Mul": np.multiply, "Add": np.add, "Sub": np.subtract}[node.op]
        return np.asarray(operation(*known), dtype=np.float32)

    def translate(self, name: str) -> str:
        """Translate a node and return the name of its ONNX value; images are NCHW there and NHWC in the graph."""
        if name not in self._translated:
            self._translated[name] = self._translate(self._nodes[name])
        return self._translated[name]

    def _translate(self, node: Node) -> str:
        if node.op == "Identity":
            return self.translate(node.inputs[0])
        if node.op in ("Conv2D", "DepthwiseConv2dNative"):
            return self._convolution(node)
        if node.op in ("Mul", "Add", "Sub", "BiasAdd"):
            op = "Add" if node.op == "BiasAdd" else node.op
            return self.add(op, [self._operand(node, i) for i in range(2)], node.name)
        if node.op == "Relu6":
            return self.add("Clip", [self.translate(node.inputs[0]), "zero", "six"], node.name)
        if node.op == "Reshape":
            # Both heads end in one; its target shape is computed in the graph, but only the last dimension matters.
            last = len(CLASS_NAMES) if node.name.endswith("_1") else 4
            moved = self.add("Transpose", [self.translate(node.inputs[0])], f"{node.name}/nhwc", perm=[0, 2, 3, 1])
            shape = self.store(f"{node.name}/shape", np.array([0, -1, last], dtype=np.int64))
            return self.add("Reshape", [moved, shape], node.name)
        if node.op == "ConcatV2":
            return self.add("Concat", [self.translate(i) for i in node.inputs[:-1]], node.name, axis=1)
        raise ValueError(f"node '{node.name}': operation {node.op} is not expected in this model")

    def _operand(self, node: Node, i: int) -> str:
        value = self.constant(node.inputs[i])
        if value is None:
            return self.translate(node.inputs[i])
        if CLASS_HEAD in node.name:
            value = of_known_classes(value)
        return self.store(f"{node.name}/{i}", value.reshape(1, -1, 1, 1) if value.ndim == 1 else value)

    def _convolution(self, node: Node) -> str:
        weights = self.required(node.inputs[1])  # height, width, channels in, channels out or multiplier
        if CLASS_HEAD in node.name:
            weights = of_known_classes(weights)
        if node.op == "Conv2D":
            kernel, groups = weights.transpose(3, 2, 0, 1), 1
        else:
            height, width, groups, multiplier = weights.shape
            kernel = weights.transpose(2, 3, 0, 1).reshape(groups * multiplier, 1, height, width)
        return self.add(
            "Conv",
            [self.translate(node.inputs[0]), self.store(f"{node.name}/weights", kernel)],
            node.name,
            strides=node.integers("strides")[1:3],
            dilations=(node.integers("dilations") or [1] * 4)[1:3],
            kernel_shape=list(kernel.shape[2:]),
            group=groups,
            auto_pad="SAME_UPPER" if node.text("padding") == "SAME" else "VALID",
        )


def convert(graph: bytes) -> onnx.ModelProto:
    """Convert the frozen graph: `images` (N, 300, 300, 3) uint8 RGB to `boxes` (N, 1917, 4) and `scores` (N, 1917, 7).

    Raises
    ------
    ValueError
        When the bytes are not that model's graph.
    """
    import onnx
    from onnx import TensorProto, helper

    converter = Converter(read_graph(graph))
    try:
        normalize_picture(converter)
        encoded, logits = converter.translate(ENCODED_BOXES), converter.translate(CLASS_LOGITS)
    except KeyError as error:
        raise ValueError(f"the graph has no node {error}") from None
    anchors = anchor_boxes()
    decode_boxes(converter, encoded, anchors)
    converter.add("Sigmoid", [logits], "scores")
    picture = helper.make_tensor_value_info("images", TensorProto.UINT8, ["N", INPUT_PX, INPUT_PX, 3])
    outputs = [
        helper.make_tensor_value_info(name, TensorProto.FLOAT, ["N", len(anchors), columns])
        for name, columns in (("boxes", 4), ("scores", len(CLASS_NAMES)))
    ]
    body = helper.make_graph(converter.onnx_nodes, "ssd_mobilenet_v2_coco", [picture], outputs, converter.initializers)
    model = helper.make_model(body, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)
    helper.set_model_props(model, {"names": repr(dict(enumerate(CLASS_NAMES.values())))})
    onnx.checker.check_model(model)
    return model


def of_known_classes(constant: NDArray[Any]) -> NDArray[Any]:
    """Leave only the columns of `CLASS_NAMES` of a constant (..., K * 91) of the classes of K shapes of boxes."""
    by_class = constant.reshape(*constant.shape[:-1], -1, GRAPH_CLASSES)
    return by_class[..., list(CLASS_NAMES)].reshape(*constant.shape[:-1], -1)


def normalize_picture(converter: Converter) -> None:
    """Append the conversion of the image from uint8 NHWC to the value range of the graph, NCHW."""
    from onnx import TensorProto

    converter.store("zero", np.float32(0))
    converter.store("six", np.float32(6))
    scale = converter.store("picture/scale", converter.required(SCALED))
    shift = converter.store("picture/shift", converter.required(SHIFTED))
    converter.add("Cast", ["images"], "picture/float", to=TensorProto.FLOAT)
    converter.add("Mul", ["picture/float", scale], "picture/scaled")
    converter.add("Sub", ["picture/scaled", shift], "picture/shifted")
    converter.add("Transpose", ["picture/shifted"], "picture_nchw", perm=[0, 3, 1, 2])


def decode_boxes(converter: Converter, encoded: str, anchors: NDArray[np.float32]) -> None:
    """Append the decoding: center = c * 0.1 * anchor size + anchor center, size = exp(s * 0.2) * anchor size."""
    store, add = converter.store, converter.add
    halves = store("decode/halves", np.array([2, 2], dtype=np.int64))
    anchor_center = store("decode/anchor_center", anchors[None, :, :2])
    center_step = store("decode/center_step", np.float32(CENTER_VARIANCE) * anchors[None, :, 2:])
    half_anchor = store("decode/half_anchor", np.float32(0.5) * anchors[None, :, 2:])
    size_step = store("decode/size_step", np.float32(SIZE_VARIANCE))
    converter.onnx_nodes.append(
        converter._helper.make_node("Split", [encoded, halves], ["decode/c", "decode/s"], axis=2)
    )
    center = add("Add", [add("Mul", ["decode/c", center_step], "decode/offset"), anchor_center], "decode/center")
    growth = add("Exp", [add("Mul", ["decode/s", size_step], "decode/log_size")], "decode/growth")
    half = add("Mul", [growth, half_anchor], "decode/half")
    low, high = add("Sub", [center, half], "decode/low"), add("Add", [center, half], "decode/high")
    add("Concat", [low, high], "boxes", axis=2)


def anchor_boxes() -> NDArray[np.float32]:
    """Build the anchors (1917, 4) center v, u, height, width in 0-1: by layer, cell row by row, then shape.

    Notes
    -----
    SSD (Liu et al., 2016) with the object detection API's reduced lowest layer: three shapes there, six elsewhere.
    """
    scales = [*np.linspace(MIN_SCALE, MAX_SCALE, len(FEATURE_CELLS)), 1.0]
    layers = []
    for layer, cells in enumerate(FEATURE_CELLS):
        scale = scales[layer]
        shapes = [(scale, ratio) for ratio in (1.0, 2.0, 0.5, 3.0, 1 / 3)] + [(np.sqrt(scale * scales[layer + 1]), 1.0)]
        if layer == 0:
            shapes = [(0.1, 1.0), (scale, 2.0), (scale, 0.5)]
        size = np.array([(s / np.sqrt(ratio), s * np.sqrt(ratio)) for s, ratio in shapes])
        v, u = np.mgrid[:cells, :cells]
        center = (np.stack([v.ravel(), u.ravel()], axis=1) + 0.5) / cells
        pairs = [np.repeat(center, len(size), axis=0), np.tile(size, (len(center), 1))]
        layers.append(np.concatenate(pairs, axis=1))
    return np.concatenate(layers).astype(np.float32)
