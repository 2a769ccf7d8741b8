"""The first pass over a log: every tick's frames and sweeps become measurements."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Detections, Log, Measurements, Obstacles, Sweep
from log2sim.geometry import Array, inverse
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.frames import FrameDetector, RecordReader
from log2sim.perception.homography.correspondences import Correspondences, foot_points, undistorted_pixels
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud, is_at_rest
from log2sim.perception.lidar.measure import measure_view, project_cloud
from log2sim.perception.lidar.projection import View
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan, Stage
from log2sim.stage_clock import StageClock

MAX_GROUND_POINTS_PER_FRAME = 40
OBSTACLE_REACH_M = 70.0
OBSTACLE_VOXEL_M = 0.12
RANK_BITS = 25  # more than the points of any sweep
BACKGROUND_THREADS = 2


@dataclass(eq=False)
class Observations:
    """Results of the first pass, by tick.

    Attributes
    ----------
    measurements : T Measurements
        Of all cameras, not fused; rows without LiDAR points have no position.
    obstacles : T Obstacles, None at ticks without LiDAR
    feet, ground : dict of str to list of Correspondences
        Foot points of measured objects and ground points of the LiDAR, by camera.
    detections : dict of str to int
        Number of detections by camera.
    records : RecordReader, optional
    sweeps : Counter of str
        Number of sweeps by how they were compensated, see `compensation_of`.
    frames_detected : int
    frames_skipped : mapping of str to int
        By camera.
    """

    measurements: list[Measurements] = field(default_factory=list)
    obstacles: list[Obstacles | None] = field(default_factory=list)
    feet: dict[str, list[Correspondences]] = field(default_factory=dict)
    ground: dict[str, list[Correspondences]] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)
    records: RecordReader | None = None
    sweeps: Counter[str] = field(default_factory=Counter)
    frames_detected: int = 0
    frames_skipped: Mapping[str, int] = field(default_factory=dict)


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
) -> Observations:
    """Run detection and measurement over all ticks."""
    out = Observations(feet={c: [] for c in plan.cameras}, ground={c: [] for c in plan.cameras})
    records = out.records = RecordReader(log)
    with ThreadPoolExecutor(BACKGROUND_THREADS) as pool:
        clouds = _CloudPrefetcher(log, schedule, plan, records, out, pool, max_range_m)
        frames = FrameDetector(log, schedule, detector, plan, records, pool, clock)
        clouds.prefetch(0)
        for tick in range(len(schedule)):
            found = frames.detections_at(tick)
            with clock.stage("cloud"):
                ready = [clouds.get(tick, row) for row in range(len(schedule.frames))]
            clouds.prefetch(tick + 1)
            _measure_tick(log, schedule, plan, tick, found, ready, out, mode=mode, max_range_m=max_range_m, clock=clock)
            progress(tick + 1, len(schedule))
    records.require_some()
    out.frames_detected, out.frames_skipped = frames.detected, frames.skipped
    return out


class _CloudPrefetcher:
    """Make the clouds of coming ticks in the background; ticks share the clouds of the same sweeps, each read once."""

    def __init__(
        self, log: Log, schedule: Schedule, plan: Plan, records: RecordReader, out: Observations,
        pool: ThreadPoolExecutor, max_range_m: float,
    ) -> None:  # fmt: skip
        self._log, self._schedule, self._plan, self._records, self._out = log, schedule, plan, records, out
        self._counting = threading.Lock()
        self._pool, self._max_range_m = pool, max_range_m
        self._sweeps: dict[tuple[str, int], Future[Sweep | None]] = {}
        self._clouds: dict[tuple[int, ...], Future[Cloud | None]] = {}

    def _key(self, tick: int, row: int) -> tuple[int, ...]:
        """Return the sweep of every LiDAR, -1 for none, that a camera of a tick uses."""
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
                self._sweeps[sweep] = self._pool.submit(self._read, *sweep)
        for key in keys:
            if key not in self._clouds:
                read = {n: self._sweeps[n, i] for n, i in zip(self._schedule.sweeps, key) if i >= 0}
                self._clouds[key] = self._pool.submit(self._make, read)

    def _read(self, name: str, index: int) -> Sweep | None:
        assert self._out.records is not None
        sweep: Sweep | None = self._records.get(name, index)
        if sweep is not None:
            kind = (
                compensation_of(self._log, name, sweep) if self._plan.keeps(Stage.MOTION_COMPENSATION) else "left out"
            )
            with self._counting:
                self._out.sweeps[kind] += 1
        return sweep

    def _make(self, reading: dict[str, Future[Sweep | None]]) -> Cloud | None:
        sweeps = {name: sweep for name, future in reading.items() if (sweep := future.result()) is not None}
        if not sweeps:
            return None
        origin, ground_z = cloud_origin(self._log, next(iter(sweeps.values())).stamp_ns)
        cloud = assemble_cloud(
            self._log, sweeps, origin=origin, ground_z=ground_z, max_range_m=self._max_range_m,
            compensate=self._plan.keeps(Stage.MOTION_COMPENSATION),
        )  # fmt: skip
        if cloud is not None:
            cloud.prepare(ground=self._plan.keeps(Stage.HOMOGRAPHY))
        return cloud

    def get(self, tick: int, row: int) -> Cloud | None:
        """Return the cloud for the camera in a row of the schedule; waits until it is made."""
        return self._clouds[self._key(tick, row)].result()


def _measure_tick(
    log: Log,
    schedule: Schedule,
    plan: Plan,
    tick: int,
    found: dict[str, Detections],
    clouds: Sequence[Cloud | None],
    out: Observations,
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
                parts.append(_measure_camera(log, schedule, plan, camera, tick, found[camera], cloud, out, mode))
        joined = Measurements.join(parts)
        out.measurements.append(joined.take(_in_range(log, schedule, tick, joined, max_range_m)))
    with clock.stage("cloud"):
        out.obstacles.append(None if clouds[0] is None else _obstacles(clouds[0]))


def compensation_of(log: Log, lidar: str, sweep: Sweep) -> str:
    """How a sweep is compensated: "in the map" before, "no times" to do it with, "at rest" or "moving"."""
    if sweep.frame == "map":
        return "in the map"
    if sweep.t_ns is None:
        return "no times"
    return "at rest" if is_at_rest(log, lidar, sweep) else "moving"


def cloud_origin(log: Log, t_ns: int) -> tuple[Array, float]:
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
    plan: Plan,
    camera: str,
    tick: int,
    detections: Detections,
    cloud: Cloud | None,
    out: Observations,
    mode: str,
) -> Measurements:
    t_ns = int(log.streams[camera].t_ns[schedule.frames[camera][tick]])
    map_T_cam, known = log.map_T_sensor(camera, t_ns)
    out.detections[camera] = out.detections.get(camera, 0) + len(detections)
    if not known[0]:
        return Measurements.empty()
    view = View(log.cameras[camera], t_ns, map_T_cam[0])
    measured = measure_view(view, detections, cloud, mode=mode)
    if not plan.keeps(Stage.HOMOGRAPHY):
        return measured
    ego_T_map = inverse(base_pose(log, t_ns))
    out.feet[camera].append(foot_points(view.camera, measured, ego_T_map, tick))
    if cloud is not None:
        out.ground[camera].append(_ground_points(view, cloud, ego_T_map, tick))
    return measured


def base_pose(log: Log, t_ns: int) -> Array:
    """Pose (4, 4) of what carries the cameras: the ego, or the map itself for a roadside log."""
    return np.eye(4) if log.ego is None else log.ego.at(t_ns)[0][0]


def _ground_points(view: View, cloud: Cloud, ego_T_map: Array, tick: int) -> Correspondences:
    """Sample the LiDAR's ground points that the camera sees evenly."""
    visible, uv, _ = project_cloud(view, cloud, cloud.ground_sample)
    if len(visible) == 0:
        return Correspondences.join([])
    step = np.linspace(0, len(visible) - 1, min(MAX_GROUND_POINTS_PER_FRAME, len(visible))).round().astype(np.intp)
    points = cloud.xyz[cloud.ground_sample[visible[step]]].astype(np.float64) + cloud.origin
    xy = (points @ ego_T_map[:3, :3].T + ego_T_map[:3, 3])[:, :2]
    return Correspondences(undistorted_pixels(view.camera, uv[step]), xy, np.full(len(step), tick, dtype=np.int64))


