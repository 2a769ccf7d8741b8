"""Feather and parquet files as NumPy columns, with limits.

Layouts: Apache Arrow, format/File.fbs and format/Message.fbs; FlatBuffers internals for tables and vectors.

`read_columns` reads chosen columns of a whole file, `log2sim.logs.arrow.ParquetRows` single rows of a large parquet
file. What a feather file declares (rows, decompressed sizes) is checked against `TableLimits` before anything is allocated;
parquet files are unpacked piece by piece up to the limits. What pyarrow returns is validated before it is used: pyarrow itself
trusts the offsets of text and lists that it reads.
"""

from __future__ import annotations

import os
import struct
from collections import OrderedDict
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Lock
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, MissingExtra, RecordError
from log2sim.files.inputs import open_regular, read_bytes
from log2sim.logs.records import MAX_KEPT_BYTES

ARROW_MAGIC = b"ARROW1"
# A block, the place of a record batch in the file: offset (int64), bytes of its message (int32, padded), bytes of its body.
BLOCK = struct.Struct("<qi4xq")
BUFFER = struct.Struct("<qq")
# Of all record batches together; a table has about three a column and batch.
MAX_BUFFERS = 1_000_000

# Fields by their number.
FOOTER_DICTIONARIES, FOOTER_BATCHES = 2, 3
MESSAGE_TYPE, MESSAGE_HEADER = 1, 2
DICTIONARY_DATA = 1
BATCH_LENGTH, BATCH_BUFFERS, BATCH_COMPRESSION = 0, 2, 3
DICTIONARY_BATCH, RECORD_BATCH = 2, 3


def declared_size(data: bytes) -> tuple[int, int]:
    """Return the rows and the unpacked bytes of all record batches of an Arrow file; `ValueError` for a damaged one."""
    if len(data) < 24 or data[-6:] != ARROW_MAGIC:
        raise ValueError("the Arrow file is truncated: it does not end with ARROW1")
    try:
        (length,) = struct.unpack_from("<i", data, len(data) - 10)
        start = len(data) - 10 - length
        if length <= 0 or start < 8:
            raise ValueError("the footer of the Arrow file is damaged")
        footer = _indirect(data, start)
        rows = size = buffers = 0
        for field in (FOOTER_DICTIONARIES, FOOTER_BATCHES):
            for place in _vector(data, footer, field, BLOCK.size):
                offset, message_bytes, _ = BLOCK.unpack_from(data, place)
                batch = _batch(data, offset)
                places = _vector(data, batch, BATCH_BUFFERS, BUFFER.size)
                buffers += len(places) + 1
                if buffers > MAX_BUFFERS:
                    raise ValueError(f"more than the {MAX_BUFFERS} buffers that an Arrow file may have")
                packed = bool(_field(data, batch, BATCH_COMPRESSION))
                for p in places:
                    start, length = BUFFER.unpack_from(data, p)
                    if start < 0 or length < 0 or offset + message_bytes < 0:
                        raise ValueError("a buffer of the Arrow file is damaged")
                    # Compressed buffers begin with their unpacked size; -1 marks one that is not compressed.
                    if packed and length >= 8:
                        (unpacked,) = struct.unpack_from("<q", data, offset + message_bytes + start)
                        if unpacked < -1:
                            raise ValueError("a buffer of the Arrow file has a negative size")
                        length = length if unpacked == -1 else unpacked
                    size += length
                at = _field(data, batch, BATCH_LENGTH)
                rows += struct.unpack_from("<q", data, at)[0] if at and field == FOOTER_BATCHES else 0
        return rows, size
    except struct.error:
        raise ValueError("the structure of the Arrow file is damaged") from None


def _batch(data: bytes, offset: int) -> int:
    """Position of the record batch of a message; that inside of a batch of dictionary entries."""
    if offset < 8:
        raise ValueError("the structure of the Arrow file is damaged")
    (mark,) = struct.unpack_from("<I", data, offset)
    # Files written before version 0.15 lack the mark.
    message = _indirect(data, offset + (8 if mark == 0xFFFFFFFF else 4))
    (kind,) = struct.unpack_from("<B", data, _field(data, message, MESSAGE_TYPE) or len(data))
    header = _indirect(data, _field(data, message, MESSAGE_HEADER) or len(data))
    if kind == DICTIONARY_BATCH:
        return _indirect(data, _field(data, header, DICTIONARY_DATA) or len(data))
    if kind != RECORD_BATCH:
        raise ValueError("a record batch of the Arrow file is none")
    return header


def _indirect(data: bytes, place: int) -> int:
    return place + int(struct.unpack_from("<I", data, place)[0])


