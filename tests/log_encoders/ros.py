"""ROS 1 bags, rosbag2 databases and MCAP, written by rosbags from the published message definitions."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as BagWriter
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Rosbag2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from log2sim.datatypes import Log
from log2sim.geometry import Array, Camera, inverse, quaternion_from_rotation
from log2sim.logs.stamps import geodetic_from_map

# From the stamp in the header to the recorder, by kind of message: messages are not recorded in the order of their stamps.
IMAGE_DELAY_NS, OTHER_DELAY_NS = 60_000_000, 5_000_000
LENS = {"none": "plumb_bob", "brown": "plumb_bob", "fisheye": "equidistant"}
POINT_FIELDS = {"f4": 7, "f8": 8, "u2": 4, "i4": 5}
Message = tuple[int, int, str, str, Any]


@dataclass(frozen=True)
class Style:
    """How a log is written.

    `container` is "bag", "db3" or "mcap", `compression` of its chunks or messages "", "lz4", "bz2", "storage" or "message";
    `poses` is "tf", "odometry", "pose", "covariance", "gnss" or "none"; with GNSS `ego_T_base` places the IMU, which is then the only frame
    of the vehicle unless `base_T_imu` and `base_T_antenna` name two others. `raw` images are of this encoding; "" writes PNG files.
    """

    container: str = "mcap"
    compression: str = ""
    poses: str = "tf"
    ego_T_base: Array | None = None
    raw: str = ""
    point_times: bool = True
    base_T_imu: Array | None = None
    base_T_antenna: Array | None = None

    @property
    def base(self) -> str:
        return "base_link" if self.ego_T_base is None else "imu"


def encode(log: Log, folder: Path) -> Path:
    """Write a log as an MCAP file `folder`/its name.mcap."""
    return encode_as(log, folder, Style())


def encode_as(log: Log, folder: Path, style: Style) -> Path:
    """Write a log in a style; the path is a file for a bag and for MCAP, a folder with metadata.yaml for a database."""
    return write(Maker(log, style), folder, log.name, style)


def write(messages: Iterator[Message] | Maker, folder: Path, name: str, style: Style, stores: Any = None) -> Path:
    """Write messages (stamp, recorder's stamp, topic, type, message) in the order of the recorder."""
    folder.mkdir(parents=True, exist_ok=True)
    ros1 = style.container == "bag"
    store = stores or typestore(ros1)
    if ros1:
        path = folder / f"{name}.bag"
        writer: Any = BagWriter(path)
        if style.compression:
            writer.set_compression(BagWriter.CompressionFormat[style.compression.upper()])
    else:
        path = folder / f"{name}_{style.container}"
        plugin = StoragePlugin.SQLITE3 if style.container == "db3" else StoragePlugin.MCAP
        writer = Rosbag2Writer(path, version=9, storage_plugin=plugin)
        if style.compression:
            writer.set_compression(CompressionMode[style.compression.upper()], CompressionFormat.ZSTD)
    connections: dict[str, Any] = {}
    with writer:
        for _, recorded, topic, kind, message in sorted(messages, key=lambda m: m[1]):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(message, kind) if ros1 else store.serialize_cdr(message, kind)
            writer.write(connections[topic], recorded, data)
    if style.container != "mcap":
        return path
    # As an MCAP file alone, as most tools write it.
    file = folder / f"{name}.mcap"
    (path / f"{path.name}.mcap").rename(file)
    (path / "metadata.yaml").unlink()
    path.rmdir()
    return file


def typestore(ros1: bool) -> Any:
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    if ros1:
        kind = "tf2_msgs/msg/TFMessage"
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", kind))
    return store


class Maker:
    """The messages of a log."""

    def __init__(self, log: Log, style: Style) -> None:
        self.log, self.style, self.ros1 = log, style, style.container == "bag"
        self.types = typestore(self.ros1).types
        self.ego_T_base = np.eye(4) if style.ego_T_base is None else style.ego_T_base

    def __iter__(self) -> Iterator[Message]:
        yield from self.static()
        for name in self.log.lidars:
            for i, t_ns in enumerate(self.log.streams[name].t_ns.tolist()):
                yield self.message(t_ns, f"/{name}/points", "sensor_msgs/msg/PointCloud2", self.cloud(name, i))
        for name in self.log.cameras:
            for i, t_ns in enumerate(self.log.streams[name].t_ns.tolist()):
                yield self.message(t_ns, f"/{name}/camera_info", "sensor_msgs/msg/CameraInfo", self.info(name, t_ns))
                kind = "Image" if self.style.raw else "CompressedImage"
                topic = f"/{name}/image_raw" + "/compressed" * (not self.style.raw)
                yield self.message(t_ns, topic, f"sensor_msgs/msg/{kind}", self.image(name, i), IMAGE_DELAY_NS)
        yield from self.poses()

    def message(self, t_ns: int, topic: str, kind: str, message: Any, delay_ns: int = OTHER_DELAY_NS) -> Message:
        return t_ns, t_ns + delay_ns, topic, kind, message

    def make(self, name: str, /, **values: Any) -> Any:
        return self.types[name](**values)

    def header(self, t_ns: int, frame: str) -> Any:
        stamp = self.make("builtin_interfaces/msg/Time", sec=t_ns // 10**9, nanosec=t_ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame, **({"seq": 0} if self.ros1 else {}))

    def vector(self, v: Array, kind: str = "Vector3") -> Any:
        return self.make(f"geometry_msgs/msg/{kind}", x=float(v[0]), y=float(v[1]), z=float(v[2]))

    def quaternion(self, rotation: Array) -> Any:
        w, x, y, z = quaternion_from_rotation(rotation).tolist()
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def transform(self, t_ns: int, parent: str, child: str, pose: Array) -> Any:
        value = self.make(
            "geometry_msgs/msg/Transform", translation=self.vector(pose[:3, 3]), rotation=self.quaternion(pose[:3, :3])
        )
        return self.make(
            "geometry_msgs/msg/TransformStamped",
            header=self.header(t_ns, parent),
            child_frame_id=child,
            transform=value,
        )

    def transforms(self, *transforms: Any) -> Any:
        return self.make("tf2_msgs/msg/TFMessage", transforms=list(transforms))

    def pose(self, pose: Array) -> Any:
        position, orientation = self.vector(pose[:3, 3], "Point"), self.quaternion(pose[:3, :3])
        return self.make("geometry_msgs/msg/Pose", position=position, orientation=orientation)

    def static(self) -> Iterator[Message]:
        begin = min(int(stream.t_ns[0]) for stream in self.log.streams.values())
        base_T_ego = inverse(self.ego_T_base)
        mounts = {n: c.mount_T_cam for n, c in self.log.cameras.items()}
        mounts |= {n: s.mount_T_lidar for n, s in self.log.lidars.items()}
        links = [self.transform(begin, self.style.base, name, base_T_ego @ mount) for name, mount in mounts.items()]
        for frame, pose in (("imu", self.style.base_T_imu), ("antenna", self.style.base_T_antenna)):
            links += [] if pose is None else [self.transform(begin, self.style.base, frame, pose)]
        yield self.message(begin, "/tf_static", "tf2_msgs/msg/TFMessage", self.transforms(*links))

    def cloud(self, name: str, i: int) -> Any:
        sweep = self.log.streams[name].read(i)
        number = "f8" if sweep.xyz_m.dtype == np.float64 else "f4"
        kinds = {"x": number, "y": number, "z": number, "intensity": "f4", "ring": "u2"}
        if self.style.point_times and sweep.t_ns is not None:
            kinds["t"] = "i4"
        table = np.zeros(len(sweep.xyz_m), np.dtype(list(kinds.items())))
        for k, axis in enumerate("xyz"):
            table[axis] = sweep.xyz_m[:, k]
        if "t" in kinds:
            table["t"] = sweep.t_ns - sweep.stamp_ns
        fields = [
            self.make(
                "sensor_msgs/msg/PointField", name=field, offset=table.dtype.fields[field][1], datatype=POINT_FIELDS[kind], count=1
            )
            for field, kind in kinds.items()
        ]  # fmt: skip
        return self.make(
            "sensor_msgs/msg/PointCloud2", header=self.header(sweep.stamp_ns, name), height=1, width=len(table), fields=fields,
            is_bigendian=False, point_step=table.dtype.itemsize, row_step=table.nbytes, data=np.frombuffer(table.tobytes(), np.uint8),
            is_dense=True,
        )  # fmt: skip

    def info(self, name: str, t_ns: int) -> Any:
        camera: Camera = self.log.cameras[name]
        P = np.column_stack([camera.K, np.zeros(3)])
        values = [np.array(camera.distortion or np.zeros(5)), camera.K.ravel(), np.eye(3).ravel(), P.ravel()]
        names = "DKRP" if self.ros1 else "dkrp"
        region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        return self.make(
            "sensor_msgs/msg/CameraInfo", header=self.header(t_ns, name), height=camera.height_px, width=camera.width_px,
            distortion_model=LENS[camera.distortion_model], binning_x=0, binning_y=0,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **region), **dict(zip(names, values)),
        )  # fmt: skip

    def image(self, name: str, i: int) -> Any:
        stream = self.log.streams[name]
        header = self.header(int(stream.t_ns[i]), name)
        if not self.style.raw:
            data = stream.encoded(i) if stream.encoded else cv2.imencode(".png", stream.read(i))[1].tobytes()
            kind = "png" if data[:1] == b"\x89" else "jpeg"
            return self.make(
                "sensor_msgs/msg/CompressedImage", header=header, format=f"bgr8; {kind} compressed bgr8",
                data=np.frombuffer(data, np.uint8),
            )  # fmt: skip
        image = stream.read(i)
        pixels = image[..., ::-1] if self.style.raw == "rgb8" else image
        return self.make(
            "sensor_msgs/msg/Image", header=header, height=image.shape[0], width=image.shape[1], encoding=self.style.raw,
            is_bigendian=0, step=image.shape[1] * 3, data=np.ascontiguousarray(pixels).ravel(),
        )  # fmt: skip

    def poses(self) -> Iterator[Message]:
        log, kind = self.log, self.style.poses
        if log.ego is None or kind == "none":
            return
        poses = log.ego.map_T_ego @ self.ego_T_base
        if kind == "gnss":
            yield from self.fixes(poses)
            return
        zero = np.zeros(36)
        for t_ns, pose in zip(log.ego.t_ns.tolist(), poses):
            header = self.header(t_ns, "map")
            if kind == "tf":
                message = self.transforms(self.transform(t_ns, "map", self.style.base, pose))
                yield self.message(t_ns, "/tf", "tf2_msgs/msg/TFMessage", message)
            elif kind == "covariance":
                stated = self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(pose), covariance=zero)
                name = "geometry_msgs/msg/PoseWithCovarianceStamped"
                yield self.message(t_ns, "/localization/pose", name, self.make(name, header=header, pose=stated))
            elif kind == "pose":
                message = self.make("geometry_msgs/msg/PoseStamped", header=header, pose=self.pose(pose))
                yield self.message(t_ns, "/localization/pose", "geometry_msgs/msg/PoseStamped", message)
            else:
                still = self.make("geometry_msgs/msg/Twist", linear=self.vector(zero), angular=self.vector(zero))
                message = self.make(
                    "nav_msgs/msg/Odometry", header=header, child_frame_id=self.style.base,
                    pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=self.pose(pose), covariance=zero),
                    twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=still, covariance=zero),
                )  # fmt: skip
                yield self.message(t_ns, "/odometry", "nav_msgs/msg/Odometry", message)

    def fixes(self, poses: Array) -> Iterator[Message]:
        assert self.log.ego is not None
        base_T_imu, base_T_antenna = self.style.base_T_imu, self.style.base_T_antenna
        imu = poses if base_T_imu is None else poses @ base_T_imu
        antenna = poses if base_T_antenna is None else poses @ base_T_antenna
        latitude, longitude, altitude, convergence = geodetic_from_map(self.log.map, antenna[:, :3, 3], "map")
        frames = (
            (self.style.base if base_T_imu is None else "imu"),
            (self.style.base if base_T_antenna is None else "antenna"),
        )
        zero = np.zeros(9)
        for k, t_ns in enumerate(self.log.ego.t_ns.tolist()):
            turn = np.array([
                [np.cos(convergence[k]), np.sin(convergence[k]), 0.0], [-np.sin(convergence[k]), np.cos(convergence[k]), 0.0],
                [0.0, 0.0, 1.0],
            ])  # fmt: skip
            heads = [self.header(t_ns, frame) for frame in frames]
            attitude = self.make(
                "sensor_msgs/msg/Imu", header=heads[0], orientation=self.quaternion(turn @ imu[k, :3, :3]),
                orientation_covariance=zero, angular_velocity=self.vector(zero), angular_velocity_covariance=zero,
                linear_acceleration=self.vector(zero), linear_acceleration_covariance=zero,
            )  # fmt: skip
            yield self.message(t_ns, "/gnss/imu", "sensor_msgs/msg/Imu", attitude)
            status = self.make("sensor_msgs/msg/NavSatStatus", status=0, service=1)
            fix = self.make(
                "sensor_msgs/msg/NavSatFix", header=heads[1], status=status, latitude=float(latitude[k]),
                longitude=float(longitude[k]), altitude=float(altitude[k]), position_covariance=zero, position_covariance_type=0,
            )  # fmt: skip
            yield self.message(t_ns, "/gnss/fix", "sensor_msgs/msg/NavSatFix", fix)


def settings_of(log: Log, style: Style) -> str:
    """The settings that tell what a bag does not: the ego, its place in the frame of the vehicle, the map."""
    size, ego_T_base = log.ego_vehicle.size_m, np.eye(4) if style.ego_T_base is None else style.ego_T_base
    origin = inverse(ego_T_base)[:3, 3].tolist()
    lines = [
        "[ego]", f'base_frame = "{style.base}"', f"origin_m = {origin}", f"ground_z_m = {float(log.ground_z_ego_m)!r}",
        f"size_m = {[float(v) for v in size]}", f"rear_axle_offset_m = {float(log.ego_vehicle.rear_axle_offset_m)!r}", "[map]",
    ]  # fmt: skip
    lines += [f"{key} = {float(value)!r}" for key in ("latitude_deg", "longitude_deg", "altitude_m") if (value := getattr(log.map, key)) is not None]  # fmt: skip
    lines += [f'projection = "{log.map.projection}"'] if log.map.projection else []
    return "\n".join(lines) + "\n"
