"""tools/profile_ticks.py: to whom time is given, which records are the floor, and its figures."""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.logs.records import translate_parser_errors
from log2sim.perception.sync import Schedule

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
import profile_ticks
from profile_ticks import Measured, Times


def test_time_is_given_to_the_innermost_function_of_log2sim() -> None:
    assert profile_ticks.function_of(None) == "libraries"
    assert profile_ticks.function_of(sys._getframe()) == "other"
    frames = []

    class Noticing(Exception):
        def __str__(self) -> str:
            frames.append(sys._getframe())
            return "noticed"

    with pytest.raises(LogError), translate_parser_errors("here", LogError):
        raise Noticing
    assert {profile_ticks.function_of(frame) for frame in frames} == {"logs.records.translate_parser_errors"}


@pytest.mark.parametrize(
    ("function", "part"),
    [
        ("logs.records.guarded", "logs"),
        ("perception.lidar.cloud.deskew", "perception.lidar"),
        ("perception.frames.get", "perception.frames"),
        ("pipeline.start", "pipeline"),
        ("libraries", "libraries"),
    ],
)
def test_parts_are_packages_and_those_of_perception(function: str, part: str) -> None:
    assert profile_ticks.part_of(function) == part


def test_the_floor_has_each_record_once() -> None:
    index = np.array([0, -1, 2])
    sweeps = np.array([[0, 0, 1], [0, 1, 1]])
    schedule = Schedule("a", np.arange(3), {"a": index, "b": index + 4}, {"top": sweeps}, {})
    found = profile_ticks.records_of(schedule)
    assert len(found) == len(set(found))
    assert set(found) == {("a", 0), ("a", 2), ("b", 4), ("b", 3), ("b", 6), ("top", 0), ("top", 1)}


def test_figures_are_medians_a_tick_and_ratios_to_the_floor_of_one_thread() -> None:
    def run(cpu_s: float) -> Measured:
        parts = Counter({"perception.detect": 0.25 * cpu_s, "libraries": 0.25 * cpu_s, "tracking": 0.5 * cpu_s})
        return Measured(Times(cpu_s / 2, cpu_s), 10, {"detect": Times(1.0, 2.0)}, parts, parts)

    log = Log("some", "test", {}, {}, {})
    found = profile_ticks.figures(
        log, "labels", [run(1.0), run(9.0), run(2.0)], {1: [Times(0.5, 0.5)], 2: [Times(0.3, 0.6)]}
    )
    assert (found["cpu_ms"], found["wall_ms"], found["ticks_per_second"]) == (200.0, 100.0, 10.0)
    assert found["detector_cpu_ms"] == 100.0
    assert (found["cpu_over_floor"], found["without_detector_over_floor"]) == (4.0, 2.0)
    assert found["stages_ms"] == {"detect": {"wall": 100.0, "cpu": 200.0}}
    text = profile_ticks.show([found], 5)
    assert "| some | `labels` | 10 | 10.00 | 100 | 200 | 100 | 50 | 30 | 4.00 | 2.00 |" in text
