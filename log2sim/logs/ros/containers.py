"""Files of chunks with channels and messages, and the oldest of them: ROS 1 bags, format 2.0.

Bags (http://wiki.ros.org/Bags/Format/2.0) are read by their index, or by all chunks where it is missing.
"""

from __future__ import annotations

import bz2
import importlib
import os
import struct
import threading
import weakref
import zlib
from array import array
from collections import OrderedDict
from contextlib import suppress
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, MissingExtra
from log2sim.files.inputs import open_regular
from log2sim.logs.records import PARSER_ERRORS

MAX_MESSAGE_BYTES = 256 * 1024 * 1024
MAX_NAME_CHARACTERS = 256
MAX_MESSAGES = 20_000_000
"""In one file; the index of as many takes half a gigabyte."""


@dataclass(frozen=True)
class Channel:
    """Messages of one topic and type in one file."""

    topic: str
    msgtype: str  # such as "sensor_msgs/msg/Image"
    encoding: str  # "ros1", "cdr", or another that is not decoded
    definition: str = ""  # text of the message definition; empty where the file holds none
    compression: str = ""  # of each message by itself: "" or "zstd"


@dataclass(frozen=True, eq=False)
class Entries:
    """Index of the messages of a file, in the order in which they lie there; M is their number."""

    channel: NDArray[np.int32]  # (M,): index into the channels
    t_ns: NDArray[np.int64]  # (M,): when the recorder received the message
    chunk: NDArray[np.int32]  # (M,): index into the chunks; -1 for a message outside of chunks
    place: NDArray[np.int64]  # (M,): where it begins: a byte of its chunk or file, or a row of a database


@lru_cache(maxsize=4096)
def printable(text: str) -> str:
    """Return a name of a recording in one line that can be shown, whatever a damaged file has in its place."""
    return "".join(c if c.isprintable() else "?" for c in text[:MAX_NAME_CHARACTERS])


def one_line(problem: Exception) -> str:
    """Return the text of an error as one line of printable characters."""
    return printable(" ".join(str(problem).split())) or type(problem).__name__


def normalized_type(name: str) -> str:
    """Name of a message type as ROS 2 writes it: "sensor_msgs/Image" becomes "sensor_msgs/msg/Image"."""
    parts = printable(name).split("/")
    return f"{parts[0]}/msg/{parts[1]}" if len(parts) == 2 else "/".join(parts)


def checked_size(size_bytes: int) -> int:
    """Return the size of a message; `ValueError` when it is more than a message may have."""
    if not 0 <= size_bytes <= MAX_MESSAGE_BYTES:
        raise ValueError(f"{size_bytes} bytes, more than the {MAX_MESSAGE_BYTES} that a message may have")
    return size_bytes


MAX_CHUNK_BYTES = 512 * 1024 * 1024
MAX_RATIO, FREE_BYTES = 256, 16 * 1024 * 1024
"""A chunk that unpacks to more than `FREE_BYTES`, and to so many times its stored size, holds nothing that was measured: sensor data
pack to a half to a twentieth. Without this a few kilobytes would keep the reader busy for minutes."""
READ_BYTES = 16 * 1024
CACHED_BYTES = 64 * 1024 * 1024
"""Of decompressed chunks; the last one is kept whatever its size."""


class Chunk(NamedTuple):
    """A chunk: where its stored bytes lie in the file, and what they unpack to."""

    position: int
    stored_bytes: int
    size_bytes: int
    compression: str
    crc: int = 0


