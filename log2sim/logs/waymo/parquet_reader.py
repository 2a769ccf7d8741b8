"""Reader of version 2 of the Waymo Open Dataset: parquet components of segments.

Types differ between releases (cameras by number or by name, poses in single or double precision): what a column holds decides.

What the components hold is what the frames of version 1 hold. Opening reads poses, stamps and calibration; pictures and range
images are read row by row.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import LogError, RecordError
from log2sim.files.inputs import is_present, require_links_inside
from log2sim.geometry import Array
from log2sim.logs.arrow import Kind, ParquetRows, Row, read_columns
from log2sim.logs.excerpt import digest_of
from log2sim.logs.records import FolderReader
from log2sim.logs.stamps import MAX_TIME_S
from log2sim.logs.waymo import segment
from log2sim.logs.waymo.messages import WireError
from log2sim.logs.waymo.range_images import checked, shaped
from log2sim.logs.waymo.reader import Segment

Columns = dict[str, NDArray[Any]]

STAMP, CAMERA, LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
IMAGE = "[CameraImageComponent]"
IMAGE_COLUMNS: Mapping[str, Kind] = {
    STAMP: "int", CAMERA: "text", f"{IMAGE}.pose.transform": "floats", f"{IMAGE}.pose_timestamp": "float",
    f"{IMAGE}.rolling_shutter_params.shutter": "float",
    f"{IMAGE}.rolling_shutter_params.camera_trigger_time": "float",
    f"{IMAGE}.rolling_shutter_params.camera_readout_done_time": "float",
}  # fmt: skip
CAMERA_PREFIX = "[CameraCalibrationComponent]"
INTRINSICS = tuple(f"{CAMERA_PREFIX}.intrinsic.{k}" for k in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"))
LASER_PREFIX = "[LiDARCalibrationComponent]"
LIDAR_RETURNS = ("[LiDARComponent].range_image_return1", "[LiDARComponent].range_image_return2")
PIXEL_POSES = "[LiDARPoseComponent].range_image_return1"
# Component and prefix of its columns.
LIDAR_BOXES = ("lidar_box", "[LiDARBoxComponent]")
PROJECTED_BOXES = ("projected_lidar_box", "[ProjectedLiDARBoxComponent]")
CAMERA_BOXES = ("camera_box", "[CameraBoxComponent]")


def read_poses(path: Path) -> tuple[list[int], list[Array], list[str]]:
    """Read stamps in us and poses (4, 4) of the frames, and remarks on those that are none; `LogError` when no row has both."""
    columns = read_columns(path, {STAMP: "int", POSE: "floats"})
    found = [(int(t), matrix(cell)) for t, cell in zip(columns[STAMP], columns[POSE])]
    usable = [(t, pose) for t, pose in found if pose is not None and 0 < t < MAX_TIME_S * 10**6]
    if not usable:
        raise LogError(f"{path}: none of its {len(found)} rows is a rigid pose with a stamp in microseconds")
    lost = len(found) - len(usable)
    notes = [f"{lost} of {len(found)} frames without a rigid pose left out"] if lost else []
    return [t for t, _ in usable], [pose for _, pose in usable], notes


def read_camera_calibration(path: Path) -> dict[int, segment.CameraCalibration]:
    """Read the calibration of the cameras by number."""
    extrinsic = f"{CAMERA_PREFIX}.extrinsic.transform"
    whole = [f"{CAMERA_PREFIX}.{name}" for name in ("width", "height", "rolling_shutter_direction")]
    columns = read_columns(
        path, {CAMERA: "text", extrinsic: "floats", **dict.fromkeys(INTRINSICS, "float"), **dict.fromkeys(whole, "int")}
    )
    out = {}
    for row, number in enumerate(numbers_of(columns[CAMERA], segment.CAMERAS).tolist()):
        intrinsic = np.array([columns[name][row] for name in INTRINSICS], dtype=np.float64)
        pose, sizes = matrix(columns[extrinsic][row]), (int(columns[name][row]) for name in whole)
        camera = None if pose is None else segment.CameraCalibration(intrinsic, pose, *sizes)
        if camera is None or not camera.is_usable:
            expected = f"expected finite intrinsics, a rigid extrinsic, width and height of camera {number}"
            raise LogError(f"{path}, row {row}: {expected}")
        out[number] = camera
    return out


def read_laser_calibration(path: Path) -> dict[int, segment.LaserCalibration]:
    """Read the calibration of the LiDARs by number."""
    extrinsic, values = f"{LASER_PREFIX}.extrinsic.transform", f"{LASER_PREFIX}.beam_inclination.values"
    limits = [f"{LASER_PREFIX}.beam_inclination.{name}" for name in ("min", "max")]
    wanted: dict[str, Kind] = {LASER: "text", extrinsic: "floats", values: "floats", **dict.fromkeys(limits, "float")}
    columns = read_columns(path, wanted, optional=(values,))
    out = {}
    for row, number in enumerate(numbers_of(columns[LASER], segment.LASERS).tolist()):
        pose = matrix(columns[extrinsic][row])
        cell = columns[values][row] if values in columns else None
        beams = np.zeros(0) if cell is None else np.asarray(cell, dtype=np.float64)
        low, high = (float(columns[name][row]) for name in limits)
        known = np.isfinite(beams).all() if len(beams) else np.isfinite([low, high]).all()
        if pose is None or not known or len(beams) > segment.MAX_BEAMS:
            raise LogError(f"{path}, row {row}: expected a rigid extrinsic and finite inclinations of LiDAR {number}")
        out[number] = segment.LaserCalibration(pose, beams, (low, high))
    return out


def read_boxes(path: Path, prefix: str, frame_of: Mapping[int, int], camera: int | None = None) -> segment.BoxTable:
    """Read 3D labels, or the 2D labels of a camera by number; `frame_of` gives the index of the frame of a stamp."""
    axes, track = ("xyz", "key.laser_object_id") if camera is None else ("xy", CAMERA)
    numbers = [f"{prefix}.box.{part}.{axis}" for part in ("center", "size") for axis in axes]
    numbers += [f"{prefix}.box.heading"] if camera is None else []
    kind = f"{prefix}.type"
    columns = read_columns(path, {STAMP: "int", track: "text", kind: "int", **dict.fromkeys(numbers, "float")})
    if camera is not None:
        rows = numbers_of(columns[CAMERA], segment.CAMERAS) == camera
        columns = {name: values[rows] for name, values in columns.items()}
    frame = np.array([frame_of.get(int(t), -1) for t in columns[STAMP]], dtype=np.int64)
    box = np.stack([columns[name].astype(np.float64) for name in numbers], axis=1)
    tracks = [str(word) for word in columns[track]]
    table = segment.BoxTable.of(frame, tracks, columns[kind], box, int((frame < 0).sum()))
    return table.take(np.flatnonzero(frame >= 0))


def numbers_of(words: NDArray[Any], names: Mapping[int, str]) -> NDArray[np.int64]:
    """Numbers (N,) of sensors that are given by number or by name; 0 for others."""
    number = {name: k for k, name in names.items()} | {str(k): k for k in names}
    return np.array([number.get(str(word), 0) for word in words], dtype=np.int64)


def matrix(cell: Any) -> Any:
    """Return the transform (4, 4) of a cell; None when it is none."""
    return None if cell is None else segment.rigid(np.asarray(cell, dtype=np.float64))


class SensorRows:
    """A component with one row for each frame and sensor, of which there are none where its file is absent.

    `index`: columns to read at once, with the stamp and the sensor. `names`: sensors by number. `frame_of`: index of the frame of a
    stamp in us. `kinds`: what columns hold that are large and read row by row; `optional` of them may be absent.

    `rows`: row of a frame by index and sensor by number. `columns`: those of `index`. `note`: what was left out, if anything.
    """

    def __init__(
        self, path: Path, index: Mapping[str, Kind], names: Mapping[int, str], frame_of: Mapping[int, int],
        kinds: Mapping[str, Kind], optional: Collection[str] = (),
    ) -> None:  # fmt: skip
        self.path, self.note = path, ""
        self.rows: dict[tuple[int, int], int] = {}
        self.columns: Columns = {}
        self._files: dict[int, ParquetRows] = {}
        if not is_present(path):
            return
        self.columns = read_columns(path, index)
        sensor = numbers_of(self.columns[CAMERA if CAMERA in index else LASER], names)
        frame = np.array([frame_of.get(int(t), -1) for t in self.columns[STAMP]], dtype=np.int64)
        known = np.flatnonzero((frame >= 0) & (sensor > 0))
        self.rows = {(int(frame[row]), int(sensor[row])): int(row) for row in known}
        lost = len(frame) - len(self.rows)
        self.note = f"{path.parent.name}: {lost} of {len(frame)} rows of no frame and sensor left out" if lost else ""
        # Rows can only be read on: a file with one sensor after the other is read from several places at once.
        by_sensor = bool(np.any(np.diff(frame[known]) < 0))
        shared = ParquetRows(path, kinds, optional=optional)
        for number in {number for _, number in self.rows}:
            self._files[number] = ParquetRows(path, kinds, optional=optional) if by_sensor else shared

    def read(self, frame: int, sensor: int) -> Row | None:
        """Return the record of a frame and sensor; None where there is no row, `RecordError` for one that cannot be read."""
        row = self.rows.get((frame, sensor))
        return None if row is None else self._files[sensor].read(row)


POSES = "vehicle_pose"
STATISTICS = ("time_of_day", "location", "weather")


class WaymoParquetReader(FolderReader):
    """Reader of segments of version 2; the root holds a folder for each component."""

    name = "waymo-parquet"
    looks_for = "a folder with vehicle_pose/SEGMENT.parquet and further components of the Waymo Open Dataset, version 2"

    def find(self, path: Path) -> dict[str, Path]:
        """Find the poses of segments at a folder by name."""
        try:
            return {file.stem: file for file in (path / POSES).glob("*.parquet") if file.is_file()}
        except OSError:
            return {}

    def open(self, path: Path, sequence: str) -> Log:
        """Open a segment; no picture, range image or label is read."""
        require_links_inside(path)
        return _SegmentFolder(path, sequence).log(self.name)


READER = WaymoParquetReader()


class _SegmentFolder(Segment):
    def __init__(self, root: Path, name: str) -> None:
        def file(component: str) -> Path:
            return root / component / f"{name}.parquet"

        self.stamps_us, poses, notes = read_poses(file(POSES))
        frame_of = {t: k for k, t in enumerate(self.stamps_us)}
        of_lidars: dict[str, Kind] = {STAMP: "int", LASER: "text"}
        second = [f"{LIDAR_RETURNS[1]}.{part}" for part in ("values", "shape")]
        self.sweeps = SensorRows(file("lidar"), of_lidars, segment.LASERS, frame_of, _matrices(*LIDAR_RETURNS), second)
        self.pixel_poses = SensorRows(file("lidar_pose"), of_lidars, segment.LASERS, frame_of, _matrices(PIXEL_POSES))
        self.images = SensorRows(
            file("camera_image"), IMAGE_COLUMNS, segment.CAMERAS, frame_of, {f"{IMAGE}.image": "bytes"}
        )
        notes += [rows.note for rows in (self.sweeps, self.pixel_poses, self.images) if rows.note]
        # Boxes projected from 3D labels go before boxes drawn in the images.
        boxes, projected, drawn = (
            partial(read_boxes, file(component), prefix, frame_of) if is_present(file(component)) else None
            for component, prefix in (LIDAR_BOXES, PROJECTED_BOXES, CAMERA_BOXES)
        )
        frames = [segment.FrameRow(t * 1000, pose, {}, ()) for t, pose in zip(self.stamps_us, poses)]
        for (k, number), row in self.images.rows.items():
            # NaN counts as unknown.
            pose, *times = (self.images.columns[name][row] for name in IMAGE_COLUMNS if name not in (STAMP, CAMERA))
            seconds = (float(s) if np.isfinite(s) else 0.0 for s in times)
            frames[k].images[number] = segment.ImageTimes(matrix(pose), *seconds)
        for k, number in self.sweeps.rows:
            frames[k] = replace(frames[k], lasers=(*frames[k].lasers, number))
        statistics = {}
        if is_present(file("stats")):
            names: dict[str, Kind] = {f"[StatsComponent].{word}": "text" for word in STATISTICS}
            columns = read_columns(file("stats"), names, optional=tuple(names))
            statistics = {name.rpartition(".")[2]: str(values[0]) for name, values in columns.items() if len(values)}
        cameras = read_camera_calibration(file("camera_calibration")) if self.images.rows else {}
        lasers = read_laser_calibration(file("lidar_calibration")) if self.sweeps.rows else {}
        super().__init__(name, root, frames, cameras, lasers, notes, {**statistics, "frames": len(poses)})
        self.boxes, in_images = boxes, projected or drawn
        self.image_boxes = in_images and (lambda camera: in_images(camera=camera))
        self.image_boxes_are_projected = projected is not None
        self.pixel_poses_are_missing = not self.pixel_poses.rows
        sizes = [f"{f.parent.name} {f.stat().st_size}" for f in sorted(root.glob(f"*/{name}.parquet"))]
        self.digest = digest_of([name, repr(self.stamps_us), np.stack(poses).tobytes().hex(), *sizes], [])

    def where(self, frame: int) -> str:
        return f"{self.path}: segment {self.name}, frame {self.stamps_us[frame]}"

    def image(self, frame: int, camera: int) -> bytes:
        return bytes((self.images.read(frame, camera) or {}).get(f"{IMAGE}.image") or b"")

    def ranges(self, frame: int, laser: int) -> segment.RangeImages:
        row, of_pixels = self.sweeps.read(frame, laser), self.pixel_poses.read(frame, laser)
        try:
            returns = [image for name in LIDAR_RETURNS if (image := _image_of(row, name)) is not None]
            return checked(returns, _image_of(of_pixels, PIXEL_POSES))
        except WireError as error:
            row_number = self.sweeps.rows.get((frame, laser), "none")
            raise RecordError(f"{self.sweeps.path}, row {row_number}: {error}") from None


def _matrices(*names: str) -> dict[str, Kind]:
    """Columns of matrices, each with its values and its shape."""
    parts: dict[str, Kind] = {"values": "floats", "shape": "ints"}
    return {f"{name}.{part}": kind for name in names for part, kind in parts.items()}


def _image_of(row: Row | None, name: str) -> NDArray[np.float32] | None:
    """Range image (H, W, C) of a row; None where it has none."""
    values, shape = ((row or {}).get(f"{name}.{part}") for part in ("values", "shape"))
    if values is None or shape is None or not len(np.atleast_1d(values)):
        return None
    return shaped(np.asarray(values), [int(n) for n in np.atleast_1d(shape)])
