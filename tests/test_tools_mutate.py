"""The mutation harness tells each class of outcome apart, repeats what it did, and finds nothing in the package."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tools"))
import mutate
from mutation import killing, running
from mutation.binaries import MESSAGES
from mutation.damage import Damage, Mutation
from mutation.running import ROOT, Outcome, Ran, Watch, Watched, measured
from mutation.supervising import ALL, CYCLE, Harness, Row, indices, kind_of, run_many
from mutation.texts import cut_is_visible

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="forks, and reads /proc")
INPUTS, KILLS = 64, 10
SCENARIO_AT = CYCLE.index("scenario")
GOOD = Outcome("reconstruct", 0, "", frozenset(), "other")
SOUND = Outcome("reconstruct", 0, "", frozenset(["note: one"]), "same")
Reader = Callable[[Path, Path], Outcome | None]


def cut_in_half(rng: np.random.Generator, file: Path, place: object) -> Damage:
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return Damage("cut in half", True)


@pytest.fixture(scope="module")
def harness(tmp_path_factory: pytest.TempPathFactory) -> Harness:
    return Harness(tmp_path_factory.mktemp("mutate").resolve(), ["scenario"], (Mutation(cut_in_half),))


def row_of(harness: Harness, reader: Reader, time_limit_s: float = 20.0) -> Row:
    """What the harness makes of a reader that is run in the place of the commands, in a worker."""

    def runner(kind: str, path: Path, out: Path, variant: int, watched: Watched) -> Ran:
        out.mkdir()
        with watched():
            outcome = reader(path, out)
        return Ran([outcome or GOOD])

    return next(iter(run_many(harness, 0, [SCENARIO_AT], runner=runner, time_limit_s=time_limit_s)))


def test_a_reader_that_never_ends_is_a_hang(harness: Harness) -> None:
    assert row_of(harness, lambda path, out: time.sleep(60), 0.5).verdict == "hang"


def test_what_a_late_run_left_does_not_stop_the_next(harness: Harness) -> None:
    (harness.folder / "sound-out" / "old").mkdir(parents=True, exist_ok=True)
    row = row_of(harness, lambda path, out: os.kill(os.getpid(), signal.SIGKILL))
    assert row.verdict == "crash"


def test_a_reader_that_dies_is_a_crash(harness: Harness) -> None:
    row = row_of(harness, lambda path, out: os.kill(os.getpid(), signal.SIGKILL))
    assert row.verdict == "crash"
    assert row.damage == "cut_in_half scenario.json: cut in half"


@pytest.mark.parametrize(
    ("reader", "words"),
    [
        (lambda path, out: (path.parents[2] / "new").write_text("x"), "open writes"),
        (lambda path, out: (path.parents[4] / "outside" / "canary").read_bytes(), "open reads"),
        (lambda path, out: Path("/etc/passwd").read_bytes(), "open reads /etc/passwd"),
        (lambda path, out: os.remove(path), "os.remove writes"),
        (lambda path, out: subprocess.run(["true"], check=False), "subprocess.Popen"),
        (lambda path, out: os.system("true"), "os.system"),
        (lambda path, out: socket.socket().close(), "socket"),
        (lambda path, out: np.load(path.parents[4] / "outside" / "canary"), "open reads"),
    ],
    ids=["write", "read", "system file", "remove", "process", "shell", "socket", "through a library"],
)
def test_what_a_reader_does_outside_is_found(harness: Harness, reader: Reader, words: str) -> None:
    def forgiving(path: Path, out: Path) -> None:
        try:
            reader(path, out)
        except (OSError, ValueError):
            return  # as a parser would that takes any error for damage

    row = row_of(harness, forgiving)
    assert row.verdict == "outside"
    assert words in row.reason


def test_what_a_library_in_c_reads_or_writes_outside_is_found(harness: Harness) -> None:
    import cv2

    row = row_of(harness, lambda path, out: cv2.imread(str(path.parents[4] / "outside" / "canary")))
    if harness.canaries.shows_reading:
        assert "read outside: canary" in row.reason
    row = row_of(harness, lambda p, o: cv2.imwrite(str(p.parents[4] / "outside" / "x.png"), np.zeros((2, 2), np.uint8)))
    assert "made outside: x.png" in row.reason


def test_a_link_out_of_the_input_is_followed_before_it_is_judged(harness: Harness) -> None:
    def reader(path: Path, out: Path) -> None:
        (out / "link").symlink_to("/etc/hostname")
        with contextlib.suppress(PermissionError):
            (out / "link").read_bytes()

    assert row_of(harness, reader).verdict == "outside"


def test_reading_the_input_and_writing_the_result_is_allowed(harness: Harness) -> None:
    def reader(path: Path, out: Path) -> None:
        (out / "s.json").write_bytes(path.read_bytes())
        shutil.rmtree(out)

    assert row_of(harness, reader).verdict == "swallowed"


def test_more_memory_than_the_limit_is_found(harness: Harness, monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that asks for more gets a MemoryError, which it may call an internal error."""
    import mutation.running as running

    def run_greedily(*arguments: object) -> Outcome:
        return Outcome("reconstruct", 1, f"log2sim: internal error: {greedy()}", frozenset(), "")

    def greedy() -> str:
        try:
            return str(len(bytearray(3 * 1024**3)))
        except MemoryError as error:
            return f"MemoryError: {error}"

    monkeypatch.setattr(running, "run_commands", lambda *a: [run_greedily()])
    row = next(iter(run_many(harness, 0, [SCENARIO_AT], runner=measured)))
    assert row.verdict == "memory"


