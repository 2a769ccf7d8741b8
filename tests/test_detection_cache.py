"""Detections of earlier runs: the same results bit for bit, nothing searched or decoded twice, nothing damaged believed."""

from __future__ import annotations

import copy
import os
import shutil
import signal
import struct
import subprocess
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
    open_cache,
    to_bytes,
)
from log2sim.perception.first_pass import Observations
from log2sim.pipeline import Run, observe_log, start

ROOT = Path(__file__).resolve().parents[1]
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


def test_the_first_pass_takes_the_same_from_a_picture(tiny_folder: Path, folder: Path, made: list[Seeing]) -> None:
    log = open_log(tiny_folder)
    (_, one), (_, other) = look(log), look(log)
    assert len(one.lights) == 2 * len(one.measurements) > 0  # two traffic lights in each picture
    assert_same_observations(one, other)
    assert len(made[-1].seen) == 0


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


def test_one_changed_picture_is_searched_again(log_folder: Path, folder: Path, made: list[Seeing]) -> None:
    look(open_log(log_folder))
    pictures = sorted(p for p in log_folder.rglob("*") if p.suffix in (".png", ".jpg"))
    shutil.copy(pictures[0], pictures[4])
    look(open_log(log_folder))
    assert len(made[-1].seen) == 0  # known, from another moment
    pictures[4].write_bytes(pictures[4].read_bytes()[:-30])
    run, observations = look(open_log(log_folder))
    assert len(made[-1].seen) == 0  # a file that cannot be decoded
    assert observations.records is not None
    assert observations.records.summary()["front"]["count"] == 1
    assert run.detectors.cache is not None
    assert run.detectors.cache.found == TICKS - 1
    pictures[4].write_bytes(recoded(pictures[0]))
    look(open_log(log_folder))
    assert len(made[-1].seen) == 1


