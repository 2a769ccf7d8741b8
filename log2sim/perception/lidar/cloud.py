"""Sweeps in the map frame, compensated for the motion of their sensor, as one cloud with its ground."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS, VEHICLE, Log, Sweep
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.azimuth_index import AzimuthIndex

# Rotation is constant within a bin, which errs by 2.5 cm at 1 rad/s and 50 m; translation is interpolated for every point.
POSE_BIN_NS = 500_000
MAX_POSE_BINS = 4096
# A sensor that moves less than this during a sweep, with its rotation measured at 30 m, needs a single pose.
AT_REST_M = 0.01
AT_REST_RAD = AT_REST_M / 30.0
AT_REST_PROBES = 5
# Heights above ground of what a vehicle could hit: above the curb, below signs and bridges.
MIN_OBSTACLE_HEIGHT_M, MAX_OBSTACLE_HEIGHT_M = 0.2, 4.2
GROUND_REACH_M = 45.0
GROUND_SAMPLE = 2000
# Fewer points in a box may be of the road or of a neighbor.
MIN_END_POINTS = 3


@dataclass(frozen=True, eq=False)
class CloudSensor:
    """One of the LiDARs whose points are in a cloud.

    Attributes
    ----------
    points : int
        Number of its points, which follow those of the previous sensor.
    position : (3,) float64
        At the stamp of the cloud, relative to the cloud's origin, m.
    velocity_mps : (3,) float64
        Mean over its points.
    end : str
        One of `ENDS`.
    """

    points: int
    position: Array
    velocity_mps: Array
    end: str = VEHICLE


@dataclass(frozen=True, eq=False)
class Cloud:
    """Points of one moment in the map frame.

    Attributes
    ----------
    stamp_ns : int
    origin : (3,) float64
        m, map frame. Coordinates are relative to it, so that single precision resolves 1e-5 m.
    xyz : (N, 3) float32
        m, map axes, relative to `origin`.
    t_s : (N,) float32
        Time of every point relative to `stamp_ns`.
    sensor : (3,) float32
        Position of the sensor in the middle of the sweep, mean over several, relative to `origin`; with parts of the first.
    ground : (N,) bool
        True for points on the ground.
    height : (N,) float32
        m above the ground.
    sensors : tuple of CloudSensor
        Empty where the points are all of one sensor at `sensor`.
    parts : tuple of Cloud
        The same points by viewpoint, in their order; empty where all are seen from one.
    """

    stamp_ns: int
    origin: Array
    xyz: NDArray[np.float32]
    t_s: NDArray[np.float32]
    sensor: NDArray[np.float32]
    ground: NDArray[np.bool_]
    height: NDArray[np.float32]
    sensors: tuple[CloudSensor, ...] = ()
    parts: tuple[Cloud, ...] = ()

    @property
    def views(self) -> tuple[Cloud, ...]:
        """The cloud of each viewpoint: the parts, or the cloud itself."""
        return self.parts or (self,)

    @property
    def end(self) -> str:
        """The end, one of `ENDS`, of the first sensor."""
        return self.sensors[0].end if self.sensors else VEHICLE

    @cached_property
    def obstacles(self) -> NDArray[np.intp]:
        """Indices (n,) of the points above the ground and below what hangs over the road."""
        return np.flatnonzero(
            ~self.ground & (self.height > MIN_OBSTACLE_HEIGHT_M) & (self.height < MAX_OBSTACLE_HEIGHT_M)
        )

    @cached_property
    def columns(self) -> NDArray[np.float32]:
        """The points as rows x, y, z (3, N), contiguous for products."""
        return np.ascontiguousarray(self.xyz.T)

    @cached_property
    def obstacle_columns(self) -> NDArray[np.float32]:
        """The points at `obstacles` as rows x, y, z (3, n), shared by all cameras."""
        return np.ascontiguousarray(self.xyz[self.obstacles].T)

    @cached_property
    def azimuth_index(self) -> AzimuthIndex:
        """The points sorted by azimuth around the sensor."""
        return AzimuthIndex.of(self.xyz, self.sensor, self.ground)

    @cached_property
    def ground_sample(self) -> NDArray[np.intp]:
        """Indices of about `GROUND_SAMPLE` ground points within `GROUND_REACH_M` of the origin, evenly spaced in their order."""
        index = np.flatnonzero(self.ground & (np.hypot(self.xyz[:, 0], self.xyz[:, 1]) < GROUND_REACH_M))
        return index[:: max(len(index) // GROUND_SAMPLE, 1)]

    def ends_of(self, index: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Return (2,), in the order of `ENDS`, whose sensors measured points (n,): those with `MIN_END_POINTS` or half of them."""
        if not self.sensors or not len(index):
            return np.zeros(len(ENDS), dtype=bool)
        ends = {s.end for s in self.sensors}
        if len(ends) == 1:
            return np.array([end in ends for end in ENDS])
        sensor = np.searchsorted(np.cumsum([s.points for s in self.sensors]), index, side="right")
        end = np.array([ENDS.index(s.end) for s in self.sensors], dtype=np.int64)[sensor]
        return np.asarray(np.bincount(end, minlength=len(ENDS)) >= max(min(MIN_END_POINTS, len(index) / 2), 1))

    def prepare(self, *, ground: bool = True) -> None:
        """Fill the cached columns in the calling thread; `ground` includes the sample of ground points."""
        _ = self.obstacle_columns, self.ground_sample if ground else None
        for view in self.views:
            _ = view.azimuth_index

    def split(self, index: NDArray[np.intp]) -> list[tuple[Cloud, NDArray[np.intp]]]:
        """Divide points (n,) by viewpoint: each with the rows in its own cloud, those with most points first."""
        if not self.parts:
            return [(self, index)]
        first = np.cumsum([0, *(len(part.xyz) for part in self.parts)])
        of = np.searchsorted(first, index, side="right") - 1
        found = [(part, index[of == k] - first[k]) for k, part in enumerate(self.parts)]
        return sorted((view for view in found if len(view[1])), key=lambda view: -len(view[1]))


