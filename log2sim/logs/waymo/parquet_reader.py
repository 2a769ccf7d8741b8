"""Reader of version 2 of the Waymo Open Dataset: parquet components, a folder for each; needs the extra "parquet" (pyarrow).

What the components hold is what the frames of version 1 hold. Opening reads poses, stamps and calibration; pictures and range
images are read row by row.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import RecordError
from log2sim.logs.arrow_tables import read_columns
from log2sim.logs.arrow_values import Kind
from log2sim.logs.digest import digest_of
from log2sim.logs.parquet_rows import ParquetRows
from log2sim.logs.waymo import components
from log2sim.logs.waymo.assembly import log_of
from log2sim.logs.waymo.components import CAMERA, LASER, STAMP, component_file
from log2sim.logs.waymo.range_images import checked, shaped
from log2sim.logs.waymo.segment import CAMERAS, LASERS, FrameRow, ImageTimes, RangeImages, Segment
from log2sim.logs.waymo.wire import WireError

POSES = "vehicle_pose"
STATISTICS = ("time_of_day", "location", "weather")

# Index of the frame and number of the sensor, to the row of a component.
Rows = dict[tuple[int, int], int]


class WaymoParquetReader:
    """Reader of segments of version 2; the root holds a folder for each component."""

    name = "waymo-parquet"
    looks_for = "a folder with vehicle_pose/SEGMENT.parquet and further components of the Waymo Open Dataset, version 2"
    suffixes = ()

    def matches(self, path: Path) -> bool:
        """Return whether the folder holds vehicle poses of segments."""
        return bool(self.sequences(path))

    def sequences(self, path: Path) -> list[str]:
        """Return the names of the segments, sorted."""
        try:
            return sorted(file.stem for file in (path / POSES).glob("*.parquet") if file.is_file())
        except OSError:
            return []

    def open(self, path: Path, sequence: str) -> Log:
        """Open a segment; no picture, range image or label is read."""
        return _SegmentFolder(path, sequence).log()


READER = WaymoParquetReader()


@dataclass(eq=False)
class _SegmentFolder:
    root: Path
    name: str

    def log(self) -> Log:
        stamps_us, poses, self.notes = components.read_poses(self._file(POSES))
        self.frame_of = {int(t): k for k, t in enumerate(stamps_us)}
        images = self._images()
        self.sweeps, _ = self._rows("lidar", {STAMP: "int", LASER: "text"}, LASERS)
        self.pixel_poses, _ = self._rows("lidar_pose", {STAMP: "int", LASER: "text"}, LASERS)
        of_frame: list[dict[int, ImageTimes]] = [{} for _ in poses]
        for (frame, number), times in images.items():
            of_frame[frame][number] = times
        lasers: list[list[int]] = [[] for _ in poses]
        for frame, number in self.sweeps:
            lasers[frame].append(number)
        rows = zip(stamps_us, poses, of_frame, lasers)
        frames = [FrameRow(stamp * 1000, pose, taken, tuple(numbers)) for stamp, pose, taken, numbers in rows]
        self._open_records()
        boxes = self._labels_of(components.LIDAR_BOXES[0])
        projected, drawn = (self._labels_of(c[0]) for c in (components.PROJECTED_BOXES, components.CAMERA_BOXES))
        kind = components.PROJECTED_BOXES if projected else components.CAMERA_BOXES
        image_boxes = projected or drawn
        segment = Segment(
            name=self.name,
            cameras=components.read_camera_calibration(self._file("camera_calibration")) if images else {},
            lasers=components.read_laser_calibration(self._file("lidar_calibration")) if self.sweeps else {},
            frames=frames,
            image=self._image,
            ranges=self._ranges,
            boxes=partial(components.read_boxes, boxes, components.LIDAR_BOXES[1], self.frame_of) if boxes else None,
            image_boxes=partial(components.read_image_boxes, image_boxes, kind[1], self.frame_of)
            if image_boxes
            else None,
            image_boxes_are_projected=projected is not None,
            pixel_poses_are_missing=not self.pixel_poses,
            where=lambda frame: f"{self.root}: segment {self.name}, frame {stamps_us[frame]}",
            details={**self._statistics(), "frames": len(frames)},
            notes=self.notes,
        )
        sizes = [
            f"{file.parent.name} {file.stat().st_size}" for file in sorted(self.root.glob(f"*/{self.name}.parquet"))
        ]
        texts = [self.name, " ".join(map(str, stamps_us)), np.stack(poses).tobytes().hex(), *sizes]
        return log_of(segment, READER.name, digest_of(texts, []))

    def _file(self, component: str) -> Path:
        return component_file(self.root, component, self.name)

    def _rows(
        self, component: str, columns: Mapping[str, Kind], names: Mapping[int, str]
    ) -> tuple[Rows, components.Columns]:
        """Row of a component for each frame and sensor, and its columns; empty where the file is absent."""
        path = self._file(component)
        if not path.is_file():
            return {}, {}
        table = read_columns(path, columns)
        sensor = components.numbers_of(table[LASER if LASER in columns else CAMERA], names)
        frame = [self.frame_of.get(int(t), -1) for t in table[STAMP]]
        rows = {(k, int(number)): row for row, (k, number) in enumerate(zip(frame, sensor)) if k >= 0 and number}
        if len(rows) < len(frame):
            self.notes.append(
                f"{component}: {len(frame) - len(rows)} of {len(frame)} rows of no frame and sensor left out"
            )
        return rows, table

    def _images(self) -> dict[tuple[int, int], ImageTimes]:
        """Read when the image of each frame and camera was taken."""
        self.image_rows, columns = self._rows("camera_image", components.IMAGE_COLUMNS, CAMERAS)
        return {key: components.image_times(columns, row) for key, row in self.image_rows.items()}

    def _open_records(self) -> None:
        parts = [f"{name}.{part}" for name in components.LIDAR_RETURNS for part in ("values", "shape")]
        first = {name: kind_of(name) for name in parts}
        second = parts[2:]
        self.ranges_file = ParquetRows(self._file("lidar"), first, optional=second)
        pose_parts = {f"{components.PIXEL_POSES}.{part}": kind_of(part) for part in ("values", "shape")}
        self.pixel_poses_file = ParquetRows(self._file("lidar_pose"), pose_parts)
        self.images_file = ParquetRows(self._file("camera_image"), {f"{components.IMAGE}.image": "bytes"})

    def _image(self, frame: int, camera: int) -> bytes:
        data = self.images_file.read(self.image_rows[frame, camera])[f"{components.IMAGE}.image"]
        return bytes(data or b"")

    def _ranges(self, frame: int, laser: int) -> RangeImages:
        row = self.ranges_file.read(self.sweeps[frame, laser])
        pose_row = self.pixel_poses.get((frame, laser))
        try:
            returns = [image for name in components.LIDAR_RETURNS if (image := _image_of(row, name)) is not None]
            poses = None
            if pose_row is not None:
                poses = _image_of(self.pixel_poses_file.read(pose_row), components.PIXEL_POSES)
            return checked(returns, poses)
        except WireError as error:
            raise RecordError(f"{self._file('lidar')}, row {self.sweeps[frame, laser]}: {error}") from None

    def _labels_of(self, component: str) -> Path | None:
        path = self._file(component)
        return path if path.is_file() else None

    def _statistics(self) -> dict[str, str]:
        path = self._file("stats")
        if not path.is_file():
            return {}
        names: dict[str, Kind] = {f"[StatsComponent].{word}": "text" for word in STATISTICS}
        columns = read_columns(path, names, optional=tuple(names))
        return {name.rpartition(".")[2]: str(values[0]) for name, values in columns.items() if len(values)}


def kind_of(column: str) -> Kind:
    """Kind of a column of a range image: its values, or its shape."""
    return "ints" if column.endswith("shape") else "floats"


def _image_of(row: Mapping[str, Any], name: str) -> NDArray[np.float32] | None:
    """Range image (H, W, C) of a row; None where it has none."""
    values, shape = row.get(f"{name}.values"), row.get(f"{name}.shape")
    if values is None or shape is None or not len(np.atleast_1d(values)):
        return None
    return shaped(np.asarray(values), [int(n) for n in np.atleast_1d(shape)])
