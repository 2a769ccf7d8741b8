"""Files that are read: regular ones, up to a limit, and no link that leads out of a log."""

from __future__ import annotations

import errno
import os
import stat
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import BinaryIO

from log2sim.errors import LogError

# Of a file that grew since its size was asked for.
CHUNK_BYTES = 1024 * 1024
# Of one name in ext4, XFS, Btrfs, NTFS and APFS; of a path in Linux, less what a folder above may have.
MAX_NAME_BYTES, MAX_PATH_BYTES = 255, 3072
_KINDS = {
    stat.S_IFDIR: "a folder", stat.S_IFIFO: "a named pipe", stat.S_IFSOCK: "a socket", stat.S_IFCHR: "a device", stat.S_IFBLK: "a device",
}  # fmt: skip


class TooLargeError(OSError):
    """A file that has more bytes than it may have."""


def open_regular(path: Path | str, *, buffering: int = -1) -> BinaryIO:
    """Open a regular file to read its bytes; `OSError` for one that is missing or may not be read, and for whatever else it is.

    A pipe would wait for somebody who writes, a device may never end, and both have a size of 0.
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
    """Read a whole regular file of up to `limit_bytes`, also one that grows meanwhile, else `TooLargeError`; as `open_regular`."""
    with open_regular(path, buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        parts, count = list[bytes](), 0
        while count <= limit_bytes and size <= limit_bytes:
            part = file.read(min(size - count if size > count else CHUNK_BYTES, limit_bytes + 1 - count))
            if not part:
                return parts[0] if len(parts) == 1 else b"".join(parts)
            parts.append(part)
            count += len(part)
    found = f"{max(size, count)} bytes, more than the {limit_bytes} that it may have"
    raise TooLargeError(errno.EFBIG, found, str(path))


def read_file(
    path: Path | str, limit_bytes: int, error: type[Exception], *, where: str | None = None, missing: str = "no such file"
) -> bytes:  # fmt: skip
    """Read a whole regular file as `read_bytes` does; whatever is wrong with it is an `error` of one line.

    It begins with `where`, by default the path; `missing` is what it says of a file that is not there.
    """
    try:
        return read_bytes(path, limit_bytes)
    except FileNotFoundError:
        problem = missing
    except OSError as other:
        problem = f"{'' if isinstance(other, TooLargeError) else 'cannot be read: '}{other.strerror}"
    except ValueError as other:  # a zero byte in the path
        problem = f"cannot be read: {other}"
    raise error(f"{where or path}: {problem}")


def require_readable(path: Path | str, limit_bytes: int, error: type[Exception], what: str) -> None:
    """Check a file that another library is going to open by its name; `error` where it is missing, empty, too large or irregular."""
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
        kind = _KINDS.get(stat.S_IFMT(mode), "something else")
        raise OSError(errno.EINVAL, f"is {kind}, expected a regular file", str(path))


# Of the number of a record, by which its file is called.
MAX_DIGITS = 20
OPTION = "--follow-links"
_followed: ContextVar[bool] = ContextVar("followed", default=False)


@contextmanager
def following_links(follow: bool | None = True) -> Iterator[None]:
    """Within the block links of logs that are opened may leave the log's folders, or may not; None changes nothing."""
    token = _followed.set(_followed.get() if follow is None else follow)
    try:
        yield
    finally:
        _followed.reset(token)


def follows_links() -> bool:
    """Return whether links of logs may leave the log's folders here."""
    return _followed.get()


def inside(root: Path, relative: str, what: str) -> Path:
    """Resolve a path that a log names; `LogError` where it leaves the log's folder, also by a link unless links are followed."""
    for name, most in (*((part, MAX_NAME_BYTES) for part in Path(relative).parts), (relative, MAX_PATH_BYTES)):
        if len(os.fsencode(name)) > most:
            raise LogError(f"{what}: the file name '{name[:20]}...' is longer than the {most} bytes of file systems")
    try:
        resolved = (root / relative).resolve()
    except (OSError, RuntimeError, ValueError) as problem:  # a loop of symbolic links, a zero byte
        why = f"path {relative[:100]!r} cannot be followed: {problem}"
        raise LogError(f"{what}: {why}; give the path of a file") from None
    # By its own words, whatever is in the folder.
    by_itself = Path(relative).is_absolute() or os.path.normpath(relative).split(os.sep)[0] == os.pardir
    if by_itself or not (_followed.get() or resolved.is_relative_to(root.resolve())):
        hint = "" if by_itself else f"; where links may leave the log, pass {OPTION}"
        advice = "use a path relative to it, without '..'"
        raise LogError(f"{what}: path '{relative}' leaves the log folder; {advice}{hint}")
    return resolved


def require_links_inside(folder: Path, *roots: Path, files: Iterable[Path] = ()) -> None:
    """Refuse links in a folder of a log that lead out of it to something else, unless links are followed.

    Data sets are often laid out by links to the files of another place, so a link may lead anywhere to a file or folder of the same
    name, or of the same number ("000007.bin" and "0000000007.bin"). This is for layouts that fix the names of their files; where
    a log states them, `inside` allows no link that leaves.

    `folder`: all that is in it is looked at; it may lie behind links itself. `roots`: other folders that belong to the log, such as
    the one that was named. `files`: files of the log elsewhere; each must lie in one of the folders. Raises `LogError` naming the
    first link that leads out, and where to.
    """
    if not _followed.get():
        allowed = [root.resolve() for root in (folder, *roots)]
        for link in (*_links_in(folder), *files):
            _require_inside(link, allowed)


def require_link_inside(file: Path, *roots: Path) -> None:
    """Refuse one file of a log that is a link out of its folders, as `require_links_inside` does."""
    if not _followed.get():
        _require_inside(file, [root.resolve() for root in roots])


def _require_inside(link: Path, allowed: Iterable[Path]) -> None:
    try:
        target = link.resolve()
    except (OSError, RuntimeError) as problem:
        raise LogError(f"{link}: is a link that cannot be followed: {problem}; give the path of a file") from None
    if not any(target.is_relative_to(root) for root in allowed) and _record_of(link) != _record_of(target):
        raise LogError(f"{link}: is a link that leaves the log folder, to {target}; pass {OPTION} if it belongs to it")


def _links_in(folder: Path) -> Iterator[Path]:
    """Yield the symbolic links below a folder, in the order of their names; what cannot be listed has none."""
    try:
        with os.scandir(folder) as entries:
            found = sorted(entries, key=lambda entry: entry.name)
    except OSError:
        return
    for entry in found:
        if entry.is_symlink():
            yield Path(entry.path)
        elif entry.is_dir(follow_symlinks=False):
            yield from _links_in(Path(entry.path))


def _record_of(path: Path) -> tuple[int | str, str]:
    """Return the number, or the name, and the suffixes of a file of a data set."""
    stem, dot, suffix = path.name.partition(".")
    return int(stem) if stem.isdecimal() and len(stem) < MAX_DIGITS else stem, dot + suffix
