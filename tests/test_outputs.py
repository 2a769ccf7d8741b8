"""Outputs appear whole, together and over nobody else's; what dead runs left is removed; signals end as Ctrl-C does."""

from __future__ import annotations

import contextvars
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
from worlds import tiny_toml

from log2sim.cli.shared import Ended, TolerantStream, ending_by_signals
from log2sim.errors import ConfigError
from log2sim.export import exporters
from log2sim.files import outputs
from log2sim.files import outputs as output_folders
from log2sim.files.documents import check_targets, refuse_below_file, replaced, write_json
from log2sim.files.outputs import (
    claim,
    holding_claims,
    replaced_folder,
    temporary_beside,
    together,
)

DIES = """
import os, sys
from pathlib import Path
from log2sim.files.documents import replaced
from log2sim.files.outputs import temporary_beside
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
    with holding_claims():
        check_targets(out, overwrite=False)
        out.write_text("of another")
        with pytest.raises(ConfigError, match=r"a\.json: another run has written it meanwhile"):
            write_json(out, 1)
        assert out.read_text() == "of another"
        check_targets(out, overwrite=True)
    assert names(tmp_path) == ["a.json"]
    write_json(out, 2)  # a library call replaces as it always did
    assert out.read_text() == "2\n"
    with holding_claims():
        check_targets(tmp_path / "b.json", overwrite=False)
        write_json(tmp_path / "b.json", 3)
        write_json(tmp_path / "b.json", 4)  # its own
    assert (tmp_path / "b.json").read_text() == "4\n"
    assert names(tmp_path) == ["a.json", "b.json"]


def test_without_hard_links_files_are_renamed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def no_links(*_: object) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(outputs.os, "link", no_links)
    with holding_claims():
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


@pytest.mark.matrix
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("end", ["> /dev/full", ">&-", "| true", "2> /dev/full > /dev/full"])
def test_output_that_nobody_can_read_changes_no_exit_code(end: str) -> None:
    command = f"{sys.executable} -m log2sim config {end}"
    ran = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


PRINTS = """
import os, sys
from log2sim.cli.shared import tolerating_lost_output
with tolerating_lost_output():
    with open(sys.argv[1], "w") as file:
        os.write(1, b"of a library")
        os.write(2, b"of a library")
        file.write("result")
