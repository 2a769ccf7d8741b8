"""The first pass of earlier runs: the same results bit for bit, nothing searched or decoded twice, nothing damaged believed."""

from __future__ import annotations

import copy
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from log2sim import Config, open_log, reconstruct
from log2sim.datatypes import Detections, Frame, Log, Stream
from log2sim.errors import LogError, RecordError
from log2sim.files import plugins
from log2sim.files.documents import check
from log2sim.files.packing import pack
from log2sim.files.stages import StageClock
from log2sim.perception import first_pass, run_detectors
from log2sim.perception.first_pass import Observations
from log2sim.perception.records import RecordSource
from log2sim.perception.run_detectors import StageCache, open_cache, open_store
from log2sim.pipeline import observe_log, start
from log2sim.report import Run

ROOT = Path(__file__).resolve().parents[1]
TICKS = 6
# Ticks that are kept together: as many as frames of an empty camera may be skipped in a row.
PART = 3
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
    """All detectors of the name "seeing" that runs make; as few ticks as can be are kept together."""
    monkeypatch.setattr(first_pass, "PART_TICKS", 1)
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
    once = ("recall", "decode", "detect", "cloud", "measure", "pictures")
    out["stages"] = [stage["stage"] for stage in out["stages"] if stage["stage"] not in once]
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
    log, settings = counted(open_log(tiny_folder), reads), config(map={"lanes": True}, calibration={"check": True})
    without = reconstruct(log, settings, cache=False)
    assert not folder.exists()
    first = reconstruct(log, settings)
    reads.clear()
    second = reconstruct(log, settings)
    ticks = without.report["ticks"]
    assert [len(detector.seen) for detector in made] == [ticks, ticks, 0]
    assert reads == []  # nothing was decoded
    assert [r.report["detection_cache"] for r in (without, first, second)] == [
        None,
        {"found": 0, "kept": ticks, "problem": None, "stages": []},
        {"found": ticks, "kept": 0, "problem": None, "stages": ["calibration", "map-poses", "map", "appearance"]},
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
    look(log, config(track={"max_gap_s": 1.0}, smooth={"enabled": False}))
    assert len(made[-1].seen) == 0
    look(log, config(measure={"max_range_m": 30.0}))
    assert len(made[-1].seen) == TICKS
    monkeypatch.setitem(STATED, "cache_key", "seeing 2")
    look(log)
    assert len(made[-1].seen) == TICKS
    monkeypatch.setattr(run_detectors, "software_key", lambda *_: "another version")
    look(log)
    assert len(made[-1].seen) == TICKS


def test_one_changed_picture_is_searched_again(log_folder: Path, folder: Path, made: list[Seeing]) -> None:
    look(open_log(log_folder))
    pictures = sorted(p for p in log_folder.rglob("*") if p.suffix in (".png", ".jpg"))
    pictures[4].write_bytes(pictures[4].read_bytes()[:-30])  # a file that cannot be decoded
    run, observations = look(open_log(log_folder))
    assert len(made[-1].seen) == PART - 1
    assert observations.records is not None
    assert observations.records.summary()["front"]["count"] == 1
    assert run.detectors.cache is not None
    assert run.detectors.cache.found == TICKS - PART
    pictures[4].write_bytes(recoded(pictures[0]))
    look(open_log(log_folder))
    assert len(made[-1].seen) == PART


def test_a_changed_sweep_a_moved_sensor_and_other_poses_are_measured_anew(
    tiny_folder: Path, folder: Path, made: list[Seeing]
) -> None:
    log = open_log(tiny_folder)
    look(log)
    (lidar,) = log.lidars
    read = log.streams[lidar].read

    def moved(i: int) -> Any:
        sweep = read(i)
        return replace(sweep, xyz_m=sweep.xyz_m + 0.01) if i == 3 else sweep

    changed = log.changed(streams={**log.streams, lidar: Stream(lidar, log.streams[lidar].t_ns, moved)})
    run, observations = look(changed)
    assert run.detectors.cache is not None
    assert 0 < run.detectors.cache.found < TICKS
    assert_same_observations(look(changed, cache=False)[1], observations)
    mount = log.lidars[lidar].mount_T_lidar.copy()
    mount[2, 3] += 0.01
    look(log.changed(lidars={lidar: replace(log.lidars[lidar], mount_T_lidar=mount)}))
    assert len(made[-1].seen) == TICKS
    assert log.ego is not None
    look(log.changed(ego=replace(log.ego, map_T_ego=log.ego.map_T_ego + 0.0, extrapolate_s=0.1)))
    assert len(made[-1].seen) == TICKS


def test_what_repeats_is_judged_by_all_before_it_whoever_knows_it(
    tiny_folder: Path, folder: Path, made: list[Seeing]
) -> None:
    log = open_log(tiny_folder)
    stream = log.streams["front"]
    assert stream.encoded is not None
    frozen = Stream("front", stream.t_ns, lambda i: stream.read(min(i, 2)), lambda i: stream.encoded(min(i, 2)))  # type: ignore[misc]
    log = log.changed(streams={**log.streams, "front": frozen})
    runs = [look(log, cache=cache)[1] for cache in (False, True, True)]
    for other in runs[1:]:
        assert_same_observations(runs[0], other)
        assert other.unseen == runs[0].unseen
        assert other.faults == runs[0].faults


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
    assert not list(folder.glob("?/seeing*"))


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
    paths = sorted(folder.glob("?/seeing*"))
    contents = [path.read_bytes() for path in paths]
    for k, (path, content) in enumerate(zip(paths, contents, strict=True)):
        middle = len(content) // 2
        flipped = content[:middle] + bytes([content[middle] ^ 4]) + content[middle + 1 :]
        path.write_bytes([content[:-1], flipped, contents[k - 1], b""][k % 4])
    _, after = look(log)
    assert (len(made[-1].seen), len(paths)) == (TICKS, TICKS // PART)
    assert_same_observations(before, after)
    assert [path.read_bytes() for path in paths] == contents


def test_a_run_that_was_interrupted_goes_on_where_it_was(
    tiny_folder: Path, folder: Path, made: list[Seeing], monkeypatch: pytest.MonkeyPatch
) -> None:
    kept: list[int] = []  # when it happens: what a run that is killed there leaves, too

    def interrupt(seeing: Seeing) -> None:
        if len(seeing.seen) == 4:
            kept.append(len(list(folder.glob("?/seeing*"))))
            raise KeyboardInterrupt

    log = open_log(tiny_folder)
    with monkeypatch.context() as patch:
        patch.setitem(STATED, "before", interrupt)
        with pytest.raises(KeyboardInterrupt):
            look(log)
    assert kept == [1]
    _, resumed = look(log)
    assert len(made[-1].seen) == TICKS - PART
    assert_same_observations(look(log, cache=False)[1], resumed)


# --- stages


def a_stage(shown: dict[int, Any], of: Any = 1) -> tuple[float, list[str]]:
    """Run a stage that adds up the first two of three records; its result and what was known."""

    def read(i: int) -> Any:
        if isinstance(shown[i], str):
            raise RecordError(shown[i])
        return np.full((1, 1, 3), shown[i], np.uint8)

    stream = Stream("front", np.arange(3), read)
    earlier = StageCache(Log("few", "test", {}, {}, {"front": stream}), open_store(), StageClock())

    def add() -> float:
        records = RecordSource(earlier.log)
        return sum(0.0 if (image := records.get("front", i)) is None else float(image.sum()) for i in (0, 1))

    return earlier.known("sum", earlier.log, of, (), add), earlier.found


def test_a_stage_is_known_while_what_it_read_and_was_told_is_the_same(folder: Path) -> None:
    assert a_stage({0: 1, 1: 2, 2: 3}) == (9.0, [])
    assert a_stage({0: 1, 1: 2, 2: 3}) == (9.0, ["sum"])
    assert a_stage({0: 1, 1: 2, 2: 9}) == (9.0, ["sum"])  # it did not look at the last one
    assert a_stage({0: 1, 1: 3, 2: 3}) == (12.0, [])
    assert a_stage({0: 1, 1: 3, 2: 3}, 2) == (12.0, [])
    for _ in range(2):  # what cannot be read is told each time
        assert a_stage({0: 1, 1: "cut", 2: 3}) == (3.0, [])


def test_damaged_and_foreign_results_of_stages_are_made_again(folder: Path) -> None:
    good = {0: 1, 1: 2, 2: 3}
    a_stage(good)
    (own,) = entries(folder)
    a_stage(good, 2)
    other = next(path for path in entries(folder) if path != own)
    name, content = own.name, own.read_bytes()
    strange: list[Any] = [None, 7, [], [name, [["front", 7]], "", 0.0], [name, [["rear", 0]], "", 0.0], [name, 1, 2, 3]]
    for bad in (b"", content[:-1], bytes([*content[:-1], content[-1] ^ 1]), other.read_bytes(), *map(pack, strange)):
        own.write_bytes(bad)
        assert a_stage(good) == (9.0, [])
        assert own.read_bytes() == content
    assert a_stage(good) == (9.0, ["sum"])


# --- keys


def test_the_key_of_a_network_changes_with_its_weights_and_settings(tmp_path: Path) -> None:
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
    assert open_cache(open_store(), create_detector(str(tmp_path / "d.onnx"), LOG), None) is None


def test_the_keys_hold_the_code_that_they_are_named_after() -> None:
    package = Path(run_detectors.__file__).resolve().parents[1]
    assert all(list(package.glob(pattern)) for pattern in run_detectors.STAGE_SOURCES)
