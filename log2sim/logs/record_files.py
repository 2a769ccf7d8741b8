"""Files and folders of a log, by their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np

MAX_NUMBER = np.iinfo(np.int64).max
# More digits are no int64, and converting many of them takes long.
MAX_DIGITS = 19


def list_numbered_files(folder: Path, suffixes: tuple[str, ...]) -> dict[int, Path]:
    """Return the files of a folder by the number that is their name (of a frame, or a stamp), in the order of the numbers; others are left out.

    Parameters
    ----------
    folder : Path
        May be absent: there are no files then.
    suffixes : tuple of str
        In lower case, such as ".jpg" or ".pkl.gz".
    """
    found = {}
    for path in list_files(folder, suffixes):
        suffix = next(s for s in suffixes if path.name.lower().endswith(s))
        word = path.name[: -len(suffix)]
        if word.isdecimal() and len(word) <= MAX_DIGITS and int(word) <= MAX_NUMBER:
            found[int(word)] = path
    return dict(sorted(found.items()))


def list_folders(path: Path) -> list[Path]:
    """Return the folders in a folder, sorted; none where it cannot be read or is none."""
    try:
        return sorted(p for p in path.iterdir() if p.is_dir())
    except OSError:
        return []


def list_files(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """Return the files of a folder with one of some suffixes, sorted; none where there is no such folder."""
    if not folder.is_dir():
        return []
    return sorted(p for p in folder.iterdir() if p.name.lower().endswith(suffixes))
