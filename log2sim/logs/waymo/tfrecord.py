"""TFRecord files: records by their lengths, with their checksums.

The register of a CRC is linear over GF(2) in the message: it can be cut into lanes whose remainders matrices join, as zlib's
`crc32_combine` does. Lane k holds the words k, k + LANES, k + 2 LANES, ..., so that one step takes a contiguous row.

A record is its length (uint64, little-endian), the masked CRC-32C of these 8 bytes, the data and their masked CRC-32C
(https://www.tensorflow.org/tutorials/load_data/tfrecord).
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from functools import cache
from io import SEEK_END
from pathlib import Path
from threading import Lock
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, RecordError
from log2sim.files.inputs import open_regular

Words = NDArray[np.uint32]

# Castagnoli's polynomial with its bits reversed (RFC 3720, section 12.1).
POLYNOMIAL = 0x82F63B78
# TFRecord rotates a CRC and adds this, so that the CRC of data which hold CRCs is not degenerate (TensorFlow, crc32c.h).
MASK_DELTA = 0xA282EAD8

# The fastest of 2048 to 32768 lanes for records of some MB, where the joining of the lanes counts.
LOG2_LANES = 12
LANES = 1 << LOG2_LANES
# Shorter messages are taken byte by byte.
MIN_LANED_BYTES = 1024


def masked_crc32c(data: bytes) -> int:
    """Compute the masked CRC-32C that TFRecord files hold."""
    crc = crc32c(data)
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """Compute the CRC-32C (Castagnoli) of a message."""
    words = len(data) // 4 if len(data) >= MIN_LANED_BYTES else 0
    register = _laned(np.frombuffer(data, "<u4", words)) if words else 0xFFFFFFFF
    table = _byte_table()
    for byte in data[4 * words :]:
        register = int(table[(register ^ byte) & 0xFF]) ^ (register >> 8)
    return register ^ 0xFFFFFFFF


def _laned(words: Words) -> int:
    """Return the register after words (n,), from the first register on."""
    head = len(words) % LANES or min(len(words), LANES)
    # Zeros before the message leave an empty register empty; the first register is added to the first word.
    state = np.zeros(LANES, dtype=np.uint32)
    state[LANES - head :] = words[:head]
    state[LANES - head] ^= np.uint32(0xFFFFFFFF)
    low_table, high_table = _row_tables()
    low, high = np.empty(LANES, np.intp), np.empty(LANES, np.intp)
    from_low, from_high = np.empty_like(state), np.empty_like(state)
    for row in words[head:].reshape(-1, LANES):
        np.bitwise_and(state, np.uint32(0xFFFF), out=low)
        np.right_shift(state, np.uint32(16), out=high)
        # With "raise", the default, NumPy would buffer the output; all indices have 16 bits.
        low_table.take(low, out=from_low, mode="wrap")
        high_table.take(high, out=from_high, mode="wrap")
        np.bitwise_xor(from_low, from_high, out=state)
        state ^= row
    for level in reversed(range(LOG2_LANES)):
        half = 1 << level
        state = _product(_after_words(level), state[:half]) ^ state[half:]
    return int(_product(_after_words(0), state)[0])


@cache
def _byte_table() -> Words:
    """Register (256,) after one zero byte, by its lowest byte."""
    table = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(POLYNOMIAL), table >> 1)
    return table


@cache
def _after_words(log2_words: int) -> Words:
    """Matrix over GF(2) that takes a register past 2^k zero words: column b (32,) is the image of bit b."""
    if log2_words:
        half = _after_words(log2_words - 1)
        return _product(half, half)
    columns = np.uint32(1) << np.arange(32, dtype=np.uint32)
    for _ in range(4):
        columns = _byte_table()[columns & 0xFF] ^ (columns >> 8)
    return columns


@cache
def _row_tables() -> tuple[Words, Words]:
    """Return the registers (65536,) after a row of zeros, of the lower and of the upper 16 bits."""
    bits = np.arange(1 << 16, dtype=np.uint32)
    return _product(_after_words(LOG2_LANES), bits), _product(_after_words(LOG2_LANES), bits << np.uint32(16))


def _product(matrix: Words, registers: Words) -> Words:
    """Multiply a matrix (32,) and registers (n,) over GF(2)."""
    out = np.zeros_like(registers)
    for bit in range(32):
        # -1 times the bit has all bits set where it is set.
        out ^= matrix[bit] * ((registers >> np.uint32(bit)) & np.uint32(1))
    return out


HEADER_BYTES, FOOTER_BYTES = 12, 4
# A frame of the data set has 4 to 8 MB.
MAX_RECORD_BYTES = 256 * 1024 * 1024
MAX_RECORDS = 20_000
# Records whose bytes are kept: the streams of a frame share it, and ticks are read some ahead.
MAX_KEPT_RECORDS = 3
# Bytes read at once where only headers of fields are wanted; images between them are skipped.
BLOCK_BYTES = 512


def starts_like_tfrecord(path: Path) -> bool:
    """Return whether the file's first length has its CRC; False for what cannot be read."""
    try:
        with open_regular(path) as file:
            return _length_of(file.read(HEADER_BYTES)) is not None
    except OSError:
        return False


