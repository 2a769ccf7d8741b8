"""Upright edges of objects in LiDAR sweeps, where the range jumps from one ray to the next."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import NS_PER_S, Array, apply, inverse
from log2sim.perception.lidar.cloud import sweep_to_map

# Nearer edges lie elsewhere in a camera's view when its position is off by centimeters; farther ones have few rays.
MIN_RANGE_M, MAX_RANGE_M = 5.0, 60.0
# What stands before a wall or a street stands out by a meter; far away rays along the road are farther apart than that.
MIN_JUMP_M, MIN_JUMP_SHARE = 1.0, 0.05
# The ray on the other side is on the same surface.
MAX_STEP_SHARE = 0.3
# An edge of what stands is at the same place in another sweep, but for the distance of rays; most of what moves is not.
MAX_SHIFT_M, MAX_SHIFT_RAD = 0.2, np.deg2rad(0.5)
# Neighboring rays of one laser are 0.1 to 0.4 degrees apart; those of one band of elevation belong to one or two lasers.
BAND_RAD, MAX_APART_RAD = np.deg2rad(0.2), np.deg2rad(0.8)
# More than the azimuths of a band differ.
WHOLE_TURN_RAD = 8.0


@dataclass(frozen=True, eq=False)
class DepthEdges:
    """Edges in one sweep.

    Attributes
    ----------
    points_map : (N, 3) float64, m
        The last points on the near side of each edge, map frame.
    range_m : (N,) float64
        Their distances from the LiDAR.
    left : (N,) bool
        Whether the edge is the left one of what is near, seen from the LiDAR; else the right one.
    """

    points_map: Array
    range_m: Array
    left: NDArray[np.bool_]


def read_depth_edges(log: Log, lidar: str, index: int) -> DepthEdges | None:
    """Find the edges in a sweep of a log; None where it cannot be read or its pose is not known."""
    try:
        sweep: Sweep = log.streams[lidar].read(index)
    except RecordError:
        return None
    mapped = sweep_to_map(log, lidar, sweep, compensate=True)
    if mapped is None or len(mapped[0]) < 2:
        return None
    rays = np.asarray(sweep.xyz_m, dtype=np.float64)
    if sweep.frame == "map":
        map_T_lidar, known = log.map_T_sensor(lidar, sweep.stamp_ns + round(float(np.median(mapped[1])) * NS_PER_S))
        if not known[0]:
            return None
        rays = apply(inverse(map_T_lidar[0]), rays)
    index_of, left = find_depth_edges(rays)
    return DepthEdges(mapped[0][index_of], np.linalg.norm(rays[index_of], axis=1), left)


def keep_standing(edges: DepthEdges, others: DepthEdges) -> DepthEdges:
    """Keep the edges that are at the same place, seen from above, in another sweep: what moves is elsewhere by then.

    A camera and a LiDAR see what moves at different times, which would turn one against the other.
    """
    stands = np.zeros(len(edges.left), dtype=bool)
    for side in (True, False):
        rows, there = np.flatnonzero(edges.left == side), others.points_map[others.left == side, :2]
        if len(rows) and len(there):
            apart_m, _ = cKDTree(there).query(edges.points_map[rows, :2])
            stands[rows] = apart_m < np.maximum(MAX_SHIFT_M, MAX_SHIFT_RAD * edges.range_m[rows])
    return DepthEdges(edges.points_map[stands], edges.range_m[stands], edges.left[stands])


def find_depth_edges(points: Array) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Find the points at which a near surface ends on its left or right.

    Parameters
    ----------
    points : (N, 3) float64, m
        Around the sensor, z along the axis that it turns about.

    Returns
    -------
    index : (n,) int
    left : (n,) bool
        Whether the surface ends on its left, counter-clockwise; else on its right.
    """
    x, y, z = points.T
    range_m = np.sqrt(x * x + y * y + z * z)
    azimuth = np.arctan2(y, x)
    band = np.floor(np.arcsin(z / np.maximum(range_m, MIN_RANGE_M / 100)) / BAND_RAD)
    # By band, then azimuth, in one sort.
    order = np.argsort(band * WHOLE_TURN_RAD + azimuth, kind="stable")
    range_m, azimuth, band = range_m[order], azimuth[order], band[order]
    neighbors = (band[1:] == band[:-1]) & (np.diff(azimuth) < MAX_APART_RAD)
    inner = slice(1, -1)
    near = range_m[inner]
    jump = np.maximum(MIN_JUMP_M, MIN_JUMP_SHARE * near)
    usable = neighbors[:-1] & neighbors[1:] & (near > MIN_RANGE_M) & (near < MAX_RANGE_M)
    to_right, to_left = range_m[:-2] - near, range_m[2:] - near
    left = usable & (to_left > jump) & (np.abs(to_right) < MAX_STEP_SHARE * jump)
    right = usable & (to_right > jump) & (np.abs(to_left) < MAX_STEP_SHARE * jump)
    found = np.flatnonzero(left | right)
    return order[inner][found], left[found]
