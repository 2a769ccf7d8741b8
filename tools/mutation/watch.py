"""What a command reads, writes and starts: an audit hook, and files that show whether somebody read them."""

from __future__ import annotations

import os
import shutil
import site
import sys
import sysconfig
import tempfile
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
PROCESSES = (
    "os.system",
    "os.exec",
    "os.posix_spawn",
    "os.spawn",
    "os.fork",
    "os.forkpty",
    "subprocess.Popen",
    "pty.spawn",
    "os.startfile",
)
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

    The hook of Python sees what Python does. Of libraries in C it sees nothing, so `Canaries` tells whether files outside were
    read or written by them.
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
        if (
            not self.on
            or (event not in WATCHED and not event.startswith((*PROCESSES, *SOCKETS)))
            or getattr(self._busy, "now", False)
        ):
            return
        self._busy.now = True
        try:
            self._judge(event, arguments)
        finally:
            self._busy.now = False

    def _judge(self, event: str, arguments: tuple[Any, ...]) -> None:
        if event == "open":
            self._check(event, arguments[0], bool(arguments[2] & WRITING) if isinstance(arguments[2], int) else False)
        elif event in CHANGES:
            for path in arguments[FIRST_CHANGED.get(event, 0) : 2 if event in CHANGES_OF_TWO else 1]:
                # A database is opened for reading, with its own uri; what it writes is found by the canaries.
                self._check(event, path, event != "sqlite3.connect")
        elif event == "pickle.find_class":
            if not str(arguments[0]).startswith(("numpy", "pandas", "log2sim")):
                self._forbid(f"{event} {arguments!r:.200}")
        else:
            self._forbid(f"{event} {arguments!r:.200}")

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


class Canaries:
    """Files outside of every input whose content, times and company show whether somebody read or wrote there."""

    NAMES = ("canary", "canary.json", "secret.txt")

    def __init__(self, folder: Path) -> None:
        folder.mkdir(parents=True, exist_ok=True)
        self.folder = folder
        for name in self.NAMES:
            (folder / name).write_text('{"canary": 1}')
        self.shows_reading = self._shows_reading()

    def reset(self) -> None:
        """Make the files look as if they had never been read; remove what is left of the last input."""
        for path in self.folder.iterdir():
            if path.name not in self.NAMES:
                path.unlink() if path.is_symlink() or path.is_file() else path.rmdir()
        for name in self.NAMES:
            os.utime(self.folder / name, ns=(0, 10**18))

    def check(self, before: set[str]) -> list[str]:
        """What was read, written or made since `reset`; `before` names what the mutation itself put there."""
        found = [f"made outside: {p.name}" for p in self.folder.iterdir() if p.name not in (*self.NAMES, *before)]
        for name in self.NAMES:
            state = (self.folder / name).stat()
            if name not in before and state.st_mtime_ns != 10**18:
                found.append(f"written outside: {name}")
            elif self.shows_reading and name not in before and state.st_atime_ns != 0:
                found.append(f"read outside: {name}")
        return found

    def _shows_reading(self) -> bool:
        """Whether the file system notes the time of reading (not with the mount option noatime)."""
        self.reset()
        (self.folder / self.NAMES[0]).read_bytes()
        return (self.folder / self.NAMES[0]).stat().st_atime_ns != 0


def temporary_folder() -> Path:
    """A new folder for inputs, which is not a link."""
    return Path(tempfile.mkdtemp(prefix="mutate-")).resolve()
