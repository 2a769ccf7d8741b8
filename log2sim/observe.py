"""The first pass over a log: every tick's frames and sweeps become measurements."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.clock import StageClock
from log2sim.detect import Detector
from log2sim.errors import LogError, RecordError
from log2sim.extend import Obstacles
from log2sim.fuse import fuse
from log2sim.geometry import Array, inverse
from log2sim.measure import Cloud, View, assemble_cloud, measure_view, project_cloud
from log2sim.plan import Plan
from log2sim.sync import Schedule
from log2sim.topdown import Correspondences, foot_points, pinhole
from log2sim.types import Detections, Frame, Log, Measurements, Sweep

GROUND_POINTS_A_FRAME = 40
OBSTACLE_REACH_M = 70.0
OBSTACLE_VOXEL_M = 0.12
RANK_BITS = 25  # more than the points of any sweep
BACKGROUND_THREADS = 2


@dataclass(eq=False)
class Observed:
    """What the first pass found: per tick the measurements of all cameras and the obstacles that the LiDARs saw."""

    measurements: list[Measurements] = field(default_factory=list)
    obstacles: list[Obstacles | None] = field(default_factory=list)
    feet: dict[str, list[Correspondences]] = field(default_factory=dict)
    ground: dict[str, list[Correspondences]] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)
    records: Records | None = None


class Records:
    """Reads records of a log and counts what cannot be read; a stream with nothing readable is an error."""

    def __init__(self, log: Log) -> None:
        self.log = log
        self.read: dict[str, int] = {}
        self.failed: dict[str, list[str]] = {}
        self._lock = threading.Lock()

    def get(self, stream: str, index: int) -> Any | None:
        """The record, or None when it cannot be read."""
        try:
            record = self.log.streams[stream].read(index)
            if isinstance(record, Sweep) and not len(record.xyz_m):
                raise RecordError(f"sweep at stamp {record.stamp_ns} has no finite point")
        except RecordError as error:
            with self._lock:
                self.failed.setdefault(stream, []).append(str(error))
            return None
        with self._lock:
            self.read[stream] = self.read.get(stream, 0) + 1
        return record

    def require_some(self) -> None:
        """Raise `LogError` for a stream of which nothing that was asked for could be read."""
        for stream, problems in self.failed.items():
            if not self.read.get(stream):
                raise LogError(
                    f"stream '{stream}': none of the {len(problems)} records asked for can be read, "
                    f"the first because {problems[0]}. Mend or remove the stream; `log2sim validate` lists all problems"
                )

    def summary(self) -> dict[str, Any]:
        return {s: {"count": len(p), "first": p[0]} for s, p in sorted(self.failed.items())}


def observe(
    log: Log,
    schedule: Schedule,
    detector: Detector,
    plan: Plan,
    *,
    mode: str,
    max_range_m: float,
    clock: StageClock,
    progress: Callable[[int, int], None],
) -> Observed:
    """Run detection and measurement over all ticks."""
    out = Observed(feet={c: [] for c in plan.cameras}, ground={c: [] for c in plan.cameras})
    records = out.records = Records(log)
    with ThreadPoolExecutor(BACKGROUND_THREADS) as pool:
        clouds = _Clouds(log, schedule, plan, records, pool, max_range_m)
        clouds.prefetch(0)
        for tick in range(len(schedule)):
            frames = _frames(log, schedule, plan, tick, records)
            found = _detect_all(frames, detector, pool, clock, decode=plan.keeps("decode images"))
            with clock.stage("cloud"):
                ready = [clouds.get(tick, row) for row in range(len(schedule.frames))]
            clouds.prefetch(tick + 1)
            _measure_tick(log, schedule, tick, found, ready, out, mode=mode, max_range_m=max_range_m, clock=clock)
            progress(tick + 1, len(schedule))
    records.require_some()
    return out


def _frames(log: Log, schedule: Schedule, plan: Plan, tick: int, records: Records) -> dict[str, Frame]:
    """The camera frames of a tick; each decodes its image once, when somebody asks."""
    frames = {}
    for name in plan.cameras:
        index = int(schedule.frames[name][tick])
        if index >= 0:
            frames[name] = Frame(log.cameras[name], int(log.streams[name].t_ns[index]), _Once(records, name, index))
    return frames


class _Once:
    """An image that is decoded when first asked for."""

    def __init__(self, records: Records, stream: str, index: int) -> None:
        self._records, self._stream, self._index = records, stream, index
        self._image: NDArray[np.uint8] | None = None

    def __call__(self) -> NDArray[np.uint8]:
        if self._image is None:
            image = self._records.get(self._stream, self._index)
            if image is None:
                raise RecordError(f"{self._stream}: frame {self._index} cannot be read")
            self._image = image
        return self._image


def _detect_all(
    frames: dict[str, Frame], detector: Detector, pool: ThreadPoolExecutor, clock: StageClock, *, decode: bool
) -> dict[str, Detections]:
    """Detections of every frame of a tick; a frame that cannot be read has none. All frames decode at once, ahead."""
    if decode:
        with clock.stage("decode"):
            readable = dict(zip(frames, pool.map(_decodes, frames.values())))
        frames = {name: frame for name, frame in frames.items() if readable[name]}
    with clock.stage("detect"):
        return {name: detector.detect(frame) for name, frame in frames.items()}


def _decodes(frame: Frame) -> bool:
    try:
        frame.image()
    except RecordError:
        return False
    return True


class _Clouds:
    """Clouds of coming ticks, made in the background; sweeps are read once, and ticks share the clouds of the same sweeps."""

    def __init__(
        self, log: Log, schedule: Schedule, plan: Plan, records: Records, pool: ThreadPoolExecutor, max_range_m: float
    ) -> None:
        self._log, self._schedule, self._plan, self._records = log, schedule, plan, records
        self._pool, self._max_range_m = pool, max_range_m
        self._sweeps: dict[tuple[str, int], Future[Sweep | None]] = {}
        self._clouds: dict[tuple[int, ...], Future[Cloud | None]] = {}

    def _key(self, tick: int, row: int) -> tuple[int, ...]:
        """The sweep of every LiDAR, -1 for none, that a camera of a tick uses."""
        return tuple(int(index[row, tick]) for index in self._schedule.sweeps.values())

    def prefetch(self, tick: int) -> None:
        """Start making what a tick needs, and forget what only earlier ticks needed."""
        ticks = [k for k in (tick - 1, tick) if 0 <= k < len(self._schedule)]
        keys = {key: None for k in ticks for row in range(len(self._schedule.frames)) for key in [self._key(k, row)]}
        sweeps = {(name, i): None for key in keys for name, i in zip(self._schedule.sweeps, key) if i >= 0}
        self._clouds = {k: v for k, v in self._clouds.items() if k in keys}
        self._sweeps = {k: v for k, v in self._sweeps.items() if k in sweeps}
        # Sweeps go first: a cloud that waits for its sweeps must never keep them from being read.
        for sweep in sweeps:
            if sweep not in self._sweeps:
                self._sweeps[sweep] = self._pool.submit(self._records.get, *sweep)
        for key in keys:
            if key not in self._clouds:
                read = {n: self._sweeps[n, i] for n, i in zip(self._schedule.sweeps, key) if i >= 0}
                self._clouds[key] = self._pool.submit(self._make, read)

    def _make(self, reading: dict[str, Future[Sweep | None]]) -> Cloud | None:
        sweeps = {name: sweep for name, future in reading.items() if (sweep := future.result()) is not None}
        if not sweeps:
            return None
        origin, ground_z = place_of_ego(self._log, next(iter(sweeps.values())).stamp_ns)
        cloud = assemble_cloud(
            self._log, sweeps, origin=origin, ground_z=ground_z, max_range_m=self._max_range_m,
            compensate=self._plan.keeps("compensate"),
        )  # fmt: skip
        if cloud is not None:
            cloud.prepare()
        return cloud

    def get(self, tick: int, row: int) -> Cloud | None:
        """The cloud for the camera in a row of the schedule; waits until it is made."""
        return self._clouds[self._key(tick, row)].result()


def _measure_tick(
    log: Log,
    schedule: Schedule,
    tick: int,
    found: dict[str, Detections],
    clouds: Sequence[Cloud | None],
    out: Observed,
    *,
    mode: str,
    max_range_m: float,
    clock: StageClock,
) -> None:
    """Measure the detections of a tick, each camera in its cloud, and keep what later stages ask for."""
    parts: list[Measurements] = []
    with clock.stage("measure"):
        for camera, cloud in zip(schedule.frames, clouds, strict=True):
            if camera in found:
                parts.append(_measure_camera(log, schedule, camera, tick, found[camera], cloud, out, mode))
    with clock.stage("fuse"):
        joined = Measurements.join(parts)
        joined = joined.take(_in_range(log, schedule, tick, joined, max_range_m))
        out.measurements.append(fuse(joined) if len(joined) else joined)
    with clock.stage("cloud"):
        out.obstacles.append(None if clouds[0] is None else _obstacles(clouds[0]))


def place_of_ego(log: Log, t_ns: int) -> tuple[Array, float]:
    """Origin (3,) of a tick's clouds in the map frame, and the height of the ground there.

    Without ego it is the middle of the sensors, with the ground taken from `ground_z_ego_m` as a height in the map.
    """
    if log.ego is not None:
        map_T_ego, _ = log.ego.at(t_ns)
        ground = map_T_ego[0] @ np.array([0.0, 0.0, log.ground_z_ego_m, 1.0])
        return map_T_ego[0, :3, 3].copy(), float(ground[2])
    places = [log.map_T_sensor(name, t_ns)[0][0, :3, 3] for name in (*log.lidars, *log.cameras)]
    return np.mean(places, axis=0), log.ground_z_ego_m


def _measure_camera(
    log: Log,
    schedule: Schedule,
    camera: str,
    tick: int,
    detections: Detections,
    cloud: Cloud | None,
    out: Observed,
    mode: str,
) -> Measurements:
    t_ns = int(log.streams[camera].t_ns[schedule.frames[camera][tick]])
    map_T_cam, known = log.map_T_sensor(camera, t_ns)
    out.detections[camera] = out.detections.get(camera, 0) + len(detections)
    if not known[0]:
        return Measurements.empty()
    view = View(log.cameras[camera], t_ns, map_T_cam[0])
    measured = measure_view(view, detections, cloud, mode=mode)
    ego_T_map = inverse(base_pose(log, t_ns))
    out.feet[camera].append(foot_points(view.camera, measured, ego_T_map, tick))
    if cloud is not None:
        out.ground[camera].append(_ground_points(view, cloud, ego_T_map, tick))
    return measured


def base_pose(log: Log, t_ns: int) -> Array:
    """Pose (4, 4) of what carries the cameras: the ego, or the map itself for a roadside log."""
    return np.eye(4) if log.ego is None else log.ego.at(t_ns)[0][0]


def _ground_points(view: View, cloud: Cloud, ego_T_map: Array, tick: int) -> Correspondences:
    """An even sample of the LiDAR's ground points that the camera sees."""
    seen, uv, _ = project_cloud(view, cloud, cloud.ground_sample)
    if len(seen) == 0:
        return Correspondences.join([])
    step = np.linspace(0, len(seen) - 1, min(GROUND_POINTS_A_FRAME, len(seen))).round().astype(np.intp)
    points = cloud.xyz[cloud.ground_sample[seen[step]]].astype(np.float64) + cloud.origin
    xy = (points @ ego_T_map[:3, :3].T + ego_T_map[:3, 3])[:, :2]
    return Correspondences(pinhole(view.camera, uv[step]), xy, np.full(len(step), tick, dtype=np.int64))


