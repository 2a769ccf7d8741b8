"""nuScenes, version 1.0, by the schema of its development kit: tables of flat records, samples and sweeps.

Points are written as a Velodyne HDL-32E fires: 32 rings in turn every 46.08 us up to the stamp, all in the frame of the
LiDAR at the stamp (x right, y forward), rays without a return at range 0.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Log
from log2sim.geometry import Array, apply, inverse, quaternion_from_rotation, rotation_from_rpy, transform
from log_encoders.world import labels_at, make_world

FIRINGS, RINGS, FIRING_NS, TURN_NS = 1085, 32, 46_080, 50_000_000
# Of the world's LiDAR: the firings of its view, of which it has every third.
VIEW_FIRINGS, FIRING_STEP = 543, 3
KIND_OF = {
    "car": "vehicle.car", "truck": "vehicle.truck", "bus": "vehicle.bus.rigid", "motorcycle": "vehicle.motorcycle",
    "bicycle": "vehicle.bicycle", "cyclist": "vehicle.bicycle", "pedestrian": "human.pedestrian.adult",
    "other": "vehicle.trailer",
}  # fmt: skip
TABLES = (
    "attribute", "calibrated_sensor", "category", "ego_pose", "instance", "log", "map", "sample", "sample_annotation",
    "sample_data", "scene", "sensor", "visibility",
)  # fmt: skip
# The axes of the LiDAR of nuScenes in those of the world's, which has x forward and y left.
WORLD_T_LIDAR = transform(rotation_from_rpy(0.0, 0.0, -np.pi / 2), np.zeros(3))


@cache
def hdl32_world() -> Log:
    """The world of the other encoders; its LiDAR has 32 rings and sees a quarter of a circle in half a turn's time."""
    view_deg = 180.0 * 10.0 * VIEW_FIRINGS * FIRING_NS / 1e9
    lidar = {
        "name": "top", "position_m": [0.75, 0.0, 2.125], "channels": RINGS, "elevation_deg": [-20.0, 2.0],
        "azimuth_deg": [-view_deg, view_deg], "azimuth_step_deg": 2 * view_deg * FIRING_STEP / VIEW_FIRINGS,
        "range_m": 60.0,
    }  # fmt: skip
    return make_world(lidar=[lidar])


def encode_world(log: Log, folder: Path) -> Path:
    """Write the world by its name; every record is a key frame."""
    return encode(replace(hdl32_world(), name=log.name), folder)


def encode(log: Log, folder: Path, *, key_every: int = 1, version: str = "v1.0-mini") -> Path:
    """Write a log as a scene below `folder`, beside those that are there; every so many LiDAR sweeps are key frames."""
    scene = _Scene(log, folder, folder / version)
    for name in log.lidars:
        scene.write_sensor(name, "lidar", key_every)
    for name in log.cameras:
        scene.write_sensor(name, "camera", key_every)
    scene.write_radar()
    scene.write_samples(key_every)
    scene.write_annotations()
    scene.save()
    return folder


