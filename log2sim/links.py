"""Paths and symbolic links of a log: none leads out of its folders unless links are followed."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path

from log2sim.errors import LogError

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
    """Resolve a path that a log names.

    Raises
    ------
    LogError
        For a path outside the log's folder, also through a symbolic link unless links are followed.
    """
    try:
        resolved = (root / relative).resolve()
    except (OSError, RuntimeError, ValueError) as problem:  # a loop of symbolic links, a zero byte
        raise LogError(
            f"{what}: path {relative[:100]!r} cannot be followed: {problem}; give the path of a file"
        ) from None
    if _leaves_by_itself(relative) or not (_followed.get() or resolved.is_relative_to(root.resolve())):
        hint = "" if _leaves_by_itself(relative) else f"; where links may leave the log, pass {OPTION}"
        raise LogError(
            f"{what}: path '{relative}' leaves the log folder; use a path relative to it, without '..'{hint}"
        )
    return resolved


def require_links_inside(folder: Path, *roots: Path, files: Iterable[Path] = ()) -> None:
    """Refuse links in a folder of a log that lead out of it to something else, unless links are followed.

    Data sets are often laid out by links to the files of another place, so a link may lead anywhere to a file or folder of the same
    name, or of the same number ("000007.bin" and "0000000007.bin"). This is for layouts that fix the names of their files; where
    a log states them, `inside` allows no link that leaves.

    Parameters
    ----------
    folder : Path
        All that is in it is looked at; it may lie behind links itself.
    *roots : Path
        Other folders that belong to the log, such as the one that was named.
    files : iterable of Path
        Files of the log elsewhere; each must lie in one of the folders.

    Raises
    ------
    LogError
        Naming the first link that leads out, and where to.
    """
    if _followed.get():
        return
    allowed = [root.resolve() for root in (folder, *roots)]
    for link in (*_links_in(folder), *files):
        _require_inside(link, allowed)


def require_link_inside(file: Path, *roots: Path) -> None:
    """Refuse one file of a log that is a link out of its folders, as `require_links_inside` does.

    Raises
    ------
    LogError
        Naming the link and where it leads to.
    """
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


def _leaves_by_itself(relative: str) -> bool:
    """Whether a path leaves a folder by its own words, whatever is in the folder."""
    return Path(relative).is_absolute() or os.path.normpath(relative).split(os.sep)[0] == os.pardir
