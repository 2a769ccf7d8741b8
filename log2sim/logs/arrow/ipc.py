"""Sizes that an Arrow IPC file declares, read from its flatbuffers before pyarrow decompresses anything.

Layouts: Apache Arrow, format/File.fbs and format/Message.fbs; FlatBuffers internals for tables and vectors.
"""

from __future__ import annotations

import struct

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
    """Return the rows and the unpacked bytes of all record batches of an Arrow file.

    Raises
    ------
    ValueError
        When it is truncated or its structure is damaged.
    """
    if len(data) < 24 or data[-6:] != ARROW_MAGIC:
        raise ValueError("the Arrow file is truncated: it does not end with ARROW1")
    try:
        (length,) = struct.unpack_from("<i", data, len(data) - 10)
        start = len(data) - 10 - length
        if length <= 0 or start < 8:
            raise ValueError("the footer of the Arrow file is damaged")
        return _sum_blocks(data, start)
    except struct.error:
        raise ValueError("the structure of the Arrow file is damaged") from None


def _sum_blocks(data: bytes, start: int) -> tuple[int, int]:
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
            size += sum(_unpacked_bytes(data, offset + message_bytes, p, packed) for p in places)
            at = _field(data, batch, BATCH_LENGTH)
            rows += struct.unpack_from("<q", data, at)[0] if at and field == FOOTER_BATCHES else 0
    return rows, size


def _unpacked_bytes(data: bytes, body: int, place: int, packed: bool) -> int:
    offset, length = BUFFER.unpack_from(data, place)
    if offset < 0 or length < 0 or body < 0:
        raise ValueError("a buffer of the Arrow file is damaged")
    if not packed or length < 8:
        return int(length)
    # Compressed buffers begin with their unpacked size; -1 marks one that is not compressed.
    (unpacked,) = struct.unpack_from("<q", data, body + offset)
    if unpacked < -1:
        raise ValueError("a buffer of the Arrow file has a negative size")
    return int(length if unpacked == -1 else unpacked)


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
