"""Claims to output files and folders, so that of two runs at once the second is refused before its work."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path

from log2sim.errors import ConfigError

_claims: ContextVar[dict[Path, _Lock] | None] = ContextVar("claims", default=None)


@contextmanager
def holding_claims() -> Iterator[None]:
    """Within the block what `claim` takes is kept from other runs; at its end all is released."""
    held: dict[Path, _Lock] = {}
    token = _claims.set(held)
    try:
        yield
    finally:
        _claims.reset(token)
        # The first one made the folders for the others.
        for lock in reversed(held.values()):
            lock.release()


def claim(target: Path, *, overwrite: bool) -> None:
    """Within `holding_claims`: refuse a file or folder that another living run is about to write, or that cannot be written.

    Parameters
    ----------
    target : Path
    overwrite : bool
        Whether another run does not matter.

    Raises
    ------
    ConfigError
        Before anything was done.

    Notes
    -----
    A locked file next to the target shows it to others. The system unlocks it when the process ends in any way, so that no claim of a
    dead run stays. Folders that are missing above the target are made, and removed again where nothing came into them.
    """
    claims, path = _claims.get(), target.absolute()
    if claims is None or path in claims:
        return
    try:
        lock = _Lock.take(path)
    except BlockingIOError:
        if not overwrite:
            raise ConfigError(
                f"{target}: another run is about to write it; wait for that, choose another name or pass --overwrite"
            ) from None
    except OSError as error:
        raise ConfigError(f"{target}: cannot be written: {error.strerror or error}; choose another place") from None
    else:
        claims[path] = lock


@dataclass(frozen=True)
class _Lock:
    """A locked file: its name, its descriptor, and the folders made for it, the outermost first."""

    path: Path
    handle: int
    made: tuple[Path, ...]

    @classmethod
    def take(cls, target: Path) -> _Lock:
        """Make and lock the file beside a target; `BlockingIOError` where another process has locked it."""
        made = tuple(reversed([p for p in target.parents if not p.exists()]))
        target.parent.mkdir(parents=True, exist_ok=True)
        path = target.with_name(f".{target.name}.lock")
        try:
            while True:
                handle = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o666)
                lock = cls(path, handle, made)
                try:
                    _lock(handle)
                    if path.exists() and os.path.samestat(os.fstat(handle), path.stat()):
                        return lock
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


def _lock(handle: int) -> None:
    """Lock an open file for this process; without effect where the system or its file system has no such locks."""
    try:
        import fcntl
    except ImportError:
        return
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise
    except OSError:
        return


def _remove_empty(folders: Sequence[Path]) -> None:
    for folder in reversed(folders):
        try:
            folder.rmdir()
        except OSError:
            return
