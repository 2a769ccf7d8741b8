"""Messages of version 1: the fields of `Frame` that log2sim needs, by dataset.proto and label.proto."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from log2sim.geometry import Array
from log2sim.logs.waymo.segment import MAX_BEAMS, CameraCalibration, ImageTimes, LaserCalibration, are_usable, rigid
from log2sim.logs.waymo.tfrecord import RecordWindow
from log2sim.logs.waymo.wire import BYTES, VARINT, Field, WireError, doubles, doubles_by_number, fields, fields_of, text

# Calibration, poses and labels; a larger field of these is none of the data set's.
MAX_INDEX_BYTES = 16 * 1024 * 1024

Span = tuple[int, int]


@dataclass(eq=False)
class FrameIndex:
    """Offsets and small fields of one Frame; offsets count from the start of the record's data.

    Attributes
    ----------
    context : Span
    stamp_us : int or None
    pose : (4, 4) float64 or None
    images : dict of camera number to (ImageTimes, Span of the JPEG)
    lasers : dict of LiDAR number to Span of its message
        Only those with a range image.
    labels, camera_labels, projected_labels : list of Span
    no_label_zones : int
    """

    context: Span = (0, 0)
    stamp_us: int | None = None
    pose: Array | None = None
    images: dict[int, tuple[ImageTimes, Span]] = field(default_factory=dict)
    lasers: dict[int, Span] = field(default_factory=dict)
    labels: list[Span] = field(default_factory=list)
    camera_labels: list[Span] = field(default_factory=list)
    projected_labels: list[Span] = field(default_factory=list)
    no_label_zones: int = 0


def read_index(window: RecordWindow) -> FrameIndex:
    """Read offsets and small fields of a Frame; neither images nor range images.

    Raises
    ------
    WireError
        When the record is no Frame.
    """
    index = FrameIndex()
    for f in fields(window, 0, window.size):
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
            _add_image(window, span, index)
        elif f.number == 5:
            _add_laser(window, span, index)
        elif f.number == 6:
            index.labels.append(span)
        elif f.number == 7:
            index.no_label_zones += 1
        elif f.number == 8:
            index.camera_labels.append(span)
        elif f.number == 9:
            index.projected_labels.append(span)
    return index


def _add_image(window: RecordWindow, span: Span, index: FrameIndex) -> None:
    number, jpeg, pose, times = 0, (0, 0), None, {5: 0.0, 6: 0.0, 7: 0.0, 8: 0.0}
    for f in fields(window, *span):
        if f.number == 1:
            number = f.value
        elif f.number == 2:
            jpeg = f.begin, f.end
        elif f.number == 3 and f.kind == BYTES:
            pose = _transform(take_index(window, (f.begin, f.end)))
        elif f.number in times:
            times[f.number] = f.real()
    if jpeg[1] > jpeg[0]:
        index.images[number] = ImageTimes(pose, *times.values()), jpeg


def _add_laser(window: RecordWindow, span: Span, index: FrameIndex) -> None:
    number, filled = 0, False
    for f in fields(window, *span):
        if f.number == 1:
            number = f.value
        elif f.number in (2, 3):
            filled |= f.end > f.begin
    if filled:
        index.lasers[number] = span


def segment_name(window: RecordWindow, span: Span) -> str:
    """Return the name of the segment from the span of a Context."""
    for f in fields(window, *span):
        if f.number == 1 and f.kind == BYTES:
            value = take_index(window, (f.begin, f.end))
            return text(value, f._replace(begin=0, end=len(value)))
    return ""


def read_calibration(
    context: bytes,
) -> tuple[dict[int, CameraCalibration], dict[int, LaserCalibration], dict[str, str]]:
    """Read cameras, LiDARs and statistics (time of day, location, weather) of a Context.

    Raises
    ------
    WireError
        For a calibration that is incomplete; names it.
    """
    cameras, lasers, stats = {}, {}, {}
    for f in fields_of(context):
        if f.kind != BYTES:
            continue
        data = context[f.begin : f.end]
        if f.number == 2:
            number, camera = _camera(data)
            cameras[number] = camera
        elif f.number == 3:
            number, laser = _laser(data)
            lasers[number] = laser
        elif f.number == 4:
            names = {2: "time_of_day", 3: "location", 4: "weather"}
            stats = {names[s.number]: text(data, s) for s in fields_of(data) if s.number in names}
    return cameras, lasers, stats


def _camera(data: bytes) -> tuple[int, CameraCalibration]:
    found = _by_number(data)
    number = _whole(found, 1)
    intrinsic = doubles(data, found.get(2, []))
    extrinsic = _submessage(data, found, 3)
    pose = None if extrinsic is None else _transform(extrinsic)
    width, height = _whole(found, 4), _whole(found, 5)
    if pose is None or not are_usable(intrinsic, width, height):
        raise WireError(
            f"calibration of camera {number}: expected 9 finite intrinsics, a rigid extrinsic, width and height"
        )
    return number, CameraCalibration(intrinsic, pose, width, height, _whole(found, 6))


def _laser(data: bytes) -> tuple[int, LaserCalibration]:
    found = _by_number(data)
    number = _whole(found, 1)
    beams = doubles(data, found.get(2, []))
    limits = tuple(found[k][-1].real() if k in found else 0.0 for k in (3, 4))
    extrinsic = _submessage(data, found, 5)
    pose = None if extrinsic is None else _transform(extrinsic)
    if pose is None or len(beams) > MAX_BEAMS or not np.isfinite([*beams, *limits]).all():
        raise WireError(f"calibration of LiDAR {number}: expected a rigid extrinsic and finite inclinations")
    return number, LaserCalibration(pose, beams, (limits[0], limits[1]))


def read_box(data: bytes, dimensions: int) -> tuple[str, int, list[float]] | None:
    """Read id, type and box (center, size as length, width[, height], heading) of a Label; None when it has no box.

    Parameters
    ----------
    data : bytes
    dimensions : int
        3, or 2 for a box in an image.
    """
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
