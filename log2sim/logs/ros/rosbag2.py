"""MCAP files and rosbag2 databases."""

from __future__ import annotations

import os
import sqlite3
import struct
import threading
import weakref
from collections.abc import Iterator
from contextlib import suppress
from itertools import chain
from pathlib import Path
from urllib.parse import quote

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.logs.records import PARSER_ERRORS
from log2sim.logs.ros.containers import (
    MAX_MESSAGE_BYTES,
    MAX_MESSAGES,
    Channel,
    Chunk,
    ChunkedFile,
    Entries,
    checked_size,
    decompressor_of,
    normalized_type,
    one_line,
    printable,
    unpack_part,
)

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX, CHUNK_INDEX, STATISTICS, DATA_END = 2, 3, 4, 5, 6, 7, 8, 11, 15
RECORD_HEAD = struct.Struct("<BQ")
MESSAGE_HEAD = struct.Struct("<BQHIQQ")
CHUNK_HEAD = struct.Struct("<QQQI")
FOOTER_BYTES = RECORD_HEAD.size + 20 + len(MAGIC)
MAX_RECORD_BYTES = 64 * 1024 * 1024
"""Of schemas, channels and indexes."""


class Mcap(ChunkedFile):
    """An MCAP file."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._schemas: dict[int, tuple[str, str, str]] = {}
        self.index()

    def _locate(self, chunk: int, place: int, *, ahead: bool) -> tuple[int, int]:
        op, size, *_ = MESSAGE_HEAD.unpack(self.within(chunk, place, MESSAGE_HEAD.size, ahead=ahead))
        if op != MESSAGE or size < 22:
            raise ValueError("no message where the index says so")
        return place + MESSAGE_HEAD.size, size - 22

    def _read_index(self) -> bool:
        footer = self.at(self.size - FOOTER_BYTES, FOOTER_BYTES)
        if footer[-len(MAGIC) :] != MAGIC or footer[0] != FOOTER:
            raise ValueError("the recording was not closed")
        (position,) = struct.unpack_from("<Q", footer, RECORD_HEAD.size)
        if not position:
            return False
        chunks, expected = [], None
        while position < self.size - FOOTER_BYTES:
            op, size = RECORD_HEAD.unpack(self.at(position, RECORD_HEAD.size))
            if op in (SCHEMA, CHANNEL, CHUNK_INDEX):
                data = self._small(position, size)
                if op == CHUNK_INDEX:
                    chunks.append(data)
                else:
                    self._declare(op, data)
            elif op == STATISTICS:
                (expected,) = struct.unpack("<Q", self.at(position + RECORD_HEAD.size, 8))
            position += RECORD_HEAD.size + size
        if not chunks or not self.channels:
            return False
        for data in chunks:
            self._index_chunk(data)
        # Messages may also lie between the chunks, where no index leads.
        return expected in (None, self._count()) or bool(self.notes)

    def _small(self, position: int, size: int) -> bytes:
        if size > MAX_RECORD_BYTES:
            raise ValueError(f"record of {size} bytes at byte {position}")
        return self.at(position + RECORD_HEAD.size, size)

    def _declare(self, op: int, data: bytes) -> None:
        """Take over a schema or a channel."""
        if op == SCHEMA:
            (number,) = struct.unpack_from("<H", data)
            name, position = _text(data, 2)
            encoding, position = _text(data, position)
            definition, _ = _text(data, position)
            self._schemas[number] = (name, encoding, definition)
            return
        number, schema = struct.unpack_from("<HH", data)
        topic, position = _text(data, 4)
        encoding, _ = _text(data, position)
        name, language, definition = self._schemas.get(schema, ("", "", ""))
        if number not in self._numbers:
            self._numbers[number] = len(self.channels)
            text = definition if language in ("ros1msg", "ros2msg") else ""
            self.channels.append(Channel(printable(topic), normalized_type(name), printable(encoding), text))

    def _index_chunk(self, data: bytes) -> None:
        """Read the indexes of the messages of a chunk, or the chunk where it has none."""
        start, _, size = struct.unpack_from("<QQI", data, 16)
        offsets = [struct.unpack_from("<HQ", data, p)[1] for p in range(36, 36 + size, 10)]
        number = len(self.chunks)
        try:
            self._add_chunk(start)
            for offset in offsets:
                op, size = RECORD_HEAD.unpack(self.at(offset, RECORD_HEAD.size))
                if op != MESSAGE_INDEX:
                    raise ValueError("its index is damaged")
                index = self._small(offset, size)
                channel, length = struct.unpack_from("<HI", index)
                pairs = np.frombuffer(index[6 : 6 + length], "<u8").reshape(-1, 2).astype(np.int64)
                self._add(self._numbers[channel], pairs[:, 0], number, pairs[:, 1])
            if not offsets:
                self._walk(number)
        except PARSER_ERRORS as problem:
            self.notes.append(f"{self.path.name}: the chunk at byte {start} cannot be read: {one_line(problem)}")

    def _add_chunk(self, position: int) -> None:
        """Add the chunk whose record begins at a byte."""
        op, size = RECORD_HEAD.unpack(self.at(position, RECORD_HEAD.size))
        if op != CHUNK:
            raise ValueError("no chunk where the index says so")
        start = position + RECORD_HEAD.size
        head = self.at(start, min(size, 256))
        _, _, unpacked, crc = CHUNK_HEAD.unpack_from(head)
        compression, offset = _text(head, CHUNK_HEAD.size)
        (stored,) = struct.unpack_from("<Q", head, offset)
        self.chunks.append(Chunk(start + offset + 8, stored, unpacked, compression, crc))

    def _scan(self) -> None:
        position = len(MAGIC)
        while position + RECORD_HEAD.size <= self.size:
            op, size = RECORD_HEAD.unpack(self.at(position, RECORD_HEAD.size))
            if op in (DATA_END, FOOTER):
                return
            try:
                if position + RECORD_HEAD.size + size > self.size:
                    raise ValueError(f"the file ends within a record of {size} bytes")
                if op == CHUNK:
                    self._add_chunk(position)
                    self._walk(len(self.chunks) - 1)
                elif op in (SCHEMA, CHANNEL):
                    self._declare(op, self._small(position, size))
                elif op == MESSAGE:
                    self._add_message(self.at(position, MESSAGE_HEAD.size), -1, position)
            except PARSER_ERRORS as problem:
                self.notes.append(f"{self.path.name}: the record at byte {position} is left out: {one_line(problem)}")
            position += RECORD_HEAD.size + size

    def _add_message(self, head: bytes, chunk: int, place: int) -> None:
        _, _, channel, _, t_ns, _ = MESSAGE_HEAD.unpack(head)
        if t_ns >= 1 << 63:
            raise ValueError(f"the recorder's stamp is {t_ns}, no time in ns")
        self._add(self._numbers[channel], t_ns, chunk, place)

    def _walk(self, number: int) -> None:
        data, position = self.unpacked(number), 0
        while position < len(data):
            op, size = RECORD_HEAD.unpack_from(data, position)
            end = position + RECORD_HEAD.size + size
            if end > len(data):
                raise ValueError("a record is longer than its chunk")
            if op in (SCHEMA, CHANNEL):
                self._declare(op, data[position + RECORD_HEAD.size : end])
            elif op == MESSAGE:
                self._add_message(data[position : position + MESSAGE_HEAD.size], number, position)
            position = end


def _text(data: bytes, position: int) -> tuple[str, int]:
    """Text after its length, and where it ends."""
    (size,) = struct.unpack_from("<I", data, position)
    end = position + 4 + size
    if end > len(data):
        raise ValueError("a text is longer than its record")
    return data[position + 4 : end].decode("utf-8", "replace"), end


SQLITE_MAGIC = b"SQLite format 3\x00"
# A block of zstd (RFC 8878: 128 KiB) has to be there whole before its first byte can be unpacked.
COMPRESSED_HEAD_BYTES = 129 * 1024


class SqliteBag:
    """A rosbag2 database; `compression` is that of each message ("" or "zstd"). The rest is as of a `ChunkedFile`."""

    def __init__(self, path: Path, compression: str = "") -> None:
        self.path = path
        self.notes: list[str] = []
        self._lock = threading.Lock()
        wal = path.with_name(path.name + "-wal")
        if wal.is_file() and wal.stat().st_size:
            self.notes.append(f"{path.name}: the recording was not closed; what is in {wal.name} only is not read")
        # As a URI: read-only, no journal is looked for, no other file is opened.
        self._uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        try:
            self._open()
        except sqlite3.Error as problem:
            raise LogError(f"{path}: cannot be opened as an SQLite database: {one_line(problem)}") from None
        try:
            self._read_index(compression)
        except (sqlite3.Error, TypeError, ValueError, KeyError, OverflowError) as problem:
            raise LogError(f"{path}: not a readable rosbag2 database: {one_line(problem)}") from None

    def message(self, k: int, limit_bytes: int | None = None) -> bytes:
        """Read message `k`, or its first `limit_bytes`."""
        compression = self.channels[int(self.entries.channel[k])].compression
        wanted = COMPRESSED_HEAD_BYTES if compression and limit_bytes else limit_bytes
        try:
            with self._lock:
                if self._process != os.getpid():  # a connection must not be used in a forked process
                    self._open()
                row = int(self.entries.place[k])
                with self._database.blobopen("messages", "data", row, readonly=True) as blob:
                    size = checked_size(len(blob))
                    data = blob.read(size if wanted is None else min(size, wanted))
        except sqlite3.Error as problem:
            raise ValueError(f"the database cannot be read there: {one_line(problem)}") from None
        if compression:
            data = unpack_part(decompressor_of(compression), data, limit_bytes or MAX_MESSAGE_BYTES + 1)
            checked_size(len(data))
        return data

    def _open(self) -> None:
        self._process = os.getpid()
        self._database = sqlite3.connect(self._uri, uri=True, check_same_thread=False)
        weakref.finalize(self, self._database.close)
        self._database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        self._database.execute("PRAGMA trusted_schema = OFF")

    def _read_index(self, compression: str) -> None:
        database = self._database
        tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
        for name in ("topics", "messages"):
            # A view or a virtual table of that name could compute anything.
            if not str(tables.get(name, "")).upper().startswith("CREATE TABLE"):
                raise LogError(f"{self.path}: no table '{name}' in it; expected a rosbag2 database")
        definitions: dict[str, str] = {}
        if "message_definitions" in tables:
            with suppress(sqlite3.Error):
                columns = "topic_type, encoding, encoded_message_definition"
                found = database.execute(f"SELECT {columns} FROM message_definitions")
                definitions = {str(kind): str(text) for kind, language, text in found if language == "ros2msg"}
        rows = list(database.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id"))
        self.channels = [
            Channel(
                printable(topic), normalized_type(kind), printable(encoding), definitions.get(kind, ""), compression
            )
            for topic, kind, encoding in ((str(text) for text in row[1:]) for row in rows)
        ]
        table: NDArray[np.int64] = np.fromiter(chain.from_iterable(self._rows()), dtype=np.int64).reshape(-1, 3)
        numbers = {int(row[0]): k for k, row in enumerate(rows)}
        known = np.isin(table[:, 1], list(numbers))
        if not known.all():
            self.notes.append(f"{self.path.name}: {int((~known).sum())} messages of topics that it does not list")
        table = table[known]
        channel = np.array([numbers[t] for t in table[:, 1].tolist()], dtype=np.int32)
        self.entries = Entries(channel, table[:, 2], np.full(len(table), -1, np.int32), table[:, 0])

    def _rows(self) -> Iterator[tuple[int, int, int]]:
        """Yield id, topic and recorder's stamp of the messages, up to where the database is damaged."""
        count = odd = 0
        try:
            # The data come last in a row, so their pages are not read.
            for row in self._database.execute("SELECT id, topic_id, timestamp FROM messages ORDER BY id"):
                count += 1
                if count > MAX_MESSAGES:
                    raise LogError(f"{self.path}: more than the {MAX_MESSAGES} messages that a file may have")
                # SQLite stores values of any type in any column.
                if type(row[1]) is int and type(row[2]) is int:
                    yield row
                else:
                    odd += 1
        except sqlite3.Error as problem:
            self.notes.append(f"{self.path.name}: damaged after {count} messages: {one_line(problem)}")
        if odd:
            self.notes.append(
                f"{self.path.name}: {odd} of {count} messages without whole numbers as topic and stamp; left out"
            )
