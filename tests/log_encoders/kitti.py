"""KITTI raw drives and the tracking layout, by the development kits' readme files (Geiger et al., IJRR 2013).

The camera of the log must look level along the ego, its LiDAR turn clockwise and face forward at the frames of the camera.
"""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import (
    Array,
    apply,
    box_corners,
    inverse,
    nearest_index,
    project_boxes,
    rotation_from_rpy,
    transform,
)
from log2sim.logs.kitti.labels import EGO_T_IMU
from log_encoders.world import labels_at

CAMERA, LIDAR = "front", "top"
LATITUDE_DEG, LONGITUDE_DEG = 49.0, 8.4
EARTH_RADIUS_M = 6378137.0
HALF_TURN_NS = 50_000_000
# Of camera 2 from the rectified camera 0, and of the axes of the cameras before and after rectification.
CAM_T_RECT = transform(np.eye(3), [0.06, -0.002, 0.003])
RECT_R_CAM = rotation_from_rpy(0.004, -0.003, 0.002)
TYPE_OF = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}


def encode_raw(log: Log, folder: Path, drive: int = 1) -> Path:
    """Write a drive below `folder`, which is returned."""
    date = folder / "2011_09_26"
    path = date / f"2011_09_26_drive_{drive:04d}_sync"
    frames = log.streams[CAMERA].t_ns
    sweep_of_frame = sweeps_of_frames(log)
    for k, t_ns in enumerate(frames.tolist()):
        write_image(log.streams[CAMERA].read(k), path / "image_02" / "data" / f"{k:010d}.png")
        _write_points(log, sweep_of_frame[k], path / "velodyne_points" / "data" / f"{k:010d}.bin")
        write_text(path / "oxts" / "data" / f"{k:010d}.txt", _oxts(log, t_ns) + "\n")
    for name in ("image_02", "oxts", "velodyne_points"):
        write_text(path / name / "timestamps.txt", _stamps(frames))
    for name, shift_ns in (("start", -HALF_TURN_NS), ("end", HALF_TURN_NS)):
        write_text(path / "velodyne_points" / f"timestamps_{name}.txt", _stamps(frames + shift_ns))
    velo_T_imu, cam_T_velo, P, size_px = calibration_of(log)
    write_text(
        date / "calib_imu_to_velo.txt",
        f"calib_time: x\nR: {numbers(velo_T_imu[:3, :3])}\nT: {numbers(velo_T_imu[:3, 3])}\n",
    )
    write_text(
        date / "calib_velo_to_cam.txt",
        f"calib_time: x\nR: {numbers(cam_T_velo[:3, :3])}\nT: {numbers(cam_T_velo[:3, 3])}\n",
    )
    write_text(
        date / "calib_cam_to_cam.txt",
        f"calib_time: x\nS_rect_02: {numbers(size_px)}\nR_rect_00: {numbers(RECT_R_CAM)}\nP_rect_02: {numbers(P)}\n",
    )  # fmt: skip
    write_text(path / "label_02.txt", label_lines(log))
    return folder


def encode_tracking(log: Log, folder: Path, sequence: int = 0) -> Path:
    """Write a sequence below `folder`, which is returned."""
    base, name = folder / "training", f"{sequence:04d}"
    sweep_of_frame = sweeps_of_frames(log)
    frames = log.streams[CAMERA].t_ns
    for k in range(len(frames)):
        write_image(log.streams[CAMERA].read(k), base / "image_02" / name / f"{k:06d}.png")
        _write_points(log, sweep_of_frame[k], base / "velodyne" / name / f"{k:06d}.bin")
    velo_T_imu, cam_T_velo, P, _ = calibration_of(log)
    write_text(base / "oxts" / f"{name}.txt", "".join(_oxts(log, t_ns) + "\n" for t_ns in frames.tolist()))
    write_text(
        base / "calib" / f"{name}.txt",
        f"P2: {numbers(P)}\nR_rect {numbers(RECT_R_CAM)}\nTr_velo_cam {numbers(cam_T_velo[:3])}\nTr_imu_velo {numbers(velo_T_imu[:3])}\n",
    )
    write_text(base / "label_02" / f"{name}.txt", label_lines(log))
    return folder