class _Scene:
    """A scene while it is written."""

    def __init__(self, log: Log, root: Path, tables: Path) -> None:
        self.log, self.root, self.folder = log, root, tables
        self.rows: dict[str, list[dict[str, Any]]] = {name: [] for name in TABLES}
        reference = next(iter(log.lidars or log.cameras))
        self.stamps_ns = log.streams[reference].t_ns
        self.lidar = next(iter(log.lidars), None)

    def token(self, *words: object) -> str:
        return hashlib.md5("/".join([self.log.name, *map(str, words)]).encode()).hexdigest()

    def write_sensor(self, name: str, modality: str, key_every: int) -> None:
        camera = self.log.cameras.get(name)
        mount = camera.mount_T_cam if camera else self.log.lidars[name].mount_T_lidar @ WORLD_T_LIDAR
        self.calibrate(name, modality, mount, camera.K.tolist() if camera else [])
        stream = self.log.streams[name]
        for k, t_ns in enumerate(stream.t_ns.tolist()):
            key = k % key_every == 0
            suffix = "png" if camera else "pcd.bin"
            relative = f"{'samples' if key else 'sweeps'}/{name}/{self.log.name}__{name}__{t_ns // 1000}.{suffix}"
            (self.root / relative).parent.mkdir(parents=True, exist_ok=True)
            if camera:
                import cv2

                cv2.imwrite(str(self.root / relative), stream.read(k))
            else:
                pcd_bin(self.log, name, k).tofile(self.root / relative)
            size = (camera.width_px, camera.height_px) if camera else (0, 0)
            self.add_record(name, t_ns, relative, key, size)

    def write_radar(self) -> None:
        """Two records of a radar, whose files log2sim does not open."""
        self.calibrate("RADAR_FRONT", "radar", np.eye(4), [])
        for t_ns in self.stamps_ns[:2].tolist():
            self.add_record("RADAR_FRONT", t_ns, f"samples/RADAR_FRONT/{t_ns // 1000}.pcd", True, (0, 0))

    def calibrate(self, name: str, modality: str, mount: Array, K: list[list[float]]) -> None:
        sensor = self.token("sensor", name)
        self.rows["sensor"].append({"token": sensor, "channel": name, "modality": modality})
        pose = {"translation": mount[:3, 3].tolist(), "rotation": quaternion_from_rotation(mount[:3, :3]).tolist()}
        token = self.token("calibration", name)
        self.rows["calibrated_sensor"].append({"token": token, "sensor_token": sensor, **pose, "camera_intrinsic": K})

    def add_record(self, name: str, t_ns: int, filename: str, key: bool, size_px: tuple[int, int]) -> None:
        assert self.log.ego is not None
        pose = self.log.ego.at(t_ns)[0][0]
        token = self.token(name, t_ns)
        self.rows["ego_pose"].append(
            {"token": token, "timestamp": t_ns // 1000, "rotation": quaternion_from_rotation(pose[:3, :3]).tolist(),
             "translation": pose[:3, 3].tolist()}
        )  # fmt: skip
        self.rows["sample_data"].append(
            {"token": token, "sample_token": t_ns, "ego_pose_token": token,
             "calibrated_sensor_token": self.token("calibration", name), "timestamp": t_ns // 1000,
             "fileformat": filename.rpartition(".")[2], "is_key_frame": key, "height": size_px[1], "width": size_px[0],
             "filename": filename, "prev": "", "next": ""}
        )  # fmt: skip

    def write_samples(self, key_every: int) -> None:
        """Key frames; records belong to the first sample that is not earlier, the last ones to the last."""
        self.samples = self.stamps_ns[::key_every]
        tokens = [self.token("sample", t_ns) for t_ns in self.samples.tolist()]
        for k, (t_ns, token) in enumerate(zip(self.samples.tolist(), tokens)):
            self.rows["sample"].append(
                {"token": token, "timestamp": t_ns // 1000, "prev": tokens[k - 1] if k else "",
                 "next": tokens[k + 1] if k + 1 < len(tokens) else "", "scene_token": self.token("scene")}
            )  # fmt: skip
        for row in self.rows["sample_data"]:
            row["sample_token"] = tokens[min(int(np.searchsorted(self.samples, row["sample_token"])), len(tokens) - 1)]
        scene = {
            "token": self.token("scene"), "log_token": self.token("log"), "nbr_samples": len(tokens),
            "name": self.log.name, "description": "{a} \"world\"", "first_sample_token": tokens[0], "last_sample_token": tokens[-1],
        }  # fmt: skip
        self.rows["scene"].append(scene)
        self.rows["log"].append(
            {"token": self.token("log"), "logfile": "", "vehicle": "n000", "location": "boston-seaport"}
        )

    def write_annotations(self) -> None:
        """One annotation for each track and sample, where the LiDAR saw it in its turn."""
        for name in ("cycle.with_rider", "cycle.without_rider", "vehicle.moving"):
            self.rows["attribute"].append({"token": self.token("attribute", name), "name": name, "description": ""})
        for kind in sorted(set(KIND_OF.values())):
            self.rows["category"].append({"token": self.token("category", kind), "name": kind, "description": ""})
        labels = self.log.labels
        for track in [] if labels is None else np.unique(labels.track_id):
            category = str(labels.category[labels.track_id == track][0])
            instance = self.token("instance", track)
            for t_ns in self.samples.tolist():
                self.rows["sample_annotation"].append(self.annotation(str(track), category, t_ns))
            self.rows["instance"].append(
                {"token": instance, "category_token": self.token("category", KIND_OF[category]),
                 "nbr_annotations": len(self.samples)}
            )  # fmt: skip

    def annotation(self, track: str, category: str, stamp_ns: int) -> dict[str, Any]:
        assert self.log.labels is not None
        t_ns = stamp_ns
        for _ in range(5 if self.lidar else 0):
            center, _, _ = labels_at(self.log.labels, t_ns, track)
            t_ns = stamp_ns + turn_offset_ns(self.log, str(self.lidar), stamp_ns, center[0])
        center, size, yaw = labels_at(self.log.labels, t_ns, track)
        rider = {"cyclist": "cycle.with_rider", "bicycle": "cycle.without_rider"}.get(category)
        return {
            "token": self.token(track, stamp_ns), "sample_token": self.token("sample", stamp_ns),
            "instance_token": self.token("instance", track), "visibility_token": "4",
            "attribute_tokens": [self.token("attribute", rider)] if rider else [],
            "translation": center[0].tolist(), "size": [size[1], size[0], size[2]],
            "rotation": [float(np.cos(yaw[0] / 2)), 0.0, 0.0, float(np.sin(yaw[0] / 2))], "prev": "", "next": "",
            "num_lidar_pts": 9, "num_radar_pts": 0,
        }  # fmt: skip

    def save(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for name, rows in self.rows.items():
            path = self.folder / f"{name}.json"
            there = json.loads(path.read_text()) if path.is_file() else []
            path.write_text(json.dumps(there + rows, indent=0))


def turn_offset_ns(log: Log, lidar: str, stamp_ns: int, place: Array) -> int:
    """When a turn that ends at a stamp, clockwise from the left, passes a place (3,) in the map."""
    map_T_lidar = log.map_T_sensor(lidar, stamp_ns)[0][0] @ WORLD_T_LIDAR
    right, ahead, _ = apply(inverse(map_T_lidar), place[None])[0]
    from_left = np.arctan2(ahead, -right) % (2 * np.pi)
    return round((from_left / (2 * np.pi) - 1) * TURN_NS)


def pcd_bin(log: Log, lidar: str, k: int) -> np.ndarray:
    """Rows (N, 5) float32 of a sweep in the order of firing: x, y, z, intensity, ring."""
    sweep = log.streams[lidar].read(k)
    assert sweep.t_ns is not None
    firing = FIRINGS - 1 + np.round((sweep.t_ns - sweep.stamp_ns) / FIRING_NS).astype(int)
    angle = np.arctan2(sweep.xyz_m[:, 2], np.hypot(*sweep.xyz_m[:, :2].T))
    ring = rank(np.round(angle / 2e-3))
    assert firing.min() >= 0, "the sweep lasts longer than a turn"
    stamp_T_map = inverse(log.map_T_sensor(lidar, sweep.stamp_ns)[0][0] @ WORLD_T_LIDAR)
    times = sweep.stamp_ns + (np.arange(FIRINGS) - FIRINGS + 1) * FIRING_NS
    path = apply(stamp_T_map, log.map_T_sensor(lidar, times)[0][:, :3, 3])
    rows = np.zeros((FIRINGS, RINGS, 5), dtype="<f4")
    rows[..., :3], rows[..., 4] = path[:, None], np.arange(RINGS)
    poses = log.map_T_sensor(lidar, sweep.t_ns)[0]
    in_map = np.einsum("nij,nj->ni", poses[:, :3, :3], sweep.xyz_m) + poses[:, :3, 3]
    rows[firing, ring, :3] = apply(stamp_T_map, in_map)
    return rows.reshape(-1, 5)


def rank(values: Iterable[float]) -> np.ndarray:
    """Number of each value among the different ones."""
    return np.unique(np.asarray(values), return_inverse=True)[1]
