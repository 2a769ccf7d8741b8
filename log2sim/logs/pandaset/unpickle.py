"""Reader of pickled pandas DataFrames, without pandas and without executing anything.

Every class that a pickled table refers to is replaced by a placeholder that only stores its arguments and state, so the
version of pandas or NumPy that wrote the file does not matter, and any other class is refused by name.
"""

from __future__ import annotations

import io
import pickle
import re
import struct
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, RecordError
from log2sim.files.inputs import read_file

# Type of the offsets by the name of the type: where each text starts in the bytes of all.
OFFSETS = {"string": "<i4", "large_string": "<i8"}
MAX_TEXTS = 10_000_000


def decode_text(kind: str, length: int, start: int, buffers: Sequence[bytes | bytearray | None]) -> NDArray[Any]:
    """Decode an array of text, (N,) object, with NaN where there is none, as in the text columns of pandas.

    `kind` {"string", "large_string"}. `length`, `start`: number of texts, and how many texts of the buffers come before
    them. `buffers`: one bit a text that says whether it is there (None: all are), offsets, UTF-8 bytes; `ValueError` when they do
    not hold what they should. Arrow columnar format, "variable-size binary layout"; bits are numbered from the least significant.
    """
    if kind not in OFFSETS:
        raise ValueError(f"ArrowStringArray of type '{kind}', expected {' or '.join(OFFSETS)}")
    if not all(isinstance(n, int) and n >= 0 for n in (length, start)) or len(buffers) != 3:
        raise ValueError("an ArrowStringArray has no length or not three buffers")
    there, offsets, data = (None if b is None else np.frombuffer(b, np.uint8) for b in buffers)
    if length > MAX_TEXTS:
        raise ValueError(f"an ArrowStringArray of {length} texts, more than the {MAX_TEXTS} that a column may have")
    if not length:
        return np.empty(0, dtype=object)
    if offsets is None or len(offsets) < (start + length + 1) * np.dtype(OFFSETS[kind]).itemsize:
        raise ValueError(f"an ArrowStringArray of {length} texts has too few offsets")
    ends = offsets.view(OFFSETS[kind])[start : start + length + 1].astype(np.int64)
    text = b"" if data is None else data.tobytes()
    if ends[0] < 0 or ends[-1] > len(text) or (np.diff(ends) < 0).any():
        raise ValueError("offsets of an ArrowStringArray leave its text")
    cells = np.full(length, np.nan, dtype=object)
    present = np.ones(length, dtype=bool)
    if there is not None:
        if len(there) * 8 < start + length:
            raise ValueError("an ArrowStringArray does not say of each text whether it is there")
        present = np.unpackbits(there, bitorder="little")[start : start + length].astype(bool)
    for row in np.flatnonzero(present):
        cells[row] = text[ends[row] : ends[row + 1]].decode()
    return cells


decompressobj: Callable[..., Any] = zlib.decompressobj
GzipError: Any = zlib.error
with suppress(ImportError):  # a third of the time, see the extra `pandaset`
    from isal import isal_zlib

    decompressobj, GzipError = isal_zlib.decompressobj, isal_zlib.IsalError

MAX_TABLE_BYTES = 512 * 1024 * 1024
# Cells that become objects of Python: a few bytes of a pickle can name the same text again and again.
MAX_TEXT_CELLS = 10_000_000

Columns = dict[str, NDArray[Any]]


def read_pickled_table(path: Path, error: type[LogError] = RecordError, limit_bytes: int = MAX_TABLE_BYTES) -> Columns:
    """Read the columns (N,) of a DataFrame from a .pkl or .pkl.gz file of at most `limit_bytes` once unpacked.

    Raises `RecordError` or `error` when the file is missing, too large, no table, or names a class that tables do not need.
    """
    packed = read_file(path, limit_bytes, error, missing="cannot be read: No such file or directory")
    try:
        data = packed
        if packed[:2] == b"\x1f\x8b":
            unpacker = decompressobj(wbits=31)
            data = unpacker.decompress(packed, limit_bytes)
            if unpacker.unconsumed_tail:
                raise ValueError(f"unpacks to more than the {limit_bytes} bytes that a table may have")
            if not unpacker.eof:
                raise ValueError("the file is truncated")
        table = _TableUnpickler(io.BytesIO(data)).load()
        return _columns(table)
    except (
        pickle.UnpicklingError, GzipError, struct.error, EOFError, ValueError, TypeError, KeyError, IndexError,
        AttributeError, AssertionError, OverflowError, RecursionError,
    ) as problem:  # fmt: skip
        raise error(f"{path}: not a pickled table: {problem or type(problem).__name__}") from None


