"""Roadside units: sensors on one pole, which share the errors of its pose and its clock."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.datatypes import Log, Stream, Sweep
from log2sim.geometry import NS_PER_S, Array, apply, inverse, transform

# Sensors of one pole are not farther apart in the plane.
MAX_UNIT_M = 3.0


@dataclass(frozen=True, eq=False)
class Unit:
    """Sensors at one place of the roadside.

    Attributes
    ----------
    lidars, cameras : tuple of str
    site_m : (3,) float64, m
        Mean place of its LiDARs in the map.
    """

    lidars: tuple[str, ...]
    cameras: tuple[str, ...]
    site_m: Array

    @property
    def sensors(self) -> tuple[str, ...]:
        """All of them, LiDARs first."""
        return (*self.lidars, *self.cameras)


def units_of(log: Log, lidars: Sequence[str]) -> list[Unit]:
    """Group LiDARs of the roadside, and the cameras beside them, by their places."""
    groups: list[list[str]] = []
    for name in lidars:
        near = [group for group in groups if any(_apart_m(log, name, other) < MAX_UNIT_M for other in group)]
        groups = [group for group in groups if group not in near] + [[*(n for group in near for n in group), name]]
    units = []
    for group in groups:
        site = np.mean([log.lidars[name].mount_T_lidar[:3, 3] for name in group], axis=0)
        beside = [
            n
            for n, c in log.cameras.items()
            if c.mount == "map" and np.hypot(*(c.mount_T_cam[:2, 3] - site[:2])) < MAX_UNIT_M
        ]
        units.append(Unit(tuple(group), tuple(beside), site))
    return units


def _apart_m(log: Log, first: str, second: str) -> float:
    return float(np.hypot(*(log.lidars[first].mount_T_lidar - log.lidars[second].mount_T_lidar)[:2, 3]))


def correct_unit(log: Log, unit: Unit, correction: Array, delay_s: float) -> Log:
    """Return the log with a unit's sensors moved and its stamps put right.

    Parameters
    ----------
    correction : (4, 4) float64
        Takes places by the unit's poses to right ones, both in the frame of the site: map axes, origin at `site_m`.
    delay_s : float, s
        By which its stamps are late.
    """
    shift = transform(np.eye(3), unit.site_m)
    moved = shift @ correction @ inverse(shift)
    lidars, cameras, streams = dict(log.lidars), dict(log.cameras), dict(log.streams)
    for name in unit.lidars:
        lidars[name] = replace(lidars[name], mount_T_lidar=moved @ lidars[name].mount_T_lidar)
    for name in unit.cameras:
        cameras[name] = replace(cameras[name], mount_T_cam=moved @ cameras[name].mount_T_cam)
    for name in unit.sensors:
        if name in streams:
            streams[name] = _corrected_stream(streams[name], moved, -round(delay_s * NS_PER_S))
    return log.changed(lidars=lidars, cameras=cameras, streams=streams)


def _corrected_stream(stream: Stream, moved: Array, shift_ns: int) -> Stream:
    """Move the stamps of all records, and the points of sweeps that are given in the map."""

    def read(i: int) -> Any:
        record = stream.read(i)
        return _corrected_sweep(record, moved, shift_ns) if isinstance(record, Sweep) else record

    return Stream(stream.name, lambda: stream.t_ns + shift_ns, read, stream.encoded)


def _corrected_sweep(sweep: Sweep, moved: Array, shift_ns: int) -> Sweep:
    return replace(
        sweep,
        stamp_ns=int(sweep.stamp_ns) + shift_ns,
        xyz_m=apply(moved, sweep.xyz_m) if sweep.frame == "map" else sweep.xyz_m,
        t_ns=None if sweep.t_ns is None else sweep.t_ns + shift_ns,
        compensated_ns=None if sweep.compensated_ns is None else int(sweep.compensated_ns) + shift_ns,
    )
