"""Bad input through the command line: one clear line, the right exit code, no traceback, nothing half-written."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command_line import Ran, names, run
from plain_settings import AGENTS_ONLY

from log2sim.errors import LogError
from log2sim.logs.opening import find_reader

Change = Callable[[Path], Any]


def manifest(change: Callable[[dict[str, Any]], Any]) -> Change:
    return document("log.json", change)


def document(name: str, change: Callable[[dict[str, Any]], Any]) -> Change:
    def apply(folder: Path) -> None:
        value = json.loads((folder / name).read_text())
        change(value)
        (folder / name).write_text(json.dumps(value))

    return apply


def line(name: str, number: int, text: str) -> Change:
    def apply(folder: Path) -> None:
        lines = (folder / name).read_text().split("\n")
        lines[number - 1] = text
        (folder / name).write_text("\n".join(lines))

    return apply


def replaced(name: str, old: str, new: str) -> Change:
    def apply(folder: Path) -> None:
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1))

    return apply


def sweep(factor: float, keep: int | None = None, only: str = "*") -> Change:
    def apply(folder: Path) -> None:
        for file in (folder / "top").glob(f"{only}.npz"):
            data = dict(np.load(file))
            np.savez(file, xyz_m=data["xyz_m"][:keep] * factor, t_offset_ns=data["t_offset_ns"][:keep])

    return apply


def cut_images(folder: Path) -> None:
    for file in (folder / "front").glob("*.jpg"):
        file.write_bytes(file.read_bytes()[:-300])


def link_out(folder: Path) -> None:
    secret = folder.parent / "secret.jpg"
    secret.write_bytes(b"x")
    (folder / "front/000001.jpg").unlink()
    (folder / "front/000001.jpg").symlink_to(secret)


def link_loop(folder: Path) -> None:
    (folder / "front/000001.jpg").unlink()
    (folder / "front/000001.jpg").symlink_to("000001.jpg")


def reconstruct(folder: Path, *options: object, log: Path | None = None) -> Ran:
    """Reconstruct into `out/` beside the log; on an error nothing may be there."""
    out = folder.parent / "out"
    out.mkdir(exist_ok=True)
    command = f"reconstruct '{log or folder}' --out {out}/s.json --report {out}/r.json --detector labels"
    ran = run(command, *AGENTS_ONLY, *options)
    if ran.code != 0:
        assert names(out) == []
    return ran


FIRST_NS = 1_700_000_000_030_000_000

# change, options, exit code, words of the message
LOG_FAULTS: dict[str, tuple[Change, tuple[str, ...], int, list[str]]] = {
    "unknown format": (lambda f: None, ("--format", "kiti"), 2, ["unknown log format 'kiti'", "did you mean 'kitti'", "pandaset"]),
    "format of another log": (lambda f: None, ("--format", "pandaset"), 3, ["holds no sequence of format 'pandaset'", "expected"]),
    "no log at all": (lambda f: (f / "log.json").unlink(), (), 3, ["no known log format", "log.json", "--format"]),
    "broken manifest": (lambda f: (f / "log.json").write_text('{"log_version":'), (), 3, ["log.json", "line 1", "column"]),
    "overflow in the calibration": (replaced("log.json", "1.7", "1e400"), (), 3, ["sensors[0].translation_m[0] is 1e400", "finite"]),
    "place beyond the Earth": (replaced("log.json", "1.7", "1e300"), (), 3, ["log.json", "sensors[0].translation_m[0]", "maximum"]),
    "zero byte in a path": (manifest(lambda m: m["sensors"][0].update(index="a\0b")), (), 3, ["sensors[0].index", "null byte"]),
    "symbolic link": (link_out, (), 3, ["front/index.csv, line 3", "'file'", "leaves the log folder"]),
    "loop of links": (link_loop, (), 3, ["front/index.csv, line 3", "'file'", "loop"]),
    "pose beyond the Earth": (line("ego/poses.csv", 5, f"{FIRST_NS},1e200,0,0,1,0,0,0"), (), 3, ["ego/poses.csv, line 5", "'x_m'", "1e200"]),
    "missing poses": (lambda f: (f / "ego/poses.csv").unlink(), (), 3, ["ego/poses.csv", "no such file"]),
    "no image readable": (cut_images, ("--topdown", "{out}/t.png"), 3,
                          ["stream 'front'", "none of the", ".jpg (stamp 17000000", "log2sim validate"]),
    "no sweep readable": (lambda f: [p.write_bytes(b"x") for p in (f / "top").glob("*.npz")], (), 3,
                          ["stream 'top'", "none of the", "000000.npz", "not a readable sweep"]),
    "only empty clouds": (sweep(1.0, keep=0), (), 3, ["stream 'top'", "none of the", "no finite point", "stamp 17000000001"]),
    "no labels": (manifest(lambda m: m.pop("labels")), (), 2, ["has no labeled boxes", "ssd-mobilenet-v2"]),
    "unknown camera": (lambda f: None, ("--cameras", "frnt"), 2, ["--cameras", "'frnt'", "did you mean 'front'"]),
    "no camera": (lambda f: None, ("--cameras", " , "), 2, ["--cameras", "is empty"]),
    "no time left": (lambda f: None, ("--start", "100"), 2, ["--start", "no frame of 'front'", "0.9"]),
    "start text": (lambda f: None, ("--start", "soon"), 2, ["'--start'", "number"]),
    "unknown section": (lambda f: None, ("--set", "detct.name=labels"), 2, ["--set detct.name=labels", "did you mean 'detect'"]),
    "two lines in a value": (lambda f: None, ("--set", "sync.reference=1\nseed=2"), 2, ["sync.reference"]),
    "broken TOML": (lambda f: (f.parent / "c.toml").write_text("a = ["), ("--config", "{out}/../c.toml"), 2, ["c.toml", "not valid TOML"]),
    "missing TOML": (lambda f: None, ("--config", "none.toml"), 2, ["none.toml", "no such config file"]),
    "unreadable model": (lambda f: (f.parent / "m.onnx").write_bytes(b"hello"), ("--detector", "{out}/../m.onnx"), 2, ["m.onnx", "not a model"]),
    "missing model": (lambda f: None, ("--detector", "none.onnx"), 2, ["none.onnx", "no such file"]),
    "unknown detector": (lambda f: None, ("--detector", "label"), 2, ["'label'", "did you mean 'labels'", ".onnx"]),
    "unknown option": (lambda f: None, ("--detektor", "x"), 2, ["--detektor", "log2sim reconstruct --help"]),
}  # fmt: skip


@pytest.mark.matrix
@pytest.mark.parametrize("fault", LOG_FAULTS)
def test_a_bad_log_or_setting_is_one_clear_line_and_writes_nothing(log_folder: Path, fault: str) -> None:
    change, options, code, words = LOG_FAULTS[fault]
    change(log_folder)
    ran = reconstruct(log_folder, "--quiet", *(o.format(out=log_folder.parent / "out") for o in options))
    assert ran.code == code
    assert ran.out == ""
    # Words that the user typed may hold a line end.
    message = Ran(ran.code, "", ran.err.replace("1\nseed=2", "1 seed=2")).line
    assert all(word in message for word in words), message


def report_of(folder: Path) -> dict[str, Any]:
    return json.loads((folder.parent / "out/r.json").read_text())


RECORD_FAULTS: dict[str, tuple[Change, tuple[str, ...], str, list[str]]] = {
    "image": (lambda f: (f / "front/000003.jpg").write_bytes((f / "front/000003.jpg").read_bytes()[:-300]), ("--topdown", "{out}/t.png"),
              "front", ["000003.jpg", f"stamp {FIRST_NS + 300_000_000}", "JPEG"]),
    "missing image": (lambda f: (f / "front/000003.jpg").unlink(), ("--topdown", "{out}/t.png"), "front", ["000003.jpg", "cannot be read"]),
    "sweep": (lambda f: (f / "top/000000.npz").write_bytes(b"x"), (), "top", ["000000.npz", "not a readable sweep"]),
    "empty cloud": (sweep(1.0, keep=0, only="000004"), (), "top", ["stamp 1700000000500000000", "no finite point"]),
    "NaN cloud": (sweep(np.nan, only="000004"), (), "top", ["stamp 1700000000500000000", "no finite point"]),
}  # fmt: skip


@pytest.mark.matrix
@pytest.mark.parametrize("fault", RECORD_FAULTS)
def test_one_bad_record_is_counted_and_the_run_goes_on(log_folder: Path, fault: str) -> None:
    change, options, stream, words = RECORD_FAULTS[fault]
    change(log_folder)
    ran = reconstruct(log_folder, *(o.format(out=log_folder.parent / "out") for o in options))
    assert ran.code == 0, ran.err
    report = report_of(log_folder)
    assert report["agents"]["total"] >= 2
    assert list(report["unreadable"]) == [stream]
    assert report["unreadable"][stream]["count"] == 1
    assert all(word in report["unreadable"][stream]["first"] for word in words)
    note = next(n for n in ran.out.split("\n") if n.startswith("note: "))
    assert stream in note
    assert all(word in note for word in words)
    problems = run("validate", log_folder)
    assert problems.code == 3
    assert "1 problem\n" in problems.err
    assert all(word in problems.err for word in words if "finite" not in word)


@pytest.mark.matrix
@pytest.mark.parametrize(
    ("stamp", "words"),
    [(FIRST_NS + 1, ["front: 1 of 10 records out of order", "sorted"]), (FIRST_NS + 100_000_000, ["front: 1 of 10 records repeat a stamp", "dropped"])],
)  # fmt: skip
def test_a_stamp_out_of_order_is_put_in_place_and_told(log_folder: Path, stamp: int, words: list[str]) -> None:
    line("front/index.csv", 4, f"{stamp},front/000002.jpg")(log_folder)
    ran = reconstruct(log_folder)
    assert ran.code == 0
    note, *boxes = report_of(log_folder)["log"]["notes"]
    assert all(word in note for word in (*words, str(stamp)))
    assert all("boxes in images of 'front' are at stamps of no frame" in line for line in boxes)
    assert f"note: {note}" in ran.out
    assert run("validate", log_folder).code == 3


def agent(change: Callable[[dict[str, Any]], Any]) -> Callable[[dict[str, Any]], Any]:
    return lambda d: change(d["agents"][1])


SCENARIO_FAULTS: dict[str, tuple[Callable[[dict[str, Any]], Any], list[str]]] = {
    "version": (lambda d: d.update(scenario_version=2), ["scenario_version is 2", "expected 1"]),
    "no version": (lambda d: d.pop("scenario_version"), ["is no scenario file of log2sim"]),
    "NaN": (agent(lambda a: a["waypoints"]["x_m"].__setitem__(3, float("nan"))), ["agents[1].waypoints.x_m[3] is NaN", "finite number"]),
    "infinity": (agent(lambda a: a["size_m"].update(length=float("-inf"))), ["agents[1].size_m.length is -Infinity"]),
    "null": (agent(lambda a: a["waypoints"]["x_m"].__setitem__(3, None)), ["agents[1].waypoints.x_m[3]", "not of type 'number'"]),
    "beyond the Earth": (agent(lambda a: a["waypoints"]["x_m"].__setitem__(3, 1e300)), ["agents[1].waypoints.x_m[3]", "maximum"]),
    "eternity": (agent(lambda a: a["waypoints"]["t_s"].__setitem__(-1, 1e12)), ["agents[1].waypoints.t_s", "maximum"]),
    "columns": (agent(lambda a: a["waypoints"]["x_m"].pop()), ["waypoints.x_m has ", " values, t_s has "]),
    "time runs back": (agent(lambda a: a["waypoints"]["t_s"].__setitem__(3, 0.0)), ["waypoints.t_s does not increase at index 3"]),
    "category": (agent(lambda a: a.update(category="ufo")), ["category 'ufo'", "pedestrian"]),
    "size": (agent(lambda a: a["size_m"].update(length=0)), ["agents[1].size_m.length"]),
    "id twice": (agent(lambda a: a.update(id="ego")), ["agent 'ego'", "twice"]),
    "no map": (lambda d: d.pop("map"), ["'map' is a required property"]),
}  # fmt: skip


@pytest.mark.matrix
@pytest.mark.parametrize("fault", SCENARIO_FAULTS)
def test_a_bad_scenario_is_one_clear_line_in_every_command(tmp_path: Path, tiny_scenario: Path, fault: str) -> None:
    change, words = SCENARIO_FAULTS[fault]
    broken = json.loads(tiny_scenario.read_text())
    change(broken)
    (tmp_path / "s.json").write_text(json.dumps(broken))
    for command in (
        ("replay", tmp_path / "s.json", "--out", tmp_path / "x.json"),
        ("plot", tmp_path / "s.json", "--out", tmp_path / "x.png"),
        ("evaluate", tmp_path / "s.json", "--truth", tiny_scenario, "--out", tmp_path / "x.json"),
        ("evaluate", tiny_scenario, "--truth", tmp_path / "s.json", "--out", tmp_path / "x.json"),
        ("validate", tmp_path / "s.json"),
    ):
        ran = run(*command)
        assert ran.code == 3, command
        assert all(word in ran.line for word in ("s.json", *words)), ran.err
        assert names(tmp_path) == ["s.json"]


def test_outputs_that_cannot_be_written_are_refused_before_the_work(log_folder: Path, tiny_scenario: Path) -> None:
    base = log_folder.parent
    (base / "file").write_text("mine")
    (base / "folder").mkdir()
    before = names(base)
    for out, options, words in [
        ("file", (), ["file: exists already", "--overwrite"]),
        ("folder", ("--overwrite",), ["folder: is a folder", "name of a file"]),
        ("file/s.json", (), ["file is a file and not a folder"]),
        ("a.json", ("--report", base / "a.json"), ["a.json", "two files"]),
        ("a.json", ("--report", base / "file/r.json"), ["file is a file"]),
        ("a.json", ("--report", base / "file"), ["file: exists already"]),
    ]:
        ran = run("reconstruct", log_folder, "--out", base / out, "--detector", "labels", *options)
        assert ran.code == 2
        assert all(word in ran.line for word in words), ran.err
        assert names(base) == before
    assert (base / "file").read_text() == "mine"
    for command in (
        ("replay", tiny_scenario),
        ("evaluate", tiny_scenario, "--truth", tiny_scenario),
        ("plot", tiny_scenario),
    ):
        ran = run(*command, "--out", base / "file" / "x.png")
        assert ran.code == 2
        assert "file is a file" in ran.line
    long = run("reconstruct", log_folder, "--out", base / ("x" * 300), "--detector", "labels", "--quiet")
    assert long.code in (2, 3)
    assert "name too long" in long.line
    assert names(base) == before


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("replay", "{s}", "--mode", "warp"), 2, ["'warp'", "pid", "exact"]),
        (("replay", "{s}", "--model", "hover"), 2, ["'hover'", "kinematic"]),
        (("replay", "{s}", "--dt", "nan"), 2, ["dt", "nan"]),
        (("replay", "{s}", "--ego", "nothing"), 2, ["'nothing'", "module:attribute"]),
        (("replay", "{s}", "--ego", "no_such_module:x"), 2, ["no_such_module", "cannot be imported"]),
        (("replay", "none.json"), 3, ["none.json", "no such file"]),
        (("replay", "."), 3, [".", "is a folder; expected a JSON file"]),
        (("plot", "{s}", "--out", "x.jpeg"), 2, [".png", ".mp4", "'.jpeg'"]),
        (("plot", "{s}", "--out", "x.png", "--replay", "{s}"), 3, ["replay_version"]),
        (("evaluate", "{s}", "--truth", "{s}", "--range", "-1"), 2, ["range", "-1"]),
        (("evaluate", "{s}", "--truth", "{s}", "--categories", "cars"), 2, ["'cars'", "did you mean 'car'"]),
        (("edit", "{s}", "--out", "x"), 2, ["no edits"]),
        (("edit", "{s}", "--out", "x", "--shift", "ego"), 2, ["--shift ego: expected an agent, '=' and a number"]),
        (("edit", "{s}", "--out", "x", "--speed", "ego=0"), 2, ["expected a number from 0.01 to 100"]),
        (("edit", "{s}", "--out", "x", "--lateral", "ego=nan"), 2, ["nan m for agent 'ego'"]),
        (("convert", "{log}", "--out", "x", "--cameras", "frnt"), 2, ["no camera 'frnt' (did you mean 'front'?)"]),
        (("convert", "{log}", "--out", "x", "--cameras", ","), 2, ["--cameras: is empty"]),
        (("convert", "{log}", "--out", "x", "--start", "5"), 2, ["leave no record of 'front'"]),
        (("convert", "{log}", "--out", "x", "--start", "0.5", "--stop", "0.1"), 2, ["leave no record"]),
        (("reconstrct",), 2, ["reconstrct", "Did you mean 'reconstruct'"]),
        (("reconstruct",), 2, ["LOG", "--help"]),
    ],
)
def test_a_wrong_argument_is_one_clear_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, tiny_scenario: Path, tiny_folder: Path, arguments: tuple[str, ...], code: int,
    words: list[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    ran = run(*(a.format(s=tiny_scenario, log=tiny_folder) for a in arguments))
    assert ran.code == code
    assert all(word in ran.line for word in words), ran.err
    assert names(tmp_path) == []


def test_a_traceback_only_with_debug(tmp_path: Path) -> None:
    with pytest.raises(Exception, match="no such folder"):
        run("--debug", "inspect", tmp_path / "none")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("s.json", '{"scenario_version": 1}', "s.json: is a scenario file of log2sim, not a log"),
        ("crossing.toml", "", "crossing.toml: is a TOML file, not a log; `log2sim synth` renders scenes"),
        ("some.json", "{}", "some.json: is a file of no known log format"),
    ],
)
def test_files_of_log2sim_that_are_no_logs_are_named(tmp_path: Path, name: str, text: str, message: str) -> None:
    (tmp_path / name).write_text(text)
    with pytest.raises(LogError, match=re.escape(message)):
        find_reader(tmp_path / name)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LogError, match="is an empty folder"):
        find_reader(tmp_path / "empty")
