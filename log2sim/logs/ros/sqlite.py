"""Rosbag2 databases (.db3, SQLite): rows of messages, of which only the first page is read for a header."""

from __future__ import annotations

import sqlite3
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
from log2sim.logs.ros.chunked import decompress_message
from log2sim.logs.ros.containers import (
    MAX_MESSAGE_BYTES,
    MAX_MESSAGES,
    Channel,
    Entries,
    checked_size,
    normalized_type,
    one_line,
    printable,
)

MAGIC = b"SQLite format 3\x00"
# A block of zstd (RFC 8878: 128 KiB) has to be there whole before its first byte can be unpacked.
COMPRESSED_HEAD_BYTES = 129 * 1024


class SqliteBag:
    """A rosbag2 database; `compression` is that of each message ("" or "zstd")."""

    def __init__(self, path: Path, compression: str = "") -> None:
        self.path = path
        self.notes: list[str] = []
        self._lock = threading.Lock()
        wal = path.with_name(path.name + "-wal")
        if wal.is_file() and wal.stat().st_size:
            self.notes.append(f"{path.name}: the recording was not closed; what is in {wal.name} only is not read")
        # As a URI: read-only, no journal is looked for, no other file is opened.
        uri = f"file:{quote(str(path.resolve()))}?mode=ro&immutable=1"
        try:
            self._database = sqlite3.connect(uri, uri=True, check_same_thread=False)
        except sqlite3.Error as problem:
            raise LogError(f"{path}: cannot be opened as an SQLite database: {one_line(problem)}") from None
        weakref.finalize(self, self._database.close)
        try:
            self._read_index(compression)
        except (sqlite3.Error, TypeError, ValueError, KeyError, OverflowError) as problem:
            raise LogError(f"{path}: not a readable rosbag2 database: {one_line(problem)}") from None

    def message(self, k: int, limit_bytes: int | None = None) -> bytes:
        """Read message `k`, or its first `limit_bytes`."""
        compression = self.channels[int(self.entries.channel[k])].compression
        wanted = COMPRESSED_HEAD_BYTES if compression and limit_bytes else limit_bytes
        try:
            with (
                self._lock,
                self._database.blobopen("messages", "data", int(self.entries.place[k]), readonly=True) as blob,
            ):
                size = checked_size(len(blob))
                data = blob.read(size if wanted is None else min(size, wanted))
        except sqlite3.Error as problem:
            raise ValueError(f"the database cannot be read there: {one_line(problem)}") from None
        return decompress_message(data, compression, limit_bytes)

    def _read_index(self, compression: str) -> None:
        database = self._database
        database.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, MAX_MESSAGE_BYTES)
        database.execute("PRAGMA trusted_schema = OFF")
        tables = dict(database.execute("SELECT name, sql FROM sqlite_master WHERE type = 'table'"))
        for name in ("topics", "messages"):
            # A view or a virtual table of that name could compute anything.
            if not str(tables.get(name, "")).upper().startswith("CREATE TABLE"):
                raise LogError(f"{self.path}: no table '{name}' in it; expected a rosbag2 database")
        definitions: dict[str, str] = {}
        if "message_definitions" in tables:
            with suppress(sqlite3.Error):
                definitions = {
                    str(kind): str(text)
                    for kind, language, text in database.execute(
                        "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
                    )
                    if language == "ros2msg"
                }
        rows = list(database.execute("SELECT id, name, type, serialization_format FROM topics ORDER BY id"))
        self.channels = [
            Channel(
                printable(str(topic)),
                normalized_type(str(kind)),
                printable(str(encoding)),
                definitions.get(str(kind), ""),
                compression,
            )
            for _, topic, kind, encoding in rows
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
                f"{self.path.name}: {odd} of {count} messages have no whole number as topic or stamp; left out"
            )
