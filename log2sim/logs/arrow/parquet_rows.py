"""Single rows of a parquet file that is too large to be held as a whole."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np

from log2sim.errors import LogError, RecordError
from log2sim.input_files import open_regular
from log2sim.logs.arrow.tables import LIMITS, TableLimits, check_rows, checked_schema, import_pyarrow, translate_errors
from log2sim.logs.arrow.values import Kind, values_of

# Decoded rows are kept up to this size; see `ParquetRows`.
MAX_KEPT_BYTES = 256 * 1024**2
ROWS_AT_A_TIME = 8
# Compressed pages are read from the file in parts of this size, not a whole column of a row group at once.
READ_BYTES = 1024**2

Row = dict[str, Any]


class ParquetRows:
    """Rows of a parquet file, read on request, also from several threads.

    Parameters
    ----------
    path : Path
    wanted : mapping of str to str
        The columns of a row and what they hold, as for `log2sim.logs.arrow.tables.read_columns`.
    optional : collection of str
        Names out of `wanted` that may be absent.
    limits : TableLimits

    Notes
    -----
    To read a row of a parquet file, the rows before it in its row group have to be decoded. Reading therefore continues after
    the last row that was read, and decoded rows are kept up to `MAX_KEPT_BYTES`: reading in the order of the file decodes it
    once, reading an earlier row that is not kept starts its row group again. Many writers use one row group for the whole file.
    """

    def __init__(
        self,
        path: Path,
        wanted: Mapping[str, Kind],
        *,
        optional: Collection[str] = (),
        limits: TableLimits = LIMITS,
    ) -> None:
        self._path, self._wanted, self._optional, self._limits = path, dict(wanted), optional, limits
        self._lock = Lock()
        self._file: Any = None
        self._names: list[str] = []
        # First rows of the row groups, and their end.
        self._starts = np.zeros(1, dtype=np.int64)
        self._group, self._next = -1, 0
        self._batches: Iterator[Any] = iter(())
        self._kept: OrderedDict[int, Row] = OrderedDict()
        self._kept_bytes = 0

    def __len__(self) -> int:
        """Return the number of rows; raise `LogError` when the file is missing, damaged or lacks a wanted column."""
        with self._lock, translate_errors(self._path, LogError):
            self._open()
            return int(self._starts[-1])

    def read(self, index: int) -> Row:
        """Read row `index`: a number, str, bytes or array for each column, None where it is missing.

        Raises
        ------
        RecordError
            When the file is damaged there or lacks a wanted column; names file, row and column.
        """
        with self._lock, translate_errors(f"{self._path}, row {index}", RecordError):
            self._open()
            if not 0 <= index < self._starts[-1]:
                raise ValueError(f"no such row; there are {self._starts[-1]}")
            if index in self._kept:
                self._kept.move_to_end(index)
                return self._kept[index]
            try:
                return self._read_on_to(index)
            except BaseException:
                # The position in the file is not known any more.
                self._group = -1
                raise

    def _open(self) -> None:
        if self._file is not None:
            return
        import_pyarrow()
        from pyarrow.parquet import ParquetFile

        open_regular(self._path).close()  # pyarrow would wait for a pipe
        file = ParquetFile(self._path, buffer_size=READ_BYTES)
        self._names = checked_schema(file.schema_arrow, self._wanted, self._optional)
        groups = [file.metadata.row_group(g).num_rows for g in range(file.metadata.num_row_groups)]
        check_rows(min(groups, default=0), self._limits)
        check_rows(sum(groups), self._limits)
        self._starts = np.concatenate([[0], np.cumsum(np.array(groups, dtype=np.int64))])
        self._file = file

    def _read_on_to(self, index: int) -> Row:
        group = int(np.searchsorted(self._starts, index, side="right")) - 1
        if group != self._group or index < self._next:
            self._batches = self._file.iter_batches(
                batch_size=ROWS_AT_A_TIME, row_groups=[group], columns=self._names, use_threads=False
            )
            self._group, self._next = group, int(self._starts[group])
        while True:
            batch = next(self._batches, None)
            if batch is None:
                raise ValueError("its row group holds fewer rows than the file says")
            if batch.nbytes > self._limits.unpacked_bytes:
                raise ValueError(
                    f"unpacks to {batch.nbytes} bytes, more than the {self._limits.unpacked_bytes} allowed"
                )
            rows = self._rows(batch)
            if index in rows:
                return rows[index]

    def _rows(self, batch: Any) -> dict[int, Row]:
        """Rows of a batch by their number; they are kept until newer ones need the room."""
        batch.validate(full=True)
        columns = {}
        for name in self._names:
            try:
                columns[name] = values_of(batch.column(name), self._wanted[name])
            except ValueError as problem:
                raise ValueError(f"column '{name}': {problem}") from None
        rows = {self._next + k: {name: values[k] for name, values in columns.items()} for k in range(batch.num_rows)}
        self._next += batch.num_rows
        for number, row in rows.items():
            self._kept_bytes += _size(row) - _size(self._kept.pop(number, {}))
            self._kept[number] = row
        while self._kept_bytes > MAX_KEPT_BYTES:
            self._kept_bytes -= _size(self._kept.popitem(last=False)[1])
        return rows


def _size(row: Row) -> int:
    return sum(v.nbytes if isinstance(v, (np.ndarray, np.generic)) else len(v or b"") for v in row.values())
