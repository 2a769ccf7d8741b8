"""Waymo Open Dataset, version 1: TFRecords of Frame messages, by dataset.proto and label.proto."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels, Log
from log2sim.geometry import (
    NS_PER_S,
    Array,
    Camera,
    apply,
    inverse,
    project_boxes,
    rotation_from_rpy,
    transform,
    yaw_of,
)
from log2sim.logs.waymo.messages import masked_crc32c
from log_encoders.world import labels_at

PERIOD_NS = 100_000_000
# The world of the log, far from its map's zero as the data set's worlds are.
WORLD_OFFSET_M = np.array([-25000.0, 42000.0, 0.0])
# The frame of the TOP LiDAR is turned on its vehicle by so much.
TOP_TURNED_RAD = np.deg2rad(148.0)
# After the stamp of an image its pose is taken.
POSE_LAG_NS = 2_000_000
SHUTTER_S, HALF_EXPOSED_S = 0.003, 0.023
TOP, GLOBAL_SHUTTER = 1, 5
TYPE_OF = {"car": 1, "truck": 1, "bus": 1, "pedestrian": 2, "cyclist": 4}
SIGN = 3
OPENCV_T_CAMERA = transform(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))


@dataclass(eq=False)
class Ranges:
    """Range images (H, W, 4) of both returns and poses (H, W, 6) of the pixels of one LiDAR."""

    returns: list[NDArray[np.float32]]
    poses: NDArray[np.float32] | None = None


@dataclass(eq=False)
class Image:
    jpeg: bytes
    world_T_vehicle: Array
    pose_s: float
    trigger_s: float
    readout_done_s: float


@dataclass(eq=False)
class Box:
    track_id: str
    kind: int
    center: Array
    size: Array  # length, width[, height]
    heading_rad: float = 0.0


@dataclass(eq=False)
class Frame:
    stamp_us: int
    world_T_vehicle: Array
    images: dict[int, Image] = field(default_factory=dict)
    lasers: dict[int, Ranges] = field(default_factory=dict)
    labels: list[Box] = field(default_factory=list)
    projected: dict[int, list[Box]] = field(default_factory=dict)


@dataclass(eq=False)
class Laser:
    vehicle_T_lidar: Array
    inclinations: Array
    limits: tuple[float, float] = (0.0, 0.0)


@dataclass(eq=False)
class Segment:
    name: str
    cameras: dict[int, tuple[Camera, int]]  # with the direction of the rolling shutter
    lasers: dict[int, Laser]
    frames: list[Frame]


def encode(log: Log, folder: Path) -> Path:
    """Write a log as a file of one segment; its LiDAR must turn clockwise, its cameras have global shutters."""
    segment = segment_of(log)
    path = folder / f"segment-{segment.name}_with_camera_labels.tfrecord"
    folder.mkdir(parents=True, exist_ok=True)
    path.write_bytes(b"".join(record(frame_message(segment, frame)) for frame in segment.frames))
    return path


def segment_of(log: Log) -> Segment:
    """Sort the records of a log into frames, one for each sweep."""
    lidar = next(iter(log.lidars))
    mount = log.lidars[lidar].mount_T_lidar @ transform(rotation_from_rpy(0.0, 0.0, TOP_TURNED_RAD), np.zeros(3))
    inclinations, width = ray_grid(log.streams[lidar].read(0).xyz_m)
    laser = Laser(mount, inclinations)
    cameras = {number: (camera, GLOBAL_SHUTTER) for number, camera in enumerate(log.cameras.values(), start=1)}
    frames = []
    for k, stamp in enumerate(log.streams[lidar].t_ns.tolist()):
        start_ns = stamp - PERIOD_NS
        pose_ns = pose_stamp(log, start_ns)
        frame = Frame(start_ns // 1000, world_pose(log, pose_ns))
        frame.lasers[TOP] = top_ranges(log, lidar, k, laser, width)
        for number, (camera, _) in cameras.items():
            add_image(log, camera, number, start_ns, frame)
        frame.labels = boxes(log, start_ns, frame.world_T_vehicle, mount)
        frames.append(frame)
    return Segment(f"{log.name}_0_000_20_000", cameras, {TOP: laser}, frames)


def pose_stamp(log: Log, start_ns: int) -> int:
    """Stamp of the pose that defines a frame: that of the first camera's image, or the middle of the frame."""
    for camera in log.cameras:
        stamps = log.streams[camera].t_ns
        inside = stamps[(stamps >= start_ns) & (stamps < start_ns + PERIOD_NS)]
        if len(inside):
            return int(inside[0]) + POSE_LAG_NS
    return start_ns + PERIOD_NS // 2


