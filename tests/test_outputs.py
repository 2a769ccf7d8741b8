"""Outputs appear whole, together and over nobody else's; what dead runs left is removed; signals end as Ctrl-C does."""

from __future__ import annotations

import contextvars
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from command_line import names, run

from log2sim.errors import ConfigError
from log2sim.files import outputs as output_folders
from log2sim.files.documents import check_targets, replaced, write_json
from log2sim.files.outputs import claim, holding_claims, replaced_folder, temporary_beside, together

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


@pytest.mark.skipif(os.name == "nt", reason="processes are not asked there")
def test_what_a_dead_run_left_is_removed_and_nothing_else(tmp_path: Path) -> None:
    died = subprocess.run([sys.executable, "-c", DIES, str(tmp_path)], check=False)
    assert died.returncode == 9
    left = names(tmp_path)
    assert len(left) == 2
    others = [".a.json", ".a.0123abcd.json", ".a.00000000-1-00000000.json", ".ab.json"]
    living = temporary_beside(tmp_path / "a.json")
    for path in (living, *(tmp_path / name for name in others)):
        path.write_text("x")
    with replaced(tmp_path / "a.json") as temporary:
        temporary.write_text("whole")
    assert names(tmp_path) == sorted(["a.json", living.name, *others])


@pytest.fixture
def handlers() -> Iterator[None]:
    before = {n: signal.getsignal(n) for n in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


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


@pytest.mark.matrix
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no device that is always full")
@pytest.mark.parametrize("end", ["> /dev/full", ">&-", "| true", "2> /dev/full > /dev/full"])
def test_output_that_nobody_can_read_changes_no_exit_code(end: str) -> None:
    command = f"{sys.executable} -m log2sim config {end}"
    ran = subprocess.run(["bash", "-c", f"set -o pipefail; {command}"], capture_output=True, text=True, check=False)
    assert (ran.returncode, ran.stderr) == (0, "")


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
