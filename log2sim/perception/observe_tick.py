"""What the sensors show at one tick: its detections and boxes, measured and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import chain

import numpy as np
from numpy.typing import NDArray

from log2sim.config import MeasureConfig
from log2sim.datatypes import ENDS, Boxes3D, Detections, Log, Measurements, Obstacles, end_of
from log2sim.geometry import Array, inverse
from log2sim.perception.homography.correspondences import Correspondences, foot_points, undistorted_pixels
from log2sim.perception.lidar.cloud import Cloud, cloud_origin, join_parts
from log2sim.perception.lidar.measure import Frame, measure, outside_ego, project_cloud
from log2sim.perception.lidar.projection import View, view_of
from log2sim.perception.sync import Schedule
from log2sim.perception.traffic_light_boxes import LightBox, add_ranges
from log2sim.plan import FusionLevel, Plan, Stage

MAX_GROUND_POINTS_PER_FRAME = 40


@dataclass(eq=False)
class SeenTick:
    """What the first pass takes from one tick."""

    # Of all cameras and of the sweeps, not fused; rows of a camera without LiDAR points have no position
    measurements: Measurements = field(default_factory=Measurements.empty)
    # `feet`, `ground`: foot points of measured objects and ground points of the LiDAR, by camera, where a homography needs
    # them
    feet: dict[str, Correspondences] = field(default_factory=dict)
    ground: dict[str, Correspondences] = field(default_factory=dict)
    obstacles: Obstacles | None = None
    lights: list[LightBox] = field(default_factory=list)
    # Number of detections by camera and by name of the detector in sweeps
    found: dict[str, int] = field(default_factory=dict)
    frames: int = 0  # how many were searched
    # `skipped`, `unseen`: cameras whose frame was not searched, and those of which it says nothing
    skipped: list[str] = field(default_factory=list)
    unseen: list[str] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class TickObserver:
    """Measurement of the detections of a tick, with what later stages ask for; it knows nothing of other ticks."""

    log: Log
    schedule: Schedule
    plan: Plan
    settings: MeasureConfig

    def measure(
        self, tick: int, found: dict[str, Detections], clouds: Sequence[Cloud | None], boxes: Boxes3D | None
    ) -> SeenTick:
        """Measure the detections of a tick, each camera's in its cloud and boxes in that of the reference."""
        reference = clouds[self.schedule.reference_row]
        # Where clouds were searched, a camera's objects are sought in what its own end sees.
        parts = {(id(c), end): c if boxes is None else _seen_from_end(c, end) for c in clouds for end in ENDS}
        frames: dict[str, list[Frame]] = {end: [] for end in ENDS}
        for camera, cloud in zip(self.schedule.frames, clouds):
            if camera in found and (view := self._view(camera, tick)) is not None:
                end = end_of(view.camera)
                frames[end].append((view, found[camera], parts[id(cloud), end]))
        groups = [(list(chain(*frames.values())), boxes, reference)]
        if self.plan.fusion is FusionLevel.TRACKS and boxes is not None and boxes.seen_by is not None:
            groups = [
                (frames[end], boxes.take(seen), parts[id(reference), end]) for end, seen in zip(ENDS, boxes.seen_by.T)
            ]
        joined = Measurements.join([
            measure(shown, None if of is None else outside_ego(self.log, of), cloud, mode=self.settings.mode)
            for shown, of, cloud in groups
        ])  # fmt: skip
        out = SeenTick(joined.take(self._in_range(tick, joined)))
        if self.plan.keeps(Stage.HOMOGRAPHY):
            for view, _, cloud in chain(*frames.values()):
                ego_T_map, name = inverse(base_pose(self.log, view.t_ns)), view.camera.name
                out.feet[name] = foot_points(view.camera, joined, ego_T_map, tick)
                if cloud is not None:
                    out.ground[name] = _ground_points(view, cloud, ego_T_map, tick)
        return out

    def range_lights(self, tick: int, lights: list[LightBox], clouds: Sequence[Cloud | None]) -> list[LightBox]:
        """Return the traffic lights of a tick with distances where LiDAR points are on them."""
        out = []
        for camera, cloud in zip(self.schedule.frames, clouds):
            of_camera = [light for light in lights if light.camera == camera]
            view = self._view(camera, tick) if of_camera else None
            out += of_camera if view is None or cloud is None else add_ranges(of_camera, view, cloud)
        return out

    def _view(self, camera: str, tick: int) -> View | None:
        """Return a camera's frame of a tick; None where its pose is not known."""
        t_ns = int(self.log.streams[camera].t_ns[self.schedule.frames[camera][tick]])
        return view_of(self.log, camera, t_ns)

    def _in_range(self, tick: int, rows: Measurements) -> NDArray[np.bool_]:
        """Mark the rows within range of the ego, and those without a position, which a homography may still place."""
        origin, _ = cloud_origin(self.log, int(self.schedule.t_ns[tick]))
        with np.errstate(invalid="ignore"):
            return np.asarray(~(np.hypot(*(rows.center_m[:, :2] - origin[:2]).T) > self.settings.max_range_m))


def _seen_from_end(cloud: Cloud | None, end: str) -> Cloud | None:
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
