"""The first pass over a log: every tick's frames and sweeps become measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from functools import partial
from itertools import chain, pairwise
from threading import Lock
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.config import Config
from log2sim.datatypes import (
    ENDS,
    Boxes3D,
    Detections,
    Finding,
    Log,
    Measurements,
    Obstacles,
    OtherView,
    Rays,
    Sweep,
    end_of,
    groups_of,
)
from log2sim.files.arrays import ArrayFile, ArrayList
from log2sim.files.cluster import Sent, count_workers, map_on_workers
from log2sim.files.inputs import following_links
from log2sim.files.packing import digest_of
from log2sim.files.processes import map_in_processes
from log2sim.files.stages import StageClock, usable_threads
from log2sim.geometry import Array, inverse, line_stamps_ns
from log2sim.perception.boxes import subsample
from log2sim.perception.cooperative import align_parts
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.frames import MAX_CROPS, FrameDetector, LightBox, PictureFindings, add_ranges
from log2sim.perception.homography.correspondences import (
    Correspondences,
    feet_of_boxes,
    foot_points,
    undistorted_pixels,
)
from log2sim.perception.lidar.cloud import (
    Cloud,
    assemble_views,
    cloud_origin,
    compensation_of,
    join_parts,
    obstacles_of,
)
from log2sim.perception.lidar.measure import Frame as MeasuredFrame
from log2sim.perception.lidar.measure import measure, outside_ego
from log2sim.perception.lidar.projection import View, project_boxes_in_view, project_points, view_of
from log2sim.perception.records import Look, RecordSource, RecordWatch, SweepSketch, sketch_sweep
from log2sim.perception.run_detectors import Detectors, GivenDetectors, create_detectors, digest_of_record, open_store
from log2sim.perception.sync import Schedule
from log2sim.plan import FusionLevel, Plan, Stage

if TYPE_CHECKING:
    from distributed import Client


class ObstacleList(Sequence["Obstacles | None"]):
    """Obstacles by tick, None at ticks without LiDAR.

    What is asked for is new each time: its stamp, its origin and the place of its sensor are at hand, and its points and rays are
    read when they are looked at.

    `file`: what keeps points and rays.
    """

    def __init__(self, file: ArrayFile) -> None:
        self._file = file
        self._ticks: list[Callable[[], Obstacles] | None] = []

    def append(self, obstacles: Obstacles | None) -> None:
        """Add those of the next tick."""
        if obstacles is None:
            self._ticks.append(None)
            return
        of, free, seen_from = obstacles, obstacles.free, obstacles.seen_from
        points, rays = (
            ArrayList([self._file.keep(column) for column in columns if column is not None])
            for columns in ((of.xyz, of.t_s, seen_from), () if free is None else (free.end, free.t_s, free.sensor))
        )
        read = partial(points.__getitem__, 0), partial(points.__getitem__, 1)
        of_rays = None if free is None else partial(_read_rays, rays, free.position, free.velocity_mps)
        last = None if seen_from is None else partial(points.__getitem__, 2)
        self._ticks.append(partial(Obstacles, of.stamp_ns, of.origin, *read, of.sensor, of_rays, of.viewpoints, last))

    def __len__(self) -> int:
        """Return the number of ticks."""
        return len(self._ticks)

    def __getitem__(self, tick: Any) -> Any:
        """Return the obstacles of a tick, a list of them for a slice."""
        if isinstance(tick, slice):
            return [self[k] for k in range(len(self))[tick]]
        make = self._ticks[tick]
        return None if make is None else make()


def _read_rays(kept: ArrayList, position: NDArray[np.float32], velocity_mps: NDArray[np.float32]) -> Rays:
    """Make rays of what is kept of them; a function of the module, so that first passes can be pickled."""
    end, t_s, sensor = kept
    return Rays(end, t_s, sensor, position, velocity_mps)


# Sweeps of each LiDAR that are kept for the next ticks, which may share some.
SWEEPS_KEPT = 4
# Ticks that are worked on together, at least; at the end fewer, so that no process waits long for another.
PART_TICKS, LAST_PART_TICKS = 5, 2

# Groups that pictures are to confirm at every tick, as they have few points, and the least score of their boxes, a calibrated
# probability. With 0.3 or 0, 4.6 or 5.0 of 5 parts of a picture are searched on KITTI instead of 4.2, with the same agents.
VULNERABLE, MIN_WATCHED_SCORE = ("pedestrian", "two_wheeler"), 0.5

Key = tuple[int, ...]


class CloudMaker:
    """Make the clouds of successive ticks and search them; ticks share the clouds of the same sweeps, each read once.

    `config`: `measure.max_range_m`: points farther from the origin along an axis are left out; `lidar.sweeps`: successive
    clouds that the detector sees as one. `detector`: searches the clouds of the reference sensor.
    """

    def __init__(
        self, log: Log, schedule: Schedule, plan: Plan, config: Config, detector: LidarDetector | None
    ) -> None:
        self._log, self._schedule, self._plan, self._detector = log, schedule, plan, detector
        self._max_range_m, self._most_seen = config.measure.max_range_m, config.lidar.sweeps
        self.before: list[tuple[Key, Boxes3D]] = []
        self.compensated: dict[tuple[str, int], str] = {}
        self._next = 0
        self._sweeps: dict[tuple[str, int], Sweep | None] = {}
        self._sketches: dict[tuple[str, int], SweepSketch] = {}
        self._live: set[tuple[str, int]] = set()
        self._clouds: dict[Key, Cloud | None] = {}
        self._earlier: list[tuple[Key, Cloud | None]] = []

    def clouds(self, tick: int, records: RecordSource) -> list[Cloud | None]:
        """Return the clouds of a tick for every row of the schedule."""
        rows = [self._sweeps_of(tick, row) for row in range(self._schedule.rows)]
        earlier = [] if tick == self._next else self._searched_before(tick)
        self._read([*earlier, *rows], records)
        if tick != self._next:
            self._earlier = [(key, self._cloud(key)) for key in map(self._shown, earlier)]
        self._next = tick + 1
        keys = [self._shown(sweeps) for sweeps in rows]
        self._clouds = {key: self._cloud(key) for key in dict.fromkeys(keys)}
        return [self._clouds[key] for key in keys]

    def boxes(self, tick: int) -> Boxes3D:
        """Return what the detector found in the cloud of the reference sensor, after `clouds` of this tick."""
        assert self._detector is not None
        key = self._shown(self._sweeps_of(tick, self._schedule.reference_row))
        if not self.before or self.before[-1][0] != key:
            found, cloud = Boxes3D.empty(), self._clouds[key]
            if cloud is not None:
                aligns = self._plan.fusion is FusionLevel.POINTS
                cloud = align_parts(cloud, [boxes for _, boxes in self.before] if aligns else [])
                found = self._detector.detect(cloud, [c for _, c in self._earlier if c is not None])
            self.before = [*self.before, (key, found)][-2:]
            kept = max(len(self._earlier) + 2 - self._most_seen, 0)
            self._earlier = [*self._earlier, (key, self._clouds[key])][kept:]
        return self.before[-1][1]

    def _sweeps_of(self, tick: int, row: int) -> Key:
        """Return the sweep of every LiDAR, -1 for none, that a row of a tick uses."""
        return tuple(int(index[row, tick]) for index in self._schedule.sweeps.values())

    def _shown(self, sweeps: Key) -> Key:
        """Return the same, -1 for those that cannot be read or repeat another."""
        return tuple(i if (name, i) in self._live else -1 for name, i in zip(self._schedule.sweeps, sweeps))

    def _searched_before(self, tick: int) -> list[Key]:
        """Return the sweeps of the clouds that the detector sees along with that of a tick."""
        row, wanted, found = self._schedule.reference_row, self._most_seen - 1, list[Key]()
        last = self._sweeps_of(tick, row)
        for k in range(tick - 1, -1, -1) if self._detector is not None else ():
            sweeps = self._sweeps_of(k, row)
            if len(found) == wanted:
                break
            if sweeps != last:
                found.append(sweeps)
                last = sweeps
        return found[::-1]

    def sweeps_of(self, ticks: range) -> list[tuple[str, int]]:
        """List all sweeps that the clouds of some ticks are made of: LiDARs and indices."""
        rows = [self._sweeps_of(tick, row) for tick in ticks for row in range(self._schedule.rows)]
        return self._listed([*self._searched_before(ticks.start), *rows])

    def _listed(self, keys: Sequence[Key]) -> list[tuple[str, int]]:
        return sorted({(name, i) for key in keys for name, i in zip(self._schedule.sweeps, key) if i >= 0})

    def _read(self, keys: Sequence[Key], records: RecordSource) -> None:
        """Read and judge the sweeps of some clouds in their order, and forget those that only earlier ticks needed."""
        wanted, compensates = self._listed(keys), self._plan.keeps(Stage.MOTION_COMPENSATION)
        self._live = set()
        for name, i in wanted:
            sweep = self._sweeps.pop((name, i)) if (name, i) in self._sweeps else records.get(name, i)
            self._sweeps[name, i] = sweep  # the last one in
            if sweep is None:
                continue
            if (name, i) not in self._sketches:
                self._sketches[name, i] = sketch_sweep(self._log, name, sweep)
            if records.is_live(name, i, self._sketches[name, i]):
                self._live.add((name, i))
                self.compensated[name, i] = compensation_of(self._log, name, sweep) if compensates else "left out"
        most = max(SWEEPS_KEPT * len(self._schedule.sweeps), len(wanted), 1)
        self._sweeps = dict(list(self._sweeps.items())[-most:])
        self._sketches = {key: sketch for key, sketch in self._sketches.items() if key in self._sweeps}

    def _cloud(self, key: Key) -> Cloud | None:
        """Return the cloud of some sweeps, which is made if the tick before had another."""
        if key in self._clouds:
            return self._clouds[key]
        sweeps = {name: sweep for name, i in zip(self._schedule.sweeps, key) if (sweep := self._sweeps.get((name, i)))}
        if not sweeps:
            return None
        origin, ground_z = cloud_origin(self._log, next(iter(sweeps.values())).stamp_ns)
        cloud = assemble_views(
            self._log, sweeps, origin=origin, ground_z=ground_z, max_range_m=self._max_range_m,
            compensate=self._plan.keeps(Stage.MOTION_COMPENSATION),
        )  # fmt: skip
        if cloud is not None:
            cloud.prepare(ground=self._plan.keeps(Stage.HOMOGRAPHY))
        return cloud


@dataclass(eq=False)
class Observations:
    """Results of the first pass, by tick."""

    # T Measurements: of all cameras and of the sweeps, not fused; rows of a camera without LiDAR points have no position
    measurements: list[Measurements] = field(default_factory=list)
    obstacles: Sequence[Obstacles | None] = field(default_factory=list)  # T Obstacles, None at ticks without LiDAR
    points: ArrayFile = field(default_factory=ArrayFile)  # keeps the points of all measurements and obstacles
    # `feet`, `ground`: foot points of measured objects and ground points of the LiDAR, by camera
    feet: dict[str, list[Correspondences]] = field(default_factory=dict)
    ground: dict[str, list[Correspondences]] = field(default_factory=dict)
    detections: dict[str, int] = field(default_factory=dict)  # by camera and by name of the detector in sweeps
    records: RecordSource | None = None
    sweeps: Counter[str] = field(default_factory=Counter)  # by how they were compensated, see `compensation_of`
    frames_detected: int = 0
    frames_skipped: Counter[str] = field(default_factory=Counter)  # by camera
    # Ticks at which a camera has a frame that says nothing of them, by camera: unreadable, repeated, black, or not searched
    unseen: dict[str, list[int]] = field(default_factory=dict)
    faults: tuple[Finding, ...] = ()  # of the records
    lights: list[LightBox] = field(default_factory=list)  # traffic lights in frames, which are no agents

    @property
    def unreadable(self) -> dict[str, Any]:
        """Return the records that could not be read, by stream, for the report."""
        return {} if self.records is None else self.records.summary()

    def recorded(self, schedule: Schedule) -> dict[str, NDArray[np.bool_]]:
        """Return (T,) for each camera, and for "" any LiDAR, whether it recorded at each tick something that shows what is there."""
        frames = schedule.drop_frames(self.unseen).frames
        sweeps = np.array([cloud is not None for cloud in self.obstacles], dtype=bool)
        return {"": sweeps} | {camera: index >= 0 for camera, index in frames.items()}


@dataclass(eq=False)
class SeenTick:
    """What the first pass takes from one tick, see `Observations`."""

    measurements: Measurements = field(default_factory=Measurements.empty)
    feet: dict[str, Correspondences] = field(default_factory=dict)  # where a homography needs them, as `ground`
    ground: dict[str, Correspondences] = field(default_factory=dict)
    obstacles: Obstacles | None = None
    lights: list[LightBox] = field(default_factory=list)
    found: dict[str, int] = field(default_factory=dict)  # number of `detections`
    frames: int = 0  # how many were searched
    skipped: list[str] = field(default_factory=list)  # cameras whose frame was not searched
    unseen: list[str] = field(default_factory=list)  # cameras whose frame says nothing


@dataclass(eq=False)
class Part:
    """What the first pass takes from successive ticks, with what it knew of their records."""

    ticks: list[SeenTick]
    looks: list[Look]
    read: dict[str, int]
    failed: dict[str, list[str]]
    compensated: dict[tuple[str, int], str]
    before: list[tuple[Key, Boxes3D]]  # see `CloudMaker`, after these ticks


PACKED = (
    Part, SeenTick, Measurements, OtherView, Correspondences, Obstacles, Rays, LightBox, Look, SweepSketch, Boxes3D,
)  # fmt: skip


@dataclass(eq=False)
class Task:
    """Ticks that are to be observed."""

    ticks: range
    watch: RecordWatch  # what is known of the records before them
    before: list[tuple[Key, Boxes3D]]  # see `CloudMaker`, before these ticks
    judged: bool = False  # whether all that is to be known of the records is known already


MAX_GROUND_POINTS_PER_FRAME = 40


class FirstPass:
    """Detection and measurement of parts of a log; what a part holds does not depend on those that this process made before."""

    def __init__(self, log: Log, schedule: Schedule, plan: Plan, detectors: Detectors, config: Config) -> None:
        self.log, self.schedule, self.plan, self.detectors, self.config = log, schedule, plan, detectors, config
        self.clouds = CloudMaker(log, schedule, plan, config, detectors.sweeps)
        self.frames = None if detectors.images is None else FrameDetector(log, schedule, detectors.images, plan)
        if detectors.cache is not None:
            # Of the plan what this pass looks at, so that other later stages leave the key as it is.
            stages = [plan.keeps(s) for s in (Stage.IMAGE_DECODING, Stage.MOTION_COMPENSATION, Stage.HOMOGRAPHY)]
            planned = [plan.detector_stride, plan.picture_stride, plan.tiles_by_turns, plan.fusion, stages]
            settings = [config.measure.mode, config.measure.max_range_m, config.lidar.sweeps]
            detectors.cache.begin(log, [list(plan.cameras), planned, *settings, schedule.reference_row])

    def __reduce__(self) -> Any:
        """Return how another process makes it, with detectors of its own."""
        of = self.log, self.schedule, self.plan, self.config, self.detectors.cache is not None
        return _with_own_detectors, of

    def parts(self) -> list[range]:
        """Return the ticks of each part; where frames are skipped between some of them, a part has a multiple of these."""
        total, stride = len(self.schedule), self.plan.detector_stride
        step, last = (stride * -(-least // stride) for least in (PART_TICKS, LAST_PART_TICKS))
        whole = max(total // step - 2, 0) * step
        starts = [*range(0, whole, step), *range(whole, total, last)]
        return [range(*of) for of in pairwise([*starts, total])]

    def observe(self, task: Task) -> tuple[Part, StageClock, tuple[int, int, str | None]]:
        """Detect and measure in some ticks; returns how many were known and how many were kept, and why no more, too."""
        task.watch.attach(self.log)
        records, clock, count = RecordSource(self.log, task.watch), StageClock(), len(task.ticks)
        cache = self.detectors.cache
        if cache is not None:
            with clock.stage("recall"):
                key = self._content(task, records)
                part: Part | None = cache.get(key, PACKED)
            if part is not None and len(part.ticks) == count:
                return part, clock, (count, 0, None)
        self.clouds.before, self.clouds.compensated = task.before, {}
        seen = [self._tick(tick, records, clock) for tick in task.ticks]
        looks = list(records.looks.values())
        part = Part(seen, looks, records.read, records.failed, self.clouds.compensated, self.clouds.before)
        if cache is None:
            return part, clock, (0, 0, None)
        with clock.stage("recall"):
            kept = cache.put(key, part)
        return part, clock, (0, count * kept, cache.store.problem)

    def _content(self, task: Task, records: RecordSource) -> bytes:
        """Return a digest of the records of some ticks, and of all else that what is seen there depends on."""
        ticks, total = task.ticks, len(self.schedule)
        looked = range(ticks.start, min(ticks.stop + (self.plan.detector_stride > 1), total))
        cameras = self.plan.cameras if self.frames is not None else ()
        shown = [(name, int(self.schedule.frames[name][tick])) for name in cameras for tick in looked]
        described: list[Any] = []
        for name, index in (*(key for key in shown if key[1] >= 0), *self.clouds.sweeps_of(ticks)):
            stream = self.log.streams[name]
            digest = digest_of_record(stream, index, partial(records.require, name))
            described.append([name, index, int(stream.t_ns[index]), digest])
        sweeps = {name: index[:, ticks.start : ticks.stop] for name, index in self.schedule.sweeps.items()}
        before = task.before if self.plan.fusion is FusionLevel.POINTS else []
        states = [sorted(records.watch.known(s).items()) for s in self.log.streams] if task.judged else None
        turn = ticks.start % (2 * self.plan.detector_stride) if self.plan.tiles_by_turns else 0
        described += [turn, self.schedule.t_ns[ticks.start : ticks.stop], sweeps, before, ticks.stop == total, states]
        return bytes.fromhex(digest_of(described))

    def _tick(self, tick: int, records: RecordSource, clock: StageClock) -> SeenTick:
        plan, live, lights, skipped, searched = self.plan, dict[str, Detections](), list[LightBox](), list[str](), 0
        with clock.stage("cloud"):
            clouds = self.clouds.clouds(tick, records)
        detector, boxes_3d = self.detectors.sweeps, None
        if detector is not None:
            with clock.stage("detect"):
                boxes_3d = self.clouds.boxes(tick)
        looked = dict[str, PictureFindings | None]()
        if self.frames is not None:
            watched = {} if boxes_3d is None or not plan.tiles_by_turns else self._vulnerable_in_view(tick, boxes_3d)
            looked = self.frames.search(tick, records, clock, watched)
        for camera, found in looked.items():
            if found is None:
                skipped.append(camera)
                if plan.picture_stride > 1:
                    continue
            boxes, thumbnail, shown = (Detections.empty(), None, ()) if found is None else found
            searched += found is not None
            index = int(self.schedule.frames[camera][tick])
            if not plan.keeps(Stage.IMAGE_DECODING) or records.is_live(camera, index, thumbnail, found=len(boxes) > 0):
                live[camera] = boxes
                lights += shown
        with clock.stage("measure"):
            out = self._measure(tick, live, clouds, boxes_3d)
            for camera, cloud in zip(self.schedule.frames, clouds):
                mine = [light for light in lights if light.camera == camera]
                view = self._view(camera, tick) if mine else None
                out.lights += mine if view is None or cloud is None else add_ranges(mine, view, cloud)
        with clock.stage("cloud"):
            out.obstacles = None if clouds[0] is None else obstacles_of(clouds[0])
        out.found = {} if detector is None or boxes_3d is None else {detector.name: len(boxes_3d)}
        out.found |= {camera: len(boxes) for camera, boxes in live.items()}
        out.frames, out.skipped = searched, skipped
        if self.frames is not None:
            out.unseen = [c for c in plan.cameras if self.schedule.frames[c][tick] >= 0 and c not in live]
        return out

    def _vulnerable_in_view(self, tick: int, boxes: Boxes3D) -> dict[str, Array]:
        """Return where each camera sees what is likely a person or a two-wheeler: boxes (K, 4), px."""
        rows = np.isin(groups_of(boxes.category), VULNERABLE) & (boxes.score >= MIN_WATCHED_SCORE)
        out = dict[str, Array]()
        for camera in self.plan.cameras if rows.any() else ():
            if self.schedule.frames[camera][tick] >= 0 and (view := self._view(camera, tick)) is not None:
                shown = project_boxes_in_view(view, boxes.center_m[rows], boxes.size_m[rows], boxes.yaw_rad[rows])
                out[camera] = shown.box_px[shown.valid]
        return out

    def _measure(
        self, tick: int, found: dict[str, Detections], clouds: Sequence[Cloud | None], boxes: Boxes3D | None
    ) -> SeenTick:
        """Measure the detections of a tick, each camera's in its cloud and boxes in that of the reference."""
        reference, settings = clouds[self.schedule.reference_row], self.config.measure
        # Where clouds were searched, a camera's objects are sought in what its own end sees, if it sees anything.
        parts = {(id(c), end): c for c in clouds for end in ENDS}
        for cloud in clouds if boxes is not None else ():
            if cloud is not None and cloud.parts:
                for end in ENDS:
                    parts[id(cloud), end] = join_parts([part for part in cloud.parts if part.end == end]) or cloud
        frames: dict[str, list[MeasuredFrame]] = {end: [] for end in ENDS}
        for camera, cloud in zip(self.schedule.frames, clouds):
            if camera in found and (view := self._view(camera, tick)) is not None:
                end = end_of(view.camera)
                frames[end].append((view, found[camera], parts[id(cloud), end]))
        shown = list(chain(*frames.values()))
        boxes = None if boxes is None else outside_ego(self.log, boxes)
        rows = measure(shown, boxes, reference, mode=settings.mode)
        origin, _ = cloud_origin(self.log, int(self.schedule.t_ns[tick]))
        with np.errstate(invalid="ignore"):  # of rows without a position, which a homography may still place
            far = np.hypot(*(rows.center_m[:, :2] - origin[:2]).T) > settings.max_range_m
        out = SeenTick(rows.take(~far))
        for view, _, cloud in shown if self.plan.keeps(Stage.HOMOGRAPHY) else ():
            # Where the ego is when a line is read, one homography maps all lines of a rolling shutter to the ground.
            sensor = view.camera
            ego_T_map = inverse(base_poses(self.log, line_stamps_ns(sensor, view.t_ns, feet_of_boxes(rows.box_px))))
            out.feet[sensor.name] = foot_points(sensor, rows, ego_T_map, tick)
            if cloud is None:
                continue
            # The LiDAR's ground points that the camera sees, some, evenly.
            seen = project_points(view, cloud.origin, cloud.columns.take(cloud.ground_sample, axis=1))
            if not len(seen.index):
                continue
            some = subsample(np.arange(len(seen.index)), MAX_GROUND_POINTS_PER_FRAME)
            uv = np.stack([seen.u, seen.v], axis=1)[some].astype(np.float64)
            points = cloud.xyz[cloud.ground_sample[seen.index[some]]].astype(np.float64) + cloud.origin
            ego_T_map = inverse(base_poses(self.log, line_stamps_ns(sensor, view.t_ns, uv)))
            xy = ((ego_T_map[:, :3, :3] @ points[:, :, None])[:, :, 0] + ego_T_map[:, :3, 3])[:, :2]
            number = np.full(len(some), tick, dtype=np.int64)
            out.ground[sensor.name] = Correspondences(undistorted_pixels(sensor, uv), xy, number)
        return out

    def _view(self, camera: str, tick: int) -> View | None:
        """Return a camera's frame of a tick; None where its pose is not known."""
        t_ns = int(self.log.streams[camera].t_ns[self.schedule.frames[camera][tick]])
        return view_of(self.log, camera, t_ns)