def world_pose(log: Log, t_ns: Any) -> Array:
    """Pose (4, 4) of the ego in the world, or poses (N, 4, 4)."""
    assert log.ego is not None
    poses = log.ego.at(t_ns)[0]
    poses[:, :3, 3] += WORLD_OFFSET_M
    return poses if np.ndim(t_ns) else poses[0]


def ray_grid(xyz: Array) -> tuple[Array, int]:
    """Inclinations of the beams from the lowest up, and the number of columns, of a cloud cast in a regular pattern."""
    x, y, z = np.asarray(xyz, dtype=np.float64).T
    azimuth = groups(np.arctan2(y, x), 1e-4)
    return groups(np.arctan2(z, np.hypot(x, y)), 5e-4), round(2 * np.pi / np.diff(azimuth).min())


def groups(values: Array, gap: float) -> Array:
    """Means of values that are less than `gap` apart when sorted."""
    ordered = np.sort(values)
    return np.array([part.mean() for part in np.split(ordered, np.flatnonzero(np.diff(ordered) > gap) + 1)])


def top_ranges(log: Log, lidar: str, k: int, laser: Laser, width: int) -> Ranges:
    """Sort the points of a sweep into pixels, every fifth as second return; poses are those at the points' own times."""
    sweep = log.streams[lidar].read(k)
    x, y, z = np.asarray(sweep.xyz_m, dtype=np.float64).T
    # The points are at their own times in the frame that is not turned; columns are even in the vehicle's azimuth.
    yaw = yaw_of(laser.vehicle_T_lidar) - TOP_TURNED_RAD
    column = np.round(np.mod(np.pi - np.arctan2(y, x) - yaw, 2 * np.pi) / (2 * np.pi) * width - 0.5).astype(int) % width
    row = (
        len(laser.inclinations) - 1 - np.abs(np.arctan2(z, np.hypot(x, y))[:, None] - laser.inclinations).argmin(axis=1)
    )
    assert len(np.unique(row * width + column)) == len(row), "the pattern of the LiDAR is no range image"
    shape = (len(laser.inclinations), width)
    returns = [np.full((*shape, 4), -1.0, np.float32) for _ in range(2)]
    for number, image in enumerate(returns):
        chosen = (np.arange(len(x)) % 5 == 0) == (number == 1)
        # Intensity and elongation, which no reader needs.
        image[..., 1:3] = np.random.default_rng([k, number]).random((*shape, 2))
        image[row[chosen], column[chosen], 0] = np.sqrt(x * x + y * y + z * z)[chosen]
    poses = np.zeros((*shape, 6), np.float32)
    assert sweep.t_ns is not None
    poses[row, column] = roll_pitch_yaw_xyz(world_pose(log, sweep.t_ns))
    return Ranges(returns, poses)


def roll_pitch_yaw_xyz(poses: Array) -> Array:
    """Numbers (N, 6) of poses (N, 4, 4) by Rz(yaw) Ry(pitch) Rx(roll)."""
    r = poses[:, :3, :3]
    roll, pitch = np.arctan2(r[:, 2, 1], r[:, 2, 2]), -np.arcsin(r[:, 2, 0])
    return np.column_stack([roll, pitch, np.arctan2(r[:, 1, 0], r[:, 0, 0]), poses[:, :3, 3]])


