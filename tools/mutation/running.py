"""Runs the commands on one damaged input, in this process, and records what came of it."""

from __future__ import annotations

import hashlib
import json
import os
import re
import resource
import shutil
import site
import sys
import sysconfig
import tempfile
import threading
import time
import zlib
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import typer.main
from command_line import run

from log2sim.datatypes import Scenario
from mutation.bases import LOGS, SCENARIO, WITHOUT_LABELS, XOSC

EXPORTS = ("openscenario", "carla", "csv", "scenarionet", "commonroad", "osi", "mcap")
MEMORY_BYTES = 2 * 1024**3
# Fields of a scenario that name its source, and others of a report that are measured.
_NOT_CONTENT = ("provenance", "stages")
_TELLING = re.compile(r"^(note|warning|poses|limit exceeded|the ego is doubtful|left out)")


Watched = Callable[[], AbstractContextManager[object]]


@dataclass(frozen=True)
class Outcome:
    """What one command left: exit code, text, what it made, and what it told that is not in the tables of a sound run."""

    command: str
    code: int
    errors: str
    told: frozenset[str]
    content: str
    left: tuple[str, ...] = ()


@dataclass
class Ran:
    """All commands on one input."""

    outcomes: list[Outcome] = field(default_factory=list)
    outside: list[str] = field(default_factory=list)
    seconds: float = 0.0
    peak_bytes: int = 0


def variant_of(index: int) -> int:
    """Which of several uses of an input is tried: a number that does not repeat with the order of the kinds."""
    return zlib.crc32(str(index).encode())


def commands_for(kind: str, path: Path, out: Path, variant: int) -> list[list[object]]:
    """What a user runs on such an input; the last one makes the result that is judged."""
    if kind in LOGS:
        labels = ("labels", "lidar:labels")[variant // 4 % 2]
        detector = "lidar:vehicle" if kind in WITHOUT_LABELS else labels
        looks: Sequence[list[object]] = ([["inspect", path]], [["validate", path]], [], [])[variant % 4]
        return [
            *looks,
            # Neither the user's cache nor other processes: both are outside of what the watch allows.
            ["reconstruct", path, "--detector", detector, "--no-cache", "--jobs", 1, "--out", out / "s.json", "--report", out / "r.json"],
        ]  # fmt: skip
    if kind == XOSC:
        return [["import", path, "--out", out / "s.json"]]
    assert kind == SCENARIO
    uses: Sequence[list[object]] = (
        ["replay", path, "--out", out / "r.json"],
        ["replay", path, "--mode", "exact", "--agents", "reactive"],
        ["evaluate", path, "--truth", path, "--out", out / "m.json"],
        ["edit", path, "--speed", "ego=1.1", "--out", out / "e.json"],
        ["plot", path, "--out", out / "p.png"],
        ["view", path, "--out", out / "v.html"],
        ["validate", path],
        *(["export", path, "--to", name, "--out", out / name] for name in EXPORTS),
    )
    return [uses[variant % len(uses)]]


def run_commands(
    kind: str, path: Path, out: Path, commands: Sequence[list[object]], watched: Watched = nullcontext
) -> list[Outcome]:
    """Run commands on an input; nothing that one leaves stays."""
    outcomes = []
    for arguments in commands:
        out.mkdir()
        with watched():
            ran = run(*arguments)
        content = _content(kind, path, out) if ran.code == 0 else ""
        told = frozenset(line for line in (ran.out + "\n" + ran.err).splitlines() if _TELLING.match(line))
        told |= _told_in_report(out / "r.json") if kind in LOGS else frozenset()
        # Sound and damaged inputs lie in different folders.
        told = frozenset(line.replace(str(path.parent), "IN").strip() for line in told)
        left = tuple(sorted(p.name for p in out.rglob("*"))) if ran.code else tuple(p.name for p in out.glob(".*"))
        outcomes.append(Outcome(str(arguments[0]), ran.code, ran.err, told, content, left))
        shutil.rmtree(out)
    return outcomes


def measured(kind: str, path: Path, out: Path, variant: int, watched: Watched) -> Ran:
    """Run the commands of an input with a limit of memory; measure the time and the peak of memory."""
    Path("/proc/self/clear_refs").write_text("5")  # the peak of the memory begins anew (Linux)
    hard = resource.getrlimit(resource.RLIMIT_AS)[1]
    resource.setrlimit(resource.RLIMIT_AS, (_status_bytes("VmSize") + MEMORY_BYTES, hard))
    start = time.process_time()
    try:
        outcomes = run_commands(kind, path, out, commands_for(kind, path, out, variant), watched)
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (hard, hard))
    return Ran(outcomes, [], time.process_time() - start, _status_bytes("VmHWM"))


