"""Rows of a component of version 2 by frame and sensor, their records read one at a time."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.input_files import is_present
from log2sim.logs.arrow.parquet_rows import ParquetRows, Row
from log2sim.logs.arrow.tables import read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.waymo.components import CAMERA, STAMP, Columns, numbers_of


@dataclass(frozen=True)
class RecordColumns:
    """Columns that are large and read row by row.

    Attributes
    ----------
    kinds : mapping of str to str
        What each column holds, as for `log2sim.logs.arrow.tables.read_columns`.
    optional : collection of str
        Names that may be absent.
    """

    kinds: Mapping[str, Kind]
    optional: Collection[str] = ()


@dataclass(eq=False)
class SensorRows:
    """A component with one row for each frame and sensor; without any where its file is absent.

    Parameters
    ----------
    path : Path
    index : mapping of str to str
        Columns to read at once, with the stamp and the sensor.
    names : mapping of int to str
        Sensors by number.
    frame_of : mapping of int to int
        Index of the frame of a stamp in us.
    records : RecordColumns

    Attributes
    ----------
    rows : dict of (int, int) to int
        Row of a frame by index and sensor by number.
    columns : mapping of str to array
        The columns of `index`.
    note : str
        What was left out; empty where nothing was.
    """

    path: Path
    index: Mapping[str, Kind]
    names: Mapping[int, str]
    frame_of: Mapping[int, int]
    records: RecordColumns
    rows: dict[tuple[int, int], int] = field(default_factory=dict)
    columns: Columns = field(default_factory=dict)
    note: str = ""

    def __post_init__(self) -> None:
        """Read the index."""
        self._files: dict[int, ParquetRows] = {}
        if not is_present(self.path):
            return
        self.columns = read_columns(self.path, self.index)
        sensor_column = CAMERA if CAMERA in self.index else next(name for name in self.index if name != STAMP)
        sensor = numbers_of(self.columns[sensor_column], self.names)
        frame = np.array([self.frame_of.get(int(t), -1) for t in self.columns[STAMP]], dtype=np.int64)
        known = np.flatnonzero((frame >= 0) & (sensor > 0))
        self.rows = {(int(frame[row]), int(sensor[row])): int(row) for row in known}
        if len(self.rows) < len(frame):
            lost = len(frame) - len(self.rows)
            self.note = f"{self.path.parent.name}: {lost} of {len(frame)} rows of no frame and sensor left out"
        # Rows can only be read on: a file with one sensor after the other is read from several places at once.
        by_sensor = bool(np.any(np.diff(frame[known]) < 0))
        shared = ParquetRows(self.path, self.records.kinds, optional=self.records.optional)
        for number in {number for _, number in self.rows}:
            own = ParquetRows(self.path, self.records.kinds, optional=self.records.optional) if by_sensor else shared
            self._files[number] = own

    def read(self, frame: int, sensor: int) -> Row | None:
        """Return the record of a frame and sensor; None where there is no row, `RecordError` for one that cannot be read."""
        row = self.rows.get((frame, sensor))
        return None if row is None else self._files[sensor].read(row)

    def by_frame(self, count: int) -> list[list[int]]:
        """Return the numbers of the sensors of each of `count` frames."""
        out: list[list[int]] = [[] for _ in range(count)]
        for frame, sensor in self.rows:
            out[frame].append(sensor)
        return out


def where(component: SensorRows, frame: int, sensor: int) -> str:
    """Name a record in errors."""
    return f"{component.path}, row {component.rows.get((frame, sensor), 'none')}"


def cell(row: Row | None, name: str) -> Any:
    """Return a value of a row; None where there is none."""
    return None if row is None else row.get(name)
