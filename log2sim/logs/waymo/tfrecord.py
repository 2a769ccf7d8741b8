"""TFRecord files: records found by their lengths, read one at a time, their CRCs checked.

A record is its length (uint64, little-endian), the masked CRC-32C of these 8 bytes, the data and their masked CRC-32C
(https://www.tensorflow.org/tutorials/load_data/tfrecord).
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from io import SEEK_END
from pathlib import Path
from threading import Lock
from typing import BinaryIO

from log2sim.errors import LogError, RecordError
from log2sim.input_files import open_regular
from log2sim.logs.waymo.crc32c import masked_crc32c

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

    Attributes
    ----------
    path : Path
    spans : list of (int, int)
        Offset and size of the data of each record.
    notes : list of str
        What was left out.
    """

    def __init__(self, path: Path) -> None:
        self.path, self.notes = path, list[str]()
        self.spans = list(self._walk())
        self._kept: OrderedDict[int, bytes] = OrderedDict()
        self._lock = Lock()

    def read(self, k: int, what: str) -> bytes:
        """Return the data of record `k`, checked.

        Parameters
        ----------
        k : int
        what : str
            Names the record in errors.

        Raises
        ------
        RecordError
            When the file became shorter or the CRC is not that of the data.
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
