"""SSD-MobileNetV2 in integers of 8 bits: a graph of floats from `ssd_convert` becomes one that takes half the time or less.

Weights have a scale for each channel, values one for each tensor (Jacob et al., "Quantization and Training of Neural Networks
for Efficient Integer-Arithmetic-Only Inference", CVPR 2018). Values after ReLU6 lie between 0 and 6 by definition; the ranges
of the others are those that street scenes reach.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import onnx

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
PICTURE, PICTURE_SCALE, PICTURE_SHIFT = "picture_nchw", "picture/scale", "picture/shift"
ZERO_BYTE = 128
PICTURE_STEPS = ("picture/float", "picture/scaled", "picture/shifted")


@dataclass(frozen=True, eq=False)
class Convolution:
    """A convolution with what follows it folded into its weights and bias.

    Attributes
    ----------
    node : onnx.NodeProto
    weights : (M, C, kH, kW) float32
    bias : (M,) float32
    output : str
        Name of the last value that is folded in.
    clipped : bool
        Whether a ReLU6 is among what is folded in.
    """

    node: Any
    weights: NDArray[np.float32]
    bias: NDArray[np.float32]
    output: str
    clipped: bool


def known_ranges() -> dict[str, tuple[float, float]]:
    """Return the ranges of the values that no ReLU6 bounds, by their names in the graph."""
    blocks = [f"FeatureExtractor/MobilenetV2/expanded_conv{f'_{k}' if k else ''}" for k in range(len(PROJECTED))]
    return {
        **{f"{block}/project/BatchNorm/batchnorm/add_1": limits for block, limits in zip(blocks, PROJECTED)},
        **{f"{blocks[k]}/add": limits for k, limits in SUMS.items()},
    }


def quantize(model: onnx.ModelProto, ranges: Mapping[str, tuple[float, float]]) -> onnx.ModelProto:
    """Return the model with quantized convolutions and sums; `boxes` and `scores` stay floats.

    Parameters
    ----------
    model : onnx.ModelProto
        Of `log2sim.perception.detect.ssd_convert.convert`.
    ranges : mapping of str to (float, float)
        Least and greatest value of what no ReLU6 bounds, see `known_ranges`.

    Raises
    ------
    ValueError
        For a convolution or sum without a known range.
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
        bias = np.zeros(len(weights), np.float32)
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
        found[node.output[0]] = Convolution(node, weights, bias, output, clipped)
    return found


class Quantizer:
    """Translation of a graph of floats node by node.

    Attributes
    ----------
    nodes, initializers : list
        Of the quantized graph.
    """

    def __init__(self, model: onnx.ModelProto, ranges: Mapping[str, tuple[float, float]]) -> None:
        self._ranges, self._convolutions = ranges, fold_convolutions(model)
        self._folded = {name for c in self._convolutions.values() for name in _folded_names(model, c)}
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
        elif node.output[0] == PICTURE:
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
        levels = self._make(node.op_type, ["images"], f"{PICTURE}/rounded", **_attributes(node))
        self._scales[PICTURE], self._offsets[PICTURE] = float(scale), ZERO_BYTE * scale - shift
        constants = [self._store(f"{PICTURE}/step", scale), self._store(f"{PICTURE}/level", np.uint8(ZERO_BYTE))]
        self._make("DequantizeLinear", [levels, *constants], PICTURE)

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
        self._quantize(folded.output, RELU6_RANGE if folded.clipped else self._range_of(folded.output))

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

    def _range_of(self, name: str) -> tuple[float, float]:
        if name not in self._ranges:
            raise ValueError(f"value '{name}' has no range")
        return self._ranges[name]

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


def _folded_names(model: onnx.ModelProto, folded: Convolution) -> list[str]:
    """Names of the values between a convolution and the last one that is folded into it, that one included."""
    by_input = {name: node for node in model.graph.node for name in node.input}
    names, output = [], folded.node.output[0]
    while output != folded.output:
        output = by_input[output].output[0]
        names.append(output)
    return names


def _attributes(node: Any) -> dict[str, Any]:
    from onnx import helper

    return {attribute.name: helper.get_attribute_value(attribute) for attribute in node.attribute}
