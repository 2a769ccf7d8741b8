"""A picture and a cloud of one moment with the road users in both: what the two-stream network takes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from lidar_training.real_logs import LogSweep, LogView, ground_under, labeled_by
from numpy.typing import NDArray

from log2sim.datatypes import Log
from log2sim.errors import RecordError
from log2sim.evaluation.detection.boxes import SceneBoxes
from log2sim.geometry import Array, inverse, nearest_index, rotation_from_rpy, transform, wrap_angle
from log2sim.perception.lidar.cloud import Cloud

MIN_DEPTH_M = 1.0
MIN_GROUND_POINTS = 10


@dataclass(frozen=True, eq=False)
class Pair:
    """A picture and a cloud; x of the cloud points where the camera looks, its origin is that of the log's cloud.

    Attributes
    ----------
    image : (H, W, 3) uint8
    cloud : Cloud
    pixel_T_cloud : (3, 4) float64
        Projection of positions in the cloud's frame to homogeneous pixels.
    ground : (3,) float64
        a, b, c of the plane z = a x + b y + c of the ground.
    boxes : (M, 7) float64
        x, y, height of the center above the ground, length, width, height, heading.
    truth : SceneBoxes
        The same, with z in the cloud's frame.
    views : tuple of LogView
        The cameras in whose images road users were labeled, for positions in the cloud's frame.
    """

    image: NDArray[np.uint8]
    cloud: Cloud
    pixel_T_cloud: Array
    ground: Array
    boxes: Array
    truth: SceneBoxes
    views: tuple[LogView, ...]

    def labeled(self, xyz: Array) -> NDArray[np.bool_]:
        """Mark positions (N, 3) in the cloud's frame where road users have labels."""
        return labeled_by(self.views, xyz)

    def in_picture_only(self) -> Pair:
        """Leave out the points beside the picture, which the network does not see, to save memory."""
        kept = np.flatnonzero(in_image(self.cloud.xyz, self.pixel_T_cloud, self.image.shape[:2]))
        c = self.cloud
        cloud = Cloud(c.stamp_ns, c.origin, c.xyz[kept], c.t_s[kept], c.sensor, c.ground[kept], c.height[kept])
        return replace(self, cloud=cloud)


def in_image(xyz: NDArray[np.floating], projection: Array, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Mark the points (N, 3) that a picture (height, width) shows."""
    p = np.asarray(xyz, np.float64) @ projection[:, :3].T + projection[:, 3]
    ahead = p[:, 2] > MIN_DEPTH_M
    uv = p[:, :2] / np.where(ahead, p[:, 2], 1.0)[:, None]
    return ahead & (uv >= 0).all(axis=1) & (uv < [shape[1], shape[0]]).all(axis=1)


def pairs_of(log: Log, camera: str, sweeps: list[LogSweep]) -> Iterator[Pair]:
    """Make the pairs of a log's sweeps with the nearest pictures of one camera, which must have no lens distortion."""
    stream = log.streams[camera]
    for sweep in sweeps:
        k = int(nearest_index(stream.t_ns, np.array([sweep.cloud.stamp_ns]))[0])
        pose, known = log.map_T_sensor(camera, int(stream.t_ns[k]))
        if not known[0]:
            continue
        try:
            image = stream.read(k)
        except RecordError:  # a broken picture, or one of another size than the calibration's
            continue
        yield pair_of(sweep, image, log.cameras[camera].K, pose[0])


def pair_of(sweep: LogSweep, image: NDArray[np.uint8], K: Array, map_T_cam: Array) -> Pair:
    """Turn a sweep so that x points where the camera looks."""
    old, truth = sweep.cloud, sweep.truth
    yaw = float(np.arctan2(map_T_cam[1, 2], map_T_cam[0, 2]))
    turn = rotation_from_rpy(0.0, 0.0, yaw)
    cloud = Cloud(
        old.stamp_ns, np.zeros(3), (old.xyz @ turn).astype(np.float32), old.t_s,
        (old.sensor @ turn).astype(np.float32), old.ground, old.height,
    )  # fmt: skip
    map_T_cloud = transform(turn, old.origin)
    rows = truth.box.copy()
    rows[:, :3] = rows[:, :3] @ turn
    rows[:, 6] = wrap_angle(rows[:, 6] - yaw)
    turned = SceneBoxes.of(rows, truth.category, points=truth.points, range_m=truth.range_m, ignored=truth.ignored)
    boxes = rows.copy()
    boxes[:, 2] -= ground_under(cloud, rows[:, :3])
    projection = K @ (inverse(map_T_cam) @ map_T_cloud)[:3]
    views = tuple(replace(v, cam_T_cloud=v.cam_T_cloud @ transform(turn, np.zeros(3))) for v in sweep.views)
    return Pair(image, cloud, projection, ground_plane(cloud), boxes, turned, views)


def ground_plane(cloud: Cloud) -> Array:
    """Fit a plane (3,) to the points on the ground ahead; that below the sensor where there are too few."""
    on = np.flatnonzero(cloud.ground & (cloud.xyz[:, 0] > 0))
    if len(on) < MIN_GROUND_POINTS:
        below = np.median(cloud.xyz[:, 2] - cloud.height) if len(cloud.xyz) else 0.0
        return np.array([0.0, 0.0, float(below)])
    xyz = cloud.xyz[on].astype(np.float64)
    design = np.column_stack([xyz[:, :2], np.ones(len(xyz))])
    return np.linalg.lstsq(design, xyz[:, 2], rcond=None)[0]
