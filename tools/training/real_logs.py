"""Labeled sweeps of a real log: clouds with truth to train and test detectors on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.config import LidarConfig
from log2sim.datatypes import Log
from log2sim.errors import LogError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.evaluation.detection.protocols import MIN_POINTS
from log2sim.geometry import Array, Camera, apply, inverse, nearest_index, project
from log2sim.perception.detect3d.detectors import create_lidar_detector
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud, cloud_origin
from training.clouds import Example

MAX_RANGE_M = 60.0
# The ground under a box is the mean of that under so many points nearest to it.
GROUND_POINTS = 30
MAX_LAG_NS = 100_000_000
"""Sweeps of several LiDARs, and images with ignored regions, belong together within a period of 10 Hz."""


@dataclass(frozen=True, eq=False)
class LogView:
    """A camera in whose image road users were labeled, at the time of a cloud."""

    camera: Camera
    cam_T_cloud: Array  # (4, 4): from map axes relative to the cloud's origin
    ignored_px: Array  # (R, 4): u0, v0, u1, v1 of the parts of the image without labels

    def shows(self, xyz: Array) -> NDArray[np.bool_]:
        """Mark the points (N, 3) in the labeled parts of the image."""
        uv, inside = project(self.camera, apply(self.cam_T_cloud, xyz))
        for u0, v0, u1, v1 in self.ignored_px:
            inside &= ~((uv[:, 0] >= u0) & (uv[:, 0] <= u1) & (uv[:, 1] >= v0) & (uv[:, 1] <= v1))
        return inside


@dataclass(frozen=True, eq=False)
class LogSweep:
    """A cloud of a log with its labels in the cloud's axes."""

    cloud: Cloud
    truth: SceneBoxes  # relative to the cloud's origin
    views: tuple[LogView, ...]  # the cameras in whose images road users were labeled; empty where everything was


def labeled_by(views: tuple[LogView, ...], xyz: Array) -> NDArray[np.bool_]:
    """Mark the points (N, 3) that one of the views shows in a labeled part; all where there are no views."""
    if not views:
        return np.ones(len(xyz), bool)
    return np.any([view.shows(xyz) for view in views], axis=0)


def read_sweeps(log: Log, every: int) -> list[LogSweep]:
    """Read every n-th sweep of a log that has labels in it.

    Raises `LogError` when there is none.
    """
    names = list(log.lidars)
    labels = create_lidar_detector("lidar:labels", log, LidarConfig())
    out = []
    for t_ns in log.streams[names[0]].t_ns[::every]:
        sweeps = {}
        for name in names:
            stamps = log.streams[name].t_ns
            k = int(nearest_index(stamps, np.array([t_ns]))[0])
            if abs(int(stamps[k]) - int(t_ns)) <= MAX_LAG_NS:
                sweeps[name] = log.streams[name].read(k)
        origin, ground_z = cloud_origin(log, int(t_ns))
        cloud = assemble_cloud(log, sweeps, origin=origin, ground_z=ground_z, max_range_m=MAX_RANGE_M)
        if cloud is None:
            continue
        boxes = labels.detect(cloud)
        rows = np.column_stack([boxes.center_m - origin, boxes.size_m, boxes.yaw_rad])
        away = np.hypot(*(rows[:, :2] - cloud.sensor[:2]).T)
        truth = SceneBoxes.of(rows, boxes.category, points=boxes.points, range_m=away)
        if len(truth):
            out.append(LogSweep(cloud, truth, _views(log, cloud)))
    if not out:
        raise LogError(f"{log.name}: no sweep with labels")
    return out


def _views(log: Log, cloud: Cloud) -> tuple[LogView, ...]:
    """Collect the cameras whose images limit the labels."""
    only = None if log.labels is None else log.labels.cameras
    shift = np.eye(4)
    shift[:3, 3] = cloud.origin
    views = []
    for name in only or ():
        pose, known = log.map_T_sensor(name, cloud.stamp_ns)
        if not known[0]:
            continue
        regions, ignored = log.ignored_regions.get(name), np.zeros((0, 4))
        if regions is not None and len(regions.t_ns):
            lag = np.abs(regions.t_ns - cloud.stamp_ns)
            ignored = regions.box_px[(lag == lag.min()) & (lag <= MAX_LAG_NS)]
        views.append(LogView(log.cameras[name], inverse(pose[0]) @ shift, ignored))
    return tuple(views)


def example_of(sweep: LogSweep) -> Example:
    """Turn a sweep into an example with the sensor's foot as origin; only what was labeled is kept of the cloud."""
    cloud, truth = sweep.cloud, sweep.truth
    foot = np.append(cloud.sensor[:2], np.float32(0.0))
    kept = labeled_by(sweep.views, cloud.xyz)
    columns = {name: getattr(cloud, name)[kept] for name in ("t_s", "ground", "height")}
    moved = Cloud(0, np.zeros(3), cloud.xyz[kept] - foot, sensor=cloud.sensor - foot, **columns)
    boxes = truth.box - np.append(foot, np.zeros(truth.box.shape[1] - 3))
    assert truth.points is not None
    ignored = (truth.points < MIN_POINTS) | np.isin(truth.category, ("bicycle", "other"))
    named = SceneBoxes.of(boxes, truth.category, points=truth.points, ignored=ignored)
    return Example(moved, named, ground_under(cloud, truth.box))


def ground_under(cloud: Cloud, center: Array) -> Array:
    """Estimate the height (M,) of the ground at positions (M, 2 or 3) from the nearest points of a cloud."""
    from scipy.spatial import cKDTree

    if not len(center):
        return np.zeros(0)
    _, near = cKDTree(cloud.xyz[:, :2]).query(center[:, :2], k=min(GROUND_POINTS, len(cloud.xyz)))
    return np.asarray((cloud.xyz[:, 2] - cloud.height)[near].reshape(len(center), -1).mean(axis=1), dtype=np.float64)