@pytest.mark.parametrize(
    ("outcome", "visible", "expected"),
    [
        (Outcome("r", 3, "log2sim: x.json: cut\n", frozenset(), ""), True, "refused"),
        (Outcome("r", 0, "", frozenset(["note: one", "note: two"]), "other"), True, "told"),
        (Outcome("r", 0, "", frozenset(["note: one"]), "other"), True, "swallowed"),
        (Outcome("r", 0, "", frozenset(["note: one"]), "other"), False, "plausible"),
        (Outcome("r", 0, "", frozenset(), "same"), True, "no effect"),
        (Outcome("r", 1, "log2sim: internal error: KeyError: 'x'\n", frozenset(), ""), True, "crash"),
        (Outcome("r", 3, "Traceback (most recent call last):\n", frozenset(), ""), True, "crash"),
        (Outcome("r", 3, "log2sim: a\nlog2sim: b\n", frozenset(), ""), True, "crash"),
        (Outcome("r", 7, "log2sim: a\n", frozenset(), ""), True, "crash"),
        (Outcome("r", 3, "log2sim: cut\n", frozenset(), "", ("s.json",)), True, "torn"),
        (Outcome("r", 0, "", frozenset(), "same", (".s.json",)), True, "torn"),
    ],
)
def test_classes(outcome: Outcome, visible: bool, expected: str) -> None:
    assert running.judge(Ran([outcome]), SOUND, visible=visible)[0] == expected


def test_the_peak_of_memory_counts() -> None:
    assert running.judge(Ran([SOUND], peak_bytes=3 * 1024**3), SOUND, visible=True)[0] == "memory"


def test_the_same_seed_and_index_make_the_same_input(tmp_path: Path) -> None:
    harness = Harness(tmp_path.resolve(), ["scenario"], ALL)
    numbers = list(indices(12, ["scenario"]))
    assert {kind_of(i) for i in numbers} == {"scenario"}

    def inputs() -> list[object]:
        found = []
        for index in numbers:
            path, _, name, done = harness.make(5, index)
            content = (
                path.read_bytes() if path.is_file() and not path.is_symlink() and path.stat().st_size < 10**8 else None
            )
            found.append((name, done.what, done.visible, content))
        return found

    first = inputs()
    assert inputs() == first
    assert len({name for name, *_ in first}) > 6


