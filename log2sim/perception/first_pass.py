"""The first pass over a log: every tick's frames and sweeps become measurements."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Boxes3D, Fault, Log, Measurements, Obstacles, Rays, Sweep
from log2sim.files.arrays import ArrayFile, ArrayList
from log2sim.files.stages import StageClock
from log2sim.geometry import Array
from log2sim.perception.alignment import align_parts
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.detection_cache import DetectionCache, LightBox
from log2sim.perception.frames import BACKGROUND_THREADS, FrameDetector, RecordReader
from log2sim.perception.homography.correspondences import Correspondences
from log2sim.perception.lidar.cloud import Cloud, assemble_views, cloud_origin, compensation_of, sample_rays
from log2sim.perception.observe_tick import TickObserver
from log2sim.perception.records import sketch_sweep
from log2sim.perception.sync import Schedule
from log2sim.plan import FusionLevel, Plan, Stage


@dataclass(frozen=True, eq=False)
class _Tick:
    """What is kept of obstacles: `points` holds xyz, t_s and perhaps seen_from, `rays` end, t_s and sensor."""

    stamp_ns: int
    origin: Array
    sensor: NDArray[np.float32]
    viewpoints: NDArray[np.float32] | None
    points: ArrayList
    rays: ArrayList
    lidars: tuple[NDArray[np.float32], NDArray[np.float32]] | None

    def obstacles(self) -> Obstacles:
        return Obstacles(
            self.stamp_ns,
            self.origin,
            partial(self.points.__getitem__, 0),
            partial(self.points.__getitem__, 1),
            self.sensor,
            None if self.lidars is None else self._rays,
            self.viewpoints,
            partial(self.points.__getitem__, 2) if len(self.points) > 2 else None,
        )

    def _rays(self) -> Rays:
        assert self.lidars is not None
        end, t_s, sensor = self.rays
        return Rays(end, t_s, sensor, *self.lidars)


class ObstacleList(Sequence["Obstacles | None"]):
    """Obstacles by tick, None at ticks without LiDAR.

    What is asked for is new each time: its stamp, its origin and the place of its sensor are at hand, and its points and rays are
    read when they are looked at.

    Parameters
    ----------
    file : ArrayFile
        What keeps points and rays.
    """

    def __init__(self, file: ArrayFile) -> None:
        self._file = file
        self._ticks: list[_Tick | None] = []

    def append(self, obstacles: Obstacles | None) -> None:
        """Add those of the next tick."""
        self._ticks.append(None if obstacles is None else self._kept(obstacles))

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._ticks)

    def __getitem__(self, tick: Any) -> Any:
        """Return the obstacles of a tick, a list of them for a slice."""
        if isinstance(tick, slice):
            return [self[k] for k in range(len(self))[tick]]
        kept = self._ticks[tick]
        return None if kept is None else kept.obstacles()

    def _kept(self, of: Obstacles) -> _Tick:
        points = self._keep_all([of.xyz, of.t_s] + ([] if of.seen_from is None else [of.seen_from]))
        rays = self._keep_all([] if of.free is None else [of.free.end, of.free.t_s, of.free.sensor])
        lidars = None if of.free is None else (of.free.position, of.free.velocity_mps)
        return _Tick(of.stamp_ns, of.origin, of.sensor, of.viewpoints, points, rays, lidars)

    def _keep_all(self, columns: Sequence[NDArray[Any]]) -> ArrayList:
        return ArrayList([self._file.keep(column) for column in columns])


OBSTACLE_REACH_M = 70.0
OBSTACLE_VOXEL_M = 0.12
RANK_BITS = 25  # more than the points of any sweep
# Ticks that are prepared ahead of the one that is measured, so that two threads have work.
TICKS_AHEAD = 2

Key = tuple[int, ...]


@dataclass(frozen=True, eq=False)
class CloudOptions:
    """How clouds are made and searched.

    Attributes
    ----------
    max_range_m : float
        Points farther from the origin along an axis are left out.
    detector : LidarDetector, optional
        Searches the clouds of the reference sensor.
    sweeps : int
        Successive clouds that the detector sees as one.
    """

    max_range_m: float
    detector: LidarDetector | None = None
    sweeps: int = 1


class CloudPrefetcher:
    """Make the clouds of coming ticks in the background; ticks share the clouds of the same sweeps, each read once.

    Attributes
    ----------
    compensated : Counter of str
        Number of sweeps by how they were compensated, see `compensation_of`.
    """

    def __init__(
        self,
        log: Log,
        schedule: Schedule,
        plan: Plan,
        records: RecordReader,
        pool: ThreadPoolExecutor,
        options: CloudOptions,
    ) -> None:
        self._log, self._schedule, self._plan, self._records = log, schedule, plan, records
        self._pool, self._options = pool, options
        self._counting = threading.Lock()
        self.compensated: Counter[str] = Counter()
        self._sweeps: dict[tuple[str, int], Future[Sweep | None]] = {}
        self._latest: dict[str, Future[Sweep | None]] = {}
        self._clouds: dict[Key, Future[Cloud | None]] = {}
        self._boxes: dict[Key, Future[Boxes3D]] = {}
        self._earlier: list[Key] = []
        # Boxes of the two clouds before, by whose motion the points of both ends are put to one time.
        self._before: list[Future[Boxes3D]] = []

    def prefetch(self, tick: int) -> None:
        """Start making what a tick and the ones after it need, and forget what only earlier ticks needed."""
        ticks = range(max(tick - 1, 0), min(tick + TICKS_AHEAD, len(self._schedule)))
        keys = {key: None for k in ticks for row in range(self._schedule.rows) for key in [self._key(k, row)]}
        sweeps = {(name, i): None for key in keys for name, i in zip(self._schedule.sweeps, key) if i >= 0}
        kept = {*keys, *self._earlier}
        self._clouds = {k: v for k, v in self._clouds.items() if k in kept}
        self._boxes = {k: v for k, v in self._boxes.items() if k in keys}
        self._sweeps = {k: v for k, v in self._sweeps.items() if k in sweeps}
        # What waits for something else goes after it: it must never keep that from being made.
        for name, i in sorted(sweeps):
            if (name, i) not in self._sweeps:
                reading = self._pool.submit(self._read, name, i, self._latest.get(name))
                self._sweeps[name, i] = self._latest[name] = reading
        for key in keys:
            if key not in self._clouds:
                read = {n: self._sweeps[n, i] for n, i in zip(self._schedule.sweeps, key) if i >= 0}
                self._clouds[key] = self._pool.submit(self._make, read)
        if self._options.detector is not None:
            self._search([self._key(k, self._schedule.reference_row) for k in ticks], self._options.detector)

    def cloud(self, tick: int, row: int) -> Cloud | None:
        """Return the cloud for a row of the schedule; waits until it is made."""
        return self._clouds[self._key(tick, row)].result()

    def boxes(self, tick: int) -> Boxes3D:
        """Return what the detector found in the cloud of the reference sensor; waits until it is found."""
        return self._boxes[self._key(tick, self._schedule.reference_row)].result()

    def _key(self, tick: int, row: int) -> Key:
        """Return the sweep of every LiDAR, -1 for none, that a row of a tick uses."""
        return tuple(int(index[row, tick]) for index in self._schedule.sweeps.values())

    def _search(self, keys: list[Key], detector: LidarDetector) -> None:
        """Start searching the clouds at successive keys that are not searched yet."""
        for key in keys:
            if key not in self._boxes:
                earlier = [self._clouds[k] for k in self._earlier]
                self._boxes[key] = self._pool.submit(_boxes_in, detector, self._clouds[key], earlier, self._before)
                if self._plan.fusion is FusionLevel.POINTS:
                    self._before = [*self._before, self._boxes[key]][-2:]
                self._earlier = [*self._earlier, key][max(len(self._earlier) + 2 - self._options.sweeps, 0) :]

    def _read(self, name: str, index: int, before: Future[Sweep | None] | None) -> Sweep | None:
        """Read a sweep; None where it cannot be read or repeats another, which is known once those before it are read."""
        sweep: Sweep | None = self._records.get(name, index)
        sketch = None if sweep is None else sketch_sweep(self._log, name, sweep)
        if before is not None:
            before.exception()
        if sweep is None or sketch is None:
            return None
        if self._records.watch.lidars[name].is_repeated(int(self._log.streams[name].t_ns[index]), sketch):
            return None
        kind = compensation_of(self._log, name, sweep) if self._plan.keeps(Stage.MOTION_COMPENSATION) else "left out"
        with self._counting:
            self.compensated[kind] += 1
        return sweep

    def _make(self, reading: dict[str, Future[Sweep | None]]) -> Cloud | None:
        sweeps = {name: sweep for name, future in reading.items() if (sweep := future.result()) is not None}
        if not sweeps:
            return None
        origin, ground_z = cloud_origin(self._log, next(iter(sweeps.values())).stamp_ns)
        cloud = assemble_views(
            self._log, sweeps, origin=origin, ground_z=ground_z, max_range_m=self._options.max_range_m,
            compensate=self._plan.keeps(Stage.MOTION_COMPENSATION),
        )  # fmt: skip
        if cloud is not None:
            cloud.prepare(ground=self._plan.keeps(Stage.HOMOGRAPHY))
        return cloud


def _boxes_in(
    detector: LidarDetector,
    making: Future[Cloud | None],
    earlier: list[Future[Cloud | None]],
    found: list[Future[Boxes3D]],
) -> Boxes3D:
    cloud = making.result()
    if cloud is None:
        return Boxes3D.empty()
    cloud = align_parts(cloud, [boxes.result() for boxes in found])
    return detector.detect(cloud, [before for future in earlier if (before := future.result()) is not None])


def obstacles_of(cloud: Cloud) -> Obstacles:
    """Take the points above the ground, one a voxel, and a sample of the rays, so that a long log fits in memory."""
    index, xyz = cloud.obstacles, cloud.obstacle_columns.T
    near = np.flatnonzero(np.hypot(xyz[:, 0], xyz[:, 1]) < OBSTACLE_REACH_M)
    index = index[near[_voxel_sample(xyz[near], OBSTACLE_VOXEL_M)]]
    kept = cloud.stamp_ns, cloud.origin, cloud.xyz[index], cloud.t_s[index], cloud.sensor, sample_rays(cloud)
    if not cloud.parts:
        return Obstacles(*kept)
    first = np.cumsum([len(part.xyz) for part in cloud.parts])
    seen_from = np.searchsorted(first, index, side="right").astype(np.uint8)
    return Obstacles(*kept, np.array([part.sensor for part in cloud.parts]), seen_from)


def _voxel_sample(xyz: NDArray[np.float32], voxel_m: float) -> NDArray[np.intp]:
    """Return the indices of the first point of every voxel among points (N, 3), in the order of the points."""
    i, j, k = np.floor(xyz / voxel_m).astype(np.int64).T
    # Voxel and rank in one number: numbers are sorted several times as fast as their places are.
    ordered = np.sort((((i * 4096 + j) * 4096 + k) << RANK_BITS) + np.arange(len(xyz)))
    voxel = ordered >> RANK_BITS
    first = np.flatnonzero(np.diff(voxel, prepend=voxel[:1] - 1))
    return np.sort(ordered[first] & ((1 << RANK_BITS) - 1))


@dataclass(eq=False)
class Observations:
    """Results of the first pass, by tick.

    Attributes
    ----------
    measurements : T Measurements
        Of all cameras and of the sweeps, not fused; rows of a camera without LiDAR points have no position.
    obstacles : T Obstacles, None at ticks without LiDAR
    points : ArrayFile
        Keeps the points of all measurements and obstacles.
    feet, ground : dict of str to list of Correspondences
        Foot points of measured objects and ground points of the LiDAR, by camera.
    detections : dict of str to int
        Number of detections by camera and by name of the detector in sweeps.
    sweeps : Counter of str
        Number of sweeps by how they were compensated, see `compensation_of`.
    frames_skipped : mapping of str to int
        By camera.
    unseen : mapping of str to list of int
        Ticks at which a camera has a frame that says nothing of them, by camera: unreadable, repeated, black, or not searched.
    faults : tuple of Fault
        Of the records.
    lights : list of LightBox
        Traffic lights in frames, which are no agents.
    """

    measurements: list[Measurements] = field(default_factory=list)
    obstacles: Sequence[Obstacles | None] = field(default_factory=list)
    points: ArrayFile = field(default_factory=ArrayFile)
    feet: dict[str, list[Correspondences]] = field(default_factory=dict)
    ground: dict[str, list[Correspondences]] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)
    records: RecordReader | None = None
    sweeps: Counter[str] = field(default_factory=Counter)
    frames_detected: int = 0
    frames_skipped: Mapping[str, int] = field(default_factory=dict)
    unseen: dict[str, list[int]] = field(default_factory=dict)
    faults: tuple[Fault, ...] = ()
    lights: list[LightBox] = field(default_factory=list)

    @property
    def unreadable(self) -> dict[str, Any]:
        """Return the records that could not be read, by stream, for the report."""
        return {} if self.records is None else self.records.summary()

    def recorded(self, schedule: Schedule) -> dict[str, NDArray[np.bool_]]:
        """Return (T,) for each camera, and for "" any LiDAR, whether it recorded at each tick something that shows what is there."""
        frames = schedule.without_frames(self.unseen).frames
        sweeps = np.array([cloud is not None for cloud in self.obstacles], dtype=bool)
        return {"": sweeps} | {camera: index >= 0 for camera, index in frames.items()}


def observe(
    log: Log,
    schedule: Schedule,
    detector: Detector | None,
    plan: Plan,
    *,
    mode: str,
    max_range_m: float,
    clock: StageClock,
    progress: Callable[[int, int], None],
    lidar_detector: LidarDetector | None = None,
    sweeps: int = 1,
    cache: DetectionCache | None = None,
) -> Observations:
    """Run detection and measurement over all ticks.

    Parameters
    ----------
    detector : Detector, optional
        Searches the frames of the plan's cameras; None where it has no cameras.
    lidar_detector : LidarDetector, optional
        Searches the clouds of the reference sensor.
    sweeps : int
        Successive clouds that it sees as one.
    cache : DetectionCache, optional
        Of the detector in images: frames that it knows are not searched again.
    """
    out = Observations(feet={c: [] for c in plan.cameras}, ground={c: [] for c in plan.cameras})
    records = out.records = RecordReader(log)
    obstacles = out.obstacles = ObstacleList(out.points)
    options = CloudOptions(max_range_m, lidar_detector, sweeps)
    observer = TickObserver(log, schedule, plan, mode, max_range_m)
    with ThreadPoolExecutor(BACKGROUND_THREADS) as pool:
        clouds = CloudPrefetcher(log, schedule, plan, records, pool, options)
        frames = None if detector is None else FrameDetector(log, schedule, detector, plan, records, pool, clock, cache)
        clouds.prefetch(0)
        for tick in range(len(schedule)):
            known_lights = 0 if frames is None else len(frames.lights)
            found = {} if frames is None else frames.detections_at(tick)
            for camera in plan.cameras if frames is not None else ():
                if schedule.frames[camera][tick] >= 0 and camera not in found:
                    out.unseen.setdefault(camera, []).append(tick)
            with clock.stage("cloud"):
                ready = [clouds.cloud(tick, row) for row in range(schedule.rows)]
            if lidar_detector is not None:
                with clock.stage("detect"):
                    boxes = clouds.boxes(tick)
                out.detections[lidar_detector.name] = out.detections.get(lidar_detector.name, 0) + len(boxes)
            clouds.prefetch(tick + 1)
            with clock.stage("measure"):
                seen = observer.measure(tick, found, ready, boxes if lidar_detector is not None else None)
                out.measurements.append(seen.measurements.stored(out.points))
                for camera, detections in found.items():
                    out.detections[camera] = out.detections.get(camera, 0) + len(detections)
                for kept, new in ((out.feet, seen.feet), (out.ground, seen.ground)):
                    for camera, correspondences in new.items():
                        kept[camera].append(correspondences)
                if frames is not None:
                    frames.lights[known_lights:] = observer.range_lights(tick, frames.lights[known_lights:], ready)
            with clock.stage("cloud"):
                obstacles.append(None if ready[0] is None else obstacles_of(ready[0]))
            progress(tick + 1, len(schedule))
    records.require_some()
    if cache is not None:
        cache.finish()
    out.sweeps, out.faults = clouds.compensated, records.watch.faults(schedule)
    if frames is not None:
        out.frames_detected, out.frames_skipped, out.lights = frames.detected, frames.skipped, frames.lights
    return out
