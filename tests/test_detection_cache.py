"""Detections of earlier runs: the same results bit for bit, nothing searched or decoded twice, nothing damaged believed."""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Detections, Frame, Log, Stream
from log2sim.errors import LogError, RecordError
from log2sim.files import plugins
from log2sim.files.documents import check
from log2sim.geometry import Camera
from log2sim.perception import detection_cache
from log2sim.perception.detection_cache import (
    DetectionCache,
    LightBox,
    PictureFindings,
    from_bytes,
    to_bytes,
)
from log2sim.perception.first_pass import Observations
from log2sim.pipeline import Run, observe_log, start

KEY = bytes(range(16))
TICKS = 6
# A part of the log, no second look at its pictures, and nothing that the cache has nothing to do with.
QUICK = {"map": {"lanes": False}, "appearance": {"colors": False}, "calibration": {"check": False}, "stop_s": 0.55}


STATED: dict[str, Any] = {"cache_key": "seeing 1", "before": lambda seeing: None}
"""What the detectors of a test state as their key, and what they do before they look at a picture."""


@dataclass
class Seeing:
    """A detector that finds the labeled boxes of a picture, and two traffic lights in each, and counts the pictures it saw."""

    log: Log
    name: str = "seeing"
    default_min_score: float = 0.4
    seen: list[int] = field(default_factory=list)

    @property
    def cache_key(self) -> str | None:
        return STATED["cache_key"]  # type: ignore[no-any-return]

    def detect(self, frame: Frame) -> Detections:
        STATED["before"](self)
        self.seen.append(frame.t_ns)
        labels = self.log.image_labels[frame.camera.name]
        rows = labels.t_ns == frame.t_ns
        lit = frame.image()[20:40, 30:60].mean() / 1e4  # of this picture alone
        light = np.array([[30.0, 20.0, 41.5, 52.25, 0.25 + lit], [100.0, 20.0, 190.0, 150.0, 0.5]])
        return Detections(labels.box_px[rows], np.full(rows.sum(), 0.875 + lit), labels.category[rows], light)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache folder of one test."""
    monkeypatch.setenv("LOG2SIM_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "detections"


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[Seeing]:
    """All detectors of the name "seeing" that runs make."""
    detectors: list[Seeing] = []
    module = ModuleType("seeing_package")
    module.create = lambda log, **_: detectors.append(Seeing(log)) or detectors[-1]  # type: ignore[attr-defined, func-returns-value]
    monkeypatch.setitem(sys.modules, "seeing_package", module)
    monkeypatch.setitem(plugins.BUILT_IN["detector"], "seeing", "seeing_package:create")
    return detectors


def counted(log: Log, reads: list[int]) -> Log:
    """A log whose pictures are counted when they are decoded."""
    stream = log.streams["front"]
    read = stream.read
    return log.changed(
        streams={**log.streams, "front": replace_read(stream, lambda i: reads.append(i) or read(i))}  # type: ignore[func-returns-value]
    )


def replace_read(stream: Stream, read: Any, *, encoded: bool = True) -> Stream:
    return Stream(stream.name, stream.t_ns, read, stream.encoded if encoded else None)


def config(**changes: Any) -> Config:
    return Config.load(**{"detect": {"name": "seeing"}, **QUICK, **changes})


def untimed(report: dict[str, Any]) -> dict[str, Any]:
    """A report without times and memory, and without what it says of the cache."""
    out = copy.deepcopy(report)
    for key in ("seconds", "ticks_per_second", "ticks_per_second_without_detector", "detection_cache"):
        out.pop(key)
    out["stages"] = [stage["stage"] for stage in out["stages"]]
    for step in out["plan"]:
        step.pop("saved_s"), step.pop("saved_how")
    return out


def entries(folder: Path) -> list[Path]:
    return sorted(p for p in folder.glob("?/*") if p.is_file())


# --- runs


def look(log: Log, settings: Config | None = None, *, cache: bool = True) -> tuple[Run, Observations]:
    """Run the first pass alone."""
    run = start(log, settings or config(), cache=cache)
    return run, observe_log(run)


def assert_same_observations(one: Observations, other: Observations) -> None:
    for a, b in zip(one.lights, other.lights, strict=True):
        np.testing.assert_array_equal(a.crop, b.crop)
        np.testing.assert_array_equal(a.box_px, b.box_px)
        assert (a.camera, a.t_ns, a.score) == (b.camera, b.t_ns, b.score)
    for a, b in zip(one.measurements, other.measurements, strict=True):
        for column in ("box_px", "score", "category", "center_m"):
            np.testing.assert_array_equal(getattr(a, column), getattr(b, column))
    assert one.records is not None
    assert other.records is not None
    assert one.records.watch.cameras["front"].states == other.records.watch.cameras["front"].states
    assert (one.frames_detected, one.detections) == (other.frames_detected, other.detections)


def test_runs_with_and_without_the_cache_give_the_same(tiny_folder: Path, folder: Path, made: list[Seeing]) -> None:
    reads: list[int] = []
    log = counted(open_log(tiny_folder), reads)
    without = reconstruct(log, config(), cache=False)
    assert not folder.exists()
    first = reconstruct(log, config())
    reads.clear()
    second = reconstruct(log, config())
    ticks = without.report["ticks"]
    assert [len(detector.seen) for detector in made] == [ticks, ticks, 0]
    assert reads == []  # nothing was decoded
    assert [r.report["detection_cache"] for r in (without, first, second)] == [
        None,
        {"found": 0, "kept": ticks, "problem": None},
        {"found": ticks, "kept": 0, "problem": None},
    ]
    for result in (first, second):
        assert result.scenario.to_dict() == without.scenario.to_dict()
        assert untimed(result.report) == untimed(without.report)
        check(result.report, "report-1", LogError)
    assert len(without.scenario.others) >= 2


def test_another_setting_of_the_detector_searches_everything(
    tiny_folder: Path, folder: Path, made: list[Seeing], monkeypatch: pytest.MonkeyPatch
) -> None:
    log = open_log(tiny_folder)
    look(log)
    look(log, config(track={"max_gap_s": 1.0}, measure={"max_range_m": 30.0}))
    assert len(made[-1].seen) == 0
    monkeypatch.setitem(STATED, "cache_key", "seeing 2")
    look(log)
    assert len(made[-1].seen) == TICKS
    monkeypatch.setattr(detection_cache, "software_key", lambda: "another version")
    look(log)
    assert len(made[-1].seen) == TICKS


def test_damaged_entries_are_made_again(tiny_folder: Path, folder: Path, made: list[Seeing]) -> None:
    log = open_log(tiny_folder)
    _, before = look(log)
    paths = entries(folder)
    contents = [path.read_bytes() for path in paths]
    for k, (path, content) in enumerate(zip(paths, contents, strict=True)):
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
        path.write_bytes([content[:-1], flipped, contents[k - 1], b""][k % 4])
    _, after = look(log)
    assert len(made[-1].seen) == len(paths) == TICKS
    assert_same_observations(before, after)
    assert [path.read_bytes() for path in entries(folder)] == contents


def test_a_run_that_was_interrupted_goes_on_where_it_was(
    tiny_folder: Path, folder: Path, made: list[Seeing], monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(seeing: Seeing) -> None:
        if len(seeing.seen) == 4:
            raise KeyboardInterrupt

    log = open_log(tiny_folder)
    with monkeypatch.context() as patch:
        patch.setitem(STATED, "before", interrupt)
        with pytest.raises(KeyboardInterrupt):
            look(log)
    _, resumed = look(log)
    assert len(made[-1].seen) == TICKS - 4
    assert_same_observations(look(log, cache=False)[1], resumed)


# --- keys


def camera(width: int = 60, height: int = 40) -> Camera:
    return Camera("front", width, height, np.eye(3), "ego", np.eye(4))


def frame(content: bytes = b"file", **size: int) -> Frame:
    return Frame(camera(**size), 7, lambda: np.zeros((40, 60, 3), np.uint8), lambda: content)


def cache_of(tmp_path: Path, cache_key: str = "a") -> DetectionCache:
    from log2sim.files.cache import DiskCache

    return DetectionCache(DiskCache(tmp_path), "name", cache_key)


def test_keys_differ_by_everything_that_the_result_depends_on(tmp_path: Path) -> None:
    cache = cache_of(tmp_path)
    pixels = [Frame(camera(), 7, lambda v=v: np.full((40, 60, 3), v, np.uint8)) for v in (0, 1)]
    keys = {
        cache.key_of(frame()),
        cache.key_of(frame(b"file2")),
        cache.key_of(frame(width=61)),
        cache.key_of(frame(height=41)),
        cache_of(tmp_path, "b").key_of(frame()),
        *(cache.key_of(f) for f in pixels),
    }
    assert len(keys) == 7
    assert cache.key_of(frame()) == cache_of(tmp_path).key_of(replace(frame(), t_ns=8))
    assert None not in keys

    def torn() -> bytes:
        raise RecordError("torn")

    assert cache.key_of(replace(frame(), encoded=torn)) is None


# --- bytes


FINITE = st.floats(-1e6, 1e6)


@st.composite
def findings(draw: st.DrawFn) -> PictureFindings:
    m, k = draw(st.integers(0, 4)), draw(st.integers(0, 3))
    category = np.array(draw(st.lists(st.text(max_size=5), min_size=m, max_size=m)), dtype="<U16")
    found = Detections(
        draw(arrays(np.float64, (m, 4), elements=FINITE)),
        draw(arrays(np.float64, (m,), elements=st.floats(0, 1))),
        category,
        draw(arrays(np.float64, (k, 5), elements=FINITE)),
    )
    thumbnail = draw(
        arrays(np.float32, (draw(st.integers(1, 5)), draw(st.integers(1, 5))), elements=st.floats(0, 255, width=32))
    )
    lights = [
        LightBox("front", 7, row[:4], float(row[4]), draw(arrays(np.uint8, (draw(st.integers(1, 4)), 3, 3))))
        for row in found.traffic_lights[: draw(st.integers(0, k))]
    ]
    return PictureFindings(found, thumbnail, tuple(lights))


def assert_same(one: PictureFindings, other: PictureFindings) -> None:
    for name in ("box_px", "score", "category", "traffic_lights"):
        a, b = getattr(one.detections, name), getattr(other.detections, name)
        assert (a.dtype, a.shape, a.tobytes()) == (b.dtype, b.shape, b.tobytes())
        assert b.flags.writeable
    assert one.thumbnail.tobytes() == other.thumbnail.tobytes()
    for x, y in zip(one.lights, other.lights, strict=True):
        assert (x.box_px.tobytes(), x.score, x.crop.tobytes()) == (y.box_px.tobytes(), y.score, y.crop.tobytes())
        assert x.crop.shape == y.crop.shape


@settings(max_examples=40, deadline=None)
@given(findings())
def test_findings_come_back_bit_for_bit(given_: PictureFindings) -> None:
    content = to_bytes(given_, KEY)
    assert content is not None
    back = from_bytes(content, KEY, "left", 9)
    assert back is not None
    assert_same(given_, back)
    assert all((light.camera, light.t_ns) == ("left", 9) for light in back.lights)
    assert from_bytes(content, KEY[::-1], "left", 9) is None
    assert from_bytes(content[:-1], KEY, "left", 9) is None
    assert from_bytes(content + b"\0", KEY, "left", 9) is None
