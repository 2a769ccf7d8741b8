"""What flows between the stages: sensors, streams, logs, detections.

Everything is a frozen record of columns. Arrays are never changed once a record holds them. Letters in shapes: N points,
M boxes, L labels, A agents, T ticks, F frames of a stream.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, PoseTrack

Mount = Literal["ego", "map"]

CATEGORIES = ("car", "truck", "bus", "motorcycle", "cyclist", "bicycle", "pedestrian", "other")
"""What an agent can be. A `cyclist` is a bicycle with its rider, a `bicycle` has none; vans are cars."""

GROUPS: Mapping[str, tuple[str, ...]] = {
    "vehicle": ("car", "truck", "bus"),
    "two_wheeler": ("motorcycle", "cyclist", "bicycle"),
    "pedestrian": ("pedestrian",),
    "other": ("other",),
}
"""Categories that detectors and labelers confuse and that are therefore associated with each other."""

GROUP_OF: Mapping[str, str] = {category: group for group, members in GROUPS.items() for category in members}

# Mean length, width, height in m of KITTI's and PandaSet's labels, rounded; used where nothing was measured.
TYPICAL_SIZE_M: Mapping[str, tuple[float, float, float]] = {
    "car": (4.4, 1.85, 1.6),
    "truck": (7.0, 2.4, 2.9),
    "bus": (11.5, 2.7, 3.2),
    "motorcycle": (2.1, 0.8, 1.5),
    "cyclist": (1.75, 0.65, 1.75),
    "bicycle": (1.75, 0.6, 1.1),
    "pedestrian": (0.7, 0.7, 1.75),
    "other": (3.0, 1.8, 1.8),
}


@dataclass(frozen=True, eq=False)
class Camera:
    """A pinhole camera: `K` (3, 3) px, `mount_T_cam` (4, 4), distortion in OpenCV's order.

    `distortion_model` is "none", "brown" (k1, k2, p1, p2[, k3[, k4, k5, k6]]) or "fisheye" (k1..k4, Kannala-Brandt).
    """

    name: str
    width_px: int
    height_px: int
    K: Array
    mount: Mount
    mount_T_cam: Array
    distortion_model: str = "none"
    distortion: tuple[float, ...] = ()


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


@dataclass(frozen=True, eq=False)
class Detections:
    """2D boxes of one camera frame: `box_px` (M, 4) u0, v0, u1, v1, `score` (M,) in [0, 1], `category` (M,) str."""

    box_px: Array
    score: Array
    category: NDArray[np.str_]

    def __len__(self) -> int:
        return len(self.box_px)

    @classmethod
    def empty(cls) -> Detections:
        return cls(np.zeros((0, 4)), np.zeros(0), np.zeros(0, dtype="<U16"))

    def take(self, index: Any) -> Detections:
        """The rows at `index` (integers or a mask)."""
        return Detections(self.box_px[index], self.score[index], self.category[index])


@dataclass(frozen=True, eq=False)
class Measurements:
    """What the sensors say about the objects of one tick, one row an object, all in the map frame.

    `t_ns` (M,) int64 when the object was seen (the mean time of its points, else the frame's stamp); `category` (M,) str;
    `score` (M,) of the detector; `camera` (M,) str; `box_px` (M, 4); `truncated` (M,) bool: cut by the image border;
    `ends_seen` (M, 2) bool: whether the cluster's right and left end, as the sensor sees it, are ends of the object;
    `center_m` (M, 3) box center; `size_m` (M, 3) length, width, height; `yaw_rad` (M,) up to quarter turns where only
    LiDAR speaks; `covariance` (M, 2, 2) of the center's x, y in m2; `points` (M,) LiDAR points on the object; `source`
    (M,) "lidar", "topdown" or "" where there is no position yet; `cluster` M arrays (n, 3) of points;
    `sensor_m` (M, 3) where they were seen from; `height_px_m` (M,) height in m that the image box spans at that depth.
    """

    t_ns: NDArray[np.int64]
    category: NDArray[np.str_]
    score: Array
    camera: NDArray[np.str_]
    box_px: Array
    truncated: NDArray[np.bool_]
    ends_seen: NDArray[np.bool_]
    center_m: Array
    size_m: Array
    yaw_rad: Array
    covariance: Array
    points: NDArray[np.int64]
    source: NDArray[np.str_]
    cluster: tuple[NDArray[np.float64], ...]
    sensor_m: Array
    height_px_m: Array

    def __len__(self) -> int:
        return len(self.t_ns)

    def take(self, index: Any) -> Measurements:
        """The rows at `index` (integers or a mask)."""
        rows = np.arange(len(self))[index]
        columns = {k: v[rows] for k, v in vars(self).items() if k != "cluster"}
        return Measurements(**columns, cluster=tuple(self.cluster[i] for i in rows))

    @classmethod
    def join(cls, parts: Sequence[Measurements]) -> Measurements:
        """Rows of several sets, one after the other; an empty sequence gives an empty set."""
        if not parts:
            return cls.empty()
        columns = {k: np.concatenate([getattr(p, k) for p in parts]) for k in vars(parts[0]) if k != "cluster"}
        return cls(**columns, cluster=tuple(c for p in parts for c in p.cluster))

    @classmethod
    def empty(cls) -> Measurements:
        text, none = np.zeros(0, dtype="<U16"), np.zeros(0)
        return cls(
            np.zeros(0, dtype=np.int64), text, none, text, np.zeros((0, 4)), np.zeros(0, dtype=bool),
            np.zeros((0, 2), dtype=bool), np.zeros((0, 3)), np.zeros((0, 3)), none, np.zeros((0, 2, 2)), np.zeros(0, dtype=np.int64), text, (), np.zeros((0, 3)), none,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Track:
    """One object over time: `tick` (n,) strictly increasing indices and the measurement (n rows) it got at each."""

    category: str
    tick: NDArray[np.int64]
    measurements: Measurements

    def __len__(self) -> int:
        return len(self.tick)