"""


@pytest.mark.skipif(os.name == "nt", reason="no such shell there")
@pytest.mark.parametrize("end", [">&-", "2>&-", "<&- >&- 2>&-"])
def test_what_libraries_print_never_gets_into_an_output(tmp_path: Path, end: str) -> None:
    """A file takes the lowest free number, which would be that of the closed stream."""
    command = ["bash", "-c", f'"$0" -c "$1" "$2" {end}', sys.executable, PRINTS, str(tmp_path / "out")]
    subprocess.run(command, check=True, capture_output=True)
    assert (tmp_path / "out").read_text() == "result"


@pytest.mark.slow
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

    monkeypatch.setattr("log2sim.files.documents.put", fails)
    ran = run(*command, *options)
    assert ran.code == (130 if isinstance(problem, KeyboardInterrupt) else 2)
    assert isinstance(problem, KeyboardInterrupt) or "s.json: cannot be written: No space left on device" in ran.line
    assert names(out) == []
    monkeypatch.undo()
    assert run(*command, *options).code == 0
    assert names(out) == ["r.json", "s.json", "t.png"]


def test_a_disk_that_is_full_during_an_export_names_the_file(
    tiny_scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("log2sim.export.xml_text.write", full)
    monkeypatch.setattr("log2sim.export.csv_table.csv.writer", full)
    ran = run("export", tiny_scenario, "--to", "csv", "--out", tmp_path / "o")
    assert ran.code == 2
    assert "o/agents.csv: cannot be written: No space left on device" in ran.line
    assert names(tmp_path) == []


COMMANDS: dict[str, tuple[str, ...]] = {
    "reconstruct": ("reconstruct", "no.log", "--out", "{out}/s.json"),
    "report": ("reconstruct", "no.log", "--out", "{free}/s.json", "--report", "{out}/r.json"),
    "topdown": ("reconstruct", "no.log", "--out", "{free}/s.json", "--topdown", "{out}/t.png"),
    "detect": ("detect", "no.log", "--out", "{out}/b.json"),
    "bench": ("bench", "no.log", "--out", "{out}"),
    "convert": ("convert", "no.log", "--out", "{out}/log"),
    "inspect": ("inspect", "no.log", "--overlay", "{out}/o.png"),
    "synth": ("synth", "{scene}", "--out", "{out}/log"),
    "traffic": ("synth", "--traffic", "vehicle", "--out", "{out}/data"),
    "export": ("export", "no.json", "--to", "csv", "--out", "{out}/csv"),
    "edit": ("edit", "no.json", "--out", "{out}/e.json"),
    "replay": ("replay", "no.json", "--out", "{out}/r.json"),
    "plot": ("plot", "no.json", "--out", "{out}/p.png"),
    "view": ("view", "no.json", "--out", "{out}/v.html"),
    "evaluate": ("evaluate", "no.json", "--truth", "no.json", "--out", "{out}/m.json"),
    "import": ("import", "no.xosc", "--out", "{out}/i.json"),
}


@pytest.mark.skipif(not os.path.isdir("/proc/self"), reason="no folder that nobody can write in")
@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_refuses_a_folder_that_cannot_be_written_before_its_work(command: str, tmp_path: Path) -> None:
    """Its input is not even there, which it does not come to see."""
    scene = tmp_path / "scene.toml"
    scene.write_text(tiny_toml())
    free = tmp_path / "free" / "deep"
    ran = run(*(a.format(out="/proc/self/new", free=free, scene=scene) for a in COMMANDS[command]))
    assert ran.code == 2
    assert "/proc/self/new" in ran.line
    assert "cannot be written: " in ran.line
    assert names(tmp_path) == ["scene.toml"]


HOLDS = """
import sys, time
from pathlib import Path
from log2sim.files.documents import {check}
from log2sim.files.outputs import holding_claims
with holding_claims():
    {check}(Path(sys.argv[1]), overwrite=False)
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="no such locks there")
@pytest.mark.parametrize("command", ["edit", "convert", "export", "synth", "traffic"])
def test_of_two_runs_the_second_is_refused_before_its_work(command: str, tmp_path: Path) -> None:
    scene = tmp_path / "scene.toml"
    scene.write_text(tiny_toml())
    out = tmp_path / "new"
    arguments = [a.format(out=out, scene=scene, free=tmp_path) for a in COMMANDS[command]]
    target = arguments[arguments.index("--out") + 1]
    code = HOLDS.format(check="check_targets" if command == "edit" else "check_folder")
    with subprocess.Popen([sys.executable, "-c", code, target], stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout is not None
        assert other.stdout.readline() == "held\n"
        ran = run(*arguments)
        assert ran.code == 2
        assert f"{target}: another run is about to write it" in ran.line
        other.kill()
    if not command.startswith(("synth", "traffic")):  # a killed run holds no claim: now the missing input is told
        assert "no.log" in run(*arguments).line or "no.json" in run(*arguments).line
        assert names(out) == []


def test_a_claim_is_taken_once_and_leaves_no_folder(tmp_path: Path) -> None:
    target = tmp_path / "a" / "b" / "c.json"
    with holding_claims():
        claim(target, overwrite=False)
        claim(target, overwrite=False)
        assert names(target.parent) == [".c.json.lock"]
    assert names(tmp_path) == []
    with holding_claims():
        claim(target, overwrite=False)
        target.write_text("x")
    assert names(target.parent) == ["c.json"]
    claim(target, overwrite=False)  # a library has no claims
    assert names(target.parent) == ["c.json"]


def test_with_overwrite_another_run_does_not_matter(tmp_path: Path) -> None:
    contexts = [contextvars.copy_context() for _ in range(3)]
    holders = [holding_claims() for _ in contexts]
    for context, holder in zip(contexts, holders):
        context.run(holder.__enter__)
    contexts[0].run(claim, tmp_path / "a", overwrite=False)
    contexts[1].run(claim, tmp_path / "a", overwrite=True)
    with pytest.raises(ConfigError, match="another run is about to write it"):
        contexts[2].run(claim, tmp_path / "a", overwrite=False)
    for context, holder in zip(contexts, holders):
        context.run(holder.__exit__, None, None, None)
    assert names(tmp_path) == []


def test_a_full_disk_names_the_file_of_a_folder(tmp_path: Path) -> None:
    target = tmp_path / "log"
    with pytest.raises(ConfigError) as caught, replaced_folder(target, overwrite=False) as folder:  # noqa: PT012
        (folder / "front").mkdir()
        (folder / "front" / "0.jpg").write_text("x")
        raise OSError(28, "No space left on device")
    assert str(caught.value) == f"{target}/front/0.jpg: cannot be written: No space left on device"
    with pytest.raises(ConfigError) as caught, replaced_folder(target, overwrite=False) as folder:  # noqa: PT012
        (folder / "front").mkdir()
        (folder / "front").write_text("x")
    assert str(caught.value) == f"{target}/front: cannot be written: Is a directory"
    with pytest.raises(ConfigError) as caught, replaced_folder(target, overwrite=False) as folder:
        raise ConfigError(f"{folder}/truth.json: cannot be written: No space left on device")
    assert str(caught.value) == f"{target}/truth.json: cannot be written: No space left on device"
    assert names(tmp_path) == []


def test_a_folder_that_another_run_wrote_meanwhile_is_kept(tmp_path: Path) -> None:
    target = tmp_path / "log"

    def write(folder: Path) -> None:
        (folder / "own").write_text("x")
        target.mkdir()
        (target / "of another").write_text("x")

    with (
        pytest.raises(ConfigError, match="another run has written"),
        replaced_folder(target, overwrite=False) as folder,
    ):
        write(folder)
    assert names(target) == ["of another"]
    assert names(tmp_path) == ["log"]
    with replaced_folder(target, overwrite=True) as folder:
        (folder / "own").write_text("x")
    assert names(target) == ["own"]
    assert names(tmp_path) == ["log"]


def test_a_folder_that_cannot_be_placed_leaves_the_earlier_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "log"
    target.mkdir()
    (target / "a").write_text("x")
    sound = Path.rename

    def fails(self: Path, new: Path) -> Path:
        if new == target and ".old" not in self.name:
            raise OSError(28, "No space left on device", str(self))
        return sound(self, new)

    monkeypatch.setattr(Path, "rename", fails)
    monkeypatch.setattr(output_folders, "exchange_names", lambda one, other: False)  # as on other systems
    with pytest.raises(ConfigError, match="log: cannot be written: No space"), replaced_folder(target, overwrite=True):
        pass
    assert names(target) == ["a"]
    assert names(tmp_path) == ["log"]


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="names are exchanged at once on Linux")
def test_a_folder_that_is_replaced_is_there_at_every_moment(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    target = tmp_path / "log"
    target.mkdir()
    (target / "old").write_text("x")
    monkeypatch.setattr(Path, "rename", lambda self, new: pytest.fail(f"{self} is renamed"))
    seen = []
    sound = output_folders.exchange_names

    def watched(one: Path, other: Path) -> bool:
        seen.append((names(one), names(other)))
        done = sound(one, other)
        seen.append((names(one), names(other)))
        return done

    monkeypatch.setattr(output_folders, "exchange_names", watched)
    with replaced_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("x")
    assert seen == [(["new"], ["old"]), (["old"], ["new"])]
    assert names(target) == ["new"]
    assert names(tmp_path) == ["log"]


def test_names_are_exchanged_or_nothing_happens(tmp_path: Path) -> None:
    assert not output_folders.exchange_names(tmp_path / "none", tmp_path / "nothing")
    assert names(tmp_path) == []


def test_what_a_run_put_aside_and_died_is_kept_until_a_new_folder_is_there(tmp_path: Path) -> None:
    target, aside = tmp_path / "log", tmp_path / ".log.0123abcd.old"
    (aside / "deep").mkdir(parents=True)
    with pytest.raises(ConfigError, match="broken"), replaced_folder(target, overwrite=True):
        raise ConfigError("broken")
    assert names(tmp_path) == [aside.name]
    with replaced_folder(target, overwrite=True) as folder:
        (folder / "new").write_text("x")
    assert names(tmp_path) == ["log"]


def test_files_of_an_export_replace_none_of_another_run(
    tiny_scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "o"
    out.mkdir()
    sound = exporters.place_all

    def late(files: list[tuple[Path, Path]]) -> None:
        files[-1][1].write_text("of another")
        sound(files)

    monkeypatch.setattr(exporters, "place_all", late)
    ran = run("export", tiny_scenario, "--to", "csv", "--out", out)
    assert ran.code == 2
    assert "another run has written it meanwhile" in ran.line
    assert [p.read_text() for p in out.iterdir()] == ["of another"]


def test_a_new_folder_of_an_export_replaces_none_of_another_run(
    tiny_scenario: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "o"
    sound = Path.rename

    def late(self: Path, new: Path) -> Path:
        out.mkdir()
        (out / "agents.csv").write_text("of another")
        return sound(self, new)

    monkeypatch.setattr(Path, "rename", late)
    ran = run("export", tiny_scenario, "--to", "csv", "--out", out)
    assert ran.code == 2
    assert "another run has written it meanwhile" in ran.line
    assert [p.read_text() for p in out.iterdir()] == ["of another"]
    assert names(tmp_path) == ["o"]