def sweep_to_map(log: Log, lidar: str, sweep: Sweep, *, compensate: bool) -> tuple[Array, NDArray[np.float32]] | None:
    """Transform a sweep to the map frame.

    Parameters
    ----------
    compensate : bool
        Whether every point takes the sensor pose of its own time. Sweeps without point times, or of a sensor at rest, take
        the pose of their stamp in either case; sweeps that are compensated already take the pose of the stamp to which they are.

    Returns
    -------
    xyz : (N, 3) float64, m, map frame
    t_s : (N,) float32
        Times relative to the sweep's stamp. None is returned instead of both where the sensor's pose is not known.
    """
    t_ns = sweep.t_ns if sweep.t_ns is not None else np.full(len(sweep.xyz_m), sweep.stamp_ns, dtype=np.int64)
    t_s = ((t_ns - sweep.stamp_ns) / NS_PER_S).astype(np.float32)
    if sweep.frame == "map":
        return np.asarray(sweep.xyz_m, dtype=np.float64), t_s
    one_pose = not compensate or not has_motion(sweep) or is_at_rest(log, lidar, sweep)
    xyz = transform_rigidly(log, lidar, sweep) if one_pose else deskew(log, lidar, sweep, t_ns)
    return None if xyz is None else (xyz, t_s)


def has_motion(sweep: Sweep) -> bool:
    """Return whether a sweep holds the motion of its sensor, with the times to compensate it."""
    return sweep.frame == "lidar" and sweep.compensated_ns is None and sweep.t_ns is not None and len(sweep.t_ns) > 0


