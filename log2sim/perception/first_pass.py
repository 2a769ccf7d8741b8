"""The first pass over a log: every tick's frames and sweeps become measurements."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.array_file import ArrayFile
from log2sim.datatypes import ENDS, Boxes3D, Detections, Fault, Log, Measurements, Obstacles, end_of
from log2sim.fusion_level import FusionLevel
from log2sim.geometry import Array, inverse
from log2sim.perception.background import BACKGROUND_THREADS
from log2sim.perception.detect.detectors import Detector
from log2sim.perception.detect3d.detectors import LidarDetector
from log2sim.perception.detection_cache import DetectionCache
from log2sim.perception.frames import FrameDetector, RecordReader
from log2sim.perception.homography.correspondences import Correspondences, foot_points, undistorted_pixels
from log2sim.perception.late_fusion import join_with_images, match_boxes
from log2sim.perception.lidar.cloud import Cloud, cloud_origin
from log2sim.perception.lidar.few_points import measure_few_points
from log2sim.perception.lidar.measure import measure_view, project_cloud
from log2sim.perception.lidar.measure_boxes import measure_boxes, outside_ego
from log2sim.perception.lidar.projection import View, view_of
from log2sim.perception.lidar.viewpoints import join_parts
from log2sim.perception.light_boxes import LightBox, with_ranges
from log2sim.perception.obstacle_list import ObstacleList
from log2sim.perception.prefetch import CloudOptions, CloudPrefetcher, obstacles_of
from log2sim.perception.sync import Schedule
from log2sim.plan import Plan, Stage
from log2sim.stage_clock import StageClock

MAX_GROUND_POINTS_PER_FRAME = 40


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
    records : RecordReader, optional
    sweeps : Counter of str
        Number of sweeps by how they were compensated, see `compensation_of`.
    frames_detected : int
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
    first = _FirstPass(log, schedule, plan, out, mode, max_range_m)
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
                first.measure(tick, found, ready, boxes if lidar_detector is not None else None)
                if frames is not None:
                    frames.lights[known_lights:] = first.range_lights(tick, frames.lights[known_lights:], ready)
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


@dataclass(frozen=True, eq=False)
class _FirstPass:
    """Measurement of the detections of every tick, with what later stages ask for."""

    log: Log
    schedule: Schedule
    plan: Plan
    out: Observations
    mode: str
    max_range_m: float

    def measure(
        self, tick: int, found: dict[str, Detections], clouds: Sequence[Cloud | None], boxes: Boxes3D | None
    ) -> None:
        """Measure the detections of a tick, each camera's in its cloud and boxes in that of the reference."""
        views = {name: view for name in found if (view := self._view(name, tick)) is not None}
        own = clouds if boxes is None else [_of_end(c, self._end(n)) for n, c in zip(self.schedule.frames, clouds)]
        measured = {
            camera: self._measure_camera(views[camera], tick, found[camera], cloud)
            for camera, cloud in zip(self.schedule.frames, own)
            if camera in views
        }
        for camera in found:
            self.out.detections[camera] = self.out.detections.get(camera, 0) + len(found[camera])
        reference = clouds[self.schedule.reference_row]
        if boxes is None or reference is None:
            joined = Measurements.join(list(measured.values()))
        elif self.plan.fusion is FusionLevel.TRACKS and boxes.seen_by is not None:
            joined = Measurements.join([
                self._join_sensors(
                    boxes.take(seen),
                    _of_end(reference, end),
                    {camera: rows for camera, rows in measured.items() if self._end(camera) == end},
                    views,
                )
                for end, seen in zip(ENDS, boxes.seen_by.T)
            ])  # fmt: skip
        else:
            joined = self._join_sensors(boxes, reference, measured, views)
        self.out.measurements.append(joined.take(self._in_range(tick, joined)).stored(self.out.points))

    def range_lights(self, tick: int, lights: list[LightBox], clouds: Sequence[Cloud | None]) -> list[LightBox]:
        """Return the traffic lights of a tick with distances where LiDAR points are on them."""
        out = []
        for camera, cloud in zip(self.schedule.frames, clouds):
            of_camera = [light for light in lights if light.camera == camera]
            view = self._view(camera, tick) if of_camera else None
            out += of_camera if view is None or cloud is None else with_ranges(of_camera, view, cloud)
        return out

    def _end(self, camera: str) -> str:
        return end_of(self.log.cameras[camera])

    def _join_sensors(
        self, boxes: Boxes3D, cloud: Cloud | None, measured: dict[str, Measurements], views: dict[str, View]
    ) -> Measurements:
        """Measure boxes found in a cloud and join them with the measured detections of cameras."""
        if cloud is None:
            return Measurements.join(list(measured.values()))
        in_sweep = measure_boxes(outside_ego(self.log, boxes), cloud)
        return join_with_images(
            in_sweep, [match_boxes(in_sweep, rows, views[camera]) for camera, rows in measured.items()]
        )

    def _view(self, camera: str, tick: int) -> View | None:
        """Return a camera's frame of a tick; None where its pose is not known."""
        t_ns = int(self.log.streams[camera].t_ns[self.schedule.frames[camera][tick]])
        return view_of(self.log, camera, t_ns)

    def _measure_camera(self, view: View, tick: int, detections: Detections, cloud: Cloud | None) -> Measurements:
        measured = measure_view(view, detections, cloud, mode=self.mode)
        if cloud is not None and self.mode == "robust":
            measured = measure_few_points(measured, view, cloud)
        if not self.plan.keeps(Stage.HOMOGRAPHY):
            return measured
        ego_T_map, camera = inverse(base_pose(self.log, view.t_ns)), view.camera.name
        self.out.feet[camera].append(foot_points(view.camera, measured, ego_T_map, tick))
        if cloud is not None:
            self.out.ground[camera].append(_ground_points(view, cloud, ego_T_map, tick))
        return measured

    def _in_range(self, tick: int, rows: Measurements) -> NDArray[np.bool_]:
        """Mark the rows within range of the ego, and those without a position, which a homography may still place."""
        origin, _ = cloud_origin(self.log, int(self.schedule.t_ns[tick]))
        with np.errstate(invalid="ignore"):
            return np.asarray(~(np.hypot(*(rows.center_m[:, :2] - origin[:2]).T) > self.max_range_m))


def _of_end(cloud: Cloud | None, end: str) -> Cloud | None:
    """Return the parts of a cloud that an end sees; the whole cloud where it has no parts or the end sees none of them."""
    if cloud is None or not cloud.parts:
        return cloud
    return join_parts([part for part in cloud.parts if part.end == end]) or cloud


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