def _field(data: bytes, table: int, number: int) -> int:
    """Position of a field of a table; 0 when it is absent."""
    (back,) = struct.unpack_from("<i", data, table)
    vtable = table - back
    if vtable < 0:
        raise struct.error
    (size,) = struct.unpack_from("<H", data, vtable)
    if 4 + 2 * number + 2 > size:
        return 0
    (offset,) = struct.unpack_from("<H", data, vtable + 4 + 2 * number)
    return table + offset if offset else 0


def _vector(data: bytes, table: int, number: int, item_bytes: int) -> range:
    """Positions of the items of a vector of structs."""
    field = _field(data, table, number)
    if not field:
        return range(0)
    start = _indirect(data, field)
    (count,) = struct.unpack_from("<I", data, start)
    if start + 4 + count * item_bytes > len(data):
        raise struct.error
    return range(start + 4, start + 4 + count * item_bytes, item_bytes)


# Names, ids and categories; arrays of text make room for the longest in every row.
MAX_TEXT_CHARACTERS = 4096

Kind = Literal["float", "int", "bool", "text", "bytes", "floats", "ints"]


def values_of(column: Any, kind: Kind) -> NDArray[Any]:
    """Convert a validated pyarrow array of N values; `ValueError` says what was expected instead."""
    if kind not in get_args(Kind):
        raise TypeError(f"unknown kind '{kind}', expected one of {', '.join(get_args(Kind))}")
    import pyarrow

    types = pyarrow.types
    if types.is_dictionary(column.type):
        column = column.dictionary_decode()
    of = column.type
    if kind == "floats" or kind == "ints":
        return _lists(column, "float" if kind == "floats" else "int")
    if kind in ("bool", "int"):
        fits, expected = (types.is_boolean, "true or false") if kind == "bool" else (types.is_integer, "whole numbers")
        if not fits(of) or column.null_count:
            raise ValueError(f"is {of} with {column.null_count} missing values, expected {expected}")
        numbers: NDArray[Any] = column.to_numpy(zero_copy_only=False)
        if numbers.dtype == np.uint64 and len(numbers) and numbers.max() > np.iinfo(np.int64).max:
            raise ValueError("holds a number beyond int64")
        return numbers if kind == "bool" else numbers.astype(np.int64)
    if kind == "float":
        if not (types.is_integer(of) or types.is_floating(of)):
            raise ValueError(f"is {of}, expected numbers")
        is_short = of in (pyarrow.float16(), pyarrow.float32())
        return np.asarray(column.to_numpy(zero_copy_only=False).astype(np.float32 if is_short else np.float64))
    if kind == "bytes" and not (types.is_binary(of) or types.is_large_binary(of)):
        raise ValueError(f"is {of}, expected bytes")
    if kind == "text" and types.is_integer(of):
        return _objects([None if n is None else str(n) for n in column.to_pylist()])
    if kind == "text" and not (types.is_string(of) or types.is_large_string(of)):
        raise ValueError(f"is {of}, expected text")
    cells = column.to_pylist()
    longest = max((len(cell) for cell in cells if cell is not None), default=0) if kind == "text" else 0
    if longest > MAX_TEXT_CHARACTERS:
        raise ValueError(f"holds a text of {longest} characters, more than the {MAX_TEXT_CHARACTERS} that one may have")
    return _objects(cells)


def _lists(column: Any, kind: Literal["float", "int"]) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    if types.is_fixed_size_list(column.type):
        # `flatten` leaves out the values below missing lists, which are missing themselves.
        numbers = values_of(column.flatten(), kind).reshape(-1, column.type.list_size)
        if not column.null_count:
            return numbers
        present = iter(numbers)
        return _objects([next(present) if t else None for t in column.is_valid().to_pylist()])
    if not (types.is_list(column.type) or types.is_large_list(column.type)):
        raise ValueError(f"is {column.type}, expected a list of numbers a row")
    ends = column.offsets.to_numpy(zero_copy_only=False)
    # Of a slice of a table only the part that it refers to is converted.
    first, last = (int(ends[0]), int(ends[-1])) if len(ends) else (0, 0)
    numbers = values_of(column.values.slice(first, last - first), kind)
    there = np.ones(len(column), dtype=bool) if not column.null_count else column.is_valid().to_numpy(False)
    return _objects([numbers[a - first : b - first] if t else None for a, b, t in zip(ends, ends[1:], there)])


def _objects(cells: list[Any]) -> NDArray[Any]:
    values = np.empty(len(cells), dtype=object)
    for row, cell in enumerate(cells):
        values[row] = cell
    return values


