"""Models with constant outputs: each layout decodes to boxes known in closed form, and bad models are refused clearly."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from log2sim.datatypes import Frame, Log
from log2sim.errors import ConfigError
from log2sim.geometry import Camera
from log2sim.perception.detect.detectors import create_detector

onnx = pytest.importorskip("onnx", reason="building test models needs onnx")
WIDTH, HEIGHT = 96, 64  # of the input: 12*8 + 6*4 + 3*2 cells
CELLS = 126
IMAGE = np.zeros((128, 192, 3), dtype=np.uint8)  # twice the input
CENTER_SIZE = (40.0, 20.0, 32.0, 16.0)  # px of the input
CORNERS = (24.0, 12.0, 56.0, 28.0)
BOX = (48.0, 24.0, 112.0, 56.0)  # px of the image
CAR, SCORE = 2, 0.72
LOG = Log("empty", "log2sim", {}, {}, {})


def save_model(
    path: Path,
    outputs: Mapping[str, NDArray[Any]],
    *,
    shape: tuple[Any, ...] = (1, 3, HEIGHT, WIDTH),
    dtype: int = 1,
    names: str | None = None,
) -> Path:
    """Write a model that returns the same tensors whatever it sees."""
    helper = onnx.helper
    nodes = [
        helper.make_node("Constant", [], [name], value=onnx.numpy_helper.from_array(value))
        for name, value in outputs.items()
    ]
    infos = [helper.make_tensor_value_info(n, 1, v.shape) for n, v in outputs.items()]
    graph = helper.make_graph(nodes, "constant", [helper.make_tensor_value_info("images", dtype, shape)], infos)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    if names is not None:
        onnx.helper.set_model_props(model, {"names": names})
    onnx.save(model, path)
    return path


def detect(path: Path, image: NDArray[np.uint8] = IMAGE, **settings: Any) -> list[tuple[str, float, list[float]]]:
    detector = create_detector(str(path), LOG, **{"tiles": 1, **settings})
    camera = Camera("front", image.shape[1], image.shape[0], np.eye(3), "ego", np.eye(4))
    found = detector.detect(Frame(camera, 0, lambda: image))
    return [(str(c), float(s), b.tolist()) for c, s, b in zip(found.category, found.score, found.box_px, strict=True)]


def zeros(*shape: int) -> NDArray[np.float32]:
    return np.zeros((1, *shape), dtype=np.float32)


def yolox(count: int = 80) -> NDArray[np.float32]:
    out = zeros(CELLS, 5 + count)
    row = 96 + 1 * 6 + 2  # stride 16, cell u = 2, v = 1: center (2.5, 1.25) * 16, size (2, 1) * 16
    out[0, row, :5] = (0.5, 0.25, np.log(2.0), 0.0, 0.8)
    out[0, row, 5 + CAR] = 0.9
    return out


def yolo_rows(rows: int) -> NDArray[np.float32]:
    out = zeros(rows, 85)
    out[0, 7, :5], out[0, 7, 5 + CAR] = (*CENTER_SIZE, 0.8), 0.9
    return out


def yolov8(count: int = 80) -> NDArray[np.float32]:
    out = zeros(4 + count, CELLS)
    out[0, :4, 7], out[0, 4 + CAR, 7] = CENTER_SIZE, SCORE
    return out


def yolov10() -> NDArray[np.float32]:
    out = zeros(300, 6)
    out[0, 0] = (*CORNERS, SCORE, CAR)
    out[0, 1] = (*CORNERS, 0.9, 6)  # a train
    return out


def rt_detr() -> NDArray[np.float32]:
    out = zeros(300, 84)
    out[0, 3, :4] = np.array(CENTER_SIZE) / (WIDTH, HEIGHT, WIDTH, HEIGHT)
    out[0, 3, 4 + CAR] = SCORE
    return out


def normalized_vuvu() -> NDArray[np.float32]:
    u0, v0, u1, v1 = CORNERS
    return np.array([v0 / HEIGHT, u0 / WIDTH, v1 / HEIGHT, u1 / WIDTH], dtype=np.float32)


def tf_od() -> dict[str, NDArray[np.float32]]:
    box = np.tile(normalized_vuvu(), (1, 3, 1))
    score = np.array([[SCORE, 0.7, 0.99]], np.float32)
    classes = np.array([[3, 7, 3]], np.float32)  # a car, a train, and a car behind the number of detections
    number = np.array([2], np.float32)
    return {"detection_boxes": box, "detection_scores": score, "detection_classes": classes, "num_detections": number}


def tf_od_raw(count: int) -> dict[str, NDArray[np.float32]]:
    score = zeros(5, count)
    score[0, 4, CAR + (count == 91)] = SCORE
    return {"boxes": np.tile(normalized_vuvu(), (1, 5, 1)), "scores": score}


NHWC = {"shape": (1, HEIGHT, WIDTH, 3), "dtype": 2}
LAYOUT_CASES: dict[str, tuple[dict[str, NDArray[np.float32]], dict[str, Any]]] = {
    "yolox": ({"output": yolox()}, {}),
    "yolov5": ({"output": yolo_rows(3 * CELLS)}, {}),
    "yolov8": ({"output0": yolov8()}, {}),
    "yolov10": ({"output0": yolov10()}, {}),
    "rt-detr": ({"output0": rt_detr()}, {}),
    "tf-od": (tf_od(), NHWC),
    "tf-od any size": (tf_od(), {"shape": (1, None, None, 3), "dtype": 2}),
    "tf-od-raw": (tf_od_raw(90), NHWC),
    "tf-od-raw with background": (tf_od_raw(91), NHWC),
}


@pytest.mark.parametrize("case", LAYOUT_CASES)
def test_layout_is_recognized_and_decodes_to_the_known_box(case: str, tmp_path: Path) -> None:
    outputs, spec = LAYOUT_CASES[case]
    path = save_model(tmp_path / "model.onnx", outputs, **spec)
    found = detect(path)
    assert create_detector(str(path), LOG).layout.name == case.split()[0]  # type: ignore[attr-defined]
    assert [f[0] for f in found] == ["car"]
    assert found[0][1] == pytest.approx(SCORE, abs=1e-6)
    assert found[0][2] == pytest.approx(BOX, abs=1e-3)


@pytest.mark.parametrize(
    ("layout", "output", "shift"),
    [("yolox", yolox(), (0.0, 0.0)), ("yolov8", yolov8(), (0.0, 16.0))],
    ids=["corner", "center"],
)
def test_letterbox_is_undone(
    layout: str, output: NDArray[np.float32], shift: tuple[float, float], tmp_path: Path
) -> None:
    image = np.zeros((32, 96, 3), dtype=np.uint8)  # fills the width of the input, half its height
    [(_, _, box)] = detect(save_model(tmp_path / "m.onnx", {"o": output}), image, layout=layout)
    du, dv = shift
    expected = np.clip(np.array(CORNERS) - (du, dv, du, dv), 0, (96, 32, 96, 32))
    assert box == pytest.approx(expected, abs=1e-3)


def test_boxes_that_are_not_finite_or_empty_are_dropped(tmp_path: Path) -> None:
    output = yolov8()
    output[0, :4, 8], output[0, 4 + CAR, 8] = (np.nan, 20, 30, 30), 0.9
    output[0, :4, 9], output[0, 4 + CAR, 9] = (20, 20, np.inf, 30), 0.9
    output[0, :4, 10], output[0, 4 + CAR, 10] = (60, 40, 0, 30), 0.9
    output[0, :4, 11], output[0, 4 + CAR, 11] = (-90, 40, 30, 30), 0.9
    found = detect(save_model(tmp_path / "m.onnx", {"o": output}))
    assert [f[2] for f in found] == [pytest.approx(BOX, abs=1e-3)]


def save_brightness_model(path: Path) -> Path:
    """Write a model whose box and score grow with the mean brightness of what it sees, so that no two tiles give the same."""
    helper = onnx.helper
    nodes = [
        helper.make_node("Constant", [], ["full"], value=onnx.numpy_helper.from_array(yolov8())),
        helper.make_node("ReduceMean", ["images"], ["brightness"], axes=[0, 1, 2, 3], keepdims=0),
        helper.make_node("Mul", ["full", "brightness"], ["o"]),
    ]
    picture = helper.make_tensor_value_info("images", 1, (1, 3, HEIGHT, WIDTH))
    found = helper.make_tensor_value_info("o", 1, yolov8().shape)
    graph = helper.make_graph(nodes, "brightness", [picture], [found])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


@pytest.mark.parametrize("tiles", [1, 4])
def test_frames_that_are_searched_together_have_the_boxes_of_each_alone(tiles: int, tmp_path: Path) -> None:
    detector = create_detector(str(save_brightness_model(tmp_path / "m.onnx")), LOG, tiles=tiles, min_score=0.1)
    # Of several sizes, each brighter to the right, so that its tiles differ.
    shades = [np.linspace(low, 255, width).astype(np.uint8) for low, width in zip((0, 90, 150), (192, 256, 200))]
    images = [np.tile(shade[None, :, None], (128, 1, 3)) for shade in shades]
    frames = [Frame(Camera("c", i.shape[1], 128, np.eye(3), "ego", np.eye(4)), 0, lambda i=i: i) for i in images]
    alone = [detector.detect(frame) for frame in frames]
    for one, together in zip(alone, detector.detect_many(frames), strict=True):
        assert len(one)
        np.testing.assert_array_equal(together.box_px, one.box_px)
        np.testing.assert_array_equal(together.score, one.score)
    assert len({float(one.score[0]) for one in alone}) == len(frames)


BAD_MODELS = {
    "class count": ({"o": yolov8(7)}, {}, r"7 classes without names; expected 80"),
    "no road users": ({"o": yolov8(3)}, {"names": "['tree', 'dog', 'sky']"}, r"none of its classes.*tree, dog"),
    "names run code": ({"o": yolov8(3)}, {"names": "['tree', 'dog', str('car')]"}, r"metadata 'names'"),
    "unknown output": ({"mask": zeros(5, 7)}, {}, r"'mask' \(1, 5, 7\).*layout=.*yolov8"),
    "input": ({"o": yolov8()}, {"shape": (1, 7)}, r"'images'.*expected one image"),
    "batch": ({"o": yolov8()}, {"shape": (4, 3, HEIGHT, WIDTH)}, r"3 channels at a time"),
    "channels": ({"o": yolov8()}, {"shape": (1, 1, HEIGHT, WIDTH)}, r"3 channels at a time"),
    "huge input": ({"o": yolov8()}, {"shape": (1, 3, 10**6, 10**6)}, r"at most 8192 px"),
}


@pytest.mark.parametrize("case", BAD_MODELS)
def test_unusable_models_are_refused_with_file_and_reason(case: str, tmp_path: Path) -> None:
    outputs, spec, message = BAD_MODELS[case]
    path = save_model(tmp_path / "bad.onnx", outputs, **spec)
    with pytest.raises(ConfigError, match=message) as caught:
        create_detector(str(path), LOG)
    assert "bad.onnx" in str(caught.value)


def picky_model(path: Path, output: NDArray[np.float32], side: int) -> Path:
    """A model that says it takes any size and fails for all but one."""
    helper, array = onnx.helper, onnx.numpy_helper.from_array
    constants = {"c": output, "same": np.zeros((1, 3, side, side), np.float32), "zero": np.zeros(1, np.float32)}
    nodes = [helper.make_node("Constant", [], [name], value=array(value)) for name, value in constants.items()]
    nodes += [
        helper.make_node("Add", ["images", "same"], ["sum"]),
        helper.make_node("ReduceMean", ["sum"], ["mean"], keepdims=0),
        helper.make_node("Mul", ["mean", "zero"], ["nothing"]),
        helper.make_node("Add", ["c", "nothing"], ["output"]),
    ]
    infos = [
        helper.make_tensor_value_info(n, 1, v) for n, v in (("images", (1, 3, None, None)), ("output", output.shape))
    ]
    graph = helper.make_graph(nodes, "picky", infos[:1], infos[1:])
    onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8), path)
    return path


def test_a_model_that_refuses_the_sizes_of_other_families_is_recognized(tmp_path: Path) -> None:
    path = picky_model(tmp_path / "m.onnx", zeros(3549, 85), 416)
    assert create_detector(str(path), LOG).layout.name == "yolox"  # type: ignore[attr-defined]
    with pytest.raises(ConfigError, match=r"m\.onnx: the model fails on an image \(1, 3, 320, 320\)"):
        create_detector(str(path), LOG, input_px=320)
    with pytest.raises(ConfigError, match=r"n\.onnx: the model fails on an image"):
        create_detector(str(picky_model(tmp_path / "n.onnx", zeros(5, 7), 77)), LOG)
