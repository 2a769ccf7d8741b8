"""The user's cache: small files that can be made again, in limited space.

Every entry is a file of its own, written under a temporary name and renamed. Unlike one database this holds on network drives,
where the home folders of a cluster lie and where SQLite's write-ahead log must not be used; a process that is killed leaves
nothing half-written; and what is damaged is one entry.
"""

from __future__ import annotations

import json
import os
import re
import secrets
import sys
import time
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from log2sim.errors import ConfigError
from log2sim.files.inputs import open_regular

VARIABLE = "LOG2SIM_CACHE"
"""Of the environment; names another folder."""


def cache_folder() -> Path:
    r"""Return the user's cache folder of log2sim; it need not exist.

    `LOG2SIM_CACHE` where it is set, else `log2sim` in `XDG_CACHE_HOME` where that is an absolute path, else the place that the
    system has for such files: `~/.cache/log2sim`, on macOS `~/Library/Caches/log2sim`, on Windows
    `%LOCALAPPDATA%\log2sim\Cache`.

    Raises `ConfigError` when the user has no home folder.
    """
    chosen, home = os.environ.get(VARIABLE, ""), os.environ.get("XDG_CACHE_HOME", "")
    if chosen:
        return Path(chosen).absolute()
    if Path(home).is_absolute():
        return Path(home) / "log2sim"
    local = os.environ.get("LOCALAPPDATA", "")
    if sys.platform == "win32" and local:
        return Path(local) / "log2sim" / "Cache"
    try:
        user = Path.home()
    except RuntimeError:
        raise ConfigError(f"the user has no home folder to cache anything in; name a folder in {VARIABLE}") from None
    return user / ("Library/Caches" if sys.platform == "darwin" else ".cache") / "log2sim"


def detection_folder() -> Path:
    """Return the folder of what was detected and measured in the user's cache, which need not exist."""
    return cache_folder() / "detections"


DEFAULT_MAX_MB = 2048
# Of an entry; five ticks with two LiDARs have some MB.
MAX_ENTRY_BYTES = 64 * 1024**2
MAX_JSON_BYTES = 64 * 1024
# Entries are spread over folders by the last digit of their names, each with an equal share of the size, so that only one of
# them has to be listed to keep the limit.
DIGITS = "0123456789abcdef"
# A folder is looked through again when this process has written this part of its share.
SHARE_BETWEEN_CHECKS = 1 / 16
# What is left of a folder's share when it had to be emptied in part, so that not every entry leads to the next check.
SHARE_LEFT = 0.9
# The time of the last use is kept to the hour: setting it costs as much as reading an entry.
USED_EVERY_S = 3600.0
# Temporary files that are older were left by processes that were killed.
ABANDONED_AFTER_S = 3600.0

_NAME = re.compile(r"(?P<group>[A-Za-z0-9._-]{1,80})\.(?P<key>[0-9a-f]{16,64})")
_TEMPORARY = ".writing-"
_SETTINGS, _LAST_RUN = "settings.json", "last_run.json"


