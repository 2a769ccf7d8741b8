"""Points of clouds in the level frame of the network: x and y along the map's axes, z above the ground."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.perception.detect3d.box_points import PointsOfBoxes
from log2sim.perception.detect3d.grid import MAX_HEIGHT_M, MIN_HEIGHT_M
from log2sim.perception.lidar.cloud import Cloud

# A sweep has 0.3 million points at most; what is beyond a few of them is thinned out, which bounds time and memory.
MAX_POINTS = 1_000_000
# The ground under a box is a plane. Where points reach less than this to all sides it is taken as level.
PLANE_REACH_M = 0.05
MAX_SLOPE = 0.4
PLANE_POINTS = 64


def level_points(cloud: Cloud, range_m: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Take the points in range of a cloud's sensors, relative to the cloud's origin.

    Parameters
    ----------
    cloud : Cloud
    range_m : float
        Largest distance from a sensor along x and along y, m.

    Returns
    -------
    xyz : (n, 3) float32, m
        z is the height above the ground, within the limits of the grid.
    index : (n,) int
        Of the points in the cloud.
    """
    return _cropped(cloud, viewpoints_xy(cloud), range_m)


def stack_points(cloud: Cloud, earlier: Sequence[Cloud], range_m: float) -> NDArray[np.float32]:
    """Merge the points of earlier clouds that are in range of a cloud's sensors: (n, 3) as from `level_points`.

    Notes
    -----
    Clouds are in map axes already, so that only their origins differ. Each keeps its height above its own ground.
    """
    parts = [np.zeros((0, 3), np.float32)]
    for old in earlier:
        shift = (old.origin - cloud.origin)[:2]
        xyz = _cropped(old, viewpoints_xy(cloud) - shift, range_m)[0]
        xyz[:, :2] += shift.astype(np.float32)
        parts.append(xyz)
    return np.concatenate(parts)


def viewpoints_xy(cloud: Cloud) -> Array:
    """Return the places (V, 2) of the sensors relative to the origin, m, one a viewpoint; the origin where it is not known."""
    xy = np.array([view.sensor[:2] for view in cloud.views], dtype=np.float64)
    return np.where(np.isfinite(xy).all(axis=1, keepdims=True), xy, 0.0)


def _cropped(cloud: Cloud, centers: Array, range_m: float) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """Take the points within range of any of the centers (V, 2)."""
    x, y, height = cloud.xyz[:, 0], cloud.xyz[:, 1], cloud.height
    near = np.zeros(len(x), dtype=bool)
    for center in centers:
        low, high = (center - range_m).astype(np.float32), (center + range_m).astype(np.float32)
        # False for NaN.
        near |= (x >= low[0]) & (x < high[0]) & (y >= low[1]) & (y < high[1])
    index = np.flatnonzero(near & (height > MIN_HEIGHT_M) & (height < MAX_HEIGHT_M))
    if len(index) > MAX_POINTS:
        index = index[:: -(-len(index) // MAX_POINTS)]
    xyz = np.empty((len(index), 3), np.float32)
    xyz[:, 0], xyz[:, 1], xyz[:, 2] = x[index], y[index], height[index]
    return xyz, index


def ground_under(xy: Array, inside: PointsOfBoxes, cloud: Cloud, index: NDArray[np.intp]) -> Array:
    """Estimate the height (M,) of the ground under positions (M, 2) by a plane through that under the points of each box.

    Parameters
    ----------
    xy : (M, 2) float64, m
        Centers of the boxes, relative to the cloud's origin.
    inside : PointsOfBoxes
        Each box has at least one point.
    cloud : Cloud
    index : (n,) int
        Of the points that `inside` numbers in the cloud.

    Returns
    -------
    (M,) float64, m
        Relative to the cloud's origin.

    Notes
    -----
    A car is seen from one side: on a slope of 10 % the ground under its points is 0.1 to 0.2 m off that under its center.
    """
    inside = inside.sample(PLANE_POINTS)
    box, point = inside.box, index.take(inside.point)
    x, y = (cloud.xyz[:, axis].take(point) - xy[:, axis].take(box) for axis in range(2))
    z = (cloud.xyz[:, 2].take(point) - cloud.height.take(point)).astype(np.float64)
    count = inside.count

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(box, values, minlength=len(count)) / count)

    mx, my, mz = mean(x), mean(y), mean(z)
    dx, dy, dz = x - mx[box], y - my[box], z - mz[box]
    xx, yy = (mean(d * d) + PLANE_REACH_M**2 for d in (dx, dy))
    xy_, xz, yz = mean(dx * dy), mean(dx * dz), mean(dy * dz)
    determinant = xx * yy - xy_ * xy_
    slope_x, slope_y = (
        np.clip(s / determinant, -MAX_SLOPE, MAX_SLOPE) for s in (yy * xz - xy_ * yz, xx * yz - xy_ * xz)
    )
    return np.asarray(mz - slope_x * mx - slope_y * my)
