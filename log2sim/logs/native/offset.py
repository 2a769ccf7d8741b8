"""Whole kilometers by which a log with large map coordinates is shifted, so that the rest keeps its digits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from log2sim.datatypes import Labels, Lidar
from log2sim.geometry import Array, Camera, PoseTrack, shift_poses

OFFSET_STEP_M = 1000.0


def offset_of(track: PoseTrack | None, sensors: list[Camera | Lidar], labels: Labels | None) -> Array:
    """Choose the whole kilometers (3,), m, by which a log is shifted towards the map's origin."""
    if track is not None:
        first = track.map_T_ego[0, :3, 3]
    else:
        positions = [_mount_T(s)[:3, 3] for s in sensors if s.mount == "map"]
        first = (
            positions[0]
            if positions
            else labels.center_m[0]
            if labels is not None and len(labels.t_ns)
            else np.zeros(3)
        )
    return OFFSET_STEP_M * np.round(first / OFFSET_STEP_M) + 0.0


def _mount_T(sensor: Camera | Lidar) -> Array:
    return sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar


def shifted_camera(camera: Camera, offset: Array) -> Camera:
    """Shift a camera that is fixed in the map."""
    return camera if camera.mount == "ego" else replace(camera, mount_T_cam=shift_poses(camera.mount_T_cam, offset))


def shifted_lidar(lidar: Lidar, offset: Array) -> Lidar:
    """Shift a LiDAR that is fixed in the map."""
    return lidar if lidar.mount == "ego" else Lidar(lidar.name, lidar.mount, shift_poses(lidar.mount_T_lidar, offset))


def shifted_labels(labels: Labels, offset: Array) -> Labels:
    """Shift labels."""
    return replace(labels, center_m=labels.center_m - offset)
