"""Sweeps of simultaneous LiDARs as one cloud; where these are far from each other, each place keeps its own ground and view."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import ENDS, Log, Sweep, end_of
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.cloud import Cloud, CloudSensor, sweep_to_map
from log2sim.perception.lidar.ground import ON_GROUND_M, estimate_ground

# LiDARs of one end that are nearer to each other see the same sides of what is around: those of a car or a pole are.
MAX_APART_M = 5.0


def assemble_views(
    log: Log,
    sweeps: Mapping[str, Sweep],
    *,
    origin: Array,
    ground_z: float,
    max_range_m: float,
    compensate: bool = True,
) -> Cloud | None:
    """Merge the simultaneous sweeps of all LiDARs into one cloud, by parts where both ends have LiDARs.

    Parameters are those of `assemble_cloud`, which makes the cloud of a log with one end.

    Notes
    -----
    The ground is estimated from each viewpoint's own points: between two of them there may be none.
    """
    groups = group_by_viewpoint(log, sweeps)
    parts = []
    for names in groups:
        part = assemble_cloud(
            log,
            {name: sweeps[name] for name in names},
            origin=origin,
            ground_z=ground_z,
            max_range_m=max_range_m,
            compensate=compensate,
        )
        if part is not None:
            parts.append(part)
    return join_parts(parts)


def group_by_viewpoint(log: Log, names: Mapping[str, Sweep] | Sequence[str]) -> list[list[str]]:
    """Group LiDARs by where they look from: the vehicle's together, those of the road by their place; one group without both ends."""
    if len({end_of(lidar) for lidar in log.lidars.values()}) < len(ENDS):
        return [list(names)]
    groups: list[list[str]] = [[name for name in names if end_of(log.lidars[name]) == ENDS[0]]]
    for name in names:
        if end_of(log.lidars[name]) == ENDS[0]:
            continue
        place = log.lidars[name].mount_T_lidar[:2, 3]
        near = [g for g in groups[1:] if np.hypot(*(log.lidars[g[0]].mount_T_lidar[:2, 3] - place)) <= MAX_APART_M]
        if near:
            near[0].append(name)
        else:
            groups.append([name])
    return [group for group in groups if group]


def join_parts(parts: Sequence[Cloud]) -> Cloud | None:
    """Merge clouds of one origin into one that keeps them as its parts; a single one is returned as it is."""
    if len(parts) < 2:
        return parts[0] if parts else None
    first = parts[0]
    late_s = [(part.stamp_ns - first.stamp_ns) / NS_PER_S for part in parts]
    sensors = [
        replace(s, position=s.position - late * s.velocity_mps)
        for part, late in zip(parts, late_s)
        for s in part.sensors
    ]
    return Cloud(
        first.stamp_ns,
        first.origin,
        np.concatenate([part.xyz for part in parts]),
        np.concatenate([part.t_s + np.float32(late) for part, late in zip(parts, late_s)]),
        first.sensor,
        np.concatenate([part.ground for part in parts]),
        np.concatenate([part.height for part in parts]),
        tuple(sensors),
        tuple(parts),
    )


def assemble_cloud(
    log: Log,
    sweeps: Mapping[str, Sweep],
    *,
    origin: Array,
    ground_z: float,
    max_range_m: float,
    compensate: bool = True,
) -> Cloud | None:
    """Merge the simultaneous sweeps of all LiDARs into one cloud in the map frame and estimate its ground.

    Parameters
    ----------
    sweeps : mapping of LiDAR name to Sweep
    origin : (3,) float64, m, map frame
        Position of the ego, or of the sensors; points farther than `max_range_m` along an axis are left out.
    ground_z : float
        Expected height of the ground at the origin, m, map frame.
    compensate : bool
        See `sweep_to_map`.

    Returns
    -------
    Cloud or None
        None when no sweep has a known pose and points.
    """
    parts, sensors, stamp = [], [], 0
    for name, sweep in sweeps.items():
        mapped = sweep_to_map(log, name, sweep, compensate=compensate)
        if mapped is None or len(mapped[0]) == 0:
            continue
        stamp = stamp or sweep.stamp_ns
        # Halfway through the sweep: a sensor at 30 m/s is 3 m away from there at its begin or end.
        middle_ns = round(float(mapped[1].mean(dtype=np.float64)) * NS_PER_S)
        sensor, known = log.map_T_sensor(name, sweep.stamp_ns + middle_ns)
        local = (mapped[0] - origin).astype(np.float32)
        near = np.flatnonzero(np.logical_and.reduce([np.abs(local[:, axis]) <= max_range_m for axis in range(3)]))
        t_s = mapped[1] + np.float32((sweep.stamp_ns - stamp) / NS_PER_S)
        position = sensor[0, :3, 3] - origin if known[0] else np.zeros(3)
        parts.append((local.take(near, axis=0), t_s.take(near), position))
        place = _follow_sensor(log, name, stamp, t_s, origin)
        sensors.append(CloudSensor(len(near), *place, end_of(log.lidars[name])))
    if not parts:
        return None
    xyz, t_s = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
    surface = estimate_ground(xyz, np.zeros(2), ground_z - float(origin[2]))
    height = xyz[:, 2] - surface.at(xyz[:, :2])
    # A distant LiDAR without points in range must not shift the viewpoint.
    sensor = np.mean([p[2] for p in parts if len(p[0])] or [p[2] for p in parts], axis=0).astype(np.float32)
    ground = np.abs(height) <= ON_GROUND_M
    return Cloud(stamp, np.asarray(origin, float), xyz, t_s, sensor, ground, height, tuple(sensors))


def _follow_sensor(log: Log, name: str, stamp_ns: int, t_s: NDArray[np.float32], origin: Array) -> tuple[Array, Array]:
    """Follow a LiDAR through times (N,) relative to a stamp: position (3,) at the stamp relative to `origin`, velocity (3,).

    The line goes through its places at the first and the last time; without known poses it stands at the origin.
    """
    first_s, last_s = float(t_s.min()), float(t_s.max())
    t_ns = stamp_ns + np.round(np.array([first_s, last_s]) * NS_PER_S).astype(np.int64)
    map_T_lidar, known = log.map_T_sensor(name, t_ns)
    if not known.all():
        return np.zeros(3), np.zeros(3)
    first, last = map_T_lidar[:, :3, 3] - origin
    velocity = (last - first) / (last_s - first_s) if last_s > first_s else np.zeros(3)
    return first - first_s * velocity, velocity