def sweeps_of_frames(log: Log) -> list[int]:
    """Find the sweep that faces forward at each frame."""
    forward = log.streams[LIDAR].t_ns - HALF_TURN_NS
    return [int(i) for i in nearest_index(forward, log.streams[CAMERA].t_ns)]


def calibration_of(log: Log) -> tuple[Array, Array, Array, Array]:
    """Split the mounts into KITTI's chain: velo_T_imu, cam_T_velo of the unrectified camera 0, P2, and the image size."""
    camera, ego_T_velo = log.cameras[CAMERA], log.lidars[LIDAR].mount_T_lidar
    velo_T_imu = inverse(ego_T_velo) @ EGO_T_IMU
    rect_T_velo = inverse(CAM_T_RECT) @ inverse(camera.mount_T_cam) @ ego_T_velo
    cam_T_velo = transform(RECT_R_CAM.T, np.zeros(3)) @ rect_T_velo
    P = camera.K @ CAM_T_RECT[:3]
    return velo_T_imu, cam_T_velo, P, np.array([camera.width_px, camera.height_px], dtype=np.float64)


def _oxts(log: Log, t_ns: int) -> str:
    """Write one record of the IMU: Mercator coordinates scaled at the first fix, as the development kit defines the map."""
    assert log.ego is not None
    first, pose = (log.ego.at(t)[0][0] @ EGO_T_IMU for t in (int(log.streams[CAMERA].t_ns[0]), t_ns))
    scale = np.cos(np.radians(LATITUDE_DEG))
    east, north, up = pose[:3, 3] - first[:3, 3]
    longitude = LONGITUDE_DEG + np.degrees(east / (scale * EARTH_RADIUS_M))
    mercator = np.arctanh(np.sin(np.radians(LATITUDE_DEG))) + north / (scale * EARTH_RADIUS_M)
    latitude = np.degrees(np.arcsin(np.tanh(mercator)))
    roll, pitch = np.arctan2(pose[2, 1], pose[2, 2]), -np.arcsin(pose[2, 0])
    yaw = np.arctan2(pose[1, 0], pose[0, 0])
    return numbers(np.array([latitude, longitude, 110.0 + up, roll, pitch, yaw, *np.zeros(24)]))


def label_lines(log: Log) -> str:
    """Write the labels in view: frame, track, type, truncation, occlusion, alpha, image box, height width length, place, turn."""
    assert log.labels is not None
    camera, lines = log.cameras[CAMERA], []
    for frame, t_ns in enumerate(log.streams[CAMERA].t_ns.tolist()):
        map_T_cam = log.map_T_sensor(CAMERA, t_ns)[0][0]
        rect_T_map = inverse(map_T_cam @ CAM_T_RECT)
        for number, track in enumerate(np.unique(log.labels.track_id)):
            center, size, yaw = labels_at(log.labels, t_ns, str(track))
            seen = project_boxes(center, size[None], yaw, camera, inverse(map_T_cam))
            if not seen.valid[0]:
                continue
            bottom = apply(rect_T_map, center - [[0.0, 0.0, size[2] / 2]])[0]
            left_rear = box_corners(center, size, yaw)[0]
            ahead = rect_T_map[:3, :3] @ (left_rear[0] - left_rear[1])
            turn = np.arctan2(-ahead[2], ahead[0])
            kind = TYPE_OF[str(log.labels.category[log.labels.track_id == track][0])]
            values = [*seen.box_px[0], size[2], size[1], size[0], *bottom, turn]
            lines.append(f"{frame} {number} {kind} 0 0 0 {numbers(np.array(values))}\n")
    return "".join(lines)


def write_image(image: Array, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(path), image)


def _write_points(log: Log, index: int, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    xyz = log.streams[LIDAR].read(index).xyz_m
    np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4").tofile(path)


def _stamps(t_ns: Array) -> str:
    return "".join(str(t).replace("T", " ") + "\n" for t in t_ns.astype("datetime64[ns]"))


def numbers(values: Array) -> str:
    return " ".join(f"{v:.12e}" for v in np.asarray(values).ravel())


def write_text(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="ascii")
