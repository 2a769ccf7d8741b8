"""A recording as topics: its files, and the messages of all of them in the order of recording."""

from __future__ import annotations

import hashlib
import re
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, MissingExtra, RecordError
from log2sim.files.inputs import open_regular, read_text, require_link_inside
from log2sim.logs.records import PARSER_ERRORS
from log2sim.logs.ros.containers import ChunkedFile, Rosbag1, one_line, printable
from log2sim.logs.ros.rosbag2 import MAGIC, SQLITE_MAGIC, Mcap, SqliteBag

SUFFIXES = (".bag", ".db3", ".mcap")
METADATA = "metadata.yaml"
MAX_METADATA_BYTES = 16 * 1024 * 1024
SETTINGS = "topics.toml"
# "drive_2024-05-01-10-00-00_3.bag" and "drive_3.db3" are parts of a recording "drive".
_SPLIT = re.compile(r"^(?P<name>.*?)(?:_?\d{4}-\d\d-\d\d-\d\d-\d\d-\d\d)?_(?P<part>\d+)$")


@dataclass(frozen=True)
class Recording:
    """One recording, found by names alone: its file or folder, its files in the order of the parts, and where settings may lie."""

    place: Path
    files: tuple[Path, ...]
    settings: tuple[Path, ...]  # TOML files; the first that exists counts


def find_recordings(path: Path) -> dict[str, Recording]:
    """Find the recordings at a file or folder by name; none where there are none.

    A folder with metadata.yaml is one recording. Bags of one name that are numbered from 0 are parts of one recording; other
    bags of a folder are recordings of their own.
    """
    path = path.absolute()
    try:
        if path.is_file():
            return {path.stem: _file_recording(path, path.parent)}
        if (path / METADATA).is_file() and _bags(path):
            return {path.name: _folder_recording(path, path)}
        groups: dict[tuple[str, str], list[Path]] = {}
        for file in _bags(path):
            match = _SPLIT.match(file.stem)
            key = (match["name"] or path.name) if match else file.stem
            groups.setdefault((key, file.suffix.lower()), []).append(file)
        loose = list[tuple[str, Recording]]()
        for (name, _), parts in groups.items():
            numbers = [_part(p) for p in parts]
            if len(parts) > 1 and numbers[0] == 0 and len(set(numbers)) == len(numbers):
                settings = (path / f"{name}.{SETTINGS}", path / SETTINGS)
                loose.append((name, Recording(path, tuple(parts), settings)))
            else:
                loose += [(p.stem, _file_recording(p, path)) for p in parts]
        # Files of one name in two formats would hide each other.
        names = [name for name, _ in loose]
        found = {r.files[0].name if names.count(name) > 1 else name: r for name, r in loose}
        for folder in sorted(p for p in path.iterdir() if p.is_dir() and (p / METADATA).is_file()):
            if _bags(folder):
                found[folder.name] = _folder_recording(folder, path)
        return found
    except OSError:
        return {}


def recorded_files(recording: Recording, notes: list[str]) -> tuple[list[Path], str]:
    """Return the files of a recording that are there, in order, and the compression of its messages."""
    if recording.place.is_dir():
        for file in recording.files:
            require_link_inside(file, recording.place)
    metadata = recording.place / METADATA
    if not recording.place.is_dir() or not metadata.is_file():
        numbers = [_part(p) for p in recording.files]
        lost = sorted(set(range(numbers[-1] + 1)) - set(numbers)) if len(numbers) > 1 else []
        if lost:
            notes.append(f"{len(lost)} of {numbers[-1] + 1} files of the recording are missing, first part {lost[0]}")
        return list(recording.files), ""
    require_link_inside(metadata, recording.place)
    try:
        from ruamel.yaml import YAML
        from ruamel.yaml.error import YAMLError
    except ImportError:
        raise MissingExtra("reading rosbag2 folders", "ros") from None
    text = read_text(metadata, MAX_METADATA_BYTES, LogError)
    try:
        document = YAML(typ="safe", pure=True).load(text)["rosbag2_bagfile_information"]
        if not isinstance(document, dict):
            raise TypeError("no table")
    except (YAMLError, ValueError, TypeError, KeyError, RecursionError) as problem:
        raise LogError(f"{metadata}: not the metadata of a rosbag2 recording: {one_line(problem)}") from None
    mode, method = (str(document.get(key) or "").lower() for key in ("compression_mode", "compression_format"))
    if mode == "file":
        raise LogError(f"{metadata}: its files are compressed whole ({method}); unpack them with `ros2 bag convert`")
    named = document.get("relative_file_paths") or []
    names = [PurePosixPath(str(name)).name for name in named if isinstance(named, list)]
    paths = [recording.place / name for name in names]
    missing = [p.name for p in paths if not p.is_file()]
    if paths and len(missing) == len(paths):
        raise LogError(f"{metadata}: none of the files that it names is there: {', '.join(missing[:5])}")
    if missing:
        notes.append(f"{len(missing)} of {len(paths)} files of the recording are missing: {', '.join(missing[:5])}")
    return [p for p in paths if p.is_file()] or list(recording.files), method if mode == "message" else ""


