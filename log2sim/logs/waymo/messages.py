"""Files and messages of version 1: TFRecord, the wire format, and the fields of `Frame` that log2sim needs.

A TFRecord file holds records: the length (uint64, little-endian), the masked CRC-32C of these 8 bytes, the data and their masked
CRC-32C (https://www.tensorflow.org/tutorials/load_data/tfrecord).

A field is a key (number << 3 | type, a varint) and its value: a varint, 8 or 4 bytes, or a length and that many bytes
(https://protobuf.dev/programming-guides/encoding).
"""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from io import SEEK_END
from pathlib import Path
from threading import Lock
from typing import Any, BinaryIO, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError, RecordError
from log2sim.files.inputs import open_regular
from log2sim.geometry import Array
from log2sim.logs.waymo.segment import MAX_BEAMS, CameraCalibration, ImageTimes, LaserCalibration, rigid

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

    @contextmanager
    def window(self, k: int) -> Iterator[RecordWindow]:
        """Open record `k` to read parts of it, without its CRC."""
        with open_regular(self.path, buffering=0) as file:
            yield RecordWindow(file, *self.spans[k])

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

    def __init__(self, file: BinaryIO, begin: int, size: int) -> None:
        self._file, self._begin, self.size = file, begin, size
        self._block, self._block_begin = b"", 0

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


VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5
MAX_VARINT_BYTES = 10
# A frame with a map has some thousand fields.
MAX_FIELDS = 200_000
MAX_PLAIN_DOUBLES = 64
# Of names and ids, which have some twenty; tables make room for the longest of a column in every row.
MAX_TEXT_BYTES = 1024


class WireError(ValueError):
    """Bytes that are no protocol buffer of the expected form."""


class Field(NamedTuple):
    """A field of a message."""

    number: int
    kind: int  # VARINT, FIXED64, BYTES or FIXED32
    value: int  # of a varint, or the bits of a fixed one; 0 for bytes
    begin: int  # offsets of the value
    end: int  # offsets of the value

    def real(self) -> float:
        """Return the value of a field of 8 or 4 bytes as a floating-point number."""
        if self.kind == FIXED64:
            return float(struct.unpack("<d", struct.pack("<Q", self.value))[0])
        if self.kind == FIXED32:
            return float(struct.unpack("<f", struct.pack("<I", self.value))[0])
        raise WireError(f"field {self.number} is of wire type {self.kind}, expected a floating-point number")


def fields(peek: Callable[[int, int], bytes], begin: int, end: int) -> Iterator[Field]:
    """Walk the fields of the message in a span; `peek` gives up to so many bytes at an offset, values of type BYTES are skipped.

    Raises `WireError` when a field leaves the span or is of an unknown wire type, or there are more than `MAX_FIELDS`.
    """
    count = 0
    while begin < end:
        head = peek(begin, min(2 * MAX_VARINT_BYTES, end - begin))
        key, used = _varint(head, 0)
        number, kind, value, size = key >> 3, key & 7, 0, 0
        if kind == VARINT:
            value, used = _varint(head, used)
        elif kind == BYTES:
            size, used = _varint(head, used)
        elif kind in (FIXED64, FIXED32):
            size = 8 if kind == FIXED64 else 4
            value = int.from_bytes(head[used : used + size], "little")
        else:
            raise WireError(f"field {number} is of wire type {kind}")
        stop = begin + used + size
        if stop > end:
            raise WireError(f"field {number} ends {stop - end} bytes beyond its message")
        count += 1
        if count > MAX_FIELDS:
            raise WireError("too many fields")
        yield Field(number, kind, value, begin + used, stop)
        begin = stop


def fields_of(data: bytes) -> Iterator[Field]:
    """Walk the fields of a message in memory."""
    return fields(lambda begin, count: data[begin : begin + count], 0, len(data))


def doubles_by_number(data: bytes) -> list[tuple[int, float]]:
    """Return number and value of each floating-point field of a message, in their order.

    A message of nothing but doubles with numbers below 16, as boxes and transforms are, has a key of one byte every 9 bytes.
    Labels are nearly all such messages, and this reads them in a tenth of the time.
    """
    count, rest = divmod(len(data), 9)
    if rest or count > MAX_PLAIN_DOUBLES or any(key & 0x87 != FIXED64 for key in data[::9]):
        return [(f.number, f.real()) for f in fields_of(data) if f.kind in (FIXED64, FIXED32)]
    cells = struct.unpack(f"<{count * 'Bd'}", data)
    return [(key >> 3, value) for key, value in zip(cells[::2], cells[1::2])]