def add_image(log: Log, camera: Camera, number: int, start_ns: int, frame: Frame) -> None:
    """Add the image of a camera that was taken during a frame, and the labels projected into it."""
    import simplejpeg

    stream = log.streams[camera.name]
    found = np.flatnonzero((stream.t_ns >= start_ns) & (stream.t_ns < start_ns + PERIOD_NS))
    if not len(found):
        return
    stamp = int(stream.t_ns[found[0]])
    picture = np.ascontiguousarray(stream.read(int(found[0])))
    jpeg = simplejpeg.encode_jpeg(picture, quality=92, colorspace="BGR")
    pose_ns, middle_s = stamp + POSE_LAG_NS, stamp / NS_PER_S
    frame.images[number] = Image(
        jpeg, world_pose(log, pose_ns), pose_ns / NS_PER_S, middle_s - HALF_EXPOSED_S, middle_s + HALF_EXPOSED_S
    )
    cam_T_map = inverse(log.map_T_sensor(camera.name, stamp)[0][0])
    frame.projected[number] = []
    for track, kind in tracks(log.labels):
        center, size, yaw = labels_at(log.labels, stamp, track)
        found_box = project_boxes(center, size[None], yaw, camera, cam_T_map)
        if found_box.valid[0]:
            u0, v0, u1, v1 = found_box.box_px[0]
            middle, extent = np.array([u0 + u1, v0 + v1]) / 2, np.array([u1 - u0, v1 - v0])
            frame.projected[number].append(Box(f"{track}_FRONT", kind, middle, extent))


def tracks(labels: Labels | None) -> Iterator[tuple[str, int]]:
    """Yield id and type of every labeled track."""
    for track in np.unique(labels.track_id) if labels is not None else []:
        yield str(track), TYPE_OF[str(labels.category[labels.track_id == track][0])]


def boxes(log: Log, start_ns: int, world_T_vehicle: Array, vehicle_T_lidar: Array) -> list[Box]:
    """List the labels of a frame, each where its box is when the LiDAR looks at it, and a sign."""
    out = [Box("sign", SIGN, np.array([10.0, 8.0, 2.0]), np.array([0.1, 1.0, 1.0]))]
    vehicle_T_map = inverse(world_T_vehicle - np.array([[0, 0, 0, v] for v in (*WORLD_OFFSET_M, 0.0)]))
    for track, kind in tracks(log.labels):
        t_ns = start_ns + PERIOD_NS // 2
        for _ in range(5):
            center, size, yaw = labels_at(log.labels, t_ns, track)
            at = apply(vehicle_T_map, center)[0]
            azimuth = np.arctan2(at[1] - vehicle_T_lidar[1, 3], at[0] - vehicle_T_lidar[0, 3])
            t_ns = start_ns + round(np.mod(np.pi - azimuth, 2 * np.pi) / (2 * np.pi) * PERIOD_NS)
        out.append(Box(track, kind, at, size, float(yaw[0] + yaw_of(vehicle_T_map))))
    return out


def frame_message(segment: Segment, frame: Frame) -> bytes:
    """Serialize a Frame."""
    parts = [
        message(1, context_message(segment)),
        whole(2, frame.stamp_us),
        message(3, pose_message(frame.world_T_vehicle)),
    ]
    for number, image in frame.images.items():
        velocity = b"".join(fixed32(k, 0.0) for k in (1, 2, 3))
        times = [image.pose_s, SHUTTER_S, image.trigger_s, image.readout_done_s]
        body = [
            whole(1, number),
            message(2, image.jpeg),
            message(3, pose_message(image.world_T_vehicle)),
            message(4, velocity),
        ]
        parts.append(message(4, b"".join(body) + b"".join(fixed64(k, t) for k, t in enumerate(times, start=5))))
    parts += [message(5, laser_message(number, ranges)) for number, ranges in frame.lasers.items()]
    parts += [message(6, label_message(box)) for box in frame.labels]
    for number, projected in frame.projected.items():
        parts.append(message(9, whole(1, number) + b"".join(message(2, label_message(box)) for box in projected)))
    return b"".join(parts)


