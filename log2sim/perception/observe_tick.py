"""What the sensors show at one tick: its detections and boxes, measured and joined."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS, Boxes3D, Detections, Log, Measurements, end_of
from log2sim.geometry import Array, inverse
from log2sim.perception.detection_cache import LightBox, with_ranges
from log2sim.perception.fusion import join_with_images, match_boxes
from log2sim.perception.homography.correspondences import Correspondences, foot_points, undistorted_pixels
from log2sim.perception.lidar.cloud import Cloud, cloud_origin, join_parts
from log2sim.perception.lidar.clusters import measure_few_points
from log2sim.perception.lidar.measure import measure_boxes, measure_view, outside_ego, project_cloud
from log2sim.perception.lidar.projection import View, view_of
from log2sim.perception.sync import Schedule
from log2sim.plan import FusionLevel, Plan, Stage

MAX_GROUND_POINTS_PER_FRAME = 40


@dataclass(eq=False)
class Observed:
    """What is measured at one tick.

    Attributes
    ----------
    measurements : Measurements
        Of all cameras and of the sweeps, not fused; rows of a camera without LiDAR points have no position.
    feet, ground : dict of str to Correspondences
        Foot points of measured objects and ground points of the LiDAR, by camera, where a homography needs them.
    """

    measurements: Measurements = field(default_factory=Measurements.empty)
    feet: dict[str, Correspondences] = field(default_factory=dict)
    ground: dict[str, Correspondences] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class TickObserver:
    """Measurement of the detections of a tick, with what later stages ask for; it knows nothing of other ticks."""

    log: Log
    schedule: Schedule
    plan: Plan
    mode: str
    max_range_m: float

    def measure(
        self, tick: int, found: dict[str, Detections], clouds: Sequence[Cloud | None], boxes: Boxes3D | None
    ) -> Observed:
        """Measure the detections of a tick, each camera's in its cloud and boxes in that of the reference."""
        out = Observed()
        views = {name: view for name in found if (view := self._view(name, tick)) is not None}
        own = clouds if boxes is None else [_of_end(c, self._end(n)) for n, c in zip(self.schedule.frames, clouds)]
        measured = {
            camera: self._measure_camera(views[camera], tick, found[camera], cloud, out)
            for camera, cloud in zip(self.schedule.frames, own)
            if camera in views
        }
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
        out.measurements = joined.take(self._in_range(tick, joined))
        return out

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

    def _measure_camera(
        self, view: View, tick: int, detections: Detections, cloud: Cloud | None, out: Observed
    ) -> Measurements:
        measured = measure_view(view, detections, cloud, mode=self.mode)
        if cloud is not None and self.mode == "robust":
            measured = measure_few_points(measured, view, cloud)
        if not self.plan.keeps(Stage.HOMOGRAPHY):
            return measured
        ego_T_map, camera = inverse(base_pose(self.log, view.t_ns)), view.camera.name
        out.feet[camera] = foot_points(view.camera, measured, ego_T_map, tick)
        if cloud is not None:
            out.ground[camera] = _ground_points(view, cloud, ego_T_map, tick)
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
