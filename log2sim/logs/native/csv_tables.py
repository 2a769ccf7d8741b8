"""CSV tables of a log, read strictly: errors name file, line and field."""

from __future__ import annotations

import csv
import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.input_files import read_file
from log2sim.numerals import is_plain
from log2sim.registry import nearest

MAX_TABLE_BYTES = 256 * 1024 * 1024
# No coordinate on Earth, in any projection, is near this, and no square of it overflows.
MAX_NUMBER = 1e8

_DTYPE = {"int": np.int64, "float": np.float64}
_EXPECTED = {
    "int": "a whole number",
    "float": f"a finite number of at most {MAX_NUMBER:g} in size",
    "bool": "0, 1, true or false",
    "str": "text",
}


@dataclass(frozen=True, eq=False)
class CsvTable:
    """A CSV file with typed columns.

    Attributes
    ----------
    path : Path
    columns : mapping of str to (N,) array
    line : (N,) int64
        Line of the file of each row, for messages.
    sha256 : str
        Of the file.
    """

    path: Path
    columns: Mapping[str, NDArray[Any]]
    line: NDArray[np.int64]
    sha256: str

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.line)

    def __getitem__(self, name: str) -> NDArray[Any]:
        """Return a column (N,)."""
        return self.columns[name]

    def stack(self, *names: str) -> NDArray[np.float64]:
        """Stack columns to (N, len(names)) float64."""
        return np.stack([self.columns[n].astype(np.float64) for n in names], axis=1)

    def where(self, row: int, field: str) -> str:
        """Location of a value, for a message."""
        return f"{self.path}, line {self.line[row]}, field '{field}'"


def read_csv_table(
    path: Path,
    columns: Mapping[str, str],
    optional: Mapping[str, str] | None = None,
    *,
    damaged: list[str] | None = None,
) -> CsvTable:
    """Read a CSV file with a header.

    Parameters
    ----------
    path : Path
    columns, optional : mapping of name to "int", "float", "bool" or "str"
        Columns that must and that may be there, in any order. An unknown one is an error.
    damaged : list of str, optional
        Takes a message for each row with fewer or more fields than the header, which is left out; else it is an error.

    Raises
    ------
    LogError
        Naming file, line and field.
    """
    kinds = {**columns, **(optional or {})}
    data = read_file(path, MAX_TABLE_BYTES, LogError)
    try:
        reader = csv.reader(io.StringIO(data.decode("utf-8-sig"), newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if row]
    except (UnicodeDecodeError, csv.Error) as problem:
        raise LogError(f"{path}: not a CSV table in UTF-8: {problem}") from None
    if not rows:
        raise LogError(f"{path}: is empty; expected the header {','.join(columns)}")
    header = [name.strip() for name in rows[0][1]]
    _check_header(path, header, columns, kinds)
    wrong = [
        f"{path}, line {n}: {len(row)} fields, the header has {len(header)}"
        for n, row in rows[1:]
        if len(row) != len(header)
    ]
    if wrong and damaged is None:
        raise LogError(wrong[0])
    if damaged is not None:
        damaged += wrong
    whole = [(n, row) for n, row in rows[1:] if len(row) == len(header)]
    line = np.array([n for n, _ in whole], dtype=np.int64)
    cells = {name: [row[k].strip() for _, row in whole] for k, name in enumerate(header)}
    values = {name: _parse(path, line, name, text, kinds[name]) for name, text in cells.items()}
    return CsvTable(path, values, line, hashlib.sha256(data).hexdigest())


def _check_header(path: Path, header: list[str], columns: Mapping[str, str], kinds: Mapping[str, str]) -> None:
    missing = [name for name in columns if name not in header]
    if missing:
        raise LogError(f"{path}, line 1: column '{missing[0]}' is missing; expected the header {','.join(columns)}")
    for name in header:
        if name not in kinds:
            hint = nearest(name, list(kinds))
            raise LogError(f"{path}, line 1: unknown column '{name}'{hint}; known: {', '.join(kinds)}")
        if header.count(name) > 1:
            raise LogError(f"{path}, line 1: column '{name}' occurs twice")


def _parse(path: Path, line: NDArray[np.int64], name: str, text: list[str], kind: str) -> NDArray[Any]:
    if kind == "str":
        return np.array(text, dtype=np.str_)
    if kind == "bool":
        words = {"0": False, "1": True, "false": False, "true": True}
        good = [t.lower() in words for t in text]
        values: NDArray[Any] = np.array([words.get(t.lower(), False) for t in text], dtype=bool)
    else:
        try:
            if not is_plain("".join(text)):
                raise ValueError
            values = np.array(text, dtype=np.str_).astype(_DTYPE[kind])
            good = list(_is_possible(values))
        except (ValueError, OverflowError):
            values, good = np.zeros(0), [_parses(t, kind) for t in text]
    if not all(good):
        k = good.index(False)
        raise LogError(f"{path}, line {line[k]}, field '{name}': '{text[k][:40]}', expected {_EXPECTED[kind]}")
    return values


def _parses(text: str, kind: str) -> bool:
    try:
        return is_plain(text) and bool(_is_possible(np.array([text]).astype(_DTYPE[kind]))[0])
    except (ValueError, OverflowError):
        return False


def _is_possible(values: NDArray[Any]) -> NDArray[np.bool_]:
    """Which numbers are finite and, unless whole (stamps), at most `MAX_NUMBER`."""
    return np.asarray(np.isfinite(values) & ((np.abs(values) <= MAX_NUMBER) | (values.dtype.kind == "i")))
