"""Output files and folders: complete or absent, several that appear together, claimed by one run, and none that replaces another's."""

from __future__ import annotations

import ctypes
import errno
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
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from log2sim.errors import ConfigError

_claims: ContextVar[dict[Path, _Lock] | None] = ContextVar("claims", default=None)


@contextmanager
def holding_claims() -> Iterator[None]:
    """Within the block what `claim` takes is kept from other runs, and files of `expect_new` replace none that others wrote since."""
    held: dict[Path, _Lock] = {}
    token, new = _claims.set(held), _expected_new.set(set())
    try:
        yield
    finally:
        _claims.reset(token)
        _expected_new.reset(new)
        # The first one made the folders for the others.
        for lock in reversed(held.values()):
            lock.release()


def claim(target: Path, *, overwrite: bool) -> None:
    """Within `holding_claims`: refuse a file or folder that another living run is about to write, or that cannot be written.

    Raises `ConfigError` before anything was done; with `overwrite` another run does not matter. A locked file next to the target
    shows it to others. The system unlocks it when the process ends in any way, so that no claim of a dead run stays. Folders that
    are missing above the target are made, and removed again where nothing came into them.
    """
    claims, path = _claims.get(), target.absolute()
    if claims is None or path in claims:
        return
    try:
        claims[path] = _Lock.take(path)
    except BlockingIOError:
        if not overwrite:
            raise ConfigError(
                f"{target}: another run is about to write it; wait, choose another name or pass --overwrite"
            ) from None
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror or error}; choose another place") from None


@dataclass(frozen=True)
class _Lock:
    """A locked file: its name, its descriptor, and the folders made for it, the outermost first."""

    path: Path
    handle: int
    made: tuple[Path, ...]

    @classmethod
    def take(cls, target: Path) -> _Lock:
        """Make and lock the file beside a target; `BlockingIOError` where another process has locked it.

        Where the system or its file system has no such locks, nothing is locked.
        """
        made = tuple(reversed([p for p in target.parents if not p.exists()]))
        target.parent.mkdir(parents=True, exist_ok=True)
        path = target.with_name(f".{target.name}.lock")
        try:
            while True:
                handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
                try:
                    try:
                        import fcntl

                        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
                    except BlockingIOError:
                        raise
                    except (ImportError, OSError):
                        pass
                    if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
                        return cls(path, handle, made)
                except BaseException:
                    os.close(handle)
                    raise
                os.close(handle)  # the run that had it removed it meanwhile
        except BaseException:
            _remove_empty(made)
            raise

    def release(self) -> None:
        """Remove the file, and the folders that are still empty."""
        self.path.unlink(missing_ok=True)
        os.close(self.handle)
        _remove_empty(self.made)


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in reversed(folders):
        try:
            folder.rmdir()
        except OSError:
            return


_TEMPORARY = re.compile(r"\.(?P<machine>[0-9a-f]{8})-(?P<process>[0-9]{1,10})-[0-9a-f]{8}(?=\.|$)")
_waiting: ContextVar[list[tuple[Path, Path]] | None] = ContextVar("waiting", default=None)
_expected_new: ContextVar[set[Path] | None] = ContextVar("expected_new", default=None)


def temporary_beside(target: Path) -> Path:
    """Return a free name for a file or folder that becomes `target`; what runs that died left under such names is removed.

    The name holds the machine since its last start and the process, so that of another living run nothing is removed.
    """
    for left in target.parent.glob(f".{glob.escape(target.stem)}.*"):
        if is_left_over(left):
            remove(left)
    return target.with_name(f".{target.stem}.{_machine()}-{os.getpid()}-{secrets.token_hex(4)}{target.suffix}")


def is_temporary(path: Path) -> bool:
    """Return whether a file or folder has a name of `temporary_beside`."""
    return _TEMPORARY.search(path.name) is not None


def is_left_over(path: Path) -> bool:
    """Return whether a file or folder has such a name of a process of this machine that is not there any more."""
    found = _TEMPORARY.search(path.name)
    if found is None or found["machine"] != _machine() or os.name == "nt":  # on Windows asking would end the process
        return False
    try:
        os.kill(int(found["process"]), 0)
    except ProcessLookupError:
        return True
    except (OSError, OverflowError):
        pass
    return False


