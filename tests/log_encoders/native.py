"""Log2sim's own folders, by their writer."""

from __future__ import annotations

from pathlib import Path

from log2sim.datatypes import Log
from log2sim.logs.native.writer import write_log


def encode(log: Log, folder: Path) -> Path:
    """Write a log as `folder`/its name."""
    write_log(log, folder / log.name)
    return folder / log.name