def is_at_rest(log: Log, lidar: str, sweep: Sweep) -> bool:
    """Decide whether a LiDAR moves less than `AT_REST_M`, also at 30 m, during a sweep with point times."""
    if sweep.t_ns is None or len(sweep.t_ns) == 0:
        return False
    probes = np.linspace(0, int(sweep.t_ns.max() - sweep.t_ns.min()), AT_REST_PROBES).astype(np.int64)
    map_T_lidar, valid = log.map_T_sensor(lidar, np.append(sweep.t_ns.min() + probes, sweep.stamp_ns))
    moved = np.linalg.norm(map_T_lidar[:, :3, 3] - map_T_lidar[-1, :3, 3], axis=1)
    turned = np.linalg.norm(map_T_lidar[:, :3, :3] - map_T_lidar[-1, :3, :3], axis=(1, 2)) / np.sqrt(2)
    return bool(valid.all() and moved.max() < AT_REST_M and turned.max() < AT_REST_RAD)


def transform_rigidly(log: Log, lidar: str, sweep: Sweep) -> Array | None:
    """Transform a sweep to the map frame by one pose: (N, 3); None where that pose is not known.

    It is the pose at the stamp of the sweep or, of a compensated sweep, at the stamp to which it is compensated.
    """
    stamp_ns = sweep.stamp_ns if sweep.compensated_ns is None else sweep.compensated_ns
    map_T_lidar, valid = log.map_T_sensor(lidar, stamp_ns)
    if not valid[0]:
        return None
    return np.asarray(sweep.xyz_m @ map_T_lidar[0, :3, :3].T + map_T_lidar[0, :3, 3], dtype=np.float64)


def deskew(log: Log, lidar: str, sweep: Sweep, t_ns: NDArray[np.int64]) -> Array | None:
    """Transform a sweep to the map frame, every point by the pose of its own time (N,): (N, 3).

    None where a pose is not known.
    """
    first, span = int(t_ns.min()), int(t_ns.max() - t_ns.min())
    bins = min(max(span // POSE_BIN_NS, 1), MAX_POSE_BINS)
    knots = first + (np.arange(bins + 1) * span) // bins
    map_T_lidar, valid = log.map_T_sensor(lidar, knots)
    if not valid.all():
        return None
    place = (t_ns - first) * (bins / max(span, 1))
    k = np.minimum(place.astype(np.intp), bins - 1)
    place -= k
    # Coordinate by coordinate, rotated in the points' own precision: entries of the pose of each point come from small tables.
    xyz = [np.ascontiguousarray(sweep.xyz_m[:, axis]) for axis in range(3)]
    rotation = map_T_lidar[:, :3, :3].astype(np.result_type(sweep.xyz_m, np.float32))
    position, moved = map_T_lidar[:-1, :3, 3], np.diff(map_T_lidar[:, :3, 3], axis=0)
    out = np.empty((len(t_ns), 3))
    for row in range(3):
        rotated = sum(rotation[:, row, axis].take(k) * xyz[axis] for axis in range(3))
        out[:, row] = rotated + position[:, row].take(k) + moved[:, row].take(k) * place
    return out


def compensation_of(log: Log, lidar: str, sweep: Sweep) -> str:
    """How a sweep is compensated: "in the log" already, "no times" to do it with, "at rest" or "moving"."""
    if sweep.frame == "map" or sweep.compensated_ns is not None:
        return "in the log"
    if sweep.t_ns is None:
        return "no times"
    return "at rest" if is_at_rest(log, lidar, sweep) else "moving"


def cloud_origin(log: Log, t_ns: int) -> tuple[Array, float]:
    """Origin (3,) of a tick's clouds in the map frame, and the height of the ground there.

    Without ego it is the middle of the sensors whose poses are known, with the ground taken from `ground_z_ego_m` as a height in the map.
    """
    if log.ego is not None:
        map_T_ego, _ = log.ego.at(t_ns)
        ground = map_T_ego[0] @ np.array([0.0, 0.0, log.ground_z_ego_m, 1.0])
        return map_T_ego[0, :3, 3].copy(), float(ground[2])
    poses = [log.map_T_sensor(name, t_ns) for name in (*log.lidars, *log.cameras)]
    places = [map_T_sensor[0, :3, 3] for map_T_sensor, known in poses if known[0]]
    return np.mean(places, axis=0) if places else np.zeros(3), log.ground_z_ego_m