def _with_own_detectors(log: Log, schedule: Schedule, plan: Plan, config: Config, cached: bool) -> FirstPass:
    cv2.setNumThreads(usable_threads())
    store = open_store() if cached else None
    return FirstPass(log, schedule, plan, create_detectors(log, config, GivenDetectors(config), store=store), config)


_WORKING = Lock()  # threads of one worker, which share detectors and clouds


def observe_on_worker(run: Sent, task: Task) -> tuple[Part, StageClock, tuple[int, int, str | None]]:
    """Observe some ticks of a first pass that was sent to this process, and is made here once."""
    with _WORKING, following_links(run.follow_links):
        first_pass: FirstPass = run.received()
        return first_pass.observe(task)


def base_poses(log: Log, t_ns: NDArray[np.int64]) -> Array:
    """Poses (N, 4, 4) at stamps (N,) of what carries the cameras: the ego, or the map itself for a roadside log."""
    return np.tile(np.eye(4), (len(t_ns), 1, 1)) if log.ego is None else log.ego.at(t_ns)[0]


def observe(
    log: Log,
    schedule: Schedule,
    plan: Plan,
    *,
    detectors: Detectors,
    config: Config,
    clock: StageClock,
    progress: Callable[[int, int], None] = lambda done, total: None,
    jobs: int = 1,
    client: Client | None = None,
) -> Observations:
    """Run detection and measurement over all ticks.

    `detectors`: those of pictures search the frames of the plan's cameras, those of sweeps the clouds of the reference
    sensor; ticks that their cache knows are not looked at again. `config`: how to measure, and how many successive clouds
    are searched as one. `jobs`: processes that share the ticks. `client`: of a Dask scheduler whose workers share them in place of
    processes. The result is the same for any number; with fusion of points each cloud needs the one before, so that this process
    does all.

    Whether a record repeats another depends on all before it. A part is made with what is known when it begins; its records are
    judged again when all before are known, and it is made again, by then in this process, where that changes anything.
    """
    out = Observations(feet={c: [] for c in plan.cameras}, ground={c: [] for c in plan.cameras})
    obstacles = out.obstacles = ObstacleList(out.points)
    first_pass, cache = FirstPass(log, schedule, plan, detectors, config), detectors.cache
    ranges = first_pass.parts()
    if plan.fusion is FusionLevel.POINTS:
        jobs, client = 1, None
    jobs = min(jobs, len(ranges)) if client is None else count_workers(client)
    records = out.records = RecordSource(log)
    before: list[tuple[Key, Boxes3D]] = []
    compensated: dict[tuple[str, int], str] = {}
    tasks = (Task(ticks, records.watch, before) for ticks in ranges)
    if client is None:
        parts = map_in_processes(first_pass.observe, tasks, jobs)
    else:
        parts = map_on_workers(client, observe_on_worker, tasks, Sent.of(first_pass))
    with closing(parts):
        for ticks, (part, spent, known) in zip(ranges, parts):
            if [records.watch.judge(look) for look in part.looks] != [look.state for look in part.looks]:
                part, spent, known = first_pass.observe(Task(ticks, records.watch, before, judged=True))
            before = part.before
            records.add(part.read, part.failed)
            compensated |= part.compensated
            clock.add(spent, jobs)
            if cache is not None:
                cache.count(*known)
            for tick, seen in zip(ticks, part.ticks):
                out.measurements.append(seen.measurements.stored(out.points))
                obstacles.append(seen.obstacles)
                for kept, new in ((out.feet, seen.feet), (out.ground, seen.ground)):
                    for camera, correspondences in new.items():
                        kept[camera].append(correspondences)
                for name, number in seen.found.items():
                    out.detections[name] = out.detections.get(name, 0) + number
                if len(out.lights) < MAX_CROPS:
                    out.lights += seen.lights
                out.frames_detected += seen.frames
                out.frames_skipped.update(seen.skipped)
                for camera in seen.unseen:
                    out.unseen.setdefault(camera, []).append(tick)
                progress(tick + 1, len(schedule))
    records.require_some()
    if cache is not None:
        cache.finish()
    used = dict.fromkeys([*schedule.frames, *schedule.sweeps])
    out.sweeps = Counter(compensated.values())
    out.faults = records.watch.faults(used, int(schedule.t_ns[0]), int(schedule.t_ns[-1]))
    return out
