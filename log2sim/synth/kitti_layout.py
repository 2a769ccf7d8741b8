"""KITTI's object detection layout: image_2, velodyne, calib and label_2 of a frame.

Labels are in the frame of R0_rect * Tr_velo_to_cam, which is level: y points down along gravity, so boxes stand upright in it.
A camera that looks down has its tilt in P2, which then is the intrinsics times a rotation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, apply, inverse, rotation_from_rpy, transform
from log2sim.synth.render import Visibility
from log2sim.synth.traffic import TrafficObject
from log2sim.synth.traffic_rig import FORWARD_R_CAM, Rig

FOLDERS = {"image_2": ".png", "velodyne": ".bin", "calib": ".txt", "label_2": ".txt"}
TYPES = {"car": "Car", "truck": "Truck", "pedestrian": "Pedestrian", "cyclist": "Cyclist"}
VAN, OTHER, DONT_CARE = "Van", "Misc", "DontCare"
MIN_VAN_HEIGHT_M = 2.1
# Less is a region to be ignored; a region of less than that is nothing.
MIN_LABEL_PX, MIN_REGION_PX, MIN_VISIBLE = 12.0, 5.0, 0.1
# Least visible share of what counts as fully visible and as partly hidden; below it is largely hidden.
OCCLUSION_LIMITS = (0.8, 0.4)
BOX_GRID = 7  # points along each edge of a box, for the share of it in the picture
PNG_COMPRESSION = 1
# The IMU of KITTI's car: the LiDAR is so far ahead of it and to its left, it is so high above the ground.
LIDAR_FROM_IMU_M, IMU_HEIGHT_M = (0.81, -0.32), 0.93


@dataclass(frozen=True, eq=False)
class KittiFrame:
    """One frame.

    Attributes
    ----------
    image : (H, W, 3) uint8
        BGR.
    points : (N, 4) float32
        x, y, z in m in the LiDAR's frame and intensity in [0, 1].
    calibration, labels : str
        Contents of the text files.
    """

    image: NDArray[np.uint8]
    points: NDArray[np.float32]
    calibration: str
    labels: str

    def write(self, folder: Path, index: int) -> None:
        """Write the four files of a frame below a folder such as `training`."""
        paths = {name: folder / name / f"{index:06d}{suffix}" for name, suffix in FOLDERS.items()}
        for path in paths.values():
            path.parent.mkdir(parents=True, exist_ok=True)
        encoded = cv2.imencode(".png", self.image, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])[1]
        paths["image_2"].write_bytes(encoded.tobytes())
        paths["velodyne"].write_bytes(self.points.astype("<f4").tobytes())
        paths["calib"].write_text(self.calibration, encoding="ascii")
        paths["label_2"].write_text(self.labels, encoding="ascii")


def calibration_text(rig: Rig) -> str:
    """Write a calibration file: P0 to P3, R0_rect, Tr_velo_to_cam, Tr_imu_to_velo."""
    cam_R_level = (inverse(rig.map_T_cam)[:3, :3] @ rig.map_T_level[:3, :3]).round(12) + 0.0
    P = np.column_stack([rig.camera.K @ cam_R_level, np.zeros(3)])
    level_T_lidar = inverse(rig.map_T_level) @ rig.map_T_lidar
    rows = {f"P{k}": P for k in range(4)}
    rows |= {"R0_rect": np.eye(3), "Tr_velo_to_cam": level_T_lidar[:3], "Tr_imu_to_velo": _lidar_T_imu(rig)[:3]}
    return "".join(f"{name}: {' '.join(f'{v:.12e}' for v in np.ravel(values))}\n" for name, values in rows.items())


def _lidar_T_imu(rig: Rig) -> Array:
    """Place KITTI's IMU, by which readers know how high the LiDAR is above the ground."""
    level = rig.map_T_level[:3, :3] @ FORWARD_R_CAM.T
    away = np.append(LIDAR_FROM_IMU_M, rig.lidar_height_m - IMU_HEIGHT_M)
    return np.asarray(inverse(transform(level.T @ rig.map_T_lidar[:3, :3], away)))


def label_text(objects: Sequence[TrafficObject], seen: Sequence[Visibility | None], rig: Rig) -> str:
    """Write a label file: road users, and as regions to be ignored those that are too small or hidden.

    Notes
    -----
    Truncation is the share of the box outside the picture. Occlusion is 0 where 80 % or more of the silhouette are visible,
    1 where 40 %, 2 below. The 2D box surrounds the whole silhouette in the picture, hidden parts too, as KITTI's do.
    """
    labels, regions = [], []
    for item, visibility in zip(objects, seen):
        if not item.category or visibility is None:
            continue
        left, top, right, bottom = visibility.silhouette_box_px - [0, 0, 1, 1]
        share = visibility.visible_px / visibility.silhouette_px
        box_2d = f"{left:.2f} {top:.2f} {right:.2f} {bottom:.2f}"
        if bottom - top >= MIN_LABEL_PX and share >= MIN_VISIBLE:
            labels.append(_label(item, share, box_2d, rig))
        elif bottom - top >= MIN_REGION_PX:
            regions.append(f"{DONT_CARE} -1 -1 -10 {box_2d} -1 -1 -1 -1000 -1000 -1000 -10\n")
    return "".join(labels + regions)


def kitti_type(item: TrafficObject) -> str:
    """KITTI's name of a road user's kind."""
    if item.category == "car" and item.size_m[2] >= MIN_VAN_HEIGHT_M:
        return VAN
    return TYPES.get(item.category, OTHER)


def _label(item: TrafficObject, share: float, box_2d: str, rig: Rig) -> str:
    level_T_map = inverse(rig.map_T_level)
    x, y, z = apply(level_T_map, item.position_m[None])[0]
    heading = level_T_map[:3, :3] @ np.array([np.cos(item.yaw_rad), np.sin(item.yaw_rad), 0.0])
    rotation = float(np.arctan2(-heading[2], heading[0]))
    alpha = (rotation - np.arctan2(x, z) + np.pi) % (2 * np.pi) - np.pi
    occlusion = int(np.sum(share < np.array(OCCLUSION_LIMITS)))
    length, width, height = item.size_m
    size = f"{height:.2f} {width:.2f} {length:.2f}"
    return (
        f"{kitti_type(item)} {truncation(item, rig):.2f} {occlusion} {alpha:.2f} {box_2d} {size} "
        f"{x:.2f} {y:.2f} {z:.2f} {rotation:.2f}\n"
    )


def truncation(item: TrafficObject, rig: Rig) -> float:
    """Share of an object's box that lies outside the picture."""
    steps = np.linspace(-0.5, 0.5, BOX_GRID)
    grid = np.stack(np.meshgrid(steps, steps, steps + 0.5, indexing="ij"), -1).reshape(-1, 3) * item.size_m
    map_T_item = transform(rotation_from_rpy(0.0, 0.0, item.yaw_rad), item.position_m)
    points = apply(inverse(rig.map_T_cam) @ map_T_item, grid)
    ahead = points[:, 2] > 0.1
    uv: Array = (
        points[:, :2] / np.where(ahead, points[:, 2], 1.0)[:, None] * np.diag(rig.camera.K)[:2] + rig.camera.K[:2, 2]
    )
    inside = ahead & np.all((uv >= -0.5) & (uv < [rig.camera.width_px - 0.5, rig.camera.height_px - 0.5]), axis=1)
    return float(1 - inside.mean())
