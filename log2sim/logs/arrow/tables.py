"""Columns of feather (Arrow IPC) and parquet files as NumPy arrays; needs the extra "parquet" (pyarrow).

`read_columns` reads chosen columns of a whole file, `log2sim.logs.arrow.parquet_rows.ParquetRows` single rows of a large parquet
file. What a feather file declares (rows, decompressed sizes) is checked against `TableLimits` before anything is allocated;
parquet files are unpacked piece by piece up to the limits. What pyarrow returns is validated before it is used: pyarrow itself
trusts the offsets of text and lists that it reads.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from log2sim.errors import LogError, MissingExtra
from log2sim.input_files import open_regular, read_bytes
from log2sim.logs.arrow.ipc import ARROW_MAGIC, declared_size
from log2sim.logs.arrow.values import Kind, values_of

PARQUET_MAGIC = b"PAR1"
# Before this version a file could make pyarrow unpickle (CVE-2023-47248); the extra "parquet" requires it too.
MIN_PYARROW_VERSION = 17
# Rows of a parquet file that are unpacked before the limit of bytes is checked again.
ROWS_AT_A_TIME = 16_384


@dataclass(frozen=True)
class TableLimits:
    """What a table may have at most.

    Attributes
    ----------
    rows : int
    file_bytes : int
        Of a feather file, which is read as a whole. Parquet files are read in parts.
    unpacked_bytes : int
        Of all that is decompressed at a time.
    """

    rows: int = 20_000_000
    file_bytes: int = 1024**3
    unpacked_bytes: int = 2 * 1024**3


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

    Parameters
    ----------
    path : Path
    wanted : mapping of str to str
        What each column must hold. "float": numbers, as (N,) float32 if they are float16 or float32, else float64, NaN where
        one is missing. "int": whole numbers, (N,) int64. "bool": (N,) bool. "text": (N,) object of str, also of whole numbers
        ("3"). "bytes": (N,) object of bytes. "floats" and "ints": a list of numbers a row, (N, K) where the type says that
        all have the length K, else (N,) object of arrays. Columns encoded by a dictionary are decoded. Missing text, bytes
        and lists are None.
    optional : collection of str
        Names out of `wanted` that may be absent; they are absent in the result then.
    error : type
        What is raised: `LogError` for an index or calibration, `RecordError` for one record.
    limits : TableLimits

    Returns
    -------
    dict of str to (N, ...) array
        In the order of `wanted`.

    Raises
    ------
    LogError or `error`
        When the file is missing, too large, damaged, or has no such column; names file, column and what was expected.
    MissingExtra
        When pyarrow is not installed.
    """
    with translate_errors(path, error):
        table = _read_table(path, wanted, optional, limits)
        return {name: _values(table.column(name), name, wanted[name]) for name in wanted if name in table.column_names}


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


def checked_schema(schema: Any, wanted: Mapping[str, Kind], optional: Collection[str] = ()) -> list[str]:
    """Return the names out of `wanted` that a pyarrow schema has.

    Raises
    ------
    ValueError
        When a column is missing or there twice, or when its type is an extension: those run code of whoever registered them.
    """
    pyarrow = import_pyarrow()
    names = list(schema.names)
    for name in wanted:
        if name not in names and name not in optional:
            there = ", ".join(names[:20]) or "none"
            raise ValueError(f"no column '{name}'; expected {', '.join(wanted)}, found {there}")
        if names.count(name) > 1:
            raise ValueError(f"{names.count(name)} columns '{name}', expected one")
    chosen = [name for name in wanted if name in names]
    for field in (schema.field(name) for name in chosen):
        extension = b"ARROW:extension:name" in (field.metadata or {})
        if extension or isinstance(field.type, pyarrow.BaseExtensionType):
            raise ValueError(f"column '{field.name}' is of the extension type {field.type}, expected a plain type")
    return chosen


def _read_table(path: Path, wanted: Mapping[str, Kind], optional: Collection[str], limits: TableLimits) -> Any:
    """Read the wanted columns as a pyarrow table whose offsets were validated."""
    with open_regular(path) as file:
        magic = file.read(len(ARROW_MAGIC))
    if magic.startswith(PARQUET_MAGIC):
        table = _read_parquet(path, wanted, optional, limits)
    elif magic == ARROW_MAGIC:
        table = _read_feather(path, wanted, optional, limits)
    else:
        raise ValueError("neither an Arrow (feather, version 2) nor a parquet file")
    table.validate(full=True)
    return table


def _read_parquet(path: Path, wanted: Mapping[str, Kind], optional: Collection[str], limits: TableLimits) -> Any:
    """Read columns piece by piece, up to the limit: pyarrow does not check the sizes that the metadata declare."""
    pyarrow = import_pyarrow()
    from pyarrow.parquet import ParquetFile

    with ParquetFile(path) as file:
        names = checked_schema(file.schema_arrow, wanted, optional)
        check_rows(file.metadata.num_rows, limits)
        pieces, size = [], 0
        for piece in file.iter_batches(batch_size=ROWS_AT_A_TIME, columns=names, use_threads=False):
            pieces.append(piece)
            size += piece.nbytes
            _check_size(size, limits)
        return pyarrow.Table.from_batches(pieces) if pieces else file.schema_arrow.empty_table().select(names)


def check_rows(rows: int, limits: TableLimits) -> None:
    """Raise `ValueError` when a table declares more rows than it may have, or less than none."""
    if not 0 <= rows <= limits.rows:
        raise ValueError(f"{rows} rows, more than the {limits.rows} that a table may have")


def _check_size(unpacked_bytes: int, limits: TableLimits) -> None:
    if unpacked_bytes > limits.unpacked_bytes:
        raise ValueError(
            f"unpacks to {unpacked_bytes} bytes, more than the {limits.unpacked_bytes} that a table may have"
        )


def _read_feather(path: Path, wanted: Mapping[str, Kind], optional: Collection[str], limits: TableLimits) -> Any:
    pyarrow = import_pyarrow()
    data = read_bytes(path, limits.file_bytes)
    rows, unpacked = declared_size(data)
    check_rows(rows, limits)
    _check_size(unpacked, limits)
    with pyarrow.ipc.open_file(pyarrow.BufferReader(data)) as whole:
        names = checked_schema(whole.schema, wanted, optional)
        fields = [whole.schema.get_field_index(name) for name in names]
    options = pyarrow.ipc.IpcReadOptions(included_fields=fields, use_threads=False)
    with pyarrow.ipc.open_file(pyarrow.BufferReader(data), options=options) as file:
        return file.read_all() if names else pyarrow.table({})


def _values(column: Any, name: str, kind: Kind) -> NDArray[Any]:
    try:
        return values_of(column.combine_chunks(), kind)
    except ValueError as problem:
        raise ValueError(f"column '{name}': {problem}") from None