class ChunkedFile:
    """Reads messages, ranges of a file, and the unpacked chunks in it, from any thread."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.chunks: list[Chunk] = []
        self._file = open_regular(path, buffering=0)
        weakref.finalize(self, self._file.close)
        self.size = os.fstat(self._file.fileno()).st_size
        self._lock = threading.RLock()
        self._cache: OrderedDict[int, bytes] = OrderedDict()
        self._intact: set[int] = set()
        self._damaged: dict[int, str] = {}
        self._partial: _PartialChunk | None = None

    def index(self) -> None:
        """Find all messages by the index of the file, or by all its chunks where the index is missing or damaged."""
        self.notes, problem = list[str](), ""
        try:
            self._begin()
            complete = self._read_index()
        except PARSER_ERRORS as error:
            complete, problem = False, one_line(error)
        if not complete:
            self._begin()
            self._scan()
        if problem:
            self.notes.append(
                f"{self.path.name}: its index is missing or damaged ({problem}); {self._count()} messages were found by reading it whole"
            )
        rows = np.frombuffer(self._index, dtype=np.int64).reshape(-1, 4)
        channel, t_ns, chunk, place = rows[np.lexsort((rows[:, 3], rows[:, 2]))].T
        self.entries = Entries(channel.astype(np.int32), t_ns, chunk.astype(np.int32), place)

    def _begin(self) -> None:
        """Forget what was found."""
        self.channels: list[Channel] = []
        self._numbers: dict[int, int] = {}  # of the channels, by their number in the file
        self._index, self.chunks = array("q"), []

    def _add(self, channel: int, t_ns: Any, chunk: int, place: Any) -> None:
        """Add messages of one channel in one chunk to the index, by their stamps and places (N,) or those of one."""
        rows = np.empty((np.size(t_ns), 4), dtype=np.int64)
        for column, value in enumerate((channel, t_ns, chunk, place)):
            rows[:, column] = value
        self._index.frombytes(rows.tobytes())
        if self._count() > MAX_MESSAGES:
            raise ValueError(f"more than the {MAX_MESSAGES} messages that a file may have")

    def _count(self) -> int:
        return len(self._index) // 4

    def _read_index(self) -> bool:
        """Read the index; return whether it leads to all messages."""
        raise NotImplementedError

    def _scan(self) -> None:
        """Find all messages by walking the file, up to where it is cut."""
        raise NotImplementedError

    def _locate(self, chunk: int, place: int, *, ahead: bool) -> tuple[int, int]:
        """Return where the data of a message begin, and their size, by the head of its record at a place."""
        raise NotImplementedError

    def message(self, k: int, limit_bytes: int | None = None) -> bytes:
        """Read message `k`, or its first `limit_bytes`; raise one of `PARSER_ERRORS` where it is damaged.

        With a limit, chunks are unpacked only as far as needed, and their checksums are not checked; reading messages in
        their order is then fastest. It may be called from several threads at once.
        """
        chunk, ahead = int(self.entries.chunk[k]), limit_bytes is not None
        position, size = self._locate(chunk, int(self.entries.place[k]), ahead=ahead)
        wanted = checked_size(size)
        if limit_bytes is not None:
            wanted = min(wanted, limit_bytes)
        elif chunk >= 0 and self.chunks[chunk].crc and chunk not in self._intact:
            self.unpacked(chunk)  # checks the CRC
        data = self.within(chunk, position, wanted, ahead=ahead) if wanted else b""
        if len(data) != wanted:
            raise ValueError(f"{len(data)} of {wanted} bytes; the chunk is truncated")
        return data

    def at(self, position: int, count: int) -> bytes:
        """Read `count` bytes; `ValueError` where the file ends before."""
        if count < 0 or position < 0 or position + count > self.size:
            raise ValueError(f"{count} bytes at byte {position} of a file of {self.size}; it is truncated or damaged")
        parts, missing = [], count
        # Without a position of the file, which other threads and forked processes share.
        while missing and (part := os.pread(self._file.fileno(), missing, position + count - missing)):
            parts.append(part)
            missing -= len(part)
        if missing:
            raise ValueError(f"{count} bytes at byte {position}, but the file ends {missing} bytes before")
        return b"".join(parts)

    def within(self, chunk: int, offset: int, count: int, *, ahead: bool = False) -> bytes:
        """Read up to `count` bytes from `offset` of a chunk, or of the file for chunk -1; fewer at its end.

        With `ahead` a compressed chunk is unpacked only as far as needed, for callers that go through the file in order.
        """
        if chunk < 0:
            return self.at(offset, min(count, self.size - offset))
        c = self.chunks[chunk]
        if not 0 <= offset < c.size_bytes:
            raise ValueError(f"message at byte {offset} of a chunk of {c.size_bytes}")
        count = min(count, c.size_bytes - offset)
        if c.compression in ("", "none"):
            return self.at(c.position + offset, count)
        if ahead and chunk not in self._cache:
            with self._lock:
                return bytes(self._unpacked_up_to(chunk, offset + count)[offset : offset + count])
        return self.unpacked(chunk)[offset : offset + count]

    def _unpacked_up_to(self, number: int, end: int) -> bytearray:
        """First bytes of a compressed chunk, at least `end` of them; what is stored behind them is not read."""
        chunk = self.chunks[number]
        self._require_sizes(chunk)
        partial = self._partial
        if partial is None or partial.number != number:
            partial = self._partial = _PartialChunk(number, decompressor_of(chunk.compression))
        while len(partial.data) < end:
            left = chunk.stored_bytes - partial.read_bytes
            if number in self._damaged or not left:
                raise ValueError(self._damaged.get(number, f"unpacks to {len(partial.data)} bytes only"))
            part = self.at(chunk.position + partial.read_bytes, min(left, READ_BYTES))
            partial.read_bytes += len(part)
            try:
                # No more is unpacked than the size that the chunk declares.
                partial.data += unpack_part(partial.decompressor, part, chunk.size_bytes + 1 - len(partial.data))
            except ValueError as problem:
                self._damaged[number] = str(problem)
        return partial.data

    def unpacked(self, chunk: int) -> bytes:
        """Bytes of a chunk, decompressed and checked; a damaged one is not tried again."""
        with self._lock:
            if chunk in self._cache:
                self._cache.move_to_end(chunk)
                return self._cache[chunk]
        if chunk in self._damaged:
            raise ValueError(self._damaged[chunk])
        try:
            c = self.chunks[chunk]
            self._require_sizes(c)
            data = self.at(c.position, c.stored_bytes)
            if c.compression not in ("", "none"):
                data = unpack_part(decompressor_of(c.compression), data, c.size_bytes + 1)
            if len(data) != c.size_bytes:
                found = f"more than {c.size_bytes}" if len(data) > c.size_bytes else f"{len(data)}"
                raise ValueError(f"unpacks to {found} bytes, expected {c.size_bytes}")
            if c.crc and zlib.crc32(data) != c.crc:
                raise ValueError(f"the CRC of the chunk at byte {c.position} is wrong")
        except (ValueError, OSError, EOFError) as problem:
            self._damaged[chunk] = str(problem)
            raise
        with self._lock:
            self._cache[chunk] = data
            self._intact.add(chunk)
            while len(self._cache) > 1 and sum(map(len, self._cache.values())) > CACHED_BYTES:
                self._cache.popitem(last=False)
        return data

    def _require_sizes(self, chunk: Chunk) -> None:
        """Raise `ValueError` for a chunk whose sizes no recorder writes."""
        if max(chunk.size_bytes, chunk.stored_bytes) > MAX_CHUNK_BYTES:
            raise ValueError(f"a chunk of {chunk.size_bytes} bytes, more than the {MAX_CHUNK_BYTES} that it may have")
        if chunk.size_bytes > max(FREE_BYTES, MAX_RATIO * chunk.stored_bytes):
            raise ValueError(
                f"a chunk of {chunk.stored_bytes} bytes that says to unpack to {chunk.size_bytes}, more than {MAX_RATIO} times as many"
            )


@dataclass
class _PartialChunk:
    """A chunk that is unpacked from its beginning on: its number, and how much of it was read and unpacked."""

    number: int
    decompressor: Any
    read_bytes: int = 0
    data: bytearray = field(default_factory=bytearray)


def unpack_part(decompressor: Any, data: bytes, limit_bytes: int) -> bytes:
    """Unpack the next part of compressed data into at most `limit_bytes`; `ValueError` where it is damaged."""
    try:
        return bytes(decompressor.decompress(data, max_length=limit_bytes))
    except Exception as error:  # the libraries have errors of their own
        raise ValueError(f"damaged compressed data: {error}") from None


def decompressor_of(method: str) -> Any:
    """Return the decompressor of a method; `MissingExtra` where its library is not installed."""
    if method == "bz2":
        return bz2.BZ2Decompressor()
    # Python has zstd from 3.14 on.
    names = {"lz4": ("lz4.frame",), "zstd": ("compression.zstd", "backports.zstd")}.get(method, ())
    for name in names:
        with suppress(ImportError):
            module = importlib.import_module(name)
            return module.LZ4FrameDecompressor() if method == "lz4" else module.ZstdDecompressor()
    if names:
        raise MissingExtra(f"reading {method} compression of a bag", "ros")
    raise ValueError(f"unknown compression '{method[:20]}'; known: none, bz2, lz4, zstd")


MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER_BYTES = 1024 * 1024
MAX_INDEX_BYTES = 256 * 1024 * 1024
MESSAGE, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 4, 5, 6, 7
# A record begins with its header; that of a message is about 40 bytes.
FIRST_BYTES = 512


class Record(NamedTuple):
    """A record of a ROS 1 bag: fields of its header, and where its data lie."""

    fields: dict[bytes, bytes]
    position: int
    size: int

    @property
    def op(self) -> int:
        """Kind of the record."""
        return self.fields[b"op"][0]

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.position + self.size

    def number(self, name: bytes, code: str = "<I") -> int:
        """Return a number of the header."""
        return int(struct.unpack(code, self.fields[name])[0])


class Rosbag1(ChunkedFile):
    """A ROS 1 bag."""

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        if self.size < len(MAGIC) or self.at(0, len(MAGIC)) != MAGIC:
            raise LogError(f"{path}: does not begin with '#ROSBAG V2.0'; expected a ROS 1 bag of that version")
        self.index()

    def _locate(self, chunk: int, place: int, *, ahead: bool) -> tuple[int, int]:
        record = parse_record(self.within(chunk, place, FIRST_BYTES, ahead=ahead), 0, place)
        if record.op != MESSAGE:
            raise ValueError("no message where the index says so")
        return record.position, record.size

    def _record(self, position: int) -> Record:
        return parse_record(self.at(position, min(FIRST_BYTES, self.size - position)), 0, position, self)

    def _read_index(self) -> bool:
        header = self._record(len(MAGIC))
        position = header.number(b"index_pos", "<Q")
        if not position:
            raise ValueError("the recording was not closed")
        for _ in range(header.number(b"conn_count")):
            record = self._record(position)
            self._add_connection(record, self.at(record.position, record.size))
            position = record.end
        for _ in range(header.number(b"chunk_count")):
            record = self._record(position)
            if record.op != CHUNK_INFO:
                raise ValueError(f"record of kind {record.op} in the index, expected {CHUNK_INFO}")
            self._index_chunk(record.number(b"chunk_pos", "<Q"), record.number(b"count"))
            position = record.end
        return True

    def _index_chunk(self, position: int, connections: int) -> None:
        """Read the index of one chunk; a damaged one is left out with a note."""
        try:
            record = self._record(position)
            number = self._add_chunk(record)
            position = record.end
            for _ in range(connections):
                record = self._record(position)
                if record.op != INDEX or record.size > MAX_INDEX_BYTES:
                    raise ValueError("its index is damaged")
                data = np.frombuffer(self.at(record.position, record.size), "<u4")
                seconds, nanoseconds, offset = data.reshape(-1, 3).astype(np.int64).T
                channel = self._numbers[record.number(b"conn")]
                self._add(channel, seconds * 1_000_000_000 + nanoseconds, number, offset)
                position = record.end
        except PARSER_ERRORS as problem:
            self.notes.append(f"{self.path.name}: the chunk at byte {position} cannot be read: {one_line(problem)}")

    def _add_chunk(self, record: Record) -> int:
        compression = record.fields[b"compression"].decode("ascii", "replace")
        self.chunks.append(Chunk(record.position, record.size, record.number(b"size"), compression))
        return len(self.chunks) - 1

    def _add_connection(self, record: Record, data: bytes) -> None:
        if record.op != CONNECTION:
            raise ValueError(f"record of kind {record.op}, expected {CONNECTION}")
        number, fields = record.number(b"conn"), parse_fields(data)
        if number in self._numbers:
            return
        self._numbers[number] = len(self.channels)
        # The topic in the record's header is the one that it was recorded under.
        described = {**fields, **{k: v for k, v in record.fields.items() if k == b"topic"}}
        topic, kind, definition = (
            described.get(key, b"").decode("utf-8", "replace") for key in (b"topic", b"type", b"message_definition")
        )
        self.channels.append(Channel(printable(topic), normalized_type(kind), "ros1", definition))

    def _scan(self) -> None:
        position = len(MAGIC)
        while position < self.size:
            try:
                record = self._record(position)
                if record.op == CONNECTION:
                    self._add_connection(record, self.at(record.position, record.size))
                elif record.op == CHUNK:
                    self._walk(self._add_chunk(record))
            except PARSER_ERRORS as problem:
                self.notes.append(f"{self.path.name}: unreadable from byte {position}: {one_line(problem)}")
                return
            position = record.end

    def _walk(self, number: int) -> None:
        chunk = self.chunks[number]
        if chunk.compression == "none" and chunk.position + chunk.stored_bytes > self.size:
            data = self.at(chunk.position, self.size - chunk.position)
        else:
            data = self.unpacked(number)
        position = 0
        while position < len(data):
            record = parse_record(data, position, position)
            if record.end > len(data):
                raise ValueError("the last chunk is truncated")
            if record.op == CONNECTION:
                self._add_connection(record, data[record.position : record.end])
            elif record.op == MESSAGE:
                seconds, nanoseconds = struct.unpack("<II", record.fields[b"time"])
                channel = self._numbers[record.number(b"conn")]
                self._add(channel, seconds * 1_000_000_000 + nanoseconds, number, position)
            position = record.end


def parse_record(data: bytes, start: int, position: int, file: ChunkedFile | None = None) -> Record:
    """Parse a record that begins at `start` of data and at `position` of its file or chunk; `file` has longer headers."""
    (size,) = struct.unpack_from("<I", data, start)
    if size > MAX_HEADER_BYTES:
        raise ValueError(f"header of {size} bytes at byte {position}")
    if start + 8 + size > len(data):
        if file is None:
            raise ValueError(f"header of {size} bytes at byte {position} is truncated")
        data, start = file.at(position, 8 + size), 0
    fields = parse_fields(data[start + 4 : start + 4 + size])
    if len(fields.get(b"op", b"")) != 1:
        raise ValueError(f"no record at byte {position}")
    return Record(fields, position + 8 + size, int(struct.unpack_from("<I", data, start + 4 + size)[0]))


def parse_fields(data: bytes) -> dict[bytes, bytes]:
    """Parse fields "name=value", each after its length."""
    fields, position = {}, 0
    while position < len(data):
        (size,) = struct.unpack_from("<I", data, position)
        name, equals, value = data[position + 4 : position + 4 + size].partition(b"=")
        if not equals or position + 4 + size > len(data):
            raise ValueError("a header without 'name=value'")
        fields[name] = value
        position += 4 + size
    return fields
