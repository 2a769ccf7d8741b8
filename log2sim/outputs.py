"""Output files and folders: complete or absent, several that appear together, and none that replaces another run's."""

from __future__ import annotations

import glob
import hashlib
import os
import platform
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from pathlib import Path

from log2sim.errors import ConfigError

_TEMPORARY = re.compile(r"\.(?P<machine>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}(?=\.|$)")
_waiting: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("waiting", default=None)
_expected_new: ContextVar[set[Path] | None] = ContextVar("expected_new", default=None)


def temporary_beside(target: Path) -> Path:
    """Return a free name for a file or folder that becomes `target`; what runs that died left under such names is removed.

    Notes
    -----
    The name holds the machine since its last start and the process, so that of another living run nothing is removed.
    """
    for left in target.parent.glob(f".{glob.escape(target.stem)}.*"):
        found = _TEMPORARY.search(left.name, len(target.stem) + 1)
        if found and found["machine"] == _machine() and not _is_alive(int(found["process"])):
            remove(left)
    return target.with_name(f".{target.stem}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{target.suffix}")


def is_temporary(path: Path) -> bool:
    """Return whether a file or folder has a name of `temporary_beside`."""
    return _TEMPORARY.search(path.name) is not None


def is_left_over(path: Path) -> bool:
    """Return whether a file or folder has such a name of a process of this machine that is not there any more."""
    found = _TEMPORARY.search(path.name)
    return found is not None and found["machine"] == _machine() and not _is_alive(int(found["process"]))


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def put(temporary: Path, target: Path) -> bool:
    """Rename a finished file to its target, or keep it for the end of `together`; return whether it waits for that.

    Raises
    ------
    ConfigError
        When another run wrote the target meanwhile and this one may not replace it.
    OSError
        When it cannot be renamed.
    """
    waiting = _waiting.get()
    if waiting is not None:
        waiting.append((temporary, target))
        return True
    expected_new = _expected_new.get()
    if expected_new is None or target.resolve() not in expected_new:
        os.replace(temporary, target)
        return False
    try:
        _rename_to_new(temporary, target)
    except FileExistsError:
        raise written_meanwhile(target) from None
    expected_new.discard(target.resolve())
    return False


def written_meanwhile(target: Path) -> ConfigError:
    """Return the error for a target that another run wrote while this one worked."""
    return ConfigError(f"{target}: another run has written it meanwhile; choose another name or pass --overwrite")


def _rename_to_new(temporary: Path, target: Path) -> None:
    """Rename a file; raise `FileExistsError` when there is such a file, which a renaming would replace."""
    try:
        os.link(temporary, target)
    except FileExistsError:
        raise
    except OSError:  # a file system without hard links
        if target.exists():
            raise FileExistsError from None
        os.replace(temporary, target)
    else:
        temporary.unlink()


@contextmanager
def together() -> Iterator[None]:
    """Within the block files are written under temporary names; at its end all of them appear, after an error none.

    Raises
    ------
    ConfigError
        When one of them cannot be renamed; those that are new are removed again.
    """
    files: list[tuple[Path, Path]] = []
    token = _waiting.set(files)
    try:
        yield
    except BaseException:
        for temporary, _ in files:
            remove(temporary)
        raise
    finally:
        _waiting.reset(token)
    place_all(files)


def place_all(files: Sequence[tuple[Path, Path]]) -> None:
    """Rename finished files to their targets, all of them or none.

    Raises
    ------
    ConfigError
        When one of them cannot be renamed; those that are new are removed again.
    """
    placed: list[Path] = []
    try:
        for temporary, target in files:
            is_new = not target.exists()
            try:
                target.parent.mkdir(parents=True, exist_ok=True)
                put(temporary, target)
            except OSError as error:
                raise ConfigError(f"{target}: cannot be written: {error.strerror or error}") from error
            placed += [target] if is_new else []
    except BaseException:
        for path in (*placed, *(temporary for temporary, _ in files)):
            remove(path)
        raise


@contextmanager
def refusing_to_replace() -> Iterator[None]:
    """Within the block files of `expect_new` replace none that others wrote since."""
    token = _expected_new.set(set())
    try:
        yield
    finally:
        _expected_new.reset(token)


def expect_new(targets: Iterable[Path]) -> None:
    """Remember that there are no such files yet, and that none may be replaced, within `refusing_to_replace`."""
    expected = _expected_new.get()
    if expected is not None:
        expected.update(target.resolve() for target in targets)


@cache
def _machine() -> str:
    """Return 8 hexadecimal digits of this machine since its last start, and of the numbers of its processes (Linux)."""
    parts = [platform.node()]
    try:
        parts += [Path("/proc/sys/kernel/random/boot_id").read_text(), os.readlink("/proc/self/ns/pid")]
    except OSError:
        parts.append("")  # of another system
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:8]


def _is_alive(process: int) -> bool:
    """Whether there is a process of this number; True where asking would end it (Windows)."""
    if os.name == "nt":
        return True
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True
