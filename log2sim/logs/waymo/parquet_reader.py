"""Reader of version 2 of the Waymo Open Dataset: parquet components, a folder for each; needs the extra "parquet" (pyarrow).

What the components hold is what the frames of version 1 hold. Opening reads poses, stamps and calibration; pictures and range
images are read row by row.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import RecordError
from log2sim.input_files import is_present
from log2sim.links import require_links_inside
from log2sim.logs.arrow.parquet_rows import Row
from log2sim.logs.arrow.tables import read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.digest import digest_of
from log2sim.logs.waymo import components
from log2sim.logs.waymo.assembly import log_of
from log2sim.logs.waymo.components import IMAGE, LASER, LIDAR_RETURNS, PIXEL_POSES, STAMP
from log2sim.logs.waymo.range_images import checked, shaped
from log2sim.logs.waymo.segment import CAMERAS, LASERS, FrameRow, RangeImages, Segment
from log2sim.logs.waymo.sensor_rows import RecordColumns, SensorRows, cell, where
from log2sim.logs.waymo.wire import WireError

POSES = "vehicle_pose"
STATISTICS = ("time_of_day", "location", "weather")


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
        require_links_inside(path)
        return _SegmentFolder(path, sequence).log()


READER = WaymoParquetReader()


class _SegmentFolder:
    def __init__(self, root: Path, name: str) -> None:
        self.root, self.name = root, name
        self.stamps_us, self.poses, self.notes = components.read_poses(self._file(POSES))
        self.frame_of = {t: k for k, t in enumerate(self.stamps_us)}
        of_lidars: dict[str, Kind] = {STAMP: "int", LASER: "text"}
        second = [f"{LIDAR_RETURNS[1]}.{part}" for part in ("values", "shape")]
        ranges = RecordColumns(_matrices(*LIDAR_RETURNS), second)
        self.sweeps = self._rows("lidar", of_lidars, LASERS, ranges)
        self.pixel_poses = self._rows("lidar_pose", of_lidars, LASERS, RecordColumns(_matrices(PIXEL_POSES)))
        jpeg = RecordColumns({f"{IMAGE}.image": "bytes"})
        self.images = self._rows("camera_image", components.IMAGE_COLUMNS, CAMERAS, jpeg)

    def log(self) -> Log:
        boxes = self._path_of(components.LIDAR_BOXES[0])
        projected, drawn = (self._path_of(c[0]) for c in (components.PROJECTED_BOXES, components.CAMERA_BOXES))
        # Boxes projected from 3D labels go before boxes drawn in the images.
        kind, in_images = (components.PROJECTED_BOXES if projected else components.CAMERA_BOXES), projected or drawn
        segment = Segment(
            name=self.name,
            path=self.root,
            cameras=components.read_camera_calibration(self._file("camera_calibration")) if self.images.rows else {},
            lasers=components.read_laser_calibration(self._file("lidar_calibration")) if self.sweeps.rows else {},
            frames=self._frames(),
            image=self._image,
            ranges=self._ranges,
            boxes=partial(components.read_boxes, boxes, components.LIDAR_BOXES[1], self.frame_of) if boxes else None,
            image_boxes=partial(components.read_image_boxes, in_images, kind[1], self.frame_of) if in_images else None,
            image_boxes_are_projected=projected is not None,
            pixel_poses_are_missing=not self.pixel_poses.rows,
            where=lambda frame: f"{self.root}: segment {self.name}, frame {self.stamps_us[frame]}",
            details={**self._statistics(), "frames": len(self.poses)},
            notes=self.notes,
        )
        return log_of(segment, READER.name, self._digest())

    def _frames(self) -> list[FrameRow]:
        """Return the frames in the order of the poses."""
        times = {key: components.image_times(self.images.columns, row) for key, row in self.images.rows.items()}
        count = len(self.poses)
        rows = zip(self.stamps_us, self.poses, self.images.by_frame(count), self.sweeps.by_frame(count))
        return [
            FrameRow(stamp * 1000, pose, {number: times[k, number] for number in cameras}, tuple(lidars))
            for k, (stamp, pose, cameras, lidars) in enumerate(rows)
        ]

    def _digest(self) -> str:
        files = sorted(self.root.glob(f"*/{self.name}.parquet"))
        sizes = [f"{file.parent.name} {file.stat().st_size}" for file in files]
        return digest_of([self.name, repr(self.stamps_us), np.stack(self.poses).tobytes().hex(), *sizes], [])

    def _file(self, component: str) -> Path:
        return components.component_file(self.root, component, self.name)

    def _path_of(self, component: str) -> Path | None:
        """Path of a component; None where it was not downloaded."""
        path = self._file(component)
        return path if is_present(path) else None

    def _rows(self, component: str, index: Any, names: dict[int, str], records: RecordColumns) -> SensorRows:
        rows = SensorRows(self._file(component), index, names, self.frame_of, records)
        self.notes += [rows.note] if rows.note else []
        return rows

    def _image(self, frame: int, camera: int) -> bytes:
        return bytes(cell(self.images.read(frame, camera), f"{IMAGE}.image") or b"")

    def _ranges(self, frame: int, laser: int) -> RangeImages:
        row, of_pixels = self.sweeps.read(frame, laser), self.pixel_poses.read(frame, laser)
        try:
            returns = [image for name in LIDAR_RETURNS if (image := _image_of(row, name)) is not None]
            return checked(returns, _image_of(of_pixels, PIXEL_POSES))
        except WireError as error:
            raise RecordError(f"{where(self.sweeps, frame, laser)}: {error}") from None

    def _statistics(self) -> dict[str, str]:
        path = self._path_of("stats")
        if path is None:
            return {}
        names: dict[str, Kind] = {f"[StatsComponent].{word}": "text" for word in STATISTICS}
        columns = read_columns(path, names, optional=tuple(names))
        return {name.rpartition(".")[2]: str(values[0]) for name, values in columns.items() if len(values)}


def _matrices(*names: str) -> dict[str, Kind]:
    """Columns of matrices, each with its values and its shape."""
    return {f"{name}.{part}": kind for name in names for part, kind in _PARTS.items()}


_PARTS: dict[str, Kind] = {"values": "floats", "shape": "ints"}


def _image_of(row: Row | None, name: str) -> NDArray[np.float32] | None:
    """Range image (H, W, C) of a row; None where it has none."""
    values, shape = cell(row, f"{name}.values"), cell(row, f"{name}.shape")
    if values is None or shape is None or not len(np.atleast_1d(values)):
        return None
    return shaped(np.asarray(values), [int(n) for n in np.atleast_1d(shape)])
