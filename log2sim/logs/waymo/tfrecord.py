"""TFRecord files: records by their lengths, with their checksums.

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


def masked_crc32c(data: bytes) -> int:
    """Compute the masked CRC-32C that TFRecord files hold."""
    crc = crc32c(data)
    return ((crc >> 15 | crc << 17) + MASK_DELTA) & 0xFFFFFFFF


def crc32c(data: bytes) -> int:
    """Compute the CRC-32C (Castagnoli) of a message.

    The register is linear over GF(2) in the message: the first half of the words, taken past as many zeros as the second half has
    words, is added to that half, until one word is left (zlib's `crc32_combine` joins CRCs in this way).
    """
    words, register = np.frombuffer(data, "<u4", len(data) // 4), 0xFFFFFFFF
    if len(words):
        levels = (len(words) - 1).bit_length()
        # Zeros before the message leave an empty register empty; the first register is added to the first word.
        state = np.zeros(1 << levels, dtype="<u4")
        state[-len(words) :] = words
        state[-len(words)] ^= np.uint32(register)
        for level in reversed(range(levels)):
            state = _past_zeros(level, state[: 1 << level]) ^ state[1 << level :]
        register = int(_past_zeros(0, state)[0])
    table = _byte_table()
    for byte in data[4 * len(words) :]:
        register = int(table[(register ^ byte) & 0xFF]) ^ (register >> 8)
    return register ^ 0xFFFFFFFF


def _past_zeros(level: int, registers: Words) -> Words:
    """Return the registers (n,) after 2^level zero words."""
    of_bytes = registers.view(np.uint8).reshape(-1, 4).T
    first, second, third, fourth = (table.take(of) for table, of in zip(_word_tables(level), of_bytes))
    return np.asarray(first ^ second ^ third ^ fourth)


@cache
def _byte_table() -> Words:
    """Register (256,) after one zero byte, by its lowest byte."""
    table = np.arange(256, dtype="<u4")
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ np.uint32(POLYNOMIAL), table >> 1)
    return table


@cache
def _word_tables(level: int) -> Words:
    """Register (4, 256) after 2^level zero words, by each of its bytes."""
    registers = np.arange(256, dtype="<u4") << np.array([[0], [8], [16], [24]], dtype="<u4")
    if level:
        return _past_zeros(level - 1, _past_zeros(level - 1, registers.ravel())).reshape(4, 256)
    for _ in range(4):
        registers = np.asarray(_byte_table()[registers & 0xFF] ^ (registers >> 8))
    return np.asarray(registers)


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

    `spans`: offset and size of the data of each record. `notes`: what was left out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.notes = path, list[str]()
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()
        try:
            with open_regular(path, buffering=0) as file:
                self.spans = self._find_spans(file, file.seek(0, SEEK_END))
        except OSError as error:
            raise LogError(f"{path}: cannot be read: {error.strerror}") from None

    def read(self, k: int, what: str) -> bytes:
        """Return the data of record `k`, checked; `what` names it in `RecordError`, if its CRC is wrong or the file became shorter."""
        with self._lock:
            if k in self._kept:
                self._kept.move_to_end(k)
                return self._kept[k]
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
                crc = f"the CRC of its {size} bytes at offset {begin} is {computed:#010x}, the file says {stored:#010x}"
                raise RecordError(f"{self.path} ({what}): damaged: {crc}")
            self._kept[k] = data
            if len(self._kept) > MAX_KEPT_RECORDS:
                self._kept.popitem(last=False)
            return data

    def window(self, k: int) -> RecordWindow:
        """Open record `k` to read parts of it, without its CRC; to be closed."""
        return RecordWindow(self.path, *self.spans[k])

    def _find_spans(self, file: BinaryIO, total: int) -> list[tuple[int, int]]:
        """Find offset and size of the data of all whole records by their lengths."""
        spans: list[tuple[int, int]] = []
        offset = number = 0
        while offset < total:
            header = read_at(file, offset, HEADER_BYTES)
            size, where = _length_of(header), f"{self.path}: record {number} at offset {offset}"
            end = offset + HEADER_BYTES + int.from_bytes(header[:8], "little") + FOOTER_BYTES
            if len(header) == HEADER_BYTES and size is None:
                # A length with a wrong CRC that leads to the next record or to the end of the file is right all the same.
                leads_on = end == total or (end < total and _length_of(read_at(file, end, HEADER_BYTES)) is not None)
                if not leads_on and not spans:
                    raise LogError(f"{where}: the CRC of its length is wrong; expected a TFRecord file")
                others = "" if leads_on else ": it and what follows are"
                self.notes.append(f"{where}: the CRC of its length is wrong{others or ';'} left out")
                if not leads_on:
                    break
            elif size is None or end > total:
                self.notes.append(f"{where} is truncated: the file ends {total - offset} bytes behind it; left out")
                break
            elif size > MAX_RECORD_BYTES:
                raise LogError(f"{where}: {size} bytes, more than the {MAX_RECORD_BYTES} that it may have")
            else:
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