def context_message(segment: Segment) -> bytes:
    parts = [message(1, segment.name.encode())]
    for number, (camera, direction) in segment.cameras.items():
        parts.append(message(2, camera_message(number, camera, direction)))
    for number, laser in segment.lasers.items():
        body = whole(1, number) + b"".join(fixed64(2, v) for v in laser.inclinations)
        body += (
            fixed64(3, laser.limits[0]) + fixed64(4, laser.limits[1]) + message(5, pose_message(laser.vehicle_T_lidar))
        )
        parts.append(message(3, body))
    return b"".join(parts) + message(4, message(2, b"Day") + message(3, b"location_other") + message(4, b"sunny"))


def intrinsics(camera: Camera) -> list[float]:
    """Return f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3."""
    lens = (*camera.distortion, *[0.0] * 5)[:5]
    return [camera.K[0, 0], camera.K[1, 1], camera.K[0, 2], camera.K[1, 2], *lens]


def camera_message(number: int, camera: Camera, direction: int) -> bytes:
    body = whole(1, number) + b"".join(fixed64(2, v) for v in intrinsics(camera))
    body += message(3, pose_message(camera.mount_T_cam @ OPENCV_T_CAMERA))
    return body + whole(4, camera.width_px) + whole(5, camera.height_px) + whole(6, direction)


def laser_message(number: int, ranges: Ranges) -> bytes:
    parts = [whole(1, number)]
    for k, image in enumerate(ranges.returns):
        body = message(2, compressed(image))
        # A field that no reader needs, between those that one does.
        body += message(3, zlib.compress(b"camera projections"))
        if k == 0 and ranges.poses is not None:
            body += message(4, compressed(ranges.poses))
        parts.append(message(2 + k, body))
    return b"".join(parts)


def compressed(values: NDArray[np.float32]) -> bytes:
    """Compress a MatrixFloat."""
    dims = b"".join(whole(1, n) for n in values.shape)
    return zlib.compress(message(1, values.astype("<f4").tobytes()) + message(2, dims))


def label_message(box: Box) -> bytes:
    *center, length, width = (*box.center, *box.size[:2])
    values = dict(zip((1, 2, 3), center)) | {4: width, 5: length, 7: box.heading_rad}
    if len(box.size) == 3:
        values[6] = box.size[2]
    body = b"".join(fixed64(k, float(v)) for k, v in sorted(values.items()))
    speed = fixed64(1, 1.0) + fixed64(2, -1.0)
    return message(1, body) + message(2, speed) + whole(3, box.kind) + message(4, box.track_id.encode()) + whole(7, 9)


def pose_message(dst_T_src: Array) -> bytes:
    return b"".join(fixed64(1, v) for v in dst_T_src.ravel())


def varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*out, value])


def whole(number: int, value: int) -> bytes:
    return varint(number << 3) + varint(value)


def fixed64(number: int, value: float) -> bytes:
    return varint(number << 3 | 1) + struct.pack("<d", value)


def fixed32(number: int, value: float) -> bytes:
    return varint(number << 3 | 5) + struct.pack("<f", value)


def message(number: int, body: bytes) -> bytes:
    return varint(number << 3 | 2) + varint(len(body)) + body


def record(data: bytes) -> bytes:
    """Frame data as a TFRecord does; the checksum is compared with `bitwise_crc32c` and published vectors elsewhere."""
    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc32c(length)) + data + struct.pack("<I", masked_crc32c(data))


def bitwise_crc32c(data: Iterable[int]) -> int:
    """CRC-32C byte by byte from a table made bit by bit: slow, and independent of the reader's."""
    crc = 0xFFFFFFFF
    for byte in data:
        crc = CRC_TABLE[(crc ^ byte) & 0xFF] ^ (crc >> 8)
    return crc ^ 0xFFFFFFFF


def _table() -> list[int]:
    out = []
    for crc in range(256):
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
        out.append(crc)
    return out


CRC_TABLE = _table()