def remove(path: Path) -> None:
    """Remove a file, a link or a folder with all in it, as far as that is possible."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)


def put(temporary: Path, target: Path) -> bool:
    """Rename a finished file to its target, or keep it for the end of `together`; return whether it waits for that.

    Raises `ConfigError` when another run wrote the target meanwhile and this one may not replace it; `OSError` when it fails.
    """
    waiting, expected_new = _waiting.get(), _expected_new.get()
    if waiting is not None:
        waiting.append((temporary, target))
        return True
    if expected_new is None or target.resolve() not in expected_new:
        os.replace(temporary, target)
        return False
    try:
        os.link(temporary, target)  # a renaming would replace what is there
        temporary.unlink()
    except OSError as error:  # there is one, or the file system has no hard links
        if isinstance(error, FileExistsError) or target.exists():
            raise written_meanwhile(target) from None
        os.replace(temporary, target)
    expected_new.discard(target.resolve())
    return False


def written_meanwhile(target: Path) -> ConfigError:
    """Return the error for a target that another run wrote while this one worked."""
    return ConfigError(f"{target}: another run has written it meanwhile; choose another name or pass --overwrite")


@contextmanager
def together() -> Iterator[None]:
    """Within the block files are written under temporary names; at its end all of them appear, after an error none."""
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
    """Rename finished files to their targets, all of them or none; `ConfigError` when one of them cannot be renamed."""
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


def expect_new(targets: Iterable[Path]) -> None:
    """Remember that there are no such files yet, and that none may be replaced, within `holding_claims`."""
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


# Of the system call: paths count from the working folder; both names stay, exchanged (linux/fcntl.h, linux/fs.h).
_WORKING_FOLDER, _EXCHANGE = -100, 2


@contextmanager
def replaced_folder(target: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that takes its place when the block succeeds.

    `overwrite`: whether a folder may be replaced; without it only an empty one is. Raises `ConfigError` when it cannot
    be written, naming the file in it, or when another run wrote the target meanwhile.

    On Linux the new folder and the one that it replaces exchange their names at once, so that a run that is killed leaves either. On
    other systems there is a moment at which the target has no name; what was there is beside it then, as `.NAME.XXXXXXXX.old`.
    """
    with unfinished_folder(temporary_beside(target), target) as temporary:
        yield temporary
        if overwrite and target.exists() and exchange_names(temporary, target):
            return  # what was there is under the temporary name now, and is removed with it
        # A name that the next run does not remove at its start: until the new folder is in its place it is the only copy.
        earlier = target.with_name(f".{target.name}.{secrets.token_hex(4)}.old")
        if overwrite and target.exists():
            target.rename(earlier)
        try:
            if target.is_dir() and not any(target.iterdir()):
                target.rmdir()
            temporary.rename(target)  # fails where there is a folder with anything in it
        except BaseException as error:
            if earlier.exists():
                earlier.rename(target)
            elif isinstance(error, OSError) and error.errno in (errno.ENOTEMPTY, errno.EEXIST):
                raise written_meanwhile(target) from None
            raise
        # Also those of runs that died before this line.
        for replaced in list(target.parent.glob(f".{glob.escape(target.name)}.{'[0-9a-f]' * 8}.old")):
            remove(replaced)


def exchange_names(one: Path, other: Path) -> bool:
    """Exchange the names of two files or folders at once, by renameat2 of Linux; return False where that is not possible."""
    try:
        rename = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError, TypeError):  # another system, an old C library, Windows
        return False
    names = os.fsencode(one.absolute()), os.fsencode(other.absolute())
    return bool(rename(_WORKING_FOLDER, names[0], _WORKING_FOLDER, names[1], _EXCHANGE) == 0)


@contextmanager
def unfinished_folder(temporary: Path, target: Path) -> Iterator[Path]:
    """Make a folder for files that are to be moved to `target`, and remove what is left of it after the block.

    Raises `ConfigError` when one of its files cannot be written, naming what it would have become.
    """
    try:
        temporary.mkdir(parents=True)
        yield temporary
    except ConfigError as error:
        if type(error) is not ConfigError or str(temporary) not in str(error):
            raise
        raise ConfigError(str(error).replace(str(temporary), str(target))) from error
    except OSError as error:
        # Writing names no file when it fails for lack of space: then it is the one that was changed last.
        inside = [path for path in temporary.rglob("*") if path.is_file()]
        latest = max(inside, key=lambda path: path.stat().st_mtime_ns, default=temporary)
        path = Path(error.filename) if isinstance(error.filename, str) else latest
        if path != target and not path.is_relative_to(temporary):
            raise  # of a file that is read
        place = target / path.relative_to(temporary) if path.is_relative_to(temporary) else target
        raise ConfigError(f"{place}: cannot be written: {error.strerror or error}") from error
    finally:
        remove(temporary)
