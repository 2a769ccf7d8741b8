"""Files that are read: regular ones only, and never more of them than a limit."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

# Of a file that grew since its size was asked for.
CHUNK_BYTES = 1024 * 1024
_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a named pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISCHR, "a device"),
    (stat.S_ISBLK, "a device"),
)


class TooLargeError(OSError):
    """A file that has more bytes than it may have."""


def open_regular(path: Path | str, *, buffering: int = -1) -> BinaryIO:
    """Open a regular file to read its bytes.

    Parameters
    ----------
    path : Path or str
    buffering : int
        As for `open`.

    Returns
    -------
    file object

    Raises
    ------
    OSError
        For a file that is missing or may not be read, and for whatever is no regular file. A pipe would wait for somebody who
        writes, a device may never end, and both have a size of 0.
    """
    _require_regular(os.stat(path).st_mode, path)  # before it is opened: opening a device may already do something
    # Without waiting, should it have become a pipe by now.
    handle = os.open(path, os.O_RDONLY | getattr(os, "O_BINARY", 0) | getattr(os, "O_NONBLOCK", 0))
    try:
        _require_regular(os.fstat(handle).st_mode, path)
    except BaseException:
        os.close(handle)
        raise
    return open(handle, "rb", buffering=buffering)


def read_bytes(path: Path | str, limit_bytes: int) -> bytes:
    """Read a whole regular file.

    Raises
    ------
    TooLargeError
        For more than `limit_bytes`, also in a file that grows while it is read; no more than that is read.
    OSError
        As `open_regular` does.
    """
    with open_regular(path, buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        parts, count = list[bytes](), 0
        while count <= limit_bytes and size <= limit_bytes:
            part = file.read(min(size - count if size > count else CHUNK_BYTES, limit_bytes + 1 - count))
            if not part:
                return parts[0] if len(parts) == 1 else b"".join(parts)
            parts.append(part)
            count += len(part)
    raise TooLargeError(
        errno.EFBIG, f"{max(size, count)} bytes, more than the {limit_bytes} that it may have", str(path)
    )


def read_file(
    path: Path | str,
    limit_bytes: int,
    error: type[Exception],
    *,
    where: str | None = None,
    missing: str = "no such file",
) -> bytes:
    """Read a whole regular file as `read_bytes` does; whatever is wrong with it is an `error` of one line.

    Parameters
    ----------
    path : Path or str
    limit_bytes : int
    error : type
        Of the exception that is raised.
    where : str, optional
        What its message begins with; by default the path.
    missing : str
        What it says of a file that is not there.
    """
    try:
        return read_bytes(path, limit_bytes)
    except FileNotFoundError:
        raise error(f"{where or path}: {missing}") from None
    except TooLargeError as problem:
        raise error(f"{where or path}: {problem.strerror}") from None
    except OSError as problem:
        raise error(f"{where or path}: cannot be read: {problem.strerror}") from None
    except ValueError as problem:  # a zero byte in the path
        raise error(f"{where or path}: cannot be read: {problem}") from None


def require_readable(path: Path | str, limit_bytes: int, error: type[Exception], what: str) -> None:
    """Check a file that another library is going to open by its name.

    Parameters
    ----------
    path : Path or str
    limit_bytes : int
    error : type
        Of the exception that is raised for a file that is missing, empty, too large or no regular file.
    what : str
        What it should be, for the message.
    """
    try:
        with open_regular(path, buffering=0) as file:
            size = os.fstat(file.fileno()).st_size
    except FileNotFoundError:
        raise error(f"{path}: no such file; give the path of {what}") from None
    except OSError as problem:
        raise error(f"{path}: cannot be read: {problem.strerror}; give the path of {what}") from None
    if not 0 < size <= limit_bytes:
        raise error(f"{path}: {size} bytes; expected {what} of 1 to {limit_bytes} bytes")


def read_text(path: Path | str, limit_bytes: int, error: type[Exception], *, missing: str = "no such file") -> str:
    """Read a text file in UTF-8, with or without a byte order mark, as `read_file` does."""
    try:
        return read_file(path, limit_bytes, error, missing=missing).decode("utf-8-sig")
    except UnicodeDecodeError as problem:
        raise error(f"{path}: not a text in UTF-8: {problem}") from None


def is_present(path: Path) -> bool:
    """Return whether there is anything of a name, for a file that a log may lack.

    A folder, a pipe or a link to nothing is there: whoever reads it raises an error, instead of taking it for missing.
    """
    return os.path.lexists(path)


def _require_regular(mode: int, path: Path | str) -> None:
    if not stat.S_ISREG(mode):
        kind = next((name for is_kind, name in _KINDS if is_kind(mode)), "something else")
        raise OSError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))
