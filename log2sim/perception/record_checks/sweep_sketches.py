"""Short sketches of sweeps by which two are compared, whatever the order of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Sweep

# Points are the same within a cell. Ranges of LiDARs scatter by 1 cm and more and their azimuths by several, so that hardly a
# point of another sweep is in the same cell, even where nothing moves; copies rounded to millimeters mostly are.
CELL_M = 0.01
# Hashes of a sketch; the share of common points errs by 1 / sqrt(this), 3 %.
SKETCH_SIZE = 1024
# Rays that hit flat ground do so at the same distance wherever the ego is, and those that hit the ego itself always do.
MIN_HEIGHT_M, MIN_DISTANCE_M = 0.3, 3.0
AXIS_BITS = 21


@dataclass(frozen=True, eq=False)
class SweepSketch:
    """What is kept of a sweep to compare it with others.

    Attributes
    ----------
    points, obstacles : int
        How many points it has, and how many of them are above the ground and beyond the ego.
    hashes : (K,) uint64
        The smallest hashes of the cells of its obstacle points, sorted, at most `SKETCH_SIZE`.
    """

    points: int
    obstacles: int
    hashes: NDArray[np.uint64]


def sketch_sweep(log: Log, name: str, sweep: Sweep) -> SweepSketch:
    """Return the sketch of a sweep of a LiDAR."""
    xyz = sweep.xyz_m
    obstacles = xyz[_is_obstacle(log, name, sweep)]
    return SweepSketch(len(xyz), len(obstacles), _smallest(_hash_cells(obstacles)))


def _smallest(hashes: NDArray[np.uint64]) -> NDArray[np.uint64]:
    """Return the smallest of hashes (N,) that differ, sorted, at most `SKETCH_SIZE`."""
    few = 4 * SKETCH_SIZE  # points share cells, mostly two at a time
    chosen = np.unique(np.partition(hashes, few)[:few] if len(hashes) > few else hashes)
    return chosen[:SKETCH_SIZE] if len(chosen) >= SKETCH_SIZE else np.unique(hashes)[:SKETCH_SIZE]


def _is_obstacle(log: Log, name: str, sweep: Sweep) -> NDArray[np.bool_]:
    """Mark the points (N,) well above flat ground under the ego, and not on the ego; all of a LiDAR that stands."""
    xyz, lidar = sweep.xyz_m, log.lidars[name]
    if lidar.mount == "map":
        return np.ones(len(xyz), dtype=bool)
    above_ground_m = float(lidar.mount_T_lidar[2, 3]) - log.ground_z_ego_m
    if sweep.frame == "lidar":
        up, position = lidar.mount_T_lidar[2, :3], np.zeros(3)
    else:
        map_T_lidar, known = log.map_T_sensor(name, sweep.stamp_ns)
        up, position = np.array([0.0, 0.0, 1.0]), map_T_lidar[0][:3, 3] if known[0] else np.median(xyz, axis=0)
    kind = xyz.dtype.type
    height = xyz @ up.astype(kind) + kind(above_ground_m - up @ position)
    x, y = (xyz[:, axis] - kind(position[axis]) for axis in range(2))
    return np.asarray((height > MIN_HEIGHT_M) & (x * x + y * y > MIN_DISTANCE_M**2))


def _hash_cells(xyz: NDArray[np.floating]) -> NDArray[np.uint64]:
    """Return a hash (N,) of the cell of each point (N, 3).

    Notes
    -----
    The finalizer of SplitMix64 (Steele, Lea, Flood, OOPSLA 2014) spreads neighboring cells evenly.
    """
    i = np.floor(xyz / CELL_M).astype(np.int64).astype(np.uint64) & np.uint64((1 << AXIS_BITS) - 1)
    z = (i[:, 0] << np.uint64(2 * AXIS_BITS)) | (i[:, 1] << np.uint64(AXIS_BITS)) | i[:, 2]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(z ^ (z >> np.uint64(31)))


def common_share(a: SweepSketch, b: SweepSketch) -> float:
    """Estimate the share of the obstacle points of two sweeps that both have; 0 without any.

    Notes
    -----
    The smallest hashes are a sample of all cells, the same for both (Broder, "On the resemblance and containment of
    documents", 1997). With the Jaccard index J of two sets of one size the share is 2 J / (1 + J).
    """
    either = np.union1d(a.hashes, b.hashes)[: max(len(a.hashes), len(b.hashes))]
    if len(either) == 0:
        return 0.0
    both = np.isin(either, a.hashes, assume_unique=True) & np.isin(either, b.hashes, assume_unique=True)
    jaccard = float(both.mean())
    return 2 * jaccard / (1 + jaccard)
