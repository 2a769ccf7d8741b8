"""Sweeps of a LiDAR on the ego in the ego's frame, with the motion of the ego still in them or taken out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Log, Sweep
from log2sim.errors import RecordError
from log2sim.geometry import (
    NS_PER_S,
    Array,
    apply,
    inverse,
    quaternion_from_rotation,
    rotation_from_quaternion,
    slerp,
    transform,
)
from log2sim.localization.moving_points import move_points

# Nearer returns are of the ego's own body; farther ones are too sparse for surfaces.
MIN_RANGE_M, MAX_RANGE_M = 2.5, 100.0
# More points change neither the path nor the scatter of parked cars on recorded drives, and take time.
MAX_POINTS = 60_000
PROBED_SWEEPS = 3
COVERAGE_VOXEL_M = 0.5


@dataclass(frozen=True, eq=False)
class EgoSweep:
    """One sweep in the ego's frame.

    Attributes
    ----------
    t_ref_ns : int
        Stamp of the pose that the sweep gives, and to which it is compensated where `t_ns` is None.
    xyz_m : (N, 3) float64, m
        Points in the ego's frame; at their own times where `t_ns` is given.
    t_ns : (N,) int64 or None
        Stamps at which the points were measured; None where the ego's motion is out of them or their times are not known.
    """

    t_ref_ns: int
    xyz_m: Array
    t_ns: NDArray[np.int64] | None


def lidars_on_ego(log: Log) -> list[str]:
    """List the LiDARs on the ego that have records."""
    return [
        n for n, lidar in log.lidars.items() if lidar.mount == "ego" and n in log.streams and len(log.streams[n].t_ns)
    ]


def densest_lidar(log: Log) -> str | None:
    """Choose the LiDAR on the ego whose sweeps show most of the surroundings; None without one that can be read.

    One LiDAR alone, since those of one vehicle turn at different times: sweeps that are joined would need a motion for each.
    """
    names = lidars_on_ego(log)
    if len(names) <= 1:
        return names[0] if names else None
    coverage = {name: _coverage(log, name) for name in names}
    best = max(names, key=lambda name: coverage[name])
    return best if coverage[best] else None


def _coverage(log: Log, lidar: str) -> int:
    """Count the voxels with points in one sweep; 0 where none of the first can be read."""
    stream = log.streams[lidar]
    for i in range(min(PROBED_SWEEPS, len(stream.t_ns))):
        sweep = read_ego_sweep(log, lidar, i)
        if sweep is not None and len(sweep.xyz_m):
            return len(np.unique(np.floor(sweep.xyz_m / COVERAGE_VOXEL_M).astype(np.int64), axis=0))
    return 0


def read_ego_sweep(log: Log, lidar: str, index: int) -> EgoSweep | None:
    """Read a sweep into the ego's frame; None where it cannot be read or, in the map frame, where the ego's pose is not known."""
    try:
        sweep: Sweep = log.streams[lidar].read(index)
    except RecordError:
        return None
    return ego_sweep_of(log, lidar, sweep)


def ego_sweep_of(log: Log, lidar: str, sweep: Sweep) -> EgoSweep | None:
    """Bring a sweep into the ego's frame; points of the map frame go back by the log's own poses at their own times.

    Of more than `MAX_POINTS` every second, third ... is taken.
    """
    ego_T_lidar = log.lidars[lidar].mount_T_lidar
    step = max(-(-len(sweep.xyz_m) // MAX_POINTS), 1)
    stamp_ns, t_ns = int(sweep.stamp_ns), None if sweep.t_ns is None else sweep.t_ns[::step]
    measured = sweep.xyz_m[::step]
    if sweep.frame == "map":
        track = log.ego
        if track is None:
            return None
        times = np.full(len(measured), stamp_ns, dtype=np.int64) if t_ns is None else t_ns
        known = move_points(measured, times, lambda t: (inverse(track.at(t)[0]), track.at(t)[1]))
        if known is None:
            return None
        xyz = known
    else:
        xyz = apply(ego_T_lidar, measured)
        if sweep.compensated_ns is not None:
            stamp_ns, t_ns = int(sweep.compensated_ns), None
    away = np.linalg.norm(xyz - ego_T_lidar[:3, 3], axis=1)
    near = (away > MIN_RANGE_M) & (away < MAX_RANGE_M)
    return EgoSweep(stamp_ns, xyz[near], None if t_ns is None else t_ns[near])


def compensated(sweep: EgoSweep, motion: Array, motion_s: float) -> Array:
    """Take a constant motion out of a sweep: points (N, 3), m, in the ego's frame at its reference stamp.

    Parameters
    ----------
    sweep : EgoSweep
    motion : (4, 4) float64
        Pose of the ego after `motion_s` in its frame before.
    motion_s : float, s
    """
    if sweep.t_ns is None or motion_s <= 0:
        return sweep.xyz_m

    def ref_T_ego(t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.bool_]]:
        share = (t_ns - sweep.t_ref_ns) / NS_PER_S / motion_s
        return share_of_motion(motion, share), np.ones(len(t_ns), dtype=bool)

    moved = move_points(sweep.xyz_m, sweep.t_ns, ref_T_ego)
    return sweep.xyz_m if moved is None else moved


def share_of_motion(motion: Array, share: Array) -> Array:
    """Compute the parts (N, 4, 4) of a motion (4, 4) that is steady in the moving frame, for shares (N,) of its time.

    Notes
    -----
    The translation is scaled, which leaves out the bend of the path: 4 mm in 0.1 s at 10 m/s and 0.3 rad/s.
    """
    q = np.repeat(quaternion_from_rotation(motion[:3, :3])[None], len(share), axis=0)
    still = np.tile(np.array([1.0, 0.0, 0.0, 0.0]), (len(share), 1))
    return transform(rotation_from_quaternion(slerp(still, q, share)), share[:, None] * motion[:3, 3])
