"""ROS 1 bags, format 2.0 (http://wiki.ros.org/Bags/Format/2.0), by their index, or by all chunks where it is missing."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import NamedTuple

import numpy as np

from log2sim.errors import LogError
from log2sim.logs.records import PARSER_ERRORS
from log2sim.logs.ros.containers import Channel, Chunk, ChunkedFile, checked_size, normalized_type, one_line, printable

MAGIC = b"#ROSBAG V2.0\n"
MAX_HEADER_BYTES = 1024 * 1024
MAX_INDEX_BYTES = 256 * 1024 * 1024
MESSAGE, BAG, INDEX, CHUNK, CHUNK_INFO, CONNECTION = 2, 3, 4, 5, 6, 7
# A record begins with its header; that of a message is about 40 bytes.
FIRST_BYTES = 512


class Record(NamedTuple):
    """A record: fields of its header, and where its data lie."""

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

    def message(self, k: int, limit_bytes: int | None = None) -> bytes:
        """Read message `k`, or its first `limit_bytes`."""
        chunk, place = int(self.entries.chunk[k]), int(self.entries.place[k])
        ahead = limit_bytes is not None
        first = self.within(chunk, place, FIRST_BYTES, ahead=ahead)
        record = parse_record(first, 0, place)
        if record.op != MESSAGE:
            raise ValueError("no message where the index says so")
        start = record.position - place
        size = checked_size(record.size)
        wanted = size if limit_bytes is None else min(size, limit_bytes)
        if start + wanted <= len(first):
            return first[start : start + wanted]
        data = self.within(chunk, record.position, wanted, ahead=ahead)
        if len(data) != wanted:
            raise ValueError(f"{len(data)} of {wanted} bytes; the chunk is truncated")
        return data

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
                seconds, nanoseconds, offset = (
                    np.frombuffer(self.at(record.position, record.size), "<u4").reshape(-1, 3).astype(np.int64).T
                )
                channel = self._numbers[record.number(b"conn")]
                self._list.add_block(channel, seconds * 1_000_000_000 + nanoseconds, number, offset)
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
        topic, kind, definition = (
            fields.get(key, b"").decode("utf-8", "replace") for key in (b"topic", b"type", b"message_definition")
        )
        # The name in the record's header is the one that the topic was recorded under.
        topic = record.fields.get(b"topic", topic.encode()).decode("utf-8", "replace")
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
        whole = chunk.position + chunk.stored_bytes <= self.size
        if chunk.compression == "none" and not whole:
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
                self._list.add(channel, seconds * 1_000_000_000 + nanoseconds, number, position)
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