class RecordFile:
    """The records of a TFRecord file.

    `spans` list of (int, int): offset and size of the data of each record. `notes`: what was left out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.notes = path, list[str]()
        self.spans = list(self._walk())
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()

    def read(self, k: int, what: str) -> bytes:
        """Return the data of record `k`, checked.

        `what`: names the record in errors. Raises `RecordError` when the file became shorter or the CRC is not that of
        the data.
        """
        with self._lock:
            if k in self._kept:
                self._kept.move_to_end(k)
                return self._kept[k]
            data = self._read_checked(k, what)
            self._kept[k] = data
            if len(self._kept) > MAX_KEPT_RECORDS:
                self._kept.popitem(last=False)
            return data

    def window(self, k: int) -> RecordWindow:
        """Open record `k` to read parts of it, without its CRC; to be closed."""
        return RecordWindow(self.path, *self.spans[k])

    def _read_checked(self, k: int, what: str) -> bytes:
        begin, size = self.spans[k]
        try:
            with open_regular(self.path) as file:
                file.seek(begin)
                data, footer = file.read(size), file.read(FOOTER_BYTES)
        except OSError as error:
            raise RecordError(f"{self.path} ({what}): cannot be read: {error.strerror}") from None
        if len(footer) < FOOTER_BYTES:
            raise RecordError(f"{self.path} ({what}): truncated, expected {size} bytes at offset {begin}")
        stored, computed = struct.unpack("<I", footer)[0], masked_crc32c(data)
        if stored != computed:
            raise RecordError(
                f"{self.path} ({what}): damaged: the CRC of its {size} bytes at offset {begin} is {computed:#010x}, the file says "
                f"{stored:#010x}"
            )
        return data

    def _walk(self) -> list[tuple[int, int]]:
        """Find offset and size of the data of all whole records by their lengths."""
        try:
            with open_regular(self.path, buffering=0) as file:
                return self._spans(file, file.seek(0, SEEK_END))
        except OSError as error:
            raise LogError(f"{self.path}: cannot be read: {error.strerror}") from None

    def _spans(self, file: BinaryIO, total: int) -> list[tuple[int, int]]:
        spans: list[tuple[int, int]] = []
        offset = number = 0
        while offset < total:
            header = read_at(file, offset, HEADER_BYTES)
            size, where = _length_of(header), f"{self.path}: record {number} at offset {offset}"
            if len(header) == HEADER_BYTES and size is None:
                end = offset + HEADER_BYTES + int.from_bytes(header[:8], "little") + FOOTER_BYTES
                # A length with a wrong CRC that leads to the next record or to the end of the file is right all the same.
                if end != total and (end > total or _length_of(read_at(file, end, HEADER_BYTES)) is None):
                    if not spans:
                        raise LogError(f"{where}: the CRC of its length is wrong; expected a TFRecord file")
                    self.notes.append(f"{where}: the CRC of its length is wrong: it and what follows are left out")
                    break
                self.notes.append(f"{where}: the CRC of its length is wrong; left out")
            elif size is None or offset + HEADER_BYTES + size + FOOTER_BYTES > total:
                self.notes.append(f"{where} is truncated: the file ends {total - offset} bytes behind it; left out")
                break
            elif size > MAX_RECORD_BYTES:
                raise LogError(f"{where}: {size} bytes, more than the {MAX_RECORD_BYTES} that it may have")
            else:
                end = offset + HEADER_BYTES + size + FOOTER_BYTES
                spans.append((offset + HEADER_BYTES, size))
            offset, number = end, number + 1
            if number > MAX_RECORDS:
                raise LogError(f"{self.path}: more than {MAX_RECORDS} records; expected one segment")
        return spans


class RecordWindow:
    """Parts of one record, read in blocks from its file; offsets count from the start of its data."""

    def __init__(self, path: Path, begin: int, size: int) -> None:
        self._file, self._begin, self.size = open_regular(path, buffering=0), begin, size
        self._block, self._block_begin = b"", 0

    def __enter__(self) -> RecordWindow:
        """Return the window."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close the file."""
        self._file.close()

    def peek(self, begin: int, count: int) -> bytes:
        """Return up to `count` bytes at an offset, fewer at the end of the record; at most `BLOCK_BYTES`."""
        end = min(begin + count, self.size)
        if not self._block_begin <= begin or end > self._block_begin + len(self._block):
            wanted = min(BLOCK_BYTES, self.size - begin)
            self._block, self._block_begin = read_at(self._file, self._begin + begin, wanted), begin
        return self._block[begin - self._block_begin : end - self._block_begin]

    def take(self, begin: int, end: int) -> bytes:
        """Return the bytes of a span."""
        if end - begin <= BLOCK_BYTES:
            return self.peek(begin, end - begin)
        return read_at(self._file, self._begin + begin, end - begin)


def read_at(file: BinaryIO, begin: int, count: int) -> bytes:
    """Read up to `count` bytes at an offset, fewer at the end of the file."""
    file.seek(begin)
    return file.read(count) or b""


def _length_of(header: bytes) -> int | None:
    """Length that a header holds; None when it is short or its CRC is wrong."""
    if len(header) < HEADER_BYTES:
        return None
    size, crc = struct.unpack("<QI", header)
    return int(size) if masked_crc32c(header[:8]) == crc else None