def _in_range(log: Log, schedule: Schedule, tick: int, rows: Measurements, max_range_m: float) -> NDArray[np.bool_]:
    """Rows within range of the ego; those without a place stay, for the homography may still give them one."""
    origin, _ = place_of_ego(log, int(schedule.t_ns[tick]))
    with np.errstate(invalid="ignore"):
        return ~(np.hypot(*(rows.center_m[:, :2] - origin[:2]).T) > max_range_m)


def _obstacles(cloud: Cloud) -> Obstacles:
    """The points above the ground, thinned to one a voxel so that a long log fits in memory."""
    index, xyz = cloud.obstacles, cloud.obstacle_columns.T
    near = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) < OBSTACLE_REACH_M)
    index = index[near[_one_a_voxel(xyz[near], OBSTACLE_VOXEL_M)]]
    return Obstacles(cloud.stamp_ns, cloud.origin, cloud.xyz[index], cloud.t_s[index], cloud.sensor)


def _one_a_voxel(xyz: NDArray[np.float32], voxel_m: float) -> NDArray[np.intp]:
    """Indices of the first point of every voxel among points (N, 3), in the order of the points."""
    i, j, k = np.floor(xyz / voxel_m).astype(np.int64).T
    # Voxel and rank in one number: numbers are sorted several times as fast as their places are.
    ordered = np.sort((((i * 4096 + j) * 4096 + k) << RANK_BITS) + np.arange(len(xyz)))
    voxel = ordered >> RANK_BITS
    first = np.flatnonzero(np.diff(voxel, prepend=voxel[:1] - 1))
    return np.sort(ordered[first] & ((1 << RANK_BITS) - 1))