def doubles(data: bytes, found: list[Field]) -> Array:
    """Return the numbers (n,) of a repeated double, packed or one field each; `data` is what their offsets refer to."""
    parts = []
    for entry in found:
        if entry.kind == BYTES and (entry.end - entry.begin) % 8:
            raise WireError(f"field {entry.number} has {entry.end - entry.begin} bytes, expected doubles of 8")
        packed = entry.kind == BYTES
        parts.append(np.frombuffer(data[entry.begin : entry.end], "<f8") if packed else np.array([entry.real()]))
    return np.concatenate(parts) if parts else np.zeros(0)


def varints(data: bytes) -> list[int]:
    """Return the numbers of a packed field of varints."""
    out, at = [], 0
    while at < len(data):
        value, at = _varint(data, at)
        out.append(value)
    return out


def text(data: bytes, field: Field) -> str:
    """Return the value of a string field as printable characters; `WireError` when it is too long for a name."""
    size = field.end - field.begin
    if size > MAX_TEXT_BYTES:
        raise WireError(f"field {field.number} is a text of {size} bytes, expected at most {MAX_TEXT_BYTES}")
    words = data[field.begin : field.end].decode("utf-8", errors="replace")
    return "".join(c if c.isprintable() else "?" for c in words)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """Value of the varint at an offset, and the offset behind it."""
    value = shift = 0
    while at < len(data) and shift < 7 * MAX_VARINT_BYTES:
        byte = data[at]
        at += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, at
        shift += 7
    raise WireError("a varint does not end")


# Calibration, poses and labels; a larger field of these is none of the data set's.
MAX_INDEX_BYTES = 16 * 1024 * 1024

Span = tuple[int, int]


@dataclass(eq=False)
class FrameIndex:
    """Offsets and small fields of one Frame; offsets count from the start of the record's data."""

    context: Span = (0, 0)
    stamp_us: int | None = None
    pose: Array | None = None  # (4, 4)
    images: dict[int, tuple[ImageTimes, Span]] = field(default_factory=dict)  # by camera, with the span of the JPEG
    lasers: dict[int, Span] = field(default_factory=dict)  # only those with a range image
    labels: list[Span] = field(default_factory=list)
    camera_labels: list[Span] = field(default_factory=list)
    projected_labels: list[Span] = field(default_factory=list)
    no_label_zones: int = 0


def read_index(window: RecordWindow) -> FrameIndex:
    """Read offsets and small fields of a Frame; neither images nor range images. `WireError` when the record is none."""
    index = FrameIndex()
    spans = {6: index.labels, 8: index.camera_labels, 9: index.projected_labels}
    for f in fields(window.peek, 0, window.size):
        if f.kind == VARINT and f.number == 2:
            index.stamp_us = f.value
        if f.kind != BYTES:
            continue
        span = f.begin, f.end
        if f.number == 1:
            index.context = span
        elif f.number == 3:
            index.pose = _transform(take_index(window, span))
        elif f.number == 4:
            number, jpeg, pose, times = 0, (0, 0), None, {5: 0.0, 6: 0.0, 7: 0.0, 8: 0.0}
            for g in fields(window.peek, *span):
                if g.number == 1:
                    number = g.value
                elif g.number == 2:
                    jpeg = g.begin, g.end
                elif g.number == 3 and g.kind == BYTES:
                    pose = _transform(take_index(window, (g.begin, g.end)))
                elif g.number in times:
                    times[g.number] = g.real()
            if jpeg[1] > jpeg[0]:
                index.images[number] = ImageTimes(pose, *times.values()), jpeg
        elif f.number == 5:
            parts = list(fields(window.peek, *span))
            if any(g.number in (2, 3) and g.end > g.begin for g in parts):
                index.lasers[next((g.value for g in reversed(parts) if g.number == 1), 0)] = span
        elif f.number in spans:
            spans[f.number].append(span)
        elif f.number == 7:
            index.no_label_zones += 1
    return index


def segment_name(window: RecordWindow, span: Span) -> str:
    """Return the name of the segment from the span of a Context."""
    for f in fields(window.peek, *span):
        if f.number == 1 and f.kind == BYTES:
            value = take_index(window, (f.begin, f.end))
            return text(value, f._replace(begin=0, end=len(value)))
    return ""


