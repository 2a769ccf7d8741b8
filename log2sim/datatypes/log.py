"""What flows between the stages: sensors, streams, logs, detections.

Everything is a frozen record of columns. Arrays are never changed once a record holds them. Letters in shapes: N points,
M boxes, L labels, A agents, T ticks, F frames of a stream.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, Camera, Mount, PoseTrack


@dataclass(frozen=True, eq=False)
class Lidar:
    """A LiDAR; `mount_T_lidar` (4, 4)."""

    name: str
    mount: Mount
    mount_T_lidar: Array


@dataclass(frozen=True, eq=False)
class Sweep:
    """One LiDAR sweep.

    `xyz_m` (N, 3) float32 or float64 in `frame`: "lidar" (the sensor's own, each point at its own time) or "map" (already
    compensated). `t_ns` (N,) int64 absolute stamps of the points, or None when the log has none. All rows are finite.
    """

    stamp_ns: int
    xyz_m: NDArray[np.floating[Any]]
    frame: Literal["lidar", "map"] = "lidar"
    t_ns: NDArray[np.int64] | None = None


@dataclass(frozen=True, eq=False)
class Stream:
    """The records of one sensor in the order of the log: `t_ns` (F,) int64 and `read(i)`.

    `read` returns (H, W, 3) uint8 BGR for a camera and a `Sweep` for a LiDAR; it raises `RecordError` for one that cannot
    be read. It is safe to call from several threads.
    """

    name: str
    t_ns: NDArray[np.int64]
    read: Callable[[int], Any]


@dataclass(frozen=True, eq=False)
class Labels:
    """Labeled 3D boxes of a log, one row a box and stamp, in the map frame.

    `t_ns` (L,) int64, `track_id` (L,) str, `category` (L,) str, `center_m` (L, 3) box centers, `size_m` (L, 3) length,
    width, height, `yaw_rad` (L,). `visible` (L,) bool where the log states it, else None: then it is computed. `cameras`
    names those in whose view alone objects were labeled; None where they were labeled all around.
    """

    t_ns: NDArray[np.int64]
    track_id: NDArray[np.str_]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    visible: NDArray[np.bool_] | None = None
    cameras: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class ImageLabels:
    """Labeled 2D boxes of one camera: `t_ns` (L,) the stamp of the frame, `box_px` (L, 4), `category` (L,) str."""

    t_ns: NDArray[np.int64]
    box_px: Array
    category: NDArray[np.str_]


@dataclass(frozen=True, eq=False)
class ImageRegions:
    """Parts of the images of one camera in which objects were left without labels: `t_ns` (L,), `box_px` (L, 4)."""

    t_ns: NDArray[np.int64]
    box_px: Array


@dataclass(frozen=True)
class MapFrame:
    """Where the map frame lies on Earth: local x, y, z + `offset_m` are coordinates of `projection` (a PROJ string).

    Without a projection the map is only local. `offset_m` keeps the numbers small: large map coordinates are stored as
    whole kilometers here and the rest in the poses, so nothing is lost and nothing is rounded away.
    """

    latitude_deg: float | None = None
    longitude_deg: float | None = None
    altitude_m: float | None = None
    projection: str | None = None
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class EgoVehicle:
    """Size (length, width, height) in m; box center = ego origin + `rear_axle_offset_m` forward, half the height up."""

    size_m: tuple[float, float, float] = (4.6, 1.9, 1.6)
    rear_axle_offset_m: float = 1.4


@dataclass(frozen=True, eq=False)
class Log:
    """An opened log. Nothing is read from the streams until asked for.

    `ego` is None for a log of roadside sensors only. `ground_z_ego_m` is the height of the road in the ego frame: 0 where
    the ego's origin lies on the ground. `ignored_regions` says by camera where `labels` are incomplete. `digest` is a
    SHA-256 over the log's index.
    """

    name: str
    format: str
    cameras: Mapping[str, Camera]
    lidars: Mapping[str, Lidar]
    streams: Mapping[str, Stream]
    ego: PoseTrack | None = None
    ego_vehicle: EgoVehicle = field(default_factory=EgoVehicle)
    map: MapFrame = field(default_factory=MapFrame)
    labels: Labels | None = None
    image_labels: Mapping[str, ImageLabels] = field(default_factory=dict)
    ignored_regions: Mapping[str, ImageRegions] = field(default_factory=dict)
    ground_z_ego_m: float = 0.0
    reference_camera: str | None = None
    digest: str = ""
    notes: tuple[str, ...] = ()

    def map_T_sensor(self, name: str, t_ns: Any) -> tuple[Array, NDArray[np.bool_]]:
        """Poses (N, 4, 4) of a sensor in the map at stamps (N,) and whether each is known (N,)."""
        sensor = self.cameras.get(name) or self.lidars[name]
        mount_T_sensor = sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar
        t = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        if sensor.mount == "map":
            return np.repeat(mount_T_sensor[None], len(t), axis=0), np.ones(len(t), dtype=bool)
        if self.ego is None:
            return np.repeat(np.eye(4)[None], len(t), axis=0), np.zeros(len(t), dtype=bool)
        map_T_ego, valid = self.ego.at(t)
        return map_T_ego @ mount_T_sensor, valid


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera frame as a detector sees it: `image()` decodes it, and only when called."""

    camera: Camera
    t_ns: int
    image: Callable[[], NDArray[np.uint8]]