class _Part:
    """Placeholder for an object of pandas, NumPy or pyarrow: what it is, its arguments and its state."""

    __slots__ = ("args", "kind", "state")

    def __init__(self, kind: str, *args: Any) -> None:
        self.kind, self.args = kind, args
        self.state: Any = None


class _Allowed:
    """A name that a pickle may refer to; a call only makes a placeholder of a kind."""

    __slots__ = ("kind",)

    def __init__(self, kind: str) -> None:
        self.kind = kind


_ALLOWED: dict[str, _Allowed] = {
    name: _Allowed(kind)
    for kind, *names in (
        ("Frame", "pandas.DataFrame", "pandas.core.frame.DataFrame"),
        ("Blocks", "pandas.core.internals.managers.BlockManager", "pandas.core.internals.BlockManager"),
        ("Part", "pandas._libs.internals._unpickle_block", "pandas.core.internals.blocks.new_block"),
        ("Index", "pandas.core.indexes.base._new_Index", "pandas.indexes.base._new_Index"),
        ("Index", "pandas.Index", "pandas.core.indexes.base.Index", "pandas.indexes.base.Index"),
        ("Index", "pandas.RangeIndex", "pandas.core.indexes.range.RangeIndex", "pandas.indexes.range.RangeIndex"),
        ("Index", "pandas.core.indexes.numeric.Int64Index", "pandas.indexes.numeric.Int64Index"),
        ("Strings", "pandas._libs.arrays.__pyx_unpickle_NDArrayBacked"),
        ("Part", "pandas.arrays.StringArray", "pandas.core.arrays.string_.StringArray"),
        ("Part", "pandas.NA", "pandas._libs.missing.NA"),
        ("Part", "pandas.StringDtype", "pandas.core.arrays.string_.StringDtype"),
        ("ArrowStrings", "pandas.arrays.ArrowStringArray", "pandas.core.arrays.string_arrow.ArrowStringArray"),
        ("ArrowStrings", "pandas.core.arrays.string_arrow.ArrowStringArrayNumpySemantics"),
        ("ArrowArray", "pyarrow.lib._restore_array"),
        ("ArrowType", "pyarrow.lib.type_for_alias"),
        ("Bytes", "pyarrow.lib.py_buffer", "builtins.bytearray", "__builtin__.bytearray"),
        ("Array", "numpy._core.multiarray._reconstruct", "numpy.core.multiarray._reconstruct"),
        ("Buffer", "numpy._core.numeric._frombuffer", "numpy.core.numeric._frombuffer"),
        ("Part", "numpy.ndarray"),
        ("Dtype", "numpy.dtype"),
        ("slice", "builtins.slice", "__builtin__.slice"),
    )
    for name in names
}


# The C unpickler allocates memory for any index that a memo names; the one in Python does not, and its opcodes can be replaced.
class _TableUnpickler(pickle._Unpickler):
    stack: list[Any]
    append: Callable[[Any], None]
    read: Callable[[int], bytes]
    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    def find_class(self, module: str, name: str) -> _Allowed:
        known = _ALLOWED.get(f"{module}.{name}")
        if known is None:
            raise pickle.UnpicklingError(f"it names {module}.{name}, which a table does not need")
        return known

    def load_call(self) -> None:
        args = self.stack.pop()
        known = self.stack.pop()
        if not isinstance(known, _Allowed) or not isinstance(args, tuple):
            raise pickle.UnpicklingError("it calls something that is not a class of tables")
        self.stack.append(slice(*args) if known.kind == "slice" else _Part(known.kind, *args))

    def load_state(self) -> None:
        state = self.stack.pop()
        if not isinstance(self.stack[-1], _Part):
            raise pickle.UnpicklingError("it sets the state of something that is not part of a table")
        self.stack[-1].state = state

    def load_bounded_bytearray(self) -> None:
        (size,) = struct.unpack("<Q", self.read(8))
        data = self.read(size)
        if len(data) != size:
            raise EOFError("the file is truncated")
        self.append(data)

    def load_refused(self) -> None:
        raise pickle.UnpicklingError("it holds an instruction that a table does not need")

    dispatch[pickle.REDUCE[0]] = load_call
    dispatch[pickle.NEWOBJ[0]] = load_call
    dispatch[pickle.BUILD[0]] = load_state
    dispatch[pickle.BYTEARRAY8[0]] = load_bounded_bytearray
    for _code in (
        "INST", "OBJ", "NEWOBJ_EX", "EXT1", "EXT2", "EXT4", "PERSID", "BINPERSID", "NEXT_BUFFER", "READONLY_BUFFER",
    ):  # fmt: skip
        dispatch[getattr(pickle, _code)[0]] = load_refused


