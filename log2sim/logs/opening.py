"""Open a folder of recorded data as a `Log` with the reader of its format."""

from __future__ import annotations

from pathlib import Path

from log2sim import registry
from log2sim.datatypes import Log
from log2sim.errors import ConfigError, LogError
from log2sim.logs.reader import Reader

__all__ = ["Reader", "find_reader", "open_log"]

MAX_LISTED = 20


def open_log(path: Path | str, *, format: str = "auto", sequence: str | None = None) -> Log:
    """Open a log folder; only its index, calibration and poses are read, images and sweeps on request.

    Parameters
    ----------
    path : Path or str
        A sequence, or a root that holds one or several.
    format : str
        Name of a reader ("log2sim", "kitti", "kitti-tracking", "kitti-object", "pandaset", or a plug-in's), or "auto" to find it.
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
    return reader.open(root, _select_sequence(root, name, reader.sequences(root), sequence))


def find_reader(root: Path) -> str:
    """Name of the reader that matches a folder; `LogError` when none does."""
    known = []
    for name in registry.names("log"):
        reader: Reader = registry.load("log", name)
        if reader.matches(root):
            return name
        known.append(f"{name} ({reader.looks_for})")
    raise LogError(f"{root}: no known log format; a log is one of: {'; '.join(known)}. Force one with --format")


def _select_sequence(root: Path, name: str, available: list[str], sequence: str | None) -> str:
    if not available:
        reader: Reader = registry.load("log", name)
        raise LogError(f"{root}: holds no sequence of format '{name}'; expected {reader.looks_for}")
    if sequence is not None:
        if sequence not in available:
            hint = registry.nearest(sequence, available)
            raise ConfigError(f"{root}: no sequence '{sequence}'{hint}; there are: {_joined(available)}")
        return sequence
    if len(available) > 1:
        raise ConfigError(
            f"{root}: holds {len(available)} sequences; choose one with --sequence NAME: {_joined(available)}"
        )
    return available[0]


def _joined(names: list[str]) -> str:
    more = len(names) - MAX_LISTED
    return ", ".join(names[:MAX_LISTED]) + (f" and {more} more" if more > 0 else "")
