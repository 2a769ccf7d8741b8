"""Reader of version 1 of the Waymo Open Dataset: TFRecords of `Frame` messages, one file a segment.

Opening reads the lengths of the records and, of each frame, poses, stamps and the offsets of everything else; pictures, range
images and labels are skipped. The format is that of dataset.proto and label.proto (github.com/waymo-research/waymo-open-dataset).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from log2sim.datatypes import Log
from log2sim.errors import LogError, RecordError
from log2sim.links import require_link_inside
from log2sim.logs.digest import digest_of
from log2sim.logs.stamps import MAX_TIME_S
from log2sim.logs.waymo.assembly import log_of
from log2sim.logs.waymo.messages import (
    FrameIndex,
    Span,
    read_box,
    read_calibration,
    read_camera_labels,
    read_index,
    segment_name,
    take_index,
)
from log2sim.logs.waymo.range_images import read_range_images
from log2sim.logs.waymo.segment import (
    CAMERAS,
    BoxTable,
    CameraCalibration,
    FrameRow,
    LaserCalibration,
    RangeImages,
    Segment,
)
from log2sim.logs.waymo.tfrecord import RecordFile, starts_like_tfrecord
from log2sim.logs.waymo.wire import WireError

SUFFIX = ".tfrecord"

# Frame, id, type and numbers of a box.
LabelRow = tuple[int, str, int, list[float]]
Calibration = tuple[dict[int, CameraCalibration], dict[int, LaserCalibration], dict[str, str]]


class WaymoReader:
    """Reader of segments of version 1; the root is a file or a folder of files."""

    name = "waymo"
    looks_for = "a .tfrecord file of the Waymo Open Dataset (perception, version 1), or a folder of such files"
    suffixes = (SUFFIX,)

    def matches(self, path: Path) -> bool:
        """Return whether the file is a TFRecord file, or the folder holds some."""
        return any(_may_be_segment(file, path) for file in _files(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the files without their suffix, sorted."""
        return [file.name.removesuffix(SUFFIX) for file in _files(path)]

    def open(self, path: Path, sequence: str) -> Log:
        """Open a segment; no picture, range image or label is read."""
        if path.is_file():
            return _SegmentFile(path).log()
        require_link_inside(path / f"{sequence}{SUFFIX}", path)
        return _SegmentFile(path / f"{sequence}{SUFFIX}").log()


READER = WaymoReader()


def _files(path: Path) -> list[Path]:
    try:
        return [path] if path.is_file() else sorted(file for file in path.glob(f"*{SUFFIX}") if file.is_file())
    except OSError:
        return []


def _may_be_segment(file: Path, root: Path) -> bool:
    """Whether a file is a TFRecord file; also where it is a link that must not be read, which opening it reports."""
    try:
        require_link_inside(file, root if root.is_dir() else file)
    except LogError:
        return True
    return starts_like_tfrecord(file)


@dataclass(eq=False)
class _Frames:
    """Usable frames of a file: number of the record and index of each, why others are not, and what all share."""

    record: list[int] = field(default_factory=list)
    index: list[FrameIndex] = field(default_factory=list)
    left_out: list[str] = field(default_factory=list)
    context: bytes = b""
    name: str = ""
    calibration: Calibration = field(default_factory=lambda: ({}, {}, {}))


