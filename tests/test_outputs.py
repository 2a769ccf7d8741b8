"""Outputs appear whole, together and over nobody else's; what dead runs left is removed; signals end as Ctrl-C does."""

from __future__ import annotations

import io
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import names, run

from log2sim import outputs
from log2sim.cli.process import Ended, TolerantStream, ending_by_signals
from log2sim.documents import check_targets, refuse_below_file, replaced, write_json
from log2sim.errors import ConfigError
from log2sim.outputs import refusing_to_replace, temporary_beside, together

DIES = """
import os, sys
from pathlib import Path
from log2sim.documents import replaced
from log2sim.outputs import temporary_beside
with replaced(Path(sys.argv[1]) / "a.json") as temporary:
    temporary.write_text("half")
    folder = temporary_beside(Path(sys.argv[1]) / "a")
    (folder / "deep").mkdir(parents=True)
    os._exit(9)
"""


def test_files_appear_together(tmp_path: Path) -> None:
    with together():
        write_json(tmp_path / "a.json", 1)
        write_json(tmp_path / "b" / "b.json", 2)
        assert not (tmp_path / "a.json").exists()
        assert not (tmp_path / "b" / "b.json").exists()
    assert names(tmp_path) == ["a.json", "b"]
    assert names(tmp_path / "b") == ["b.json"]


@pytest.mark.parametrize("problem", [ValueError("late"), KeyboardInterrupt()], ids=lambda p: type(p).__name__)
def test_after_an_error_none_of_them_appears(tmp_path: Path, problem: BaseException) -> None:
    (tmp_path / "a.json").write_text("before")

    def write() -> None:
        with together():
            write_json(tmp_path / "a.json", 1)
            write_json(tmp_path / "b.json", 2)
            raise problem

    with pytest.raises(type(problem)):
        write()
    assert names(tmp_path) == ["a.json"]
    assert (tmp_path / "a.json").read_text() == "before"


def test_one_that_cannot_be_renamed_takes_the_others_along(tmp_path: Path) -> None:
    def write() -> None:
        with together():
            write_json(tmp_path / "a.json", 1)
            write_json(tmp_path / "b.json", 2)
            (tmp_path / "b.json" / "x").mkdir(parents=True)

    with pytest.raises(ConfigError, match=r"b\.json: cannot be written"):
        write()
    assert names(tmp_path) == ["b.json"]


def test_what_another_run_wrote_meanwhile_is_not_replaced(tmp_path: Path) -> None:
    out = tmp_path / "a.json"
    with refusing_to_replace():
        check_targets(out, overwrite=False)
        out.write_text("of another")
        with pytest.raises(ConfigError, match=r"a\.json: another run has written it meanwhile"):
            write_json(out, 1)
        assert out.read_text() == "of another"
        assert names(tmp_path) == ["a.json"]
        check_targets(out, overwrite=True)
    write_json(out, 2)  # a library call replaces as it always did
    assert out.read_text() == "2\n"
    with refusing_to_replace():
        check_targets(tmp_path / "b.json", overwrite=False)
        write_json(tmp_path / "b.json", 3)
        write_json(tmp_path / "b.json", 4)  # its own
    assert (tmp_path / "b.json").read_text() == "4\n"
    assert names(tmp_path) == ["a.json", "b.json"]


def test_without_hard_links_files_are_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(outputs.os, "link", no_links)
    with refusing_to_replace():
        check_targets(tmp_path / "a.json", tmp_path / "b.json", overwrite=False)
        write_json(tmp_path / "a.json", 1)
        (tmp_path / "b.json").write_text("of another")
        with pytest.raises(ConfigError, match="another run"):
            write_json(tmp_path / "b.json", 1)
    assert names(tmp_path) == ["a.json", "b.json"]
    assert (tmp_path / "b.json").read_text() == "of another"


@pytest.mark.skipif(os.name == "nt", reason="processes are not asked there")
def test_what_a_dead_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    died = subprocess.run([sys.executable, "-c", DIES, str(tmp_path)], check=False)
    assert died.returncode == 9
    left = names(tmp_path)
    assert len(left) == 2
    others = [
        ".a.json",
        ".a.0123abcd.json",
        ".a.00000000-1-00000000.json",
        ".ab.json",
    ]
    living = temporary_beside(tmp_path / "a.json")
    for path in (living, *(tmp_path / name for name in others)):
        path.write_text("x")
    with replaced(tmp_path / "a.json") as temporary:
        temporary.write_text("whole")
    assert names(tmp_path) == sorted(["a.json", living.name, *others])