PARQUET_MAGIC = b"PAR1"
# Before this version a file could make pyarrow unpickle (CVE-2023-47248); the extra "parquet" requires it too.
MIN_PYARROW_VERSION = 17
# Rows of a parquet file that are unpacked before the limit of bytes is checked again.
ROWS_AT_A_TIME = 16_384


@dataclass(frozen=True)
class TableLimits:
    """What a table may have at most."""

    rows: int = 20_000_000
    file_bytes: int = 1024**3  # of a feather file, which is read as a whole. Parquet files are read in parts.
    unpacked_bytes: int = 2 * 1024**3  # of all that is decompressed at a time


LIMITS = TableLimits()


def read_columns(
    path: Path,
    wanted: Mapping[str, Kind],
    *,
    optional: Collection[str] = (),
    error: type[LogError] = LogError,
    limits: TableLimits = LIMITS,
) -> dict[str, NDArray[Any]]:
    """Read columns of a feather or parquet file; its content decides which of the two it is, not its name.

    `wanted`: what each column must hold. "float": numbers, as (N,) float32 if they are float16 or float32, else
    float64, NaN where one is missing. "int": whole numbers, (N,) int64. "bool": (N,) bool. "text": (N,) object of str,
    also of whole numbers ("3"). "bytes": (N,) object of bytes. "floats" and "ints": a list of numbers a row, (N, K)
    where the type says that all have the length K, else (N,) object of arrays. Missing text, bytes and lists are None.
    `optional`: names that may be absent, in the result then too. Raises `error`, `RecordError` for one record, that names file,
    column and what was expected; `MissingExtra` when pyarrow is not installed.
    """
    pyarrow = import_pyarrow()
    with translate_errors(path, error):
        with open_regular(path) as file:
            magic = file.read(len(ARROW_MAGIC))
        if magic.startswith(PARQUET_MAGIC):
            # Piece by piece, up to the limit: pyarrow does not check the sizes that the metadata declare.
            from pyarrow.parquet import ParquetFile

            with ParquetFile(path) as whole:
                names = checked_schema(whole.schema_arrow, wanted, optional)
                _check_sizes(whole.metadata.num_rows, 0, limits)
                pieces, size = [], 0
                for piece in whole.iter_batches(batch_size=ROWS_AT_A_TIME, columns=names, use_threads=False):
                    pieces.append(piece)
                    size += piece.nbytes
                    _check_sizes(0, size, limits)
                schema = whole.schema_arrow
                table = pyarrow.Table.from_batches(pieces) if pieces else schema.empty_table().select(names)
        elif magic == ARROW_MAGIC:
            data = read_bytes(path, limits.file_bytes)
            _check_sizes(*declared_size(data), limits)
            with pyarrow.ipc.open_file(pyarrow.BufferReader(data)) as whole:
                names = checked_schema(whole.schema, wanted, optional)
                fields = [whole.schema.get_field_index(name) for name in names]
            options = pyarrow.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
            with pyarrow.ipc.open_file(pyarrow.BufferReader(data), options=options) as chosen:
                table = chosen.read_all() if names else pyarrow.table({})
        else:
            raise ValueError("neither an Arrow (feather, version 2) nor a parquet file")
        table.validate(full=True)
        return {name: _column(table.column(name).combine_chunks(), name, wanted) for name in names}


def _column(column: Any, name: str, wanted: Mapping[str, Kind]) -> NDArray[Any]:
    try:
        return values_of(column, wanted[name])
    except ValueError as problem:
        raise ValueError(f"column '{name}': {problem}") from None


def import_pyarrow() -> Any:
    """Return the module `pyarrow`; raise `MissingExtra` when it is missing or too old."""
    try:
        import pyarrow
    except ImportError:
        raise MissingExtra("reading feather and parquet files", "parquet") from None
    if int(pyarrow.__version__.split(".")[0]) < MIN_PYARROW_VERSION:
        raise MissingExtra(f"pyarrow {pyarrow.__version__} is too old; reading feather and parquet files", "parquet")
    return pyarrow


@contextmanager
def translate_errors(path: Path | str, error: type[LogError]) -> Iterator[None]:
    """Turn whatever reading `path` raises into `error` that begins with it, in one line."""
    pyarrow = import_pyarrow()
    try:
        yield
    except (LogError, MissingExtra):
        raise
    except FileNotFoundError:
        raise error(f"{path}: no such file") from None
    except (pyarrow.ArrowException, OSError, ValueError, TypeError, KeyError, IndexError, OverflowError) as problem:
        lines = str(getattr(problem, "strerror", None) or problem).strip().splitlines()
        raise error(f"{path}: {lines[0] if lines else type(problem).__name__}") from None