def recoded(picture: Path) -> bytes:
    """A picture that is darker than the given one."""
    import cv2

    image = cv2.imread(str(picture))
    assert image is not None
    return bytes(cv2.imencode(picture.suffix, image // 2)[1])


def test_pictures_without_files_are_known_by_their_pixels(tiny_folder: Path, folder: Path, made: list[Seeing]) -> None:
    log = open_log(tiny_folder)
    stream = log.streams["front"]
    bare = log.changed(streams={**log.streams, "front": replace_read(stream, stream.read, encoded=False)})
    (_, one), (_, other) = look(bare), look(bare)
    assert len(made[-1].seen) == 0
    assert_same_observations(one, other)


def test_detectors_that_do_not_say_what_they_depend_on_are_asked_again(
    tiny_folder: Path, folder: Path, made: list[Seeing], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(STATED, "cache_key", None)
    log = open_log(tiny_folder)
    runs = [look(log)[0], look(log)[0], look(log, config(detect={"name": "labels"}))[0]]
    assert [len(d.seen) for d in made] == [TICKS, TICKS]
    assert [run.detectors.cache for run in runs] == [None, None, None]
    assert not folder.exists()


def test_a_function_is_asked_once_where_it_states_what_it_depends_on(tiny_folder: Path, folder: Path) -> None:
    asked: list[int] = []

    def find(image: Any) -> list[tuple[float, float, float, float, float, str]]:
        asked.append(len(image))
        return [(10.0, 20.0, 60.0, 80.0, 0.9, "car")]

    log = open_log(tiny_folder)
    for expected in (TICKS, 2 * TICKS):
        observe_log(start(log, config(), detector=find))
        assert len(asked) == expected
    find.cache_key = "find 1"  # type: ignore[attr-defined]
    for min_score, expected in ((0.0, 3 * TICKS), (0.0, 3 * TICKS), (0.5, 4 * TICKS)):
        detect = {"name": "seeing", "min_score": min_score}
        observe_log(start(log, config(detect=detect), detector=find))
        assert len(asked) == expected


def test_a_folder_that_cannot_be_used_costs_the_cache_alone(
    tiny_folder: Path, folder: Path, made: list[Seeing]
) -> None:
    folder.parent.mkdir()
    folder.write_text("a file")
    log = open_log(tiny_folder)
    run, observations = look(log)
    assert_same_observations(look(log, cache=False)[1], observations)
    assert run.detectors.cache is not None
    assert run.detectors.cache.kept == 0
    assert str(folder) in str(run.detectors.cache.problem)


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


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="signals of POSIX")
def test_a_run_that_was_killed_goes_on_where_it_was(tiny_folder: Path, folder: Path, made: list[Seeing]) -> None:
    code = (
        "import os, signal, sys, test_detection_cache as t\n"
        "from log2sim import open_log\n"
        "from log2sim.files import plugins\n"
        "def kill(seeing):\n"
        "    if len(seeing.seen) == 4: os.kill(os.getpid(), signal.SIGKILL)\n"
        "t.STATED['before'] = kill\n"
        "create = lambda log, **_: t.Seeing(log)\n"
        "sys.modules['seeing_package'] = sys.modules['__main__']\n"
        "plugins.BUILT_IN['detector']['seeing'] = 'seeing_package:create'\n"
        "t.look(open_log(sys.argv[1]))\n"
    )
    ended = subprocess.run(
        [sys.executable, "-c", code, tiny_folder], cwd=ROOT / "tests", env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert ended.returncode == -signal.SIGKILL
    run, _ = look(open_log(tiny_folder))
    assert run.detectors.cache is not None
    assert (run.detectors.cache.found, len(made[-1].seen)) == (4, TICKS - 4)


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


def test_the_key_of_a_network_changes_with_its_weights_and_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    onnx = pytest.importorskip("onnx", reason="building test models needs onnx")
    from test_detect_onnx import LOG, save_model, yolov8, yolox

    from log2sim.perception.detect.detectors import create_detector

    def key(path: Path, **settings: Any) -> str | None:
        return create_detector(str(path), LOG, **settings).cache_key  # type: ignore[attr-defined, no-any-return]

    one, same = (save_model(tmp_path / f"{n}.onnx", {"o": yolox()}) for n in "ab")
    other = save_model(tmp_path / "c.onnx", {"o": yolov8()})
    changed = [key(one, min_score=0.3), key(one, tiles=2), key(one, max_overlap=0.6), key(other), key(one)]
    assert len(set(changed)) == 5
    assert None not in changed
    assert key(one) == key(same)  # the name of a file says nothing
    model = onnx.load(one)
    big = onnx.helper.make_tensor("w", 1, [600], np.zeros(600, np.float32).tobytes(), raw=True)
    model.graph.initializer.append(big)
    onnx.save(model, tmp_path / "d.onnx", save_as_external_data=True, location="d.bin", size_threshold=0)
    assert key(tmp_path / "d.onnx") is None  # its weights are in another file
    assert open_cache(create_detector(str(tmp_path / "d.onnx"), LOG)) is None


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


def sealed(counts: tuple[int, ...], body: bytes) -> bytes:
    """An entry with a right check sum, whatever is in it."""
    import hashlib

    rest = struct.pack("=6I", *counts) + body
    return struct.pack("=8s16s16s", b"l2sfound", KEY, hashlib.blake2b(rest, digest_size=16).digest()) + rest


THUMBNAIL = np.ones((1, 1), np.float32).tobytes()


def test_a_right_check_sum_does_not_make_a_wrong_entry_right() -> None:
    box = np.zeros(4).tobytes()
    word = np.array(["car"], "<U3").tobytes()
    assert (
        from_bytes(sealed((1, 3, 0, 1, 1, 0), box + np.array([0.5]).tobytes() + word + THUMBNAIL), KEY, "", 0)
        is not None
    )
    wrong = {
        "more boxes than bytes": sealed((9000, 3, 0, 1, 1, 0), b""),
        "more boxes than may be": sealed((2**32 - 1, 3, 0, 1, 1, 0), b""),
        "a huge thumbnail": sealed((0, 3, 0, 2**31, 2**31, 0), b""),
        "no thumbnail": sealed((0, 3, 0, 0, 0, 0), b""),
        "long words": sealed((1, 10**9, 0, 1, 1, 0), b""),
        "a score of 2": sealed((1, 3, 0, 1, 1, 0), box + np.array([2.0]).tobytes() + word + THUMBNAIL),
        "a score that is none": sealed((1, 3, 0, 1, 1, 0), box + np.array([np.nan]).tobytes() + word + THUMBNAIL),
        "a letter that is none": sealed((1, 3, 0, 1, 1, 0), box + np.array([0.5]).tobytes() + b"\xff" * 12 + THUMBNAIL),
        "a crop without a light": sealed((0, 3, 0, 1, 1, 1), THUMBNAIL),
        "an empty crop": sealed((0, 3, 1, 1, 1, 1), np.zeros(5).tobytes() + THUMBNAIL + bytes(4) + bytes(40)),
        "nothing": b"",
        "another file": b"PK\3\4" * 50,
    }
    assert [what for what, content in wrong.items() if from_bytes(content, KEY, "", 0) is not None] == []


def test_what_would_not_come_back_is_not_kept() -> None:
    kept = PictureFindings(Detections.empty(), np.ones((2, 2), np.float32))
    assert to_bytes(kept, KEY) is not None
    single = replace(Detections.empty(), box_px=np.zeros((0, 4), np.float32))
    assert to_bytes(replace(kept, detections=single), KEY) is None  # type: ignore[arg-type]
    assert to_bytes(replace(kept, thumbnail=np.zeros((0, 0), np.float32)), KEY) is None
    far = replace(Detections.empty(), traffic_lights=np.full((1, 5), np.inf))
    assert to_bytes(replace(kept, detections=far), KEY) is None


def test_the_keys_hold_the_code_that_they_are_named_after() -> None:
    package = Path(detection_cache.__file__).resolve().parents[1]
    assert all(list(package.glob(pattern)) for pattern in detection_cache.SOURCES)
