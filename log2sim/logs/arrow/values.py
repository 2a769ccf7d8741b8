"""Values of Arrow columns as NumPy arrays of the kind that a reader asks for."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

# Names, ids and categories; arrays of text make room for the longest in every row.
MAX_TEXT_CHARACTERS = 4096

Kind = Literal["float", "int", "bool", "text", "bytes", "floats", "ints"]


def values_of(column: Any, kind: Kind) -> NDArray[Any]:
    """Convert a validated pyarrow array of N values; `log2sim.logs.arrow.tables.read_columns` describes the kinds.

    Raises
    ------
    ValueError
        When the column holds something else; says what was expected.
    """
    if kind not in get_args(Kind):
        raise TypeError(f"unknown kind '{kind}', expected one of {', '.join(get_args(Kind))}")
    import pyarrow

    types = pyarrow.types
    if types.is_dictionary(column.type):
        column = column.dictionary_decode()
    if kind in ("floats", "ints"):
        return _lists(column, "float" if kind == "floats" else "int")
    if kind in ("float", "int", "bool"):
        return _numbers(column, kind)
    if kind == "text":
        return _text(column)
    if not (types.is_binary(column.type) or types.is_large_binary(column.type)):
        raise ValueError(f"is {column.type}, expected bytes")
    return _objects(column.to_pylist())


def _numbers(column: Any, kind: Literal["float", "int", "bool"]) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    if kind == "bool":
        if not types.is_boolean(column.type) or column.null_count:
            raise ValueError(f"is {column.type} with {column.null_count} missing values, expected true or false")
        return np.asarray(column.to_numpy(zero_copy_only=False))
    if kind == "int":
        if not types.is_integer(column.type) or column.null_count:
            raise ValueError(f"is {column.type} with {column.null_count} missing values, expected whole numbers")
        numbers: NDArray[Any] = column.to_numpy(zero_copy_only=False)
        if numbers.dtype == np.uint64 and len(numbers) and numbers.max() > np.iinfo(np.int64).max:
            raise ValueError("holds a number beyond int64")
        return numbers.astype(np.int64)
    if not (types.is_integer(column.type) or types.is_floating(column.type)):
        raise ValueError(f"is {column.type}, expected numbers")
    numbers = column.to_numpy(zero_copy_only=False)
    return numbers.astype(np.float32 if column.type in (pyarrow.float16(), pyarrow.float32()) else np.float64)


def _text(column: Any) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    if types.is_integer(column.type):
        return _objects([None if n is None else str(n) for n in column.to_pylist()])
    if not (types.is_string(column.type) or types.is_large_string(column.type)):
        raise ValueError(f"is {column.type}, expected text")
    cells = column.to_pylist()
    longest = max((len(cell) for cell in cells if cell is not None), default=0)
    if longest > MAX_TEXT_CHARACTERS:
        raise ValueError(f"holds a text of {longest} characters, more than the {MAX_TEXT_CHARACTERS} that one may have")
    return _objects(cells)


def _lists(column: Any, kind: Literal["float", "int"]) -> NDArray[Any]:
    import pyarrow

    types = pyarrow.types
    if types.is_fixed_size_list(column.type):
        # `flatten` leaves out the values below missing lists, which are missing themselves.
        numbers = _numbers(column.flatten(), kind).reshape(-1, column.type.list_size)
        if not column.null_count:
            return numbers
        present = iter(numbers)
        return _objects([next(present) if t else None for t in column.is_valid().to_pylist()])
    if not (types.is_list(column.type) or types.is_large_list(column.type)):
        raise ValueError(f"is {column.type}, expected a list of numbers a row")
    ends = column.offsets.to_numpy(zero_copy_only=False)
    # Of a slice of a table only the part that it refers to is converted.
    first, last = (int(ends[0]), int(ends[-1])) if len(ends) else (0, 0)
    numbers = _numbers(column.values.slice(first, last - first), kind)
    there = np.ones(len(column), dtype=bool) if not column.null_count else column.is_valid().to_numpy(False)
    return _objects([numbers[a - first : b - first] if t else None for a, b, t in zip(ends, ends[1:], there)])


def _objects(cells: list[Any]) -> NDArray[Any]:
    values = np.empty(len(cells), dtype=object)
    for row, cell in enumerate(cells):
        values[row] = cell
    return values