def _bags(folder: Path) -> list[Path]:
    """Return the bags in a folder by the numbers of their parts, then by their names."""
    found = (p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
    return sorted(found, key=lambda path: (_part(path), path))


def _file_recording(path: Path, root: Path) -> Recording:
    next_to = path.with_name(f"{path.stem}.{SETTINGS}")
    return Recording(path, (path,), (next_to, path.parent / SETTINGS, root / SETTINGS))


def _folder_recording(folder: Path, root: Path) -> Recording:
    settings = (folder / SETTINGS, folder.parent / f"{folder.name}.{SETTINGS}", root / SETTINGS)
    return Recording(folder, tuple(_bags(folder)), settings)


def _part(path: Path) -> int:
    match = _SPLIT.match(path.stem)
    return int(match["part"]) if match else 0


ENCODINGS = ("ros1", "cdr")
STAMP = slice(4, 12)
"""Bytes of header.stamp in a message: after the sequence number in ROS 1, after the encapsulation in CDR."""
MAX_INDEX_BYTES = 16 * 1024 * 1024
"""Of one transform, pose or calibration message; a longer one is damaged."""
MAX_COLLECTED_BYTES = 1024 * 1024 * 1024
"""Of all messages that are read at opening; an hour of /tf takes some ten megabytes."""
NAME_BYTES = 272
"""Of a message that hold its stamp and its frame_id."""


@dataclass(frozen=True, eq=False)
class Topic:
    """Messages of one topic; M is their number, i counts them in the order of recording; texts as in `containers.Channel`."""

    name: str
    msgtype: str
    encoding: str
    definition: str
    file: NDArray[np.intp]  # (M,): index of the file of each message
    entry: NDArray[np.intp]  # (M,): its number there
    recorded_ns: NDArray[np.int64]  # (M,): when the recorder received it

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.entry)