def _content(kind: str, path: Path, out: Path) -> str:
    """A digest of what the result says, without the names of its source and without times that were measured."""
    source = out / "s.json" if kind != SCENARIO else path
    if not source.exists():
        return ""
    document = Scenario.load(source).to_dict()
    for key in _NOT_CONTENT:
        document.pop(key)
    if kind == XOSC:
        document.pop("name")  # of the file, where its header has none
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _told_in_report(path: Path) -> frozenset[str]:
    """What a report says of records that were not used, and of faults."""
    if not path.exists():
        return frozenset()
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    parts = {key: report.get(key) for key in ("unreadable", "without_pose", "faults")}
    return frozenset(
        [*(f"{k}: {json.dumps(v, sort_keys=True)}" for k, v in parts.items() if v), *map(str, report["log"]["notes"])]
    )


def _status_bytes(name: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(name))


def prepare_process() -> None:
    """One core, since threads of libraries would not live on in a forked process; the command line is put together once."""
    for name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(name, "1")
    import cv2

    cv2.setNumThreads(1)
    typer.main.get_command = cache(typer.main.get_command)


# Exit codes that the README documents for something that is wrong with an input or with what was asked of it.
REFUSALS = (2, 3, 4, 6)
GOOD = ("refused", "told", "no effect", "plausible")
BAD = ("swallowed", "crash", "hang", "memory", "outside", "torn")
CLASSES = (*GOOD, *BAD)
MEANING = {
    "refused": "one message and a documented exit code",
    "told": "a result, and a line on the terminal or in the report that a sound run does not have",
    "no effect": "the same result as without the damage",
    "plausible": "another result without a word; the damage is none that a program can see, see damages.py",
    "swallowed": "another result without a word, though the damage can be seen",
    "crash": "an internal error, a traceback, a signal or an undocumented exit code",
    "hang": "not ended within the time limit",
    "memory": "more than 2 GiB",
    "outside": "a file read or written outside of the input and --out, a process or a socket",
    "torn": "files at --out though the command failed, or temporary ones",
}


def judge(ran: Ran, sound: Outcome, *, visible: bool) -> tuple[str, str]:
    """Return the class and the reason in one line.

    The result that counts is that of the last command, which makes a scenario or a file of one; what the earlier ones, inspect
    and validate, say is no word of the last one.
    """
    if ran.outside:
        return "outside", "; ".join(ran.outside[:3])
    for outcome in ran.outcomes:
        if "MemoryError" in outcome.errors or "bad_alloc" in outcome.errors or "Insufficient memory" in outcome.errors:
            return "memory", f"{outcome.command}: {_first(outcome.errors)}"
        if outcome.code and not _is_refusal(outcome):
            return "crash", f"{outcome.command}: exit code {outcome.code}: {outcome.errors[-300:].strip()}"
        if outcome.left:
            return "torn", f"{outcome.command}: left {', '.join(outcome.left[:5])}"
    if ran.peak_bytes > MEMORY_BYTES:
        return "memory", f"{ran.peak_bytes / 2**20:.0f} MiB"
    last, was = ran.outcomes[-1], sound
    if last.code:
        return "refused", f"{last.command}: {_first(last.errors)}"
    if last.content == was.content:
        return "no effect", ""
    new = sorted(last.told - was.told)
    if new:
        return "told", new[0]
    return ("swallowed" if visible else "plausible"), ""


def _is_refusal(outcome: Outcome) -> bool:
    own = [line for line in outcome.errors.splitlines() if line.startswith("log2sim: ")]
    return (
        outcome.code in REFUSALS
        and len(own) == 1
        and "internal error" not in outcome.errors
        and "Traceback" not in outcome.errors
    )


def _first(errors: str) -> str:
    return next((line for line in errors.splitlines() if line.startswith("log2sim: ")), errors[:200])


