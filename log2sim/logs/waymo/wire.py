"""The wire format of protocol buffers: fields of a message by offsets, without reading those that are not wanted.

A field is a key (number << 3 | type, a varint) and its value: a varint, 8 or 4 bytes, or a length and that many bytes
(https://protobuf.dev/programming-guides/encoding).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np

from log2sim.geometry import Array

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
MAX_VARINT_BYTES = 10
# A frame with a map has some thousand fields.
MAX_FIELDS = 200_000
MAX_PLAIN_DOUBLES = 64
# Of names and ids, which have some twenty; tables make room for the longest of a column in every row.
MAX_TEXT_BYTES = 1024


class WireError(ValueError):
    """Bytes that are no protocol buffer of the expected form."""


class Source(Protocol):
    """Bytes of a message, in memory or in a file."""

    def peek(self, begin: int, count: int) -> bytes:
        """Return up to `count` bytes at an offset."""

    def take(self, begin: int, end: int) -> bytes:
        """Return the bytes of a span."""


class Memory:
    """A message in memory."""

    def __init__(self, data: bytes) -> None:
        self.data = data

    def peek(self, begin: int, count: int) -> bytes:
        """Return up to `count` bytes at an offset."""
        return self.data[begin : begin + count]

    def take(self, begin: int, end: int) -> bytes:
        """Return the bytes of a span."""
        return self.data[begin:end]


class Field(NamedTuple):
    """A field of a message.

    Attributes
    ----------
    number : int
    kind : int
        VARINT, FIXED64, BYTES or FIXED32.
    value : int
        Of a varint, or the bits of a fixed one; 0 for bytes.
    begin, end : int
        Offsets of the value.
    """

    number: int
    kind: int
    value: int
    begin: int
    end: int

    def real(self) -> float:
        """Return the value of a field of 8 or 4 bytes as a floating-point number."""
        if self.kind == FIXED64:
            return float(struct.unpack("<d", struct.pack("<Q", self.value))[0])
        if self.kind == FIXED32:
            return float(struct.unpack("<f", struct.pack("<I", self.value))[0])
        raise WireError(f"field {self.number} is of wire type {self.kind}, expected a floating-point number")


def fields(source: Source, begin: int, end: int) -> Iterator[Field]:
    """Walk the fields of the message in a span; values of type BYTES are skipped.

    Raises
    ------
    WireError
        When a field leaves the span or is of an unknown wire type, or there are more than `MAX_FIELDS`.
    """
    count = 0
    while begin < end:
        head = source.peek(begin, min(2 * MAX_VARINT_BYTES, end - begin))
        key, used = _varint(head, 0)
        number, kind = key >> 3, key & 7
        value = 0
        if kind == VARINT:
            value, used = _varint(head, used)
            stop = begin + used
        elif kind == BYTES:
            size, used = _varint(head, used)
            stop = begin + used + size
        elif kind in (FIXED64, FIXED32):
            width = 8 if kind == FIXED64 else 4
            value = int.from_bytes(head[used : used + width], "little")
            stop = begin + used + width
        else:
            raise WireError(f"field {number} is of wire type {kind}")
        count += 1
        if stop > end or count > MAX_FIELDS:
            raise WireError(
                f"field {number} ends {stop - end} bytes beyond its message" if stop > end else "too many fields"
            )
        yield Field(number, kind, value, begin + used, stop)
        begin = stop


def fields_of(data: bytes) -> Iterator[Field]:
    """Walk the fields of a message in memory."""
    return fields(Memory(data), 0, len(data))


def doubles_by_number(data: bytes) -> list[tuple[int, float]]:
    """Return number and value of each floating-point field of a message, in their order.

    Notes
    -----
    A message of nothing but doubles with numbers below 16, as boxes and transforms are, has a key of one byte every 9 bytes.
    Labels are nearly all such messages, and this reads them in a tenth of the time.
    """
    count, rest = divmod(len(data), 9)
    if rest or count > MAX_PLAIN_DOUBLES or any(key & 0x87 != FIXED64 for key in data[::9]):
        return [(f.number, f.real()) for f in fields_of(data) if f.kind in (FIXED64, FIXED32)]
    cells = struct.unpack(f"<{count * 'Bd'}", data)
    return [(key >> 3, value) for key, value in zip(cells[::2], cells[1::2])]


def doubles(data: bytes, found: list[Field]) -> Array:
    """Return the numbers (n,) of a repeated double, packed or one field each; `data` is what their offsets refer to."""
    parts = []
    for field in found:
        if field.kind == BYTES and (field.end - field.begin) % 8:
            raise WireError(f"field {field.number} has {field.end - field.begin} bytes, expected doubles of 8")
        packed = field.kind == BYTES
        parts.append(np.frombuffer(data[field.begin : field.end], "<f8") if packed else np.array([field.real()]))
    return np.concatenate(parts) if parts else np.zeros(0)


def varints(data: bytes) -> list[int]:
    """Return the numbers of a packed field of varints."""
    out, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        out.append(value)
    return out


def text(data: bytes, field: Field) -> str:
    """Return the value of a string field as printable characters; `WireError` when it is too long for a name."""
    if field.end - field.begin > MAX_TEXT_BYTES:
        raise WireError(
            f"field {field.number} is a text of {field.end - field.begin} bytes, expected at most {MAX_TEXT_BYTES}"
        )
    return "".join(
        c if c.isprintable() else "?" for c in data[field.begin : field.end].decode("utf-8", errors="replace")
    )


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Value of the varint at an offset, and the offset behind it."""
    value = shift = 0
    while at < len(data) and shift < 7 * MAX_VARINT_BYTES:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise WireError("a varint does not end")