class Bag:
    """The files of a recording: `topics` by name, `digest` over names, sizes and indexes of the files."""

    def __init__(self, recording: Recording) -> None:
        self.place, self.notes = recording.place, list[str]()
        paths, compression = recorded_files(recording, self.notes)
        self.files: list[ChunkedFile | SqliteBag] = []
        for path in paths:
            try:
                self.files.append(open_container(path, compression))
            except (LogError, OSError) as error:
                # One damaged part of a split recording leaves the others.
                if len(paths) == 1:
                    raise LogError(str(error)) from None
                self.notes.append(f"{error}; that part of the recording is left out")
        if not self.files:
            raise LogError(f"{recording.place}: none of its {len(paths)} files can be read")
        self.notes += [note for file in self.files for note in file.notes]
        self.topics = self._join()
        value = hashlib.sha256()
        for container in self.files:
            value.update(f"{container.path.name} {container.path.stat().st_size}\n".encode())
            for column in (container.entries.channel, container.entries.t_ns):
                value.update(np.ascontiguousarray(column).astype("<i8").tobytes())
        self.digest = value.hexdigest()

    def read(self, topic: Topic, i: int, limit_bytes: int | None = None) -> bytes:
        """Read message `i` of a topic, or its first `limit_bytes`; `RecordError` where it is damaged."""
        file = self.files[int(topic.file[i])]
        try:
            return file.message(int(topic.entry[i]), limit_bytes)
        except PARSER_ERRORS as problem:
            raise RecordError(f"{self.where(topic, i)}: cannot be read: {one_line(problem)}") from None

    def where(self, topic: Topic, i: int) -> str:
        """Name file, topic and message `i` in errors."""
        path = self.files[int(topic.file[i])].path
        return f"{path}, topic '{topic.name}', message {i} (recorded at {topic.recorded_ns[i]})"

    def collect(self, wanted: Mapping[str, int | None]) -> dict[str, list[bytes | None]]:
        """Read all messages of some topics, or their first bytes, in one pass through the files.

        `wanted`: topics with the number of bytes; None for whole messages of up to `MAX_INDEX_BYTES`. Returns by topic,
        in the order of recording; None for a damaged message, and for those beyond `MAX_COLLECTED_BYTES`.
        """
        topics = [self.topics[name] for name in wanted]
        found: dict[str, list[bytes | None]] = {t.name: [None] * len(t) for t in topics}
        if not topics:
            return found
        number = np.concatenate([np.full(len(t), k) for k, t in enumerate(topics)])
        row = np.concatenate([np.arange(len(t)) for t in topics])
        order = np.lexsort((np.concatenate([t.entry for t in topics]), np.concatenate([t.file for t in topics])))
        limits = [MAX_INDEX_BYTES if wanted[t.name] is None else wanted[t.name] for t in topics]
        size = 0
        for k, i in zip(number[order].tolist(), row[order].tolist()):
            if size > MAX_COLLECTED_BYTES:
                self.notes.append(
                    f"transforms, poses and calibrations have more than {MAX_COLLECTED_BYTES} bytes; the rest is not read"
                )
                break
            with suppress(RecordError):
                data = found[topics[k].name][i] = self.read(topics[k], i, limits[k])
                size += len(data)
        return found

    def frame_id(self, topic: Topic) -> str:
        """Name of the frame in the header of the first message that can be read; "" without one."""
        for i in range(len(topic)):
            try:
                head = self.read(topic, i, NAME_BYTES)
                (size,) = struct.unpack_from(_order(head, topic.encoding) + "I", head, STAMP.stop)
            except (RecordError, struct.error, IndexError):
                continue
            name = head[STAMP.stop + 4 : STAMP.stop + 4 + size].rstrip(b"\0").decode("utf-8", "replace")
            return printable(name).lstrip("/")
        return ""

    def _join(self) -> dict[str, Topic]:
        parts: dict[tuple[str, str, str], list[tuple[int, int]]] = {}
        for f, file in enumerate(self.files):
            for c, channel in enumerate(file.channels):
                name = "/" + "/".join(part for part in channel.topic.split("/") if part)
                parts.setdefault((name, channel.msgtype, channel.encoding), []).append((f, c))
        rows_of = []
        for file in self.files:  # in one pass: a file may have many channels
            channels = file.entries.channel
            order = np.argsort(channels, kind="stable")
            last = max(len(file.channels), 1)
            rows_of.append(np.split(order, np.searchsorted(channels[order], np.arange(1, last))))
        topics: dict[str, Topic] = {}
        for (name, msgtype, encoding), places in sorted(parts.items()):
            first = self.files[places[0][0]].channels[places[0][1]]
            columns = []
            for f in dict.fromkeys(f for f, _ in places):
                rows = np.sort(np.concatenate([rows_of[f][c] for g, c in places if g == f]))
                columns.append((np.full(len(rows), f), rows, self.files[f].entries.t_ns[rows]))
            topic = Topic(name, msgtype, encoding, first.definition, *(np.concatenate(c) for c in zip(*columns)))
            other = topics.get(name)
            if other is not None:
                topic, left = (topic, other) if len(topic) > len(other) else (other, topic)
                self.notes.append(f"{name}: has two types; {len(left)} messages of {left.msgtype} are left out")
            topics[name] = topic
        return topics


def open_container(path: Path, compression: str = "") -> ChunkedFile | SqliteBag:
    """Open one file of a recording by its magic bytes; `LogError` for anything else."""
    with open_regular(path) as stream:
        head = stream.read(16)
    if not head:
        raise LogError(f"{path}: is empty; expected a ROS bag or an MCAP file")
    if head.startswith(b"#ROSBAG"):
        return Rosbag1(path)
    if head.startswith(MAGIC):
        return Mcap(path)
    if head == SQLITE_MAGIC:
        return SqliteBag(path, compression)
    raise LogError(f"{path}: neither a ROS 1 bag nor MCAP nor an SQLite database by its first bytes")


def stamp_of(head: bytes, encoding: str) -> int:
    """Stamp in ns of a message that begins with a header."""
    seconds, nanoseconds = struct.unpack(_order(head, encoding) + "iI", head[STAMP])
    return int(seconds) * 1_000_000_000 + int(nanoseconds)


def _order(head: bytes, encoding: str) -> str:
    """Byte order: little-endian in ROS 1, in CDR by the second byte."""
    return "<" if encoding == "ros1" or head[1] & 1 else ">"
