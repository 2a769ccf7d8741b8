"""Commands run in forked processes: what they make, what they say, and what they touch outside of their input and output."""

from __future__ import annotations

import hashlib
import importlib
import json
import multiprocessing
import os
import pkgutil
import re
import resource
import shutil
import site
import sys
import sysconfig
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from command_line import run

import log2sim
from log2sim.datatypes import Scenario
from mutation.bases import LOGS, SCENARIO, XOSC

ROOT = Path(__file__).resolve().parents[2]
FORK = multiprocessing.get_context("fork")
MEMORY_BYTES = 2 * 1024**3
# Lines of a command that tell of something; and what of a result names its source.
TELLING = re.compile(r"^(note|warning|poses|limit exceeded|the ego is doubtful|left out)")
SOURCE = ("provenance", "stages")


@dataclass(frozen=True)
class Outcome:
    """What one command left: exit code, errors, lines that tell something, a digest of the result, and files that should not be."""

    command: str
    code: int
    errors: str
    told: frozenset[str]
    content: str
    left: tuple[str, ...]


@dataclass(frozen=True)
class Ran:
    """All commands on one input; without outcomes the process was killed, by itself or for being late."""

    outcomes: tuple[Outcome, ...] = ()
    outside: tuple[str, ...] = ()
    seconds: float = 0.0
    peak_bytes: int = 0
    killed: str = ""


def warm_up() -> None:
    """Import the whole package, so that no process has to; one thread, as others would not live on in a forked process."""
    import cv2

    cv2.setNumThreads(1)
    for module in pkgutil.walk_packages(log2sim.__path__, "log2sim."):
        if not module.name.endswith("__main__") and ".carla" not in module.name:
            importlib.import_module(module.name)


def in_a_process(call: Callable[[], Any], limit_s: float) -> tuple[Any, str]:
    """What a call returns in a forked process, or why it returned nothing."""
    receive, send = FORK.Pipe(duplex=False)
    sys.stdout.flush()
    process = FORK.Process(target=_answer, args=(call, send), daemon=True)
    process.start()
    send.close()
    late, found = not receive.poll(limit_s), None
    with suppress(EOFError):
        found = None if late else receive.recv()
    process.kill() if late else None
    process.join()
    if isinstance(found, BaseException):
        raise RuntimeError("the harness itself failed") from found
    why = f"not ended after {limit_s:.0f} s" if late else f"the process ended with status {process.exitcode}"
    return found, "" if found is not None else why


def _answer(call: Callable[[], Any], send: Any) -> None:
    silent = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 2):  # libraries in C print to the latter
        os.dup2(silent, stream)
    try:
        send.send(call())
    except BaseException as error:
        send.send(error)
    os._exit(0)


def run_commands(
    kind: str, path: Path, out: Path, commands: Sequence[list[object]], allowed: Sequence[Path] | None = None
) -> Ran:
    """Run commands on an input; with `allowed`, which may be read beside it, they are watched and get 2 GiB at most."""
    watch = None
    if allowed is not None:
        watch = Watch([path.parent if path.is_file() else path, *allowed], out)
        size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (size + MEMORY_BYTES, resource.RLIM_INFINITY))
    outcomes, begin = [], time.process_time()
    for arguments in commands:
        out.mkdir()
        if watch:
            watch.on = True
        ran = run(*arguments)
        if watch:
            watch.on = False
        told = {line for line in (ran.out + "\n" + ran.err).splitlines() if TELLING.match(line)}
        told |= _told_in_report(out / "r.json") if kind in LOGS else set()
        # Sound and damaged inputs lie in different folders.
        lines = frozenset(line.replace(str(path.parent), "IN").strip() for line in told)
        left = tuple(sorted(p.name for p in out.rglob("*"))) if ran.code else tuple(p.name for p in out.glob(".*"))
        content = _content(kind, path, out) if ran.code == 0 else ""
        outcomes.append(Outcome(str(arguments[0]), ran.code, ran.err, lines, content, left))
        shutil.rmtree(out)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
    return Ran(tuple(outcomes), tuple(watch.found if watch else ()), time.process_time() - begin, peak)


def _content(kind: str, path: Path, out: Path) -> str:
    """A digest of what the result says, without the names of its source and without times that were measured."""
    source = out / "s.json" if kind != SCENARIO else path
    if not source.exists():
        return ""
    document = Scenario.load(source).to_dict()
    for key in (*SOURCE, *(("name",) if kind == XOSC else ())):  # the name is of the file, where its header has none
        document.pop(key)
    return hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()


def _told_in_report(path: Path) -> set[str]:
    """What a report says of records that were not used, and of faults."""
    if not path.exists():
        return set()
    report: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    parts = {key: report.get(key) for key in ("unreadable", "without_pose", "faults")}
    return {
        *(f"{k}: {json.dumps(v, sort_keys=True)}" for k, v in parts.items() if v),
        *map(str, report["log"]["notes"]),
    }


