"""LiDAR files of nuScenes: .pcd.bin, which are no PCD files but rows of five float32.

Verified on sweeps of two vehicles (n008, n015). Files keep the order of firing: 32 rings in turn, 1084 and 1086 times.
Rays without a return are stored with range 0 and compensated like the others, so they lie where the sensor was: on a
straight path that ends at the origin with the last firing. The first one is 0.425 m behind at a speed of 8.5 m/s, the
way of 50 ms. Hence all points are in the frame of the sensor at the end of the turn, which is the stamp. It begins at
the left of the vehicle and turns clockwise; times by order and by azimuth agree to 0.2 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Stream, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import Array
from log2sim.logs.images import read_bytes
from log2sim.logs.sweeps import MAX_SWEEP_BYTES, MAX_SWEEP_POINTS, sweep_of

# Velodyne HDL-32E, user's manual: 32 lasers, one firing of all in 46.08 us, no returns nearer than 1 m.
RINGS = 32
FIRING_NS = 46_080
MIN_RANGE_M = 1.0
# More than a turn: several sweeps joined in one file.
MAX_FIRINGS = 1200
TURN_NS = 50_000_000

BYTES_PER_POINT = 20

# Takes stamps (N,) int64 to the poses (N, 4, 4) of the LiDAR in the map, and whether each is known.
Poses = Callable[[NDArray[np.int64]], tuple[Array, NDArray[np.bool_]]]


def sweep_stream(name: str, t_ns: NDArray[np.int64], files: list[Path], poses: Poses) -> Stream:
    """Stream of .pcd.bin files.

    Parameters
    ----------
    name : str
    t_ns : (F,) int64
        Ends of the turns.
    files : list of Path
        F files.
    poses : callable
        Returns the poses (N, 4, 4) of the LiDAR in the map at stamps (N,), and whether each is known.
    """

    def read(i: int) -> Sweep:
        return read_sweep(files[i], int(t_ns[i]), poses)

    return Stream(name, t_ns, read)


def read_sweep(path: Path, t_ns: int, poses: Poses) -> Sweep:
    """Read a sweep in the frame of the sensor at `t_ns`; points nearer than 1 m, which are no returns, are left out.

    Raises
    ------
    RecordError
        When the file is missing or its size is not that of whole points.
    """
    data = read_bytes(path, t_ns, MAX_SWEEP_BYTES)
    points = len(data) // BYTES_PER_POINT
    if len(data) % BYTES_PER_POINT:
        raise RecordError(
            f"{path} (stamp {t_ns}): {len(data)} bytes, expected five float32 (x, y, z, intensity, ring) a point"
        )
    if points > MAX_SWEEP_POINTS:
        raise RecordError(f"{path} (stamp {t_ns}): {points} points, more than {MAX_SWEEP_POINTS}")
    rows = np.frombuffer(data, "<f4").reshape(-1, 5)
    xyz, offset_ns = rows[:, :3], firing_offset_ns(rows[:, 4])
    away = xyz - sensor_path(offset_ns, t_ns, poses)
    with np.errstate(over="ignore", invalid="ignore"):
        returned = np.linalg.norm(away, axis=1) >= MIN_RANGE_M
    offset_ns = None if offset_ns is None else offset_ns[returned]
    return sweep_of(xyz[returned], t_ns, offset_ns, "lidar", t_ns, rows[returned, 3])


def firing_offset_ns(ring: NDArray[np.float32]) -> NDArray[np.int64] | None:
    """Time (N,) ns of points relative to the end of the turn by their order; None when it is not that of firing."""
    firings = len(ring) // RINGS
    if len(ring) % RINGS or not 0 < firings <= MAX_FIRINGS:
        return None
    if not np.array_equal(ring.reshape(firings, RINGS), np.broadcast_to(np.arange(RINGS), (firings, RINGS))):
        return None
    return np.repeat((np.arange(firings, dtype=np.int64) - (firings - 1)) * FIRING_NS, RINGS)


def sensor_path(offset_ns: NDArray[np.int64] | None, t_ns: int, poses: Poses) -> Array:
    """Position (N, 3) or (3,) of the sensor at the time of each point, in its frame at the stamp; 0 where not known."""
    if offset_ns is None:
        return np.zeros(3)
    first = int(offset_ns.min())
    map_T_lidar, known = poses(np.array([t_ns + first, t_ns]))
    if first == 0 or not known.all():
        return np.zeros(3)
    start = map_T_lidar[1, :3, :3].T @ (map_T_lidar[0, :3, 3] - map_T_lidar[1, :3, 3])
    return np.asarray((offset_ns / first)[:, None] * start)