def _kind_of(part: Any) -> str:
    return part.kind if isinstance(part, _Part) else type(part).__name__.strip("_")


def _columns(table: Any) -> Columns:
    if _kind_of(table) != "Frame" or not isinstance(table.state, dict):
        raise ValueError(f"holds a {_kind_of(table)}, expected a DataFrame")
    manager: Any = table.state.get("_mgr", table.state.get("_data"))
    if _kind_of(manager) != "Blocks":
        raise ValueError("its DataFrame has no blocks")
    # Values and column positions of each block, as written since and before pandas 1.3.
    if manager.args:
        blocks, axes = manager.args
        parts = [(b.args[0], b.args[1]) for b in blocks]
    else:
        inner = manager.state[3]["0.14.1"]
        axes, parts = inner["axes"], [(b["values"], b["mgr_locs"]) for b in inner["blocks"]]
    names = [str(n) for n in _values(axes[0]).tolist()]
    columns: Columns = {}
    texts = 0
    for values, place in parts:
        rows = _values(values)
        texts += rows.size if rows.dtype == object else 0
        if texts > MAX_TEXT_CELLS:
            raise ValueError(f"more than the {MAX_TEXT_CELLS} texts that a table may have")
        if isinstance(place, slice) and not all(isinstance(v, int) for v in (place.start, place.stop, place.step)):
            raise ValueError("a block has no columns")
        numbers = list(range(len(names)))[place] if isinstance(place, slice) else [int(p) for p in _values(place)]
        for k, column in enumerate(numbers):
            columns[names[column]] = rows if rows.ndim == 1 else rows[k]
    if len(set(map(len, columns.values()))) > 1 or len(columns) != len(names):
        raise ValueError("its columns are incomplete")
    return columns


def _values(part: Any) -> NDArray[Any]:
    """Array that a placeholder stands for."""
    kind = _kind_of(part)
    if kind == "Index":
        return _values(part.args[1]["data"])
    if kind == "Strings":
        return _values(next(p for p in part.state if _kind_of(p) in ("Array", "Buffer")))
    if kind == "ArrowStrings":
        return _arrow_values(part.state.get("_pa_array", part.state.get("_data")))
    if kind == "Buffer":
        return _from_bytes(part.args[0], _dtype(part.args[1]), *part.args[2:])
    if kind != "Array":
        raise ValueError(f"a {kind} where an array was expected")
    _, shape, dtype, fortran, data = part.state
    order: Literal["F", "C"] = "F" if fortran else "C"
    if isinstance(data, list):
        cells = np.empty(len(data), dtype=object)
        cells[:] = data
        return cells.reshape(shape, order=order)
    return _from_bytes(data, _dtype(dtype), shape, order)


def _arrow_values(part: Any) -> NDArray[Any]:
    """Texts of an Arrow array."""
    if _kind_of(part) != "ArrowArray":
        raise ValueError(f"a {_kind_of(part)} where the text of an ArrowStringArray was expected")
    kind, length, _, start, buffers, *_ = part.args[0]
    found = list[bytes | bytearray | None]()
    for buffer in buffers:
        while _kind_of(buffer) == "Bytes":
            (buffer,) = buffer.args
        # A length, for which `bytearray` would make so many zeros, is refused.
        if buffer is not None and not isinstance(buffer, (bytes, bytearray)):
            raise ValueError("a buffer of an ArrowStringArray has no data")
        found.append(buffer)
    return decode_text(kind.args[0] if _kind_of(kind) == "ArrowType" else str(kind), length, start, found)


def _from_bytes(data: Any, dtype: np.dtype[Any], shape: Any, order: Any) -> NDArray[Any]:
    if not isinstance(data, (bytes, bytearray)) or order not in ("C", "F"):
        raise ValueError("an array has no data")
    return np.frombuffer(data, dtype).reshape(shape, order=order)


def _dtype(part: Any) -> np.dtype[Any]:
    code = part.args[0] if _kind_of(part) == "Dtype" else None
    if not isinstance(code, str) or not re.fullmatch(r"b1|[iu][1248]|f[48]", code):
        raise ValueError(f"an array of type {code!r}, expected plain numbers")
    order = part.state[1] if part.state else "="
    return np.dtype(code).newbyteorder(">" if order == ">" else "<")
