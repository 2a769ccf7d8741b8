"""KITTI's object layout, by the development kit's readme: single frames, each with its own calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import Array, transform
from log_encoders import kitti
from log_encoders.world import labels_at


def encode(log: Log, folder: Path) -> Path:
    """Write the frames of a log below `folder`/training; return `folder`."""
    base = folder / "training"
    velo_T_imu, cam_T_velo, P, _ = kitti.calibration_of(log)
    calibration = {
        "P2": P, "R0_rect": kitti.RECT_R_CAM, "Tr_velo_to_cam": cam_T_velo[:3], "Tr_imu_to_velo": velo_T_imu[:3]
    }  # fmt: skip
    labels = kitti.label_lines(log).splitlines()
    for k, sweep in enumerate(kitti.sweeps_of_frames(log)):
        kitti.write_image(log.streams[kitti.CAMERA].read(k), base / "image_2" / f"{k:06d}.png")
        _write_still_points(log, k, sweep, base / "velodyne" / f"{k:06d}.bin")
        text = "".join(f"{name}: {kitti.numbers(values)}\n" for name, values in calibration.items())
        kitti.write_text(base / "calib" / f"{k:06d}.txt", text)
        of_frame = [line.split(" ", 2)[2] for line in labels if line.split(" ", 1)[0] == str(k)]
        kitti.write_text(base / "label_2" / f"{k:06d}.txt", "".join(f"{line}\n" for line in of_frame))
    return folder


def _write_still_points(log: Log, frame: int, index: int, path: Path) -> None:
    """Write a sweep as if everything had stood still at its frame: the layout has no motion."""
    path.parent.mkdir(parents=True, exist_ok=True)
    sweep = log.streams[kitti.LIDAR].read(index)
    poses = log.map_T_sensor(kitti.LIDAR, sweep.t_ns)[0]
    xyz_map = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]
    t_ns = int(log.streams[kitti.CAMERA].t_ns[frame])
    xyz_map = moved_with_their_objects(log, xyz_map, sweep.t_ns, t_ns)
    pose = log.map_T_sensor(kitti.LIDAR, t_ns)[0][0]
    xyz = (xyz_map - pose[:3, 3]) @ pose[:3, :3]
    np.column_stack([xyz, np.zeros(len(xyz))]).astype("<f4").tofile(path)


def moved_with_their_objects(log: Log, xyz_map: Array, from_ns: Array, to_ns: int) -> Array:
    """Move points (N, 3) in the labeled boxes at their own times (N,) to where the boxes are at another stamp."""
    assert log.labels is not None
    out = xyz_map.copy()
    for track in np.unique(log.labels.track_id):
        center, size, yaw = labels_at(log.labels, from_ns, str(track))
        local = xyz_map - center
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = c * local[:, 0] + s * local[:, 1], c * local[:, 1] - s * local[:, 0]
        inside = (np.abs(np.stack([along, across, local[:, 2]], 1)) <= size / 2 + 0.03).all(axis=1)
        to, _, turn = labels_at(log.labels, to_ns, str(track))
        pose = transform(
            np.array([[np.cos(turn[0]), -np.sin(turn[0]), 0], [np.sin(turn[0]), np.cos(turn[0]), 0], [0, 0, 1]]), to[0]
        )
        out[inside] = np.stack([along, across, local[:, 2]], 1)[inside] @ pose[:3, :3].T + pose[:3, 3]
    return out
