"""Argoverse 2 sensor logs, by the tables that its user guide prints and the types of its files."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from log2sim.datatypes import Log
from log2sim.geometry import Array, apply, inverse, quaternion_from_rotation, transform
from log2sim.logs.argoverse import scan_time_ns
from log_encoders.world import labels_at

CAMERA, LIDAR = "front", "top"
FOLDER = "ring_front_center"
KIND_OF = {"car": "REGULAR_VEHICLE", "pedestrian": "PEDESTRIAN", "truck": "BOX_TRUCK", "bus": "BUS"}
TURN_NS = 100_000_000
# Every so many points are taken to be the lower LiDAR's, which hangs upside down.
LOWER_SHARE = 5
UPPER_T_LOWER = transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, -0.12])
# A place in Pittsburgh.
CITY_T_MAP = transform(np.eye(3), [5170.0, 2420.0, 60.0])
# From the ego's origin of the data set, at the height of the axle, to that on the road.
AXLE_T_ROAD = transform(np.eye(3), [0.0, 0.0, -0.33])


def encode(log: Log, folder: Path) -> Path:
    """Write a log as `folder`/its name."""
    path = folder / log.name
    for part in ("calibration", "sensors/lidar", f"sensors/cameras/{FOLDER}", "map"):
        (path / part).mkdir(parents=True)
    stamps = log.streams[LIDAR].t_ns - TURN_NS
    _write_poses(log, np.concatenate([stamps, log.streams[CAMERA].t_ns]), path / "city_SE3_egovehicle.feather")
    _write_calibration(log, path / "calibration")
    for k, stamp in enumerate(stamps.tolist()):
        write_table(path / "sensors" / "lidar" / f"{stamp}.feather", _points(log, k, stamp))
    rows = [row for stamp in stamps.tolist() for row in _boxes(log, stamp)]
    write_table(path / "annotations.feather", {key: [row[key] for row in rows] for key in rows[0]})
    _write_images(log, path / "sensors" / "cameras" / FOLDER)
    (path / "map" / f"log_map_archive_{log.name}____PIT_city_47896.json").write_text("{}")
    return path


def write_table(path: Path, columns: dict[str, Any]) -> None:
    pyarrow = pytest.importorskip("pyarrow")
    feather = pytest.importorskip("pyarrow.feather")
    feather.write_feather(pyarrow.table(columns), path, compression="lz4")


def city_T_axle(log: Log, t_ns: Array | int) -> Array:
    assert log.ego is not None
    return np.asarray(CITY_T_MAP @ log.ego.at(t_ns)[0] @ inverse(AXLE_T_ROAD))


def columns_of(poses: Array) -> dict[str, Array]:
    quaternion = quaternion_from_rotation(poses[:, :3, :3])
    return {
        **{name: quaternion[:, k] for k, name in enumerate(("qw", "qx", "qy", "qz"))},
        **{name: poses[:, k, 3] for k, name in enumerate(("tx_m", "ty_m", "tz_m"))},
    }


def _write_poses(log: Log, stamps: Array, path: Path) -> None:
    """Write poses at the stamps of all records; every seventh comes twice, 1 ns apart."""
    t_ns = np.unique(np.concatenate([stamps, stamps[::7] + 1]))
    write_table(path, {"timestamp_ns": t_ns, **columns_of(city_T_axle(log, t_ns))})


def _write_calibration(log: Log, folder: Path) -> None:
    camera, upper = log.cameras[CAMERA], AXLE_T_ROAD @ log.lidars[LIDAR].mount_T_lidar
    mounts = {FOLDER: AXLE_T_ROAD @ camera.mount_T_cam, "up_lidar": upper, "down_lidar": upper @ UPPER_T_LOWER}
    poses = np.stack(list(mounts.values()))
    write_table(folder / "egovehicle_SE3_sensor.feather", {"sensor_name": list(mounts), **columns_of(poses)})
    K = camera.K
    lens = {"k1": [-0.24], "k2": [-0.21], "k3": [0.33]}
    size = {"height_px": np.array([camera.height_px], "uint16"), "width_px": np.array([camera.width_px], "uint16")}
    matrix = {"fx_px": [K[0, 0]], "fy_px": [K[1, 1]], "cx_px": [K[0, 2]], "cy_px": [K[1, 2]]}
    write_table(folder / "intrinsics.feather", {"sensor_name": [FOLDER], **matrix, **lens, **size})


def _points(log: Log, k: int, stamp: int) -> dict[str, Array]:
    """Points of a sweep in the ego frame of its stamp, in half precision."""
    sweep = log.streams[LIDAR].read(k)
    poses = CITY_T_MAP @ log.map_T_sensor(LIDAR, sweep.t_ns)[0]
    city = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]
    xyz = apply(inverse(city_T_axle(log, stamp)[0]), city).astype(np.float16)
    number = np.arange(len(xyz))
    laser = np.where(number % LOWER_SHARE == 0, 32, 0) + number % 32
    return {
        "x": xyz[:, 0],
        "y": xyz[:, 1],
        "z": xyz[:, 2],
        "intensity": np.zeros(len(xyz), np.uint8),
        "laser_number": laser.astype(np.uint8),
        "offset_ns": (sweep.t_ns - stamp).astype(np.int32),
    }


def _boxes(log: Log, stamp: int) -> list[dict[str, Any]]:
    """Boxes of a sweep in the ego frame of its stamp, each where the object was when it was seen."""
    assert log.labels is not None
    axle_T_city = inverse(city_T_axle(log, stamp)[0])
    lidar_xy = log.lidars[LIDAR].mount_T_lidar[:2, 3]
    rows = []
    for track in np.unique(log.labels.track_id):
        t_ns = stamp
        for _ in range(5):
            center, size, yaw = labels_at(log.labels, t_ns, str(track))
            axle_T_box = axle_T_city @ CITY_T_MAP @ _box_pose(center[0], yaw[0])
            t_ns = stamp + int(scan_time_ns(axle_T_box[None, :2, 3] - lidar_xy)[0])
        category = str(log.labels.category[log.labels.track_id == track][0])
        pose = {name: float(column[0]) for name, column in columns_of(axle_T_box[None]).items()}
        rows.append(
            {"timestamp_ns": stamp, "track_uuid": str(track), "category": KIND_OF[category], "length_m": float(size[0]),
             "width_m": float(size[1]), "height_m": float(size[2]), **pose, "num_interior_pts": 9}
        )  # fmt: skip
    return rows


def _box_pose(center: Array, yaw: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return transform(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), center)


def _write_images(log: Log, folder: Path) -> None:
    import simplejpeg

    stream = log.streams[CAMERA]
    for k, t_ns in enumerate(stream.t_ns.tolist()):
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(stream.read(k)), quality=92, colorspace="BGR")
        (folder / f"{t_ns}.jpg").write_bytes(data)