def checked_schema(schema: Any, wanted: Mapping[str, Kind], optional: Collection[str]) -> list[str]:
    """Return the names out of `wanted` that a pyarrow schema has; `ValueError` when one is missing, there twice, or an extension.

    Extension types run code of whoever registered them.
    """
    pyarrow, names = import_pyarrow(), list(schema.names)
    for name in wanted:
        if name not in names and name not in optional:
            there = ", ".join(names[:20]) or "none"
            raise ValueError(f"no column '{name}'; expected {', '.join(wanted)}, found {there}")
        if names.count(name) > 1:
            raise ValueError(f"{names.count(name)} columns '{name}', expected one")
    chosen = [name for name in wanted if name in names]
    for field in map(schema.field, chosen):
        extension = b"ARROW:extension:name" in (field.metadata or {})
        if extension or isinstance(field.type, pyarrow.BaseExtensionType):
            raise ValueError(f"column '{field.name}' is of the extension type {field.type}, expected a plain type")
    return chosen


def _check_sizes(rows: int, unpacked_bytes: int, limits: TableLimits) -> None:
    """Raise `ValueError` when a table has more rows, or less than none, or unpacks to more bytes than it may."""
    if not 0 <= rows <= limits.rows:
        raise ValueError(f"{rows} rows, more than the {limits.rows} that a table may have")
    if unpacked_bytes > limits.unpacked_bytes:
        raise ValueError(f"unpacks to {unpacked_bytes} bytes, more than the {limits.unpacked_bytes} allowed")


PARQUET_ROWS_AT_A_TIME = 8
# Compressed pages are read from the file in parts of this size, not a whole column of a row group at once.
READ_BYTES = 1024**2

Row = dict[str, Any]


class ParquetRows:
    """Rows of a parquet file, read on request, also from several threads; `wanted` and `optional` as in `read_columns`.

    To read a row of a parquet file, the rows before it in its row group have to be decoded. Reading therefore continues after
    the last row that was read, and decoded rows are kept up to `MAX_KEPT_BYTES`: reading in the order of the file decodes it
    once, reading an earlier row that is not kept starts its row group again. Many writers use one row group for the whole file.
    """

    def __init__(
        self, path: Path, wanted: Mapping[str, Kind], *, optional: Collection[str] = (), limits: TableLimits = LIMITS
    ) -> None:
        self._path, self._wanted, self._optional, self._limits = path, dict(wanted), optional, limits
        self._lock = Lock()
        self._file: Any = None
        self._process = 0  # whose file it is
        self._names: list[str] = []
        self._starts = np.zeros(1, dtype=np.int64)  # first rows of the row groups, and their end
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
        """Read row `index`: a number, str, bytes or array for each column, None where it is missing; `RecordError` if damaged."""
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
        if self._file is not None and self._process == os.getpid():
            return
        self._process, self._group = os.getpid(), -1
        from pyarrow.parquet import ParquetFile

        open_regular(self._path).close()  # pyarrow would wait for a pipe
        file = ParquetFile(self._path, buffer_size=READ_BYTES)
        self._names = checked_schema(file.schema_arrow, self._wanted, self._optional)
        groups = [file.metadata.row_group(g).num_rows for g in range(file.metadata.num_row_groups)]
        for rows in (min(groups, default=0), sum(groups)):
            _check_sizes(rows, 0, self._limits)
        self._starts = np.concatenate([[0], np.cumsum(np.array(groups, dtype=np.int64))])
        self._file = file

    def _read_on_to(self, index: int) -> Row:
        group = int(np.searchsorted(self._starts, index, side="right")) - 1
        if group != self._group or index < self._next:
            self._batches = self._file.iter_batches(
                batch_size=PARQUET_ROWS_AT_A_TIME, row_groups=[group], columns=self._names, use_threads=False
            )
            self._group, self._next = group, int(self._starts[group])
        while index >= self._next:
            batch = next(self._batches, None)
            if batch is None:
                raise ValueError("its row group holds fewer rows than the file says")
            _check_sizes(0, batch.nbytes, self._limits)
            batch.validate(full=True)
            columns = {name: _column(batch.column(name), name, self._wanted) for name in self._names}
            rows = {self._next + k: {n: values[k] for n, values in columns.items()} for k in range(batch.num_rows)}
            self._next += batch.num_rows
            for number, row in rows.items():
                self._kept_bytes += _size(row) - _size(self._kept.pop(number, {}))
                self._kept[number] = row
            while self._kept_bytes > MAX_KEPT_BYTES:
                self._kept_bytes -= _size(self._kept.popitem(last=False)[1])
        return rows[index]


def _size(row: Row) -> int:
    return sum(v.nbytes if isinstance(v, (np.ndarray, np.generic)) else len(v or b"") for v in row.values())
