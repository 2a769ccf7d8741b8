"""PandaSet sequences, as their development kit reads them: points and boxes in the world, pickled tables, poses as JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from log2sim.datatypes import Log
from log2sim.geometry import Array, apply, inverse, quaternion_from_rotation
from log2sim.logs.pandaset.reader import PERIOD_NS, POSE_T_EGO
from log2sim.logs.stamps import compute_scan_offset_ns
from log_encoders.world import labels_at

CAMERA, LIDAR = "front", "top"
FOLDER = "front_camera"
LABEL_OF = {"car": "Car", "pedestrian": "Pedestrian", "truck": "Medium-sized Truck", "bus": "Bus"}
# The PandarGT sees ahead only; every so many of the points there are taken to be its own.
GT_HALF_VIEW_RAD, GT_SHARE = np.deg2rad(30.0), 7


def encode(log: Log, folder: Path) -> Path:
    """Write a log as `folder`/its name; the LiDAR must be mounted as the Pandar64 is."""
    pandas = pytest.importorskip("pandas")
    path = folder / log.name
    for part in ("lidar", "annotations/cuboids", "meta", f"camera/{FOLDER}"):
        (path / part).mkdir(parents=True)
    sweeps = log.streams[LIDAR].t_ns
    _write_poses(path / "lidar", sweeps, _ego_poses(log, sweeps) @ inverse(POSE_T_EGO))
    for k in range(len(sweeps)):
        pandas.DataFrame(_points(log, k)).to_pickle(path / "lidar" / f"{k:02d}.pkl.gz")
        pandas.DataFrame(_cuboids(log, int(sweeps[k]))).to_pickle(path / "annotations" / "cuboids" / f"{k:02d}.pkl.gz")
    _write_camera(log, path / "camera" / FOLDER)
    gps = [{"lat": 37.7, "long": -122.4, "height": 5.0, "xvel": 0.0, "yvel": 0.0} for _ in sweeps]
    (path / "meta" / "gps.json").write_text(json.dumps(gps))
    return path


def _ego_poses(log: Log, t_ns: Array) -> Array:
    assert log.ego is not None
    return log.ego.at(t_ns)[0]


def _points(log: Log, k: int) -> dict[str, Array]:
    sweep = log.streams[LIDAR].read(k)
    poses = log.map_T_sensor(LIDAR, sweep.t_ns)[0]
    xyz = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]
    xyz = np.round(xyz, 3)
    ahead = np.flatnonzero(np.abs(np.arctan2(sweep.xyz_m[:, 1], sweep.xyz_m[:, 0])) < GT_HALF_VIEW_RAD)
    sensor = np.zeros(len(xyz), dtype=np.int64)
    sensor[ahead[::GT_SHARE]] = 1
    return {"x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], "i": 0.0 * xyz[:, 0], "t": sweep.t_ns / 1e9, "d": sensor}


def _cuboids(log: Log, stamp_ns: int) -> dict[str, list[object]]:
    """Return the boxes of a sweep, each where the Pandar64 saw it; a yaw of 0 faces +y, width comes before length."""
    assert log.labels is not None
    lidar_T_map = inverse(log.map_T_sensor(LIDAR, stamp_ns)[0][0])
    columns: dict[str, list[object]] = {}
    for track in np.unique(log.labels.track_id):
        t_ns = stamp_ns
        for _ in range(5):
            center, size, yaw = labels_at(log.labels, t_ns, str(track))
            t_ns = stamp_ns + int(compute_scan_offset_ns(apply(lidar_T_map, center), PERIOD_NS)[0])
        category = str(log.labels.category[log.labels.track_id == track][0])
        row = {
            "uuid": str(track), "label": LABEL_OF[category], "yaw": float(yaw[0] - np.pi / 2), "stationary": False,
            "camera_used": -1, "position.x": center[0, 0], "position.y": center[0, 1], "position.z": center[0, 2],
            "dimensions.x": size[1], "dimensions.y": size[0], "dimensions.z": size[2], "attributes.object_motion": "Moving",
            "cuboids.sibling_id": "-", "cuboids.sensor_id": -1, "attributes.rider_status": np.nan,
        }  # fmt: skip
        for name, value in row.items():
            columns.setdefault(name, []).append(value)
    return columns


def _write_camera(log: Log, folder: Path) -> None:
    import simplejpeg

    camera, stream = log.cameras[CAMERA], log.streams[CAMERA]
    _write_poses(folder, stream.t_ns, log.map_T_sensor(CAMERA, stream.t_ns)[0])
    K = camera.K
    intrinsics = {"fx": K[0, 0], "fy": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}
    (folder / "intrinsics.json").write_text(json.dumps(intrinsics))
    for k in range(len(stream.t_ns)):
        data = simplejpeg.encode_jpeg(np.ascontiguousarray(stream.read(k)), quality=92, colorspace="BGR")
        (folder / f"{k:02d}.jpg").write_bytes(data)


def _write_poses(folder: Path, t_ns: Array, poses: Array) -> None:
    (folder / "timestamps.json").write_text(json.dumps((t_ns / 1e9).tolist()))
    quaternion = quaternion_from_rotation(poses[:, :3, :3])
    rows = [
        {"position": dict(zip("xyz", p.tolist())), "heading": dict(zip("wxyz", q.tolist()))}
        for p, q in zip(poses[:, :3, 3], quaternion)
    ]
    (folder / "poses.json").write_text(json.dumps(rows))