ROOT = Path(__file__).resolve().parents[2]
PROCESSES = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pty.spawn")
SOCKETS = ("socket.", "urllib.Request", "http.client", "ftplib.", "smtplib.", "webbrowser.open")
CHANGES = (
    "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink", "os.link", "os.chmod", "os.chown", "os.truncate", "os.utime",
    "shutil.rmtree", "shutil.move", "shutil.copyfile", "shutil.chown", "os.mkfifo", "os.mknod", "sqlite3.connect",
)  # fmt: skip
# Not among them: listings of folders. Who names a part of a log is told which folder above it is one.
WATCHED = frozenset(("open", "pickle.find_class", *CHANGES))
# What the C library, fonts and time zones need; nothing of a user's.
SYSTEM = ("/usr/lib", "/usr/local/lib", "/usr/share", "/lib", "/lib64", "/etc/localtime", "/etc/ld.so.cache", "/etc/fonts", "/proc/self/status",
          "/proc/cpuinfo", "/proc/meminfo", "/proc/sys/kernel/random/boot_id", "/proc/self/ns", "/sys/devices/system/cpu", "/sys/fs/cgroup",
          "/proc/self/cgroup", "/dev/null")  # fmt: skip
CHANGES_OF_TWO = ("os.rename", "os.link", "os.symlink", "shutil.move", "shutil.copyfile")
# What a link leads to is not changed by it, and what is copied is read.
FIRST_CHANGED = {"os.symlink": 1, "shutil.copyfile": 1}
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Watch:
    """Collects what is done outside of the folders that are allowed, while it is on.

    The hook of Python sees what Python does, not what libraries in C do.
    """

    def __init__(self) -> None:
        self.on = False
        self._busy = threading.local()
        self.found: list[str] = []
        self.readable: tuple[str, ...] = ()
        self.writable: tuple[str, ...] = ()
        self.code = tuple({os.path.realpath(p) for p in _code_folders()})
        sys.addaudithook(self._hook)

    def allow(self, *, read: Iterable[Path], write: Iterable[Path]) -> None:
        """State what may be read and written from now on; forget what was found."""
        self.found = []
        self.writable = tuple(os.path.realpath(p) for p in write)
        # The importer asks for the names that editable installations put on the path; there are no such files.
        hooks = [entry for entry in sys.path if entry.endswith("__path_hook__")]
        self.readable = tuple(os.path.realpath(p) for p in (*read, *write, *self.code, *SYSTEM, *hooks))

    @contextmanager
    def watching(self) -> Iterator[None]:
        """Within the block everything else is refused, and remembered."""
        self.on = True
        try:
            yield
        finally:
            self.on = False

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        # What the hook does itself has events, too.
        watched = event in WATCHED or event.startswith((*PROCESSES, *SOCKETS))
        if not self.on or not watched or getattr(self._busy, "now", False):
            return
        self._busy.now = True
        try:
            if event == "open":
                self._check(event, arguments[0], isinstance(arguments[2], int) and bool(arguments[2] & WRITING))
            elif event in CHANGES:
                for path in arguments[FIRST_CHANGED.get(event, 0) : 2 if event in CHANGES_OF_TWO else 1]:
                    # A database is opened for reading, with its own uri.
                    self._check(event, path, event != "sqlite3.connect")
            elif event != "pickle.find_class" or not str(arguments[0]).startswith(("numpy", "pandas", "log2sim")):
                self._forbid(f"{event} {arguments!r:.200}")
        finally:
            self._busy.now = False

    def _check(self, event: str, path: object, writes: bool) -> None:
        if isinstance(path, int) or (event == "sqlite3.connect" and str(path).startswith("file:")):
            return
        text = os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else str(path)
        # The place of a link that is changed is what matters, not what it leads to.
        real = (
            os.path.join(os.path.realpath(os.path.dirname(text) or "."), os.path.basename(text))
            if writes
            else os.path.realpath(text)
        )
        if not os.path.isabs(text) and _within_shutil(event):
            return
        allowed = self.writable if writes else self.readable
        if not any(real == folder or real.startswith(folder + os.sep) for folder in allowed):
            self._forbid(f"{event} {'writes' if writes else 'reads'} {real}")

    def _forbid(self, words: str) -> None:
        self.found.append(words)
        raise PermissionError(1, f"forbidden by the harness: {words[:100]}")


def _within_shutil(event: str) -> bool:
    """Whether shutil does it, by names relative to a folder that is open; it has told its own event before."""
    return not event.startswith("shutil.") and sys._getframe(4).f_code.co_filename == shutil.__file__


def _code_folders() -> list[str]:
    """Where Python, its packages and log2sim are."""
    names = ("stdlib", "platstdlib", "purelib", "platlib")
    return [
        sys.prefix, sys.base_prefix, *site.getsitepackages(), *(sysconfig.get_path(n) for n in names), str(ROOT / "log2sim"),
        str(ROOT / "schemas"), str(ROOT / "log2sim.egg-info"),
    ]  # fmt: skip


def temporary_folder() -> Path:
    """A new folder for inputs, which is not a link."""
    return Path(tempfile.mkdtemp(prefix="mutate-")).resolve()
