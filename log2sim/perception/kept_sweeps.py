"""A reader that keeps sweeps, for work that asks for the same ones several times."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from log2sim.array_file import ArrayFile, ArrayList
from log2sim.datatypes import Log, Sweep
from log2sim.perception.frames import RecordReader

# Columns of a sweep with a row a point.
COLUMNS = ("xyz_m", "t_ns", "intensity")


class KeepingReader(RecordReader):
    """Read records; the first `most` sweeps are kept in an `ArrayFile`, from where they come in milliseconds."""

    def __init__(self, log: Log, most: int) -> None:
        super().__init__(log)
        self._most = most
        self._kept: dict[tuple[str, int], tuple[Sweep, list[str], ArrayList]] = {}
        self._file = ArrayFile()

    def get(self, stream: str, index: int) -> Any | None:
        """Read a record, or take it from those that are kept; None when it cannot be read."""
        kept = self._kept.get((stream, index))
        if kept is not None:
            head, names, columns = kept
            read: dict[str, Any] = dict(zip(names, columns, strict=True))
            return replace(head, **read)
        record = super().get(stream, index)
        if isinstance(record, Sweep) and len(self._kept) < self._most:
            self._keep((stream, index), record)
        return record

    def forget(self) -> None:
        """Let go of all sweeps, and keep no more."""
        self._most = 0
        self._kept.clear()
        self._file = ArrayFile()

    def _keep(self, key: tuple[str, int], sweep: Sweep) -> None:
        names = [name for name in COLUMNS if getattr(sweep, name) is not None]
        columns = ArrayList([self._file.keep(getattr(sweep, name)) for name in names])
        empty: dict[str, Any] = {name: getattr(sweep, name)[:0].copy() for name in names}
        head = replace(sweep, **empty)
        self._kept[key] = head, names, columns
