"""Correspondences between the image and the ground: foot points of obstacles that the LiDAR measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import TYPICAL_SIZE_M, Measurements
from log2sim.geometry import Array, Camera, undistort
from log2sim.perception.homography.baselines import ground_from_sizes

# Fewer LiDAR points leave the nearest side of an obstacle undetermined.
MIN_FOOT_POINTS = 20
# Quantile of the points' distances that is taken for the nearest side, robust to stray points.
NEAREST_SIDE_QUANTILE = 0.05


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Pixels of one camera and the ground positions that they show.

    Attributes
    ----------
    uv : (N, 2) float64
        Pixels, free of lens distortion.
    xy_ego : (N, 2) float64
        Ground positions, m, in a frame that moves with the camera: x forward, y left.
    tick : (N,) int64
        Tick of each correspondence.
    xy_by_size : (N, 2) float64 or None
        Where average sizes put them without a LiDAR, NaN where there is no object; for the baseline "straw-man".

    Raises
    ------
    ValueError
        For arrays of other shapes.
    """

    uv: Array
    xy_ego: Array
    tick: NDArray[np.int64]
    xy_by_size: Array | None = None

    def __post_init__(self) -> None:
        """Check the shapes."""
        uv, xy, tick = self.uv.shape, self.xy_ego.shape, self.tick.shape
        if uv != xy or len(uv) != 2 or uv[1] != 2 or tick != uv[:1]:
            raise ValueError(f"uv and xy_ego must be (N, 2) and tick (N,), got {uv}, {xy}, {tick}")

    def __len__(self) -> int:
        """Return the number of correspondences."""
        return len(self.uv)

    def take(self, index: Any) -> Correspondences:
        """Select the rows at `index` (integers or a mask)."""
        by_size = None if self.xy_by_size is None else self.xy_by_size[index]
        return Correspondences(self.uv[index], self.xy_ego[index], self.tick[index], by_size)

    @classmethod
    def join(cls, parts: Sequence[Correspondences]) -> Correspondences:
        """Concatenate several sets; an empty sequence gives an empty set."""
        if not parts:
            return cls(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0, dtype=np.int64))
        sized = [np.full((len(p.uv), 2), np.nan) if p.xy_by_size is None else p.xy_by_size for p in parts]
        uv, xy, tick = (np.concatenate([getattr(p, k) for p in parts]) for k in ("uv", "xy_ego", "tick"))
        return cls(uv, xy, tick, np.concatenate(sized))


def undistorted_pixels(camera: Camera, uv: Array) -> Array:
    """Convert pixels (N, 2) to those of a lens without distortion."""
    return undistort(camera, uv) @ camera.K[:2, :2].T + camera.K[:2, 2]


def foot_points(camera: Camera, measured: Measurements, ego_T_map: Array, tick: int) -> Correspondences:
    """Find where obstacles touch the ground.

    In the image it is the middle of the box's lower edge, on the ground the point below the nearest side of their LiDAR
    points. Truncated boxes and obstacles with few points are left out.
    """
    kept = np.array([len(c) > 0 for c in measured.cluster], dtype=bool)
    good = (measured.source == "lidar") & ~measured.truncated & (measured.points >= MIN_FOOT_POINTS) & kept
    rows = np.flatnonzero(good & (measured.camera == camera.name))
    uv, xy = [], []
    for k in rows.tolist():
        sensor, cluster = measured.sensor_m[k, :2], measured.cluster[k][:, :2]
        direction = measured.center_m[k, :2] - sensor
        direction /= np.hypot(*direction)
        nearest = np.quantile((cluster - sensor) @ direction, NEAREST_SIDE_QUANTILE)
        foot = np.append(sensor + direction * nearest, measured.bottom_m[k])
        box = measured.box_px[k]
        xy.append((ego_T_map[:3, :3] @ foot + ego_T_map[:3, 3])[:2])
        uv.append([(box[0] + box[2]) / 2, box[3]])
    if not rows.size:
        return Correspondences.join([])
    feet, boxes = undistorted_pixels(camera, np.array(uv)), measured.box_px[rows]
    height_m = np.array([TYPICAL_SIZE_M[str(c)][2] for c in measured.category[rows]])
    ego_T_cam = camera.mount_T_cam if camera.mount == "ego" else ego_T_map @ camera.mount_T_cam
    by_size = ground_from_sizes(feet, boxes[:, 3] - boxes[:, 1], height_m, camera.K, ego_T_cam)
    return Correspondences(feet, np.array(xy), np.full(len(rows), tick, dtype=np.int64), by_size)