PROCESSES = ("os.system", "os.exec", "os.posix_spawn", "os.spawn", "os.fork", "subprocess.Popen", "pty.spawn")
SOCKETS = ("socket.", "urllib.Request", "http.client", "ftplib.", "smtplib.", "webbrowser.open")
# By event: which arguments are paths that it changes. What a link leads to is not changed by it, and what is copied is read.
# Listings of folders are not among them: who names a part of a log is told which folder above it is one.
FIRST, BOTH, SECOND = slice(0, 1), slice(0, 2), slice(1, 2)
CHANGES = {
    **dict.fromkeys((
        "os.remove", "os.mkdir", "os.rmdir", "os.chmod", "os.chown", "os.truncate", "os.utime", "shutil.rmtree", "shutil.chown",
        "os.mkfifo", "os.mknod",
    ), FIRST),
    "os.rename": BOTH, "os.link": BOTH, "shutil.move": BOTH, "os.symlink": SECOND, "shutil.copyfile": SECOND,
}  # fmt: skip
# What the C library, fonts and time zones need; nothing of a user's.
SYSTEM = ("/usr/lib", "/usr/local/lib", "/usr/share", "/lib", "/lib64", "/etc/localtime", "/etc/ld.so.cache", "/etc/fonts", "/proc/self/status",
          "/proc/cpuinfo", "/proc/meminfo", "/proc/sys/kernel/random/boot_id", "/proc/self/ns", "/sys/devices/system/cpu", "/sys/fs/cgroup",
          "/proc/self/cgroup", "/dev/null")  # fmt: skip
WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND


class Watch:
    """Refuses and remembers what this process does outside of the folders that it may read and write, while it is on.

    The hook of Python sees what Python does, not what libraries in C do.
    """

    def __init__(self, read: Iterable[Path], write: Path) -> None:
        self.on, self.found, self._busy = False, list[str](), threading.local()
        names = ("stdlib", "platstdlib", "purelib", "platlib")
        code = [sys.prefix, sys.base_prefix, *site.getsitepackages(), *(sysconfig.get_path(n) for n in names)]
        code += [str(ROOT / name) for name in ("log2sim", "schemas", "log2sim.egg-info")]
        # The importer asks for the names that editable installations put on the path; there are no such files.
        hooks = [entry for entry in sys.path if entry.endswith("__path_hook__")]
        self._writable = (os.path.realpath(write),)
        self._readable = tuple(os.path.realpath(p) for p in (*read, write, *code, *SYSTEM, *hooks))
        sys.addaudithook(self._hook)

    def _hook(self, event: str, arguments: tuple[Any, ...]) -> None:
        known = event in ("open", "pickle.find_class", "sqlite3.connect", *CHANGES)
        if not self.on or getattr(self._busy, "now", False) or not (known or event.startswith((*PROCESSES, *SOCKETS))):
            return
        self._busy.now = True  # what the hook does itself has events, too
        try:
            if event == "open":
                self._check(event, arguments[0], isinstance(arguments[2], int) and bool(arguments[2] & WRITING))
            elif event == "sqlite3.connect":
                if not str(arguments[0]).startswith("file:"):  # a database is opened for reading, with its own uri
                    self._check(event, arguments[0], False)
            elif event in CHANGES:
                for path in arguments[CHANGES[event]]:
                    self._check(event, path, True)
            elif event != "pickle.find_class" or not str(arguments[0]).startswith(("numpy", "pandas", "log2sim")):
                self._forbid(f"{event} {arguments!r:.200}")
        finally:
            self._busy.now = False

    def _check(self, event: str, path: object, writes: bool) -> None:
        if isinstance(path, int):
            return
        text = os.fsdecode(path) if isinstance(path, (str, bytes, os.PathLike)) else str(path)
        # shutil works by names relative to a folder that is open, of which it has told its own event before.
        inner = not event.startswith("shutil.") and sys._getframe(3).f_code.co_filename == shutil.__file__
        if not os.path.isabs(text) and inner:
            return
        # The place of a link that is changed is what matters, not what it leads to.
        folder, name = os.path.split(text)
        real = os.path.join(os.path.realpath(folder or "."), name) if writes else os.path.realpath(text)
        allowed = self._writable if writes else self._readable
        if not any(real == folder or real.startswith(folder + os.sep) for folder in allowed):
            self._forbid(f"{event} {'writes' if writes else 'reads'} {real}")

    def _forbid(self, words: str) -> None:
        self.found.append(words)
        raise PermissionError(1, f"forbidden by the harness: {words[:100]}")
