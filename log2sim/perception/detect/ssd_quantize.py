"""SSD-MobileNetV2 in integers of 8 bits: a graph of floats from `ssd_convert` becomes one that takes half the time.

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
PICTURE, PICTURE_RANGE = "picture_nchw", (-1.0, 1.0)
RELU6_RANGE = (0.0, 6.0)
# The encoded boxes stay floats: their errors are pixels, and their convolutions are small.
BOX_HEAD = "BoxEncodingPredictor"
# Least and greatest values, over tiles of pictures of a German town, San Francisco and a drawn crossing, of what the blocks'
# last convolutions give, by block, and of what is added to it; the greatest logits of the classes, by layer of boxes.
PROJECTED = (
    (-19.0, 19.0), (-14.0, 14.5), (-31.0, 23.5), (-14.5, 15.5), (-12.0, 15.0), (-17.5, 13.0), (-13.5, 11.5),
    (-10.0, 11.0), (-11.0, 9.5), (-15.0, 15.0), (-21.5, 9.5), (-22.0, 41.5), (-18.0, 18.5), (-17.0, 21.0),
    (-13.5, 13.5), (-20.5, 18.0), (-15.5, 18.0),
)  # fmt: skip
SUMS = {
    2: (-28.0, 25.0), 4: (-19.0, 19.0), 5: (-25.5, 27.0), 7: (-18.5, 14.0), 8: (-20.5, 16.5), 9: (-22.0, 19.5),
    11: (-22.0, 39.5), 12: (-25.5, 32.0), 14: (-21.5, 22.0), 15: (-31.5, 30.0),
}  # fmt: skip
GREATEST_LOGITS = (10.5, 9.0, 8.0, 6.5, 6.0, 7.0)
# A score of 5e-5, far below any that counts.
MIN_LOGIT = -10.0


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
        **{f"BoxPredictor_{k}/ClassPredictor/BiasAdd": (MIN_LOGIT, high) for k, high in enumerate(GREATEST_LOGITS)},
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
        self._scales: dict[str, float] = {}
        self.nodes: list[Any] = []
        self.initializers: list[Any] = list(model.graph.initializer)

    def add(self, node: Any) -> None:
        """Append what stands for a node."""
        if node.op_type == "Conv":
            self._add_convolution(self._convolutions[node.output[0]])
        elif node.output[0] not in self._folded:
            copied = type(node)()
            copied.CopyFrom(node)
            self.nodes.append(copied)
            if node.output[0] == PICTURE:
                self._quantize(PICTURE, PICTURE_RANGE)
            elif node.op_type == "Add" and node.output[0] in self._ranges:
                self._quantize(node.output[0], self._ranges[node.output[0]])

    def _add_convolution(self, folded: Convolution) -> None:
        name, source = folded.node.output[0], folded.node.input[0]
        greatest = np.maximum(np.abs(folded.weights).max(axis=(1, 2, 3)), MIN_WEIGHT)
        scale = (greatest / MAX_WEIGHT).astype(np.float32)
        whole = np.rint(folded.weights / scale[:, None, None, None]).astype(np.int8)
        # Sums of products have the scales of both factors, and so has what is added to them.
        step = (scale * np.float32(self._scales[source])).astype(np.float32)
        inputs = [
            source,
            self._restore(f"{name}/weights_int8", whole, scale),
            self._restore(f"{name}/bias_int32", np.rint(folded.bias / step).astype(np.int32), step),
        ]
        self._make("Conv", inputs, folded.output, **{a.name: _value_of(a) for a in folded.node.attribute})
        if BOX_HEAD not in name:
            self._quantize(folded.output, RELU6_RANGE if folded.clipped else self._range_of(folded.output))

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


def _value_of(attribute: Any) -> Any:
    from onnx import helper

    return helper.get_attribute_value(attribute)
