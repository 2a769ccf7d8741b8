"""Waymo Open Dataset, version 2: a parquet file for each component, by the columns of the data set's v2 Python package."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Log
from log2sim.geometry import Array
from log_encoders import waymo
from log_encoders.waymo import Frame, Segment

SEGMENT, STAMP, CAMERA, LASER = (
    "key.segment_context_name", "key.frame_timestamp_micros", "key.camera_name", "key.laser_name"
)  # fmt: skip
CALIBRATION, IMAGE, BOX = "[CameraCalibrationComponent]", "[CameraImageComponent]", "[LiDARBoxComponent]"
LENS = ("f_u", "f_v", "c_u", "c_v", "k1", "k2", "p1", "p2", "k3")


def encode(log: Log, folder: Path) -> Path:
    """Write a log as one segment below `folder`; return `folder`."""
    return write(waymo.segment_of(log), folder)


def write(segment: Segment, folder: Path) -> Path:
    """Write the components of a segment."""
    pyarrow = pytest.importorskip("pyarrow")
    from pyarrow import parquet

    for component, rows in components_of(segment).items():
        (folder / component).mkdir(parents=True, exist_ok=True)
        columns = {name: [row.get(name) for row in rows] for name in rows[0]} if rows else {SEGMENT: []}
        table = pyarrow.table({name: column(pyarrow, name, values) for name, values in columns.items()})
        parquet.write_table(table, folder / component / f"{segment.name}.parquet")
    return folder


def column(pyarrow: Any, name: str, values: list[Any]) -> Any:
    """Give a column the type that the data set's package states."""
    if name.endswith("transform"):
        kind = pyarrow.list_(pyarrow.float64(), 16)
    elif name.endswith(".shape"):
        kind = pyarrow.list_(pyarrow.int32(), 3)
    elif name.endswith("inclination.values"):
        kind = pyarrow.list_(pyarrow.float64())
    elif name.endswith(".values"):
        kind = pyarrow.list_(pyarrow.float32())
    elif name.endswith((CAMERA, LASER, ".type", "direction")):
        kind = pyarrow.int8()
    else:
        kind = None
    return pyarrow.array(values, kind)


def components_of(segment: Segment) -> dict[str, list[dict[str, Any]]]:
    """Return the rows of each component."""
    rows: dict[str, list[dict[str, Any]]] = {
        "vehicle_pose": [], "camera_image": [], "lidar": [], "lidar_pose": [], "lidar_box": [], "projected_lidar_box": [],
    }  # fmt: skip
    for frame in segment.frames:
        key = {SEGMENT: segment.name, STAMP: frame.stamp_us}
        rows["vehicle_pose"].append(
            key | {"[VehiclePoseComponent].world_from_vehicle.transform": flat(frame.world_T_vehicle)}
        )
        rows["camera_image"] += [key | image for image in images(frame)]
        for name, of_frame in sweeps(frame):
            rows[name].append(key | of_frame)
        rows["lidar_box"] += [key | box for box in boxes(frame)]
        rows["projected_lidar_box"] += [key | box for box in projected(frame)]
    rows["camera_calibration"] = [{SEGMENT: segment.name} | row for row in cameras(segment)]
    rows["lidar_calibration"] = [{SEGMENT: segment.name} | row for row in lasers(segment)]
    rows["stats"] = [
        {SEGMENT: segment.name, STAMP: frame.stamp_us, "[StatsComponent].time_of_day": "Day",
         "[StatsComponent].location": "location_other", "[StatsComponent].weather": "sunny"}
        for frame in segment.frames
    ]  # fmt: skip
    return rows


def cameras(segment: Segment) -> Iterator[dict[str, Any]]:
    for number, (camera, direction) in segment.cameras.items():
        lens = {f"{CALIBRATION}.intrinsic.{k}": float(v) for k, v in zip(LENS, waymo.intrinsics(camera))}
        yield {
            CAMERA: number, **lens, f"{CALIBRATION}.extrinsic.transform": flat(camera.mount_T_cam @ waymo.OPENCV_T_CAMERA),
            f"{CALIBRATION}.width": camera.width_px, f"{CALIBRATION}.height": camera.height_px,
            f"{CALIBRATION}.rolling_shutter_direction": direction,
        }  # fmt: skip


def lasers(segment: Segment) -> Iterator[dict[str, Any]]:
    for number, laser in segment.lasers.items():
        prefix = "[LiDARCalibrationComponent]"
        yield {
            LASER: number, f"{prefix}.extrinsic.transform": flat(laser.vehicle_T_lidar),
            f"{prefix}.beam_inclination.min": laser.limits[0], f"{prefix}.beam_inclination.max": laser.limits[1],
            f"{prefix}.beam_inclination.values": laser.inclinations.tolist() if len(laser.inclinations) else None,
        }  # fmt: skip


def images(frame: Frame) -> Iterator[dict[str, Any]]:
    for number, image in frame.images.items():
        times = {"shutter": waymo.SHUTTER_S, "camera_trigger_time": image.trigger_s,
                 "camera_readout_done_time": image.readout_done_s}  # fmt: skip
        yield {
            CAMERA: number, f"{IMAGE}.image": image.jpeg, f"{IMAGE}.pose.transform": flat(image.world_T_vehicle),
            f"{IMAGE}.pose_timestamp": image.pose_s,
            **{f"{IMAGE}.rolling_shutter_params.{name}": value for name, value in times.items()},
        }  # fmt: skip


def sweeps(frame: Frame) -> Iterator[tuple[str, dict[str, Any]]]:
    for number, ranges in frame.lasers.items():
        row: dict[str, Any] = {LASER: number}
        for k, image in enumerate(ranges.returns, start=1):
            row |= matrix(f"[LiDARComponent].range_image_return{k}", image)
        yield "lidar", row
        if ranges.poses is not None:
            yield "lidar_pose", {LASER: number} | matrix("[LiDARPoseComponent].range_image_return1", ranges.poses)


def matrix(prefix: str, values: np.ndarray) -> dict[str, Any]:
    return {f"{prefix}.values": values.ravel(), f"{prefix}.shape": list(values.shape)}


def boxes(frame: Frame) -> Iterator[dict[str, Any]]:
    for box in frame.labels:
        center = {f"{BOX}.box.center.{k}": float(v) for k, v in zip("xyz", box.center)}
        size = {f"{BOX}.box.size.{k}": float(v) for k, v in zip("xyz", box.size)}
        yield {"key.laser_object_id": box.track_id, **center, **size, f"{BOX}.box.heading": box.heading_rad,
               f"{BOX}.type": box.kind}  # fmt: skip


def projected(frame: Frame) -> Iterator[dict[str, Any]]:
    prefix = "[ProjectedLiDARBoxComponent]"
    for number, found in frame.projected.items():
        for box in found:
            center = {f"{prefix}.box.center.{k}": float(v) for k, v in zip("xy", box.center)}
            size = {f"{prefix}.box.size.{k}": float(v) for k, v in zip("xy", box.size)}
            yield {CAMERA: number, "key.laser_object_id": box.track_id, **center, **size, f"{prefix}.type": box.kind}


def flat(dst_T_src: Array) -> list[float]:
    return [float(v) for v in dst_T_src.ravel()]