class DiskCache:
    """A cache folder, made when the first entry is kept, for this user alone.

    `max_bytes`: size of all entries; without it that of the folder's settings. `problem`: why nothing more is written.
    """

    def __init__(self, folder: Path, max_bytes: int | None = None) -> None:
        self.folder = folder
        self.max_bytes = self.max_mb * 1024**2 if max_bytes is None else max_bytes
        self.problem: str | None = None
        self._written: Counter[str] = Counter()

    @property
    def max_mb(self) -> int:
        """The limit in MiB that the settings in the folder state, or the default."""
        stated = self._read_json(_SETTINGS).get("max_mb")
        return stated if isinstance(stated, int) and 0 <= stated < 2**31 else DEFAULT_MAX_MB

    @property
    def last_run(self) -> Mapping[str, Any]:
        """What the last run noted; empty without any."""
        return self._read_json(_LAST_RUN)

    def get(self, name: str) -> bytes | None:
        """Return the content of an entry; None where there is none that this user wrote whole."""
        path = self._path_of(name)
        try:
            with open_regular(path) as file:
                state = os.fstat(file.fileno())
                # What others put there is not read.
                is_own = not hasattr(os, "geteuid") or state.st_uid == os.geteuid()
                if state.st_size > MAX_ENTRY_BYTES or not is_own:
                    return None
                content = file.read(MAX_ENTRY_BYTES + 1)
        except OSError:
            return None
        if time.time() - state.st_mtime > USED_EVERY_S:
            with suppress(OSError):  # in a folder that may only be read it keeps its time
                os.utime(path)
        return content

    def put(self, name: str, content: bytes) -> bool:
        """Keep an entry, and drop those that were not used for longest where the limit is reached; return whether it was written."""
        if self.problem is not None or len(content) > MAX_ENTRY_BYTES:
            return False
        path = self._path_of(name)
        try:
            for folder in (self.folder, path.parent):  # for this user alone
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _write(path, content)
        except OSError as error:
            self.problem = f"{error.filename or path.parent}: {error.strerror or error}"
            return False
        self._written[path.parent.name] += len(content)
        if self._written[path.parent.name] > SHARE_BETWEEN_CHECKS * self.max_bytes / len(DIGITS):
            self._trim(path.parent.name)
        return True

    def finish(self, note: Mapping[str, Any]) -> None:
        """Keep the limit, and note what this run did; other processes may have written for it."""
        for digit in DIGITS:
            self._trim(digit)
        if self.problem is None and self.folder.is_dir():
            self._write_json(_LAST_RUN, note)

    def set_limit(self, max_mb: int) -> None:
        """Set the limit for this and all later runs, and drop what is beyond it; `ConfigError` when it cannot be written."""
        self.max_bytes = max_mb * 1024**2
        self._write_json(_SETTINGS, {"max_mb": max_mb})
        if self.problem is not None:
            raise ConfigError(f"the limit of the cache cannot be kept: {self.problem}")
        for digit in DIGITS:
            self._trim(digit)

    def clear(self) -> int:
        """Remove all entries; return how many there were."""
        return sum(_remove(path) for path, _ in self._entries())

    def usage(self) -> dict[str, tuple[int, int]]:
        """Count the entries and their bytes by group, the part of their names before the key."""
        found: dict[str, tuple[int, int]] = {}
        for path, state in self._entries():
            group = path.name.rpartition(".")[0]
            count, size = found.get(group, (0, 0))
            found[group] = count + 1, size + state.st_size
        return found

    def _path_of(self, name: str) -> Path:
        if not _NAME.fullmatch(name):
            raise ValueError(f"name of an entry {name!r}: expected a group, a dot and a key in hexadecimal digits")
        return self.folder / name[-1] / name

    def _entries(self, digits: str = DIGITS) -> Iterator[tuple[Path, os.stat_result]]:
        for digit in digits:
            for path, state in _files(self.folder / digit):
                if _NAME.fullmatch(path.name):
                    yield path, state

    def _trim(self, digit: str) -> None:
        """Drop entries of a folder that were not used for longest, while it has more than its share."""
        self._written.pop(digit, None)
        now = time.time()
        for path, state in _files(self.folder / digit):
            if path.name.startswith(_TEMPORARY) and now - state.st_mtime > ABANDONED_AFTER_S:
                _remove(path)
        found = sorted(self._entries(digit), key=lambda entry: entry[1].st_mtime_ns)
        share, size = self.max_bytes / len(DIGITS), sum(state.st_size for _, state in found)
        least = SHARE_LEFT * share if size > share else size
        for path, state in found:
            if size <= least:
                break
            _remove(path)
            size -= state.st_size

    def _read_json(self, name: str) -> dict[str, Any]:
        try:
            with open_regular(self.folder / name) as file:
                value = json.loads(file.read(MAX_JSON_BYTES).decode())
        except (OSError, ValueError, RecursionError):
            return {}
        return value if isinstance(value, dict) else {}

    def _write_json(self, name: str, value: Mapping[str, Any]) -> None:
        try:
            self.folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            _write(self.folder / name, json.dumps(dict(value)).encode())
        except OSError as error:
            self.problem = self.problem or f"{error.filename or self.folder}: {error.strerror or error}"


def _write(path: Path, content: bytes) -> None:
    """Write a file of this user alone under a temporary name and rename it.

    It is not forced to the disk: after a loss of power an entry may be cut, which its check sum shows.
    """
    temporary = path.with_name(f"{_TEMPORARY}{os.getpid()}-{secrets.token_hex(6)}")
    flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL | getattr(os, "O_BINARY", 0) | getattr(os, "O_NOFOLLOW", 0)
    try:
        with open(os.open(temporary, flags, 0o600), "wb", buffering=0) as file:
            rest = memoryview(content)
            while rest:
                rest = rest[file.write(rest) :]
        os.replace(temporary, path)
    except BaseException:
        _remove(temporary)
        raise


def _files(folder: Path) -> Iterator[tuple[Path, os.stat_result]]:
    """Yield the files in a folder; nothing of what is missing, goes away meanwhile or may not be read."""
    try:
        found = list(os.scandir(folder))
    except OSError:
        return
    for entry in found:
        try:
            if entry.is_file(follow_symlinks=False):
                yield Path(entry.path), entry.stat(follow_symlinks=False)
        except OSError:
            continue


def _remove(path: Path) -> bool:
    """Remove a file, which another process may have removed; return whether this one did."""
    try:
        path.unlink()
    except OSError:
        return False
    return True