def _in_range(log: Log, schedule: Schedule, tick: int, rows: Measurements, max_range_m: float) -> NDArray[np.bool_]:
    """Mark the rows within range of the ego, and those without a position, which a homography may still place."""
    origin, _ = cloud_origin(log, int(schedule.t_ns[tick]))
    with np.errstate(invalid="ignore"):
        return np.asarray(~(np.hypot(*(rows.center_m[:, :2] - origin[:2]).T) > max_range_m))


def _obstacles(cloud: Cloud) -> Obstacles:
    """Take the points above the ground, one a voxel, so that a long log fits in memory."""
    index, xyz = cloud.obstacles, cloud.obstacle_columns.T
    near = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) < OBSTACLE_REACH_M)
    index = index[near[_voxel_sample(xyz[near], OBSTACLE_VOXEL_M)]]
    return Obstacles(cloud.stamp_ns, cloud.origin, cloud.xyz[index], cloud.t_s[index], cloud.sensor)


def _voxel_sample(xyz: NDArray[np.float32], voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point of every voxel among points (N, 3), in the order of the points."""
    i, j, k = np.floor(xyz / voxel_m).astype(np.int64).T
    # Voxel and rank in one number: numbers are sorted several times as fast as their places are.
    ordered = np.sort((((i * 4096 + j) * 4096 + k) << RANK_BITS) + np.arange(len(xyz)))
    voxel = ordered >> RANK_BITS
    first = np.flatnonzero(np.diff(voxel, prepend=voxel[:1] - 1))
    return np.sort(ordered[first] & ((1 << RANK_BITS) - 1))
