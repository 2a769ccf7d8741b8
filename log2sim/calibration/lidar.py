"""Clocks and mounts of LiDARs on the ego, checked by what their sweeps show of its motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from log2sim.calibration.corrections import shift_stream, turn_mount
from log2sim.calibration.lidar_faults import Findings, unseen_faults
from log2sim.calibration.motion_fit import fit_clock_and_mount
from log2sim.calibration.sweep_pairs import pair_sweeps
from log2sim.config import Config
from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S
from log2sim.localization.choice import during_ns
from log2sim.localization.ego_sweeps import lidars_on_ego
from log2sim.sensors import Sensors

Progress = Callable[[str, int, int], None]

# Poses that err by more within seconds, or that belong to other sweeps, are no base for a calibration.
MAX_POSE_ERROR_M = 0.5


def check_lidars(log: Log, config: Config, sensors: Sensors, *, progress: Progress) -> tuple[Log, tuple[Fault, ...]]:
    """Estimate time offset and mount of each LiDAR on the ego.

    Returns
    -------
    log : Log
        Corrected where the settings ask for it.
    faults : tuple of Fault
        What is certain and large enough to matter; and what cannot be corrected although it was asked for.

    Notes
    -----
    Nothing is read where there is nothing to see: without a LiDAR on the ego, where it hardly moves, with poses that come from
    a sensor of the log itself.
    """
    faults: list[Fault] = []
    if log.ego is None or config.poses.source not in ("given", "auto"):
        return log, ()
    for lidar in lidars_on_ego(sensors.restrict(log)):
        log, found = _check_lidar(log, lidar, config, progress)
        faults += found
    return log, tuple(faults)


def _check_lidar(log: Log, lidar: str, config: Config, progress: Progress) -> tuple[Log, list[Fault]]:
    """Return the log with one LiDAR corrected, and its faults."""
    asked, stage = config.calibration, f"check {lidar}"
    seen = pair_sweeps(log, lidar, during_ns(log, config), lambda done, total: progress(stage, done, total))
    found = None if seen is None else fit_clock_and_mount(seen)
    if seen is None or found is None or found.pose_error_m > MAX_POSE_ERROR_M:
        return log, unseen_faults(lidar, None, asked)
    findings = Findings(lidar, found, seen, asked)
    return corrected(log, findings), findings.faults()


def corrected(log: Log, findings: Findings) -> Log:
    """Return the log with the stamps and the mount of a LiDAR corrected as far as it was asked for and is certain."""
    lidar, asked = findings.lidar, findings.asked
    if asked.fix_time and findings.offset_s:
        shifted = shift_stream(log.streams[lidar], round(findings.offset_s * NS_PER_S))
        log = log.changed(streams={**log.streams, lidar: shifted})
    if asked.fix_mounts and any((*findings.turn_rad, *findings.shift_m)):
        mount = turn_mount(log.lidars[lidar].mount_T_lidar, np.array(findings.turn_rad))
        mount[:3, 3] += findings.shift_m
        log = log.changed(lidars={**log.lidars, lidar: replace(log.lidars[lidar], mount_T_lidar=mount)})
    return log