def read_calibration(
    context: bytes,
) -> tuple[dict[int, CameraCalibration], dict[int, LaserCalibration], dict[str, str]]:
    """Read cameras, LiDARs and statistics (time of day, location, weather) of a Context; `WireError` names what is incomplete."""
    cameras, lasers, stats = dict[int, CameraCalibration](), dict[int, LaserCalibration](), dict[str, str]()
    for f in fields_of(context):
        if f.kind != BYTES:
            continue
        data = context[f.begin : f.end]
        if f.number == 4:
            names = {2: "time_of_day", 3: "location", 4: "weather"}
            stats = {names[s.number]: text(data, s) for s in fields_of(data) if s.number in names}
        if f.number not in (2, 3):
            continue
        found = _by_number(data)
        number, numbers = _whole(found, 1), doubles(data, found.get(2, []))
        extrinsic = _submessage(data, found, 3 if f.number == 2 else 5)
        pose = None if extrinsic is None else _transform(extrinsic)
        if f.number == 2:
            sizes = (_whole(found, key) for key in (4, 5, 6))
            camera = None if pose is None else CameraCalibration(numbers, pose, *sizes)
            if camera is None or not camera.is_usable:
                expected = "expected 9 finite intrinsics, a rigid extrinsic, width and height"
                raise WireError(f"calibration of camera {number}: {expected}")
            cameras[number] = camera
        else:
            low, high = (found[k][-1].real() if k in found else 0.0 for k in (3, 4))
            if pose is None or len(numbers) > MAX_BEAMS or not np.isfinite([*numbers, low, high]).all():
                raise WireError(f"calibration of LiDAR {number}: expected a rigid extrinsic and finite inclinations")
            lasers[number] = LaserCalibration(pose, numbers, (low, high))
    return cameras, lasers, stats


def read_box(data: bytes, dimensions: int) -> tuple[str, int, list[float]] | None:
    """Read id, type and box (center, size as length, width[, height], heading) of a Label; None when it has no box."""
    found = _by_number(data)
    box = _submessage(data, found, 1)
    if box is None:
        return None
    values = dict(doubles_by_number(box))
    # Label.Box holds the width, 4, before the length, 5.
    order = (1, 2, 3, 5, 4, 6, 7) if dimensions == 3 else (1, 2, 5, 4, 7)
    track_id = text(data, found[4][-1]) if 4 in found else ""
    return track_id, _whole(found, 3), [values.get(k, 0.0) for k in order]


def read_camera_labels(data: bytes) -> tuple[int, list[tuple[str, int, list[float]]]]:
    """Read the camera's number and the labels of a CameraLabels message."""
    number, boxes = 0, []
    for f in fields_of(data):
        if f.number == 1:
            number = f.value
        elif f.number == 2 and f.kind == BYTES:
            box = read_box(data[f.begin : f.end], 2)
            if box is not None:
                boxes.append(box)
    return number, boxes


def range_image_parts(laser: bytes) -> Iterator[tuple[int, bytes, bytes]]:
    """Yield number of the return, compressed range image and compressed poses (empty where there are none) of a Laser."""
    for f in fields_of(laser):
        if f.number in (2, 3) and f.kind == BYTES:
            parts = {g.number: laser[f.begin + g.begin : f.begin + g.end] for g in fields_of(laser[f.begin : f.end])}
            yield f.number - 1, parts.get(2, b""), parts.get(4, b"")


def take_index(window: RecordWindow, span: Span) -> bytes:
    """Return the bytes of a span of calibration, poses or labels; `WireError` when it is larger than those are."""
    if span[1] - span[0] > MAX_INDEX_BYTES:
        raise WireError(f"a field of {span[1] - span[0]} bytes where at most {MAX_INDEX_BYTES} are expected")
    return window.take(*span)


def _by_number(data: bytes) -> dict[int, list[Field]]:
    out: dict[int, list[Field]] = {}
    for f in fields_of(data):
        out.setdefault(f.number, []).append(f)
    return out


def _whole(found: dict[int, list[Field]], number: int) -> int:
    return found[number][-1].value if number in found else 0


def _submessage(data: bytes, found: dict[int, list[Field]], number: int) -> bytes | None:
    f = found[number][-1] if number in found else None
    return data[f.begin : f.end] if f is not None and f.kind == BYTES else None


def _transform(data: bytes) -> Any:
    """Return the pose (4, 4) of a Transform; None when it is none."""
    plain = [value for number, value in doubles_by_number(data) if number == 1]
    return rigid(np.array(plain) if plain else doubles(data, [f for f in fields_of(data) if f.number == 1]))
