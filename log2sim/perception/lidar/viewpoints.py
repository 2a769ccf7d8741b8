"""Clouds of LiDARs that are far from each other: each place keeps its own ground and its own view, and all make one cloud."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from log2sim.datatypes import ENDS, Log, Sweep, end_of
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.lidar.cloud import Cloud, assemble_cloud

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