def test_a_folder_that_may_not_be_written_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    for refuse in (
        lambda: check_targets(tmp_path / "new" / "a.json", overwrite=False),
        lambda: refuse_below_file(tmp_path / "new"),
    ):
        with pytest.raises(ConfigError, match=r"cannot be written: you may not write in the folder"):
            refuse()


def test_a_full_disk_names_the_file(tmp_path: Path) -> None:
    with (
        pytest.raises(ConfigError, match=r"a\.json: cannot be written: No space left on device"),
        replaced(tmp_path / "a.json"),
    ):
        raise OSError(28, "No space left on device")


@pytest.fixture
def handlers() -> Iterator[None]:
    before = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.skipif(os.name == "nt", reason="no such signals there")
@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_signals_that_end_raise_as_an_interrupt_does(handlers: None, name: str) -> None:
    number = getattr(signal, name)
    signal.signal(number, signal.SIG_DFL)
    ended = Ended()

    def end() -> None:
        nonlocal ended
        with ending_by_signals() as ended:
            os.kill(os.getpid(), number)
            time.sleep(1)

    with pytest.raises(KeyboardInterrupt):
        end()
    assert ended.signal == number
    assert signal.getsignal(number) == signal.SIG_DFL
    signal.signal(number, signal.SIG_IGN)
    with ending_by_signals():
        os.kill(os.getpid(), number)  # nohup


@pytest.mark.skipif(os.name == "nt", reason="no such signals there")
def test_a_command_that_is_terminated_leaves_nothing(
    handlers: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def ended(self: object, **_: object) -> str:
        with replaced(tmp_path / "a.json") as temporary:
            temporary.write_text("half")
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(1)
        return ""

    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    monkeypatch.setattr("log2sim.config.Config.to_toml", ended)
    ran = run("config")
    assert ran.code == 143
    assert "log2sim: terminated; no incomplete file was left" in ran.err
    assert names(tmp_path) == []


def test_what_a_terminal_cannot_show_is_escaped() -> None:
    raw = io.BytesIO()
    stream = TolerantStream(io.TextIOWrapper(raw, encoding="ascii", write_through=True))
    stream.write("Zürich → 5\n")
    assert raw.getvalue() == b"Z\\xfcrich \\u2192 5\n"
    TolerantStream(None).write("nobody")
    closed = io.StringIO()
    closed.close()
    TolerantStream(closed).write("nobody")


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("end", ["> /dev/full", ">&-", "| true", "2> /dev/full > /dev/full"])
def test_output_that_nobody_can_read_changes_no_exit_code(end: str) -> None:
    command = f"{sys.executable} -m log2sim config {end}"
    ran = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


@pytest.mark.parametrize(
    "problem", [OSError(28, "No space left on device"), KeyboardInterrupt()], ids=["full", "Ctrl-C"]
)
def test_scenario_report_and_picture_of_a_run_appear_together_or_not_at_all(
    log_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, problem: BaseException
) -> None:
    out = tmp_path / "out"
    out.mkdir()
    command = ("reconstruct", log_folder, "--detector", "labels", "--out", out / "s.json", "--quiet")
    options = ("--report", out / "r.json", "--topdown", out / "t.png")
    sound = outputs.put

    def fails(temporary: Path, target: Path) -> bool:
        if target.name == "s.json":
            raise problem
        return sound(temporary, target)

    monkeypatch.setattr("log2sim.documents.put", fails)
    ran = run(*command, *options)
    assert ran.code == (130 if isinstance(problem, KeyboardInterrupt) else 2)
    assert isinstance(problem, KeyboardInterrupt) or "s.json: cannot be written: No space left on device" in ran.line
    assert names(out) == []
    monkeypatch.undo()
    assert run(*command, *options).code == 0
    assert names(out) == ["r.json", "s.json", "t.png"]


def test_a_disk_that_is_full_during_an_export_names_the_folder(
    tiny_scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("log2sim.export.xml_text.write", full)
    monkeypatch.setattr("log2sim.export.csv_table.csv.writer", full)
    ran = run("export", tiny_scenario, "--to", "csv", "--out", tmp_path / "o")
    assert ran.code == 2
    assert "o: cannot be written: No space left on device" in ran.line
    assert names(tmp_path) == []
