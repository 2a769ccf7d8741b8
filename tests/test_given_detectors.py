"""Detectors that a program hands to `reconstruct`: functions of a picture, and objects for pictures and sweeps."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from worlds import tiny_log

from log2sim import Config, reconstruct
from log2sim.datatypes import Boxes3D, Detections, Frame, Log
from log2sim.errors import PluginError
from log2sim.perception.detect.detectors import FunctionDetector
from log2sim.perception.run_detectors import sort_detectors


@pytest.fixture(scope="module")
def log() -> Log:
    return tiny_log()[0]


@pytest.fixture
def frame(log: Log) -> Frame:
    return Frame(log.cameras["front"], int(log.streams["front"].t_ns[0]), lambda: log.streams["front"].read(0))


class InSweeps:
    name = "mine"

    def detect(self, cloud: Any, earlier: Any = ()) -> Boxes3D:
        return Boxes3D.empty()


def given(answer: Any, frame: Frame, min_score: float = 0.0) -> Detections:
    config = Config().changed(detect={"min_score": min_score})
    detector = sort_detectors(lambda image: answer, config).images
    assert detector is not None
    return detector.detect(frame)


def test_rows_become_detections_best_first(frame: Frame) -> None:
    rows = [
        (1, 2, 30.5, 40, 0.3, "car"),
        [5, 6, 7, 8, np.float32(0.5), np.str_("pedestrian")],
        (0, 0, 9, 9, 0.1, "bus"),
    ]
    found = given(rows, frame, 0.25)
    assert found.box_px.tolist() == [[5, 6, 7, 8], [1, 2, 30.5, 40]]
    assert found.score.tolist() == [0.5, pytest.approx(0.3)]
    assert found.category.tolist() == ["pedestrian", "car"]
    assert len(given([], frame)) == 0
    lights = np.array([[1.0, 1.0, 2.0, 2.0, 0.9]])
    assert np.array_equal(given(replace(found, traffic_lights=lights), frame).traffic_lights, lights)


def test_a_function_may_draw_on_its_picture(frame: Frame, log: Log) -> None:
    kept = frame.image()
    before = kept.copy()

    def paint(image: Any) -> list[Any]:
        assert image.shape == (300, 480, 3)
        assert image.dtype == np.uint8
        image[:] = 0
        return []

    FunctionDetector(paint).detect(replace(frame, image=lambda: kept))
    assert np.array_equal(kept, before)


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        (None, r"returned NoneType, expected a list of rows of x0, y0, x1, y1 in px, score, category, or Detections"),
        ([(1, 2, 3, 4, 0.5)], r"row 0 is \(1, 2, 3, 4, 0\.5\), expected x0"),
        ([7], r"row 0 is 7, expected x0"),
        (np.ones((2, 6)), r"row 0 is array\(.*, expected x0"),
        ([(1, 2, 3, 4, 0.5, "cra")], r"row 0: unknown category 'cra' \(did you mean 'car'\?\); known: car"),
        ([(3, 2, 1, 4, 0.5, "car")], r"row 0: the box is \[3\.0, 2\.0, 1\.0, 4\.0\], expected x0 < x1 and y0 < y1"),
        ([(1, 2, 3, 4, 50, "car")], r"row 0: the score is 50, expected a number from 0 to 1"),
        (Detections(np.ones((2, 4)), np.ones(1), np.array(["car"])), r"box_px has the shape \(2, 4\)"),
    ],
)
def test_a_wrong_answer_says_where_and_what(frame: Frame, answer: Any, message: str) -> None:
    with pytest.raises(PluginError, match=rf"^detector 'lambda': camera 'front' at {frame.t_ns}: {message}"):
        given(answer, frame)


def test_sweeps_are_searched_by_what_is_handed_over(log: Log) -> None:
    config = Config(stop_s=0.3, map={"lanes": False})
    result = reconstruct(log, config, detector=[lambda image: [], InSweeps()])
    assert result.scenario.provenance["detector"] == "lambda+mine"
    assert [a.id for a in result.scenario.agents] == ["ego"]
    assert repr(result).startswith("<Result: <Scenario 'tiny': the ego and 0 other agents")
