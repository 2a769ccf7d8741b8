"""Components of version 2: one parquet file for each and segment, their columns by the data set's v2 Python package.

Types differ between releases (cameras by number or by name, poses in single or double precision): what a column holds decides.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import LogError
from log2sim.geometry import Array
from log2sim.logs.arrow.tables import read_columns
from log2sim.logs.arrow.values import Kind
from log2sim.logs.stamps import MAX_TIME_S
from log2sim.logs.waymo.segment import (
    CAMERAS,
    LASERS,
    MAX_BEAMS,
    BoxTable,
    CameraCalibration,
    ImageTimes,
    LaserCalibration,
    are_usable,
    rigid,
)

Columns = dict[str, NDArray[Any]]

STAMP, CAMERA, LASER = "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
POSE = "[VehiclePoseComponent].world_from_vehicle.transform"
IMAGE = "[CameraImageComponent]"
IMAGE_COLUMNS: Mapping[str, Kind] = {
    STAMP: "int",
    CAMERA: "text",
    f"{IMAGE}.pose.transform": "floats",
    f"{IMAGE}.pose_timestamp": "float",
    f"{IMAGE}.rolling_shutter_params.shutter": "float",
    f"{IMAGE}.rolling_shutter_params.camera_trigger_time": "float",
    f"{IMAGE}.rolling_shutter_params.camera_readout_done_time": "float",
}
CAMERA_PREFIX = "[CameraCalibrationComponent]"
INTRINSICS = tuple(f"{CAMERA_PREFIX}.intrinsic.{k}" for k in ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3"))
LASER_PREFIX = "[LiDARCalibrationComponent]"
LIDAR_RETURNS = ("[LiDARComponent].range_image_return1", "[LiDARComponent].range_image_return2")
PIXEL_POSES = "[LiDARPoseComponent].range_image_return1"
# Component and prefix of its columns.
LIDAR_BOXES = ("lidar_box", "[LiDARBoxComponent]")
PROJECTED_BOXES = ("projected_lidar_box", "[ProjectedLiDARBoxComponent]")
CAMERA_BOXES = ("camera_box", "[CameraBoxComponent]")


def component_file(root: Path, component: str, segment: str) -> Path:
    """Return the path of a component of a segment."""
    return root / component / f"{segment}.parquet"


def read_poses(path: Path) -> tuple[list[int], list[Array], list[str]]:
    """Read stamps in us and poses (4, 4) of the frames, and remarks on those that are none.

    Raises
    ------
    LogError
        When no row has both.
    """
    columns = read_columns(path, {STAMP: "int", POSE: "floats"})
    found = [(int(t), matrix(cell)) for t, cell in zip(columns[STAMP], columns[POSE])]
    usable = [(t, pose) for t, pose in found if pose is not None and 0 < t < MAX_TIME_S * 10**6]
    if not usable:
        raise LogError(f"{path}: none of its {len(found)} rows is a rigid pose with a stamp in microseconds")
    lost = len(found) - len(usable)
    notes = [f"{lost} of {len(found)} frames without a rigid pose left out"] if lost else []
    return [t for t, _ in usable], [pose for _, pose in usable], notes


def read_camera_calibration(path: Path) -> dict[int, CameraCalibration]:
    """Read the calibration of the cameras by number."""
    extrinsic = f"{CAMERA_PREFIX}.extrinsic.transform"
    whole = [f"{CAMERA_PREFIX}.{name}" for name in ("width", "height", "rolling_shutter_direction")]
    columns = read_columns(
        path, {CAMERA: "text", extrinsic: "floats", **dict.fromkeys(INTRINSICS, "float"), **dict.fromkeys(whole, "int")}
    )
    out = {}
    for row, number in enumerate(numbers_of(columns[CAMERA], CAMERAS)):
        intrinsic = np.array([columns[name][row] for name in INTRINSICS], dtype=np.float64)
        pose = matrix(columns[extrinsic][row])
        width, height, direction = (int(columns[name][row]) for name in whole)
        if pose is None or not are_usable(intrinsic, width, height):
            raise LogError(
                f"{path}, row {row}: expected finite intrinsics, a rigid extrinsic, width and height of camera {number}"
            )
        out[int(number)] = CameraCalibration(intrinsic, pose, width, height, direction)
    return out


def read_laser_calibration(path: Path) -> dict[int, LaserCalibration]:
    """Read the calibration of the LiDARs by number."""
    extrinsic, values = f"{LASER_PREFIX}.extrinsic.transform", f"{LASER_PREFIX}.beam_inclination.values"
    limits = [f"{LASER_PREFIX}.beam_inclination.{name}" for name in ("min", "max")]
    columns = read_columns(
        path,
        {LASER: "text", extrinsic: "floats", values: "floats", **dict.fromkeys(limits, "float")},
        optional=(values,),
    )
    out = {}
    for row, number in enumerate(numbers_of(columns[LASER], LASERS)):
        pose = matrix(columns[extrinsic][row])
        cell = columns[values][row] if values in columns else None
        beams = np.zeros(0) if cell is None else np.asarray(cell, dtype=np.float64)
        low, high = (float(columns[name][row]) for name in limits)
        known = np.isfinite(beams).all() if len(beams) else np.isfinite([low, high]).all()
        if pose is None or not known or len(beams) > MAX_BEAMS:
            raise LogError(f"{path}, row {row}: expected a rigid extrinsic and finite inclinations of LiDAR {number}")
        out[int(number)] = LaserCalibration(pose, beams, (low, high))
    return out


def image_times(columns: Columns, row: int) -> ImageTimes:
    """Return when the image of a row of the component "camera_image" was taken; NaN counts as unknown."""
    seconds = [
        float(columns[name][row]) for name in IMAGE_COLUMNS if name not in (STAMP, CAMERA, f"{IMAGE}.pose.transform")
    ]
    return ImageTimes(matrix(columns[f"{IMAGE}.pose.transform"][row]), *(s if np.isfinite(s) else 0.0 for s in seconds))


def read_boxes(path: Path, prefix: str, frame_of: Mapping[int, int]) -> BoxTable:
    """Read 3D labels; `frame_of` gives the index of the frame of a stamp."""
    center, size = ([f"{prefix}.box.{part}.{axis}" for axis in "xyz"] for part in ("center", "size"))
    numbers = [*center, *size, f"{prefix}.box.heading"]
    columns = read_columns(
        path, {STAMP: "int", "key.laser_object_id": "text", f"{prefix}.type": "int", **dict.fromkeys(numbers, "float")}
    )
    return _table(columns, "key.laser_object_id", f"{prefix}.type", numbers, frame_of)


def read_image_boxes(path: Path, prefix: str, frame_of: Mapping[int, int], camera: int) -> BoxTable:
    """Read the 2D labels of a camera; `frame_of` gives the index of the frame of a stamp."""
    numbers = [f"{prefix}.box.{part}.{axis}" for part in ("center", "size") for axis in "xy"]
    columns = read_columns(
        path, {STAMP: "int", CAMERA: "text", f"{prefix}.type": "int", **dict.fromkeys(numbers, "float")}
    )
    of_camera = numbers_of(columns[CAMERA], CAMERAS) == camera
    columns = {name: values[of_camera] for name, values in columns.items()}
    return _table(columns, CAMERA, f"{prefix}.type", numbers, frame_of)


def _table(columns: Columns, track: str, kind: str, numbers: list[str], frame_of: Mapping[int, int]) -> BoxTable:
    frame = np.array([frame_of.get(int(t), -1) for t in columns[STAMP]], dtype=np.int64)
    known = np.flatnonzero(frame >= 0)
    box = np.stack([columns[name].astype(np.float64) for name in numbers], axis=1)
    dimensions = len(numbers) // 2
    heading = box[:, -1] if len(numbers) % 2 else np.zeros(len(box))
    track_id = np.array([str(word) for word in columns[track]], dtype=np.str_)
    table = BoxTable(
        frame,
        track_id,
        columns[kind],
        box[:, :dimensions],
        box[:, dimensions : 2 * dimensions],
        heading,
        len(box) - len(known),
    )
    return table.take(known)


def numbers_of(words: NDArray[Any], names: Mapping[int, str]) -> NDArray[np.int64]:
    """Numbers (N,) of sensors that are given by number or by name; 0 for others."""
    number = {name: k for k, name in names.items()} | {str(k): k for k in names}
    return np.array([number.get(str(word), 0) for word in words], dtype=np.int64)


def matrix(cell: Any) -> Any:
    """Return the transform (4, 4) of a cell; None when it is none."""
    return None if cell is None else rigid(np.asarray(cell, dtype=np.float64))
