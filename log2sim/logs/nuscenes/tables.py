"""Tables of nuScenes: JSON lists of flat records, scanned in chunks because some hold over a gigabyte."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.errors import LogError
from log2sim.files.documents import RepeatedKeysError, read_json, require_unique, unique_decoder
from log2sim.files.inputs import open_regular, require_link_inside
from log2sim.geometry import Array
from log2sim.logs.records import find_not_unit
from log2sim.logs.stamps import MAX_TIME_S

Record = dict[str, Any]

CHUNK_BYTES = 4 * 1024 * 1024
# Records of v1.0 have 200 to 700 bytes.
MAX_RECORD_BYTES = 64 * 1024
# Tokens have 32 characters, names of files some hundred; arrays of text make room for the longest in every row.
MAX_TEXT_CHARACTERS = 1024
# Meters, pixels and parts of quaternions are all smaller; squares of much larger numbers are not finite.
MAX_NUMBER = 1e9
# Braces inside of strings are tried as the start of a record before the one that is.
MAX_BRACES = 64

SCENES, DATA = "scene", "sample_data"


@dataclass(frozen=True)
class Tables:
    """Tables of one version, such as the folder v1.0-mini."""

    folder: Path

    def path(self, table: str) -> Path:
        """Return the file of a table; `LogError` when it is a link that leaves the folders of the log."""
        path = self.folder / f"{table}.json"
        require_link_inside(path, self.folder.parent)
        return path

    def read(self, table: str, key: str) -> list[Record]:
        """Read a small table; `LogError` for a record whose `key` is no text."""
        path = self.path(table)
        records = read_json(path)
        if not isinstance(records, list) or not all(isinstance(r, dict) for r in records):
            raise LogError(f"{path}: expected a list of records")
        for record in records:
            text_of(record, key, path)
        return records

    def all_of(self, table: str) -> dict[str, Record]:
        """Read a small table as its records by token."""
        return {record["token"]: record for record in self.read(table, "token")}

    def by_token(self, table: str, tokens: Collection[str]) -> dict[str, Record]:
        """Scan a table for the records of some tokens; `LogError` when it has not all of them."""
        path = self.path(table)
        wanted = set(tokens)
        found: dict[str, Record] = {}
        for record in scan_records(path, "token", wanted) if wanted else ():
            found[record["token"]] = record
            if len(found) == len(wanted):
                break
        if len(found) < len(wanted):
            missing = min(wanted - found.keys())
            raise LogError(
                f"{path}: no record with token {missing[:40]!a}, which another table names "
                f"({len(wanted) - len(found)} of {len(wanted)} are missing)"
            )
        return found

    def matching(self, table: str, key: str, values: Collection[str]) -> list[Record]:
        """Scan a table for the records whose `key` is one of some values."""
        return list(scan_records(self.path(table), key, values))


def scan_records(path: Path, key: str, values: Collection[str], chunk_bytes: int = CHUNK_BYTES) -> Iterator[Record]:
    """Find the records of a table in which `key` has one of some values, in the order of the table.

    Only these records are parsed. Memory is bounded by the chunk; line breaks and spaces are as they like. Raises `LogError` for a
    table that is missing or does not begin and end as a list, or a wanted record that is not valid JSON.
    """
    wanted = frozenset(values)
    plain = frozenset(value.encode(errors="replace") for value in wanted)
    entry = re.compile(rb'"' + re.escape(key.encode()) + rb'"\s*:\s*"([^"]*)"')
    for data, begin, end, offset in _windows(path, chunk_bytes):
        found = entry.findall(data, begin)
        escaped = b"\\" in data and any(b"\\" in value for value in found)
        if not escaped and plain.isdisjoint(found):
            continue
        for match in entry.finditer(data, begin):
            if match.start() >= end:
                break
            if match[1] in plain or b"\\" in match[1]:
                record = _record_around(data, match.start(), f"{path}, byte {offset + match.start()}")
                if isinstance(record.get(key), str) and record[key] in wanted:
                    yield record


def _windows(path: Path, chunk_bytes: int) -> Iterator[tuple[bytes, int, int, int]]:
    """Yield parts of a table as bytes, the range in them that is new, and the offset in the file of the first byte.

    Around the new range every record that touches it is complete.
    """
    try:
        with open_regular(path) as file:
            data, begin, offset = b"", 0, 0
            while True:
                chunk = file.read(chunk_bytes)
                if not offset and not data and chunk.lstrip()[:1] not in (b"[", b""):
                    raise LogError(f"{path}: begins with {chunk.lstrip()[:1]!a}, expected a JSON list of records")
                if b"\0" in chunk:  # a file that was cut and grown by a copy that failed: it may go on for gigabytes
                    place = offset + len(data) + chunk.index(b"\0")
                    raise LogError(f"{path}, byte {place}: not valid JSON: a zero byte; is the file damaged?")
                if not chunk and data.rstrip()[-1:] != b"]":
                    raise LogError(f"{path}: not valid JSON: it does not end with ']'; is the file truncated?")
                data += chunk
                end = max(len(data) - MAX_RECORD_BYTES, begin) if chunk else len(data)
                yield data, begin, end, offset
                if not chunk:
                    return
                cut = max(end - MAX_RECORD_BYTES, 0)
                data, begin, offset = data[cut:], end - cut, offset + cut
    except OSError as problem:
        raise LogError(f"{path}: cannot be read: {problem.strerror}; it belongs to the other tables") from None


def _record_around(data: bytes, at: int, where: str) -> Record:
    """Parse the record that holds the entry at a place."""
    first, last, start = max(at - MAX_RECORD_BYTES, 0), at + MAX_RECORD_BYTES, at
    for _ in range(MAX_BRACES):
        start = data.rfind(b"{", first, start)
        if start < 0:
            break
        text = data[start:last].decode("utf-8", errors="replace")
        repeated: list[str] = []
        try:
            record, length = unique_decoder(repeated).raw_decode(text)
        except (ValueError, RecursionError):
            continue
        if len(text[:length].encode()) > at - start:
            try:
                require_unique(repeated)
            except RepeatedKeysError as problem:
                raise LogError(f"{where}: {problem}") from None
            return dict(record)
    raise LogError(f"{where}: not valid JSON; expected a flat record of at most {MAX_RECORD_BYTES} bytes")


def text_of(record: Record, key: str, path: Path) -> str:
    """Return a text of a record; `LogError` when it has none or one that cannot be printed in a line."""
    value = record.get(key)
    if not isinstance(value, str) or not value.isprintable() or len(value) > MAX_TEXT_CHARACTERS:
        raise _wrong(record, key, path, f"a text in one line of at most {MAX_TEXT_CHARACTERS} characters")
    return value


def stamp_ns_of(record: Record, path: Path) -> int:
    """Return the stamp of a record in ns; `LogError` when it is no whole number of microseconds."""
    value = record.get("timestamp")
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value <= MAX_TIME_S * 10**6:
        raise _wrong(record, "timestamp", path, "whole microseconds")
    return value * 1000


def numbers_of(records: list[Record], key: str, shape: tuple[int, ...], path: Path) -> Array:
    """Return the numbers of a key as (len(records), *shape) float64; `LogError` that names the first record without."""
    rows = np.zeros((len(records), *shape))
    for k, record in enumerate(records):
        try:
            row = np.asarray(record.get(key), dtype=np.float64)
        except (TypeError, ValueError, OverflowError):
            row = np.zeros(0)
        if row.shape != shape or not (np.abs(row) <= MAX_NUMBER).all():
            expected = " x ".join(str(n) for n in shape)
            raise _wrong(record, key, path, f"{expected} finite numbers up to {MAX_NUMBER:g}")
        rows[k] = row
    return rows


def quaternions_of(records: list[Record], path: Path) -> Array:
    """Return the rotations of records, unit quaternions (R, 4) scalar-first; `LogError` for one that is not."""
    q = numbers_of(records, "rotation", (4,), path)
    for k in find_not_unit(q):
        raise _wrong(records[k], "rotation", path, "a unit quaternion")
    return q


def _wrong(record: Record, key: str, path: Path, expected: str) -> LogError:
    """Return the error for a value of a record, which it names by its token."""
    text = ascii(record.get(key))
    shown = text if len(text) <= 60 else f"{text[:57]}..."
    return LogError(f"{path}, token {str(record.get('token'))[:40]!a}: '{key}' is {shown}, expected {expected}")