class _SegmentFile:
    def __init__(self, path: Path) -> None:
        self.path, self.file = path, RecordFile(path)

    def log(self) -> Log:
        self.frames = frames = self._read_frames()
        notes = [*self.file.notes]
        if frames.left_out:
            notes.append(f"{len(frames.left_out)} of {len(self.file.spans)} records left out; {frames.left_out[0]}")
        if not frames.index:
            raise LogError(f"{self.path}: no usable frame; {'; '.join(notes) or 'the file is empty'}")
        index, (cameras, lasers, stats) = frames.index, frames.calibration
        self.projected = any(f.projected_labels for f in index)
        self.boxes_by_camera: dict[int, list[LabelRow]] | None = None
        zones = sum(f.no_label_zones > 0 for f in index)
        if zones:
            notes.append(f"{zones} of {len(index)} frames have zones in which objects are not labeled")
        segment = Segment(
            name=frames.name,
            path=self.path,
            cameras=cameras,
            lasers=lasers,
            frames=[_row(f) for f in index],
            image=self._image,
            ranges=self._ranges,
            boxes=self._boxes if any(f.labels for f in index) else None,
            image_boxes=self._image_boxes if any(f.projected_labels or f.camera_labels for f in index) else None,
            image_boxes_are_projected=self.projected,
            where=self._where,
            details={**stats, "frames": len(index)},
            notes=notes,
        )
        records = [f"{f.stamp_us} {self.file.spans[k][1]}" for k, f in zip(frames.record, index)]
        return log_of(segment, READER.name, digest_of([frames.name, frames.context.hex(), *records], []))

    def _read_frames(self) -> _Frames:
        """Read the index of every frame of the segment to which the first one belongs."""
        out = _Frames()
        for k in range(len(self.file.spans)):
            try:
                with self.file.window(k) as window:
                    index = read_index(window)
                    name = segment_name(window, index.context)
                    if not out.index:
                        out.context, out.name = take_index(window, index.context), name
                        out.calibration = read_calibration(out.context)
            except (WireError, OSError) as error:
                out.left_out.append(f"record {k}: not a readable frame: {error}")
                continue
            problem = _problem(index, name, out.name)
            if problem:
                out.left_out.append(f"record {k}: {problem}")
                continue
            out.record.append(k)
            out.index.append(index)
        return out

    def _where(self, frame: int) -> str:
        return f"{self.path}: record {self.frames.record[frame]}"

    def _data(self, frame: int) -> bytes:
        stamp = self.frames.index[frame].stamp_us
        return self.file.read(self.frames.record[frame], f"record {self.frames.record[frame]}, stamp {stamp} us")

    def _image(self, frame: int, camera: int) -> bytes:
        _, (begin, end) = self.frames.index[frame].images[camera]
        return self._data(frame)[begin:end]

    def _ranges(self, frame: int, laser: int) -> RangeImages:
        begin, end = self.frames.index[frame].lasers[laser]
        data = self._data(frame)[begin:end]
        try:
            return read_range_images(data)
        except WireError as error:
            raise RecordError(f"{self._where(frame)}, LiDAR {laser}: {error}") from None

    def _boxes(self) -> BoxTable:
        rows, lost = list[LabelRow](), 0
        for frame, data in self._messages(lambda index: index.labels):
            try:
                if data is None:
                    raise WireError("too large")
                box = read_box(data, 3)
            except WireError:
                lost += 1
                continue
            rows += [] if box is None else [(frame, *box)]
        return BoxTable.of(rows, 3, lost)

    def _image_boxes(self, camera: int) -> BoxTable:
        if self.boxes_by_camera is None:
            self.boxes_by_camera, self.lost_boxes = self._boxes_of_cameras()
        # To which camera a message belonged that cannot be read is not known: all of them report the first one.
        lost, self.lost_boxes = self.lost_boxes, 0
        return BoxTable.of(self.boxes_by_camera.get(camera, []), 2, lost)

    def _boxes_of_cameras(self) -> tuple[dict[int, list[LabelRow]], int]:
        """Read the labels of all images, by camera, and count the messages that cannot be read."""
        out: dict[int, list[LabelRow]] = {}
        lost = 0
        spans = (lambda index: index.projected_labels) if self.projected else (lambda index: index.camera_labels)
        for frame, data in self._messages(spans):
            try:
                if data is None:
                    raise WireError("too large")
                number, boxes = read_camera_labels(data)
            except WireError:
                lost += 1
                continue
            out.setdefault(number, []).extend((frame, *box) for box in boxes)
        return out, lost

    def _messages(self, spans: Callable[[FrameIndex], list[Span]]) -> Iterator[tuple[int, bytes | None]]:
        """Yield frame and bytes of messages of all frames; None for those that are too large."""
        for k, (record, index) in enumerate(zip(self.frames.record, self.frames.index)):
            with self.file.window(record) as window:
                for span in spans(index):
                    try:
                        data = take_index(window, span)
                    except WireError:
                        yield k, None
                        continue
                    yield k, data


def _row(index: FrameIndex) -> FrameRow:
    # `_problem` keeps others out.
    assert index.stamp_us is not None
    assert index.pose is not None
    images = {number: times for number, (times, _) in index.images.items() if number in CAMERAS}
    return FrameRow(index.stamp_us * 1000, index.pose, images, tuple(index.lasers))


def _problem(index: FrameIndex, name: str, expected: str) -> str:
    """Why a frame cannot be used; empty when it can."""
    if index.stamp_us is None or not 0 < index.stamp_us < MAX_TIME_S * 10**6:
        return f"timestamp_micros is {index.stamp_us}, expected microseconds since 1970"
    if index.pose is None:
        return "no rigid pose"
    if name != expected:
        return f"of segment '{name}', the file's first frame is of '{expected}'; expected one segment a file"
    return ""
