"""Log readers: a folder of recorded data in, a `Log` out, whatever its layout."""

from __future__ import annotations

from pathlib import Path

from log2sim import registry
from log2sim.datatypes import Log
from log2sim.errors import ConfigError, LogError
from log2sim.logs.reader import Reader

__all__ = ["Reader", "find_reader", "open_log"]


def open_log(path: Path | str, *, format: str = "auto", sequence: str | None = None) -> Log:
    """Open a log folder; nothing but its index, calibration, poses and labels is read.

    Parameters
    ----------
    path : Path or str
        A sequence, or a root that holds one or several.
    format : str
        Name of a reader ("log2sim", "kitti", "kitti-tracking", "pandaset", or a plug-in's), or "auto" to find it.
    sequence : str, optional
        Which sequence of a root; needed only when it holds several.

    Raises
    ------
    LogError
        When the folder is missing, no reader knows its layout, or its contents are inconsistent.
    ConfigError
        When the format is unknown, or the sequence is missing, unknown or ambiguous.
    """
    root = Path(path)
    if not root.exists():
        raise LogError(f"{root}: no such folder; give the folder of a log")
    if not root.is_dir():
        raise LogError(f"{root}: is a file; give the folder of a log")
    name = find_reader(root) if format == "auto" else format
    reader: Reader = registry.load("log", name)
    return reader.open(root, _choose(root, name, reader.sequences(root), sequence))


def find_reader(root: Path) -> str:
    """The name of the reader that knows the layout of a folder."""
    known = []
    for name in registry.names("log"):
        reader: Reader = registry.load("log", name)
        if reader.matches(root):
            return name
        known.append(f"{name} ({reader.looks_for})")
    raise LogError(f"{root}: no known log format; a log is one of: {'; '.join(known)}. Force one with --format")


def _choose(root: Path, name: str, found: list[str], sequence: str | None) -> str:
    if not found:
        reader: Reader = registry.load("log", name)
        raise LogError(f"{root}: holds no sequence of format '{name}'; expected {reader.looks_for}")
    if sequence is not None:
        if sequence not in found:
            hint = registry.nearest(sequence, found)
            raise ConfigError(f"{root}: no sequence '{sequence}'{hint}; there are: {_listed(found)}")
        return sequence
    if len(found) > 1:
        raise ConfigError(f"{root}: holds {len(found)} sequences; choose one with --sequence NAME: {_listed(found)}")
    return found[0]


def _listed(names: list[str], most: int = 20) -> str:
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")