def test_every_kind_of_input_is_in_the_cycle() -> None:
    assert set(CYCLE) == set(mutate.KINDS)
    assert len(MESSAGES) == 1


@pytest.mark.parametrize(
    ("text", "keep", "visible"),
    [(b"1 2 3\n4 5 6\n", 6, False), (b"1 2 3\n4 5 6\n", 7, True), (b"1 2 3\n4 5 67\n", 11, False)],
)
def test_a_cut_shows_in_the_number_of_fields(text: bytes, keep: int, visible: bool) -> None:
    assert cut_is_visible(text, keep) == visible


def test_a_watch_lets_python_and_the_package_be_read(tmp_path: Path) -> None:
    """In a process of its own, as an audit hook stays for ever."""
    code = f"""
import sys; sys.path.insert(0, {str(ROOT / "tools")!r})
from pathlib import Path
from mutation.running import Watch
watch = Watch()
watch.allow(read=[], write=[Path({str(tmp_path)!r})])
with watch.watching():
    import this, wave
    Path({str(ROOT / "schemas" / "scenario-1.json")!r}).read_bytes()
    Path({str(tmp_path / "x")!r}).write_text("x")
    try:
        Path({str(ROOT / "README.md")!r}).read_bytes()
    except PermissionError:
        pass
assert len(watch.found) == 1 and watch.found[0].endswith("README.md"), watch.found
"""
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert Watch.__doc__


def test_the_table_counts_each_input_once() -> None:
    rows = [
        Row(0, k, kind, "", True, word, "") for k, (kind, word) in enumerate([("native", "told"), ("xosc", "hang")])
    ]
    lines = mutate.table(rows).splitlines()
    assert lines[-1].startswith("| all | 0 | 1 |")
    assert lines[-1].count("| 1 |") >= 1
    assert len(lines) == 5


def test_what_a_kill_may_leave(tmp_path: Path) -> None:
    whole = {"a.json": 1000, "b.png": 500}

    def left(files: dict[str, int], before: tuple[str, ...] = ()) -> str:
        shutil.rmtree(tmp_path / "out", ignore_errors=True)
        (tmp_path / "out").mkdir()
        for name in before:
            (tmp_path / "out" / name).write_bytes(bytes(whole[name]))
        inodes = killing.names_and_inodes(tmp_path / "out")
        for name, size in files.items():
            (tmp_path / "new").write_bytes(bytes(size))
            (tmp_path / "new").rename(tmp_path / "out" / name)
        return killing._what_is_left(tmp_path / "out", inodes, whole)[0]

    both = tuple(whole)
    assert left({}) == "nothing"
    assert left({".a.json.0-1-2": 30}) == "nothing"
    assert left(whole) == "whole"
    assert left({"a.json": 1000}) == "torn"
    assert left({"a.json": 400, "b.png": 500}) == "torn"
    assert left({}, both) == "old"
    assert left(whole, both) == "whole"
    assert left({"a.json": 1000}, both) == "torn"
    assert left({"a.json": 0, "b.png": 0}, both) == "torn"


@pytest.mark.slow
def test_nothing_crashes_hangs_or_is_swallowed(tmp_path: Path) -> None:
    """Some inputs of each kind; `tools/mutate.py --count N` runs more."""
    harness = Harness(tmp_path.resolve())
    rows = list(run_many(harness, 20, list(indices(INPUTS))))
    counts = Counter(row.verdict for row in rows)
    bad = [
        f"{row.verdict}: {row.replay} {row.kind}: {row.damage}: {row.reason}"
        for row in rows
        if row.verdict in running.BAD
    ]
    assert not bad, "\n".join(bad)
    assert sum(counts.values()) == INPUTS
    assert min(counts[name] for name in running.GOOD) > 1


@pytest.mark.slow
def test_what_is_killed_leaves_nothing_torn(tmp_path: Path) -> None:
    torn = [k for k in killing.kill_many(tmp_path.resolve(), KILLS) if k.left == "torn"]
    assert not torn
