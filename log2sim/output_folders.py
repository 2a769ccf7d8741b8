"""Output folders: complete or absent, and an error names the file in them that cannot be written."""

from __future__ import annotations

import ctypes
import errno
import glob
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from log2sim.errors import ConfigError
from log2sim.outputs import remove, temporary_beside, written_meanwhile

# Of the system call: paths count from the working folder; both names stay, exchanged (linux/fcntl.h, linux/fs.h).
_WORKING_FOLDER, _EXCHANGE = -100, 2


@contextmanager
def replaced_folder(target: Path, *, overwrite: bool) -> Iterator[Path]:
    """Yield a temporary folder beside `target` that takes its place when the block succeeds.

    Parameters
    ----------
    target : Path
    overwrite : bool
        Whether a folder may be replaced; without it only an empty one is.

    Raises
    ------
    ConfigError
        When it cannot be written, naming the file in it, or when another run wrote the target meanwhile.

    Notes
    -----
    On Linux the new folder and the one that it replaces exchange their names at once, so that a run that is killed leaves either. On
    other systems there is a moment at which the target has no name; what was there is beside it then, as `.NAME.XXXXXXXX.old`.
    """
    with unfinished_folder(temporary_beside(target), target) as temporary:
        yield temporary
        if overwrite and target.exists() and exchange_names(temporary, target):
            return  # what was there is under the temporary name now, and is removed with it
        # Under another name than what the next run removes at its start: it is the only copy until a new folder is in its place.
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
        for replaced in _earlier_copies(target):  # of runs that died before this line, too
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

    Raises
    ------
    ConfigError
        When one of its files cannot be written, naming what it would have become.
    """
    try:
        temporary.mkdir(parents=True)
        yield temporary
    except ConfigError as error:
        if type(error) is not ConfigError or str(temporary) not in str(error):
            raise
        raise ConfigError(str(error).replace(str(temporary), str(target))) from error
    except OSError as error:
        path = Path(error.filename) if isinstance(error.filename, str) else _latest_in(temporary)
        if path != target and not path.is_relative_to(temporary):
            raise  # of a file that is read
        inside = path.relative_to(temporary) if path.is_relative_to(temporary) else Path()
        raise ConfigError(f"{target / inside}: cannot be written: {error.strerror or error}") from error
    finally:
        remove(temporary)


def _earlier_copies(target: Path) -> list[Path]:
    """Return what was at a target and made room for a new folder."""
    return list(target.parent.glob(f".{glob.escape(target.name)}.{'[0-9a-f]' * 8}.old"))


def _latest_in(folder: Path) -> Path:
    """Return the file of a folder that was changed last: writing names no file when it fails for lack of space."""
    files = [path for path in folder.rglob("*") if path.is_file()]
    return max(files, key=lambda path: path.stat().st_mtime_ns, default=folder)
