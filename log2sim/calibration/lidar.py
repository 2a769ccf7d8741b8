"""Clocks and mounts of LiDARs on the ego, checked by what their sweeps show of its motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from log2sim.calibration.corrections import shift_stream, turn_mount
from log2sim.calibration.motion_fit import OFFSET, PITCH, ROLL, YAW, Estimate, fit_clock_and_mount
from log2sim.calibration.sweep_pairs import SweepPairs, pair_sweeps
from log2sim.calibration.twists import velocities_at
from log2sim.config import CalibrationConfig, Config
from log2sim.datatypes import Fault, Log
from log2sim.geometry import NS_PER_S, Array
from log2sim.localization.choice import during_ns
from log2sim.localization.ego_sweeps import lidars_on_ego
from log2sim.sensors import Sensors

Progress = Callable[[str, int, int], None]

# Told is what is beyond doubt: by chance one of 2,000 estimates is so many standard deviations off.
MIN_SIGMAS = 3.5
# And what matters: 0.2 m at 10 m/s, and to the side at 40 m, which is how well agents are placed; 0.7 m up or down at 40 m, which
# is half of a car. Data sets are calibrated to less.
MIN_OFFSET_S = 0.02
MIN_ROTATION_RAD = np.array([0.7, 0.7, 0.2]) / 40.0
# An estimate that is no better than this does not help who asks for a correction.
MAX_SIGMA_S, MAX_SIGMA_RAD = 0.05, np.deg2rad(1.0)
# Poses that err by more within seconds, or that belong to other sweeps, are no base for a calibration.
MAX_POSE_ERROR_M = 0.5
AXES = {ROLL: "roll", PITCH: "pitch", YAW: "yaw"}


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
    faults = unseen_faults(lidar, found, asked)
    offset, turned = offset_fault(lidar, found, asked), certain_rotation(found)
    if offset is not None:
        faults.append(offset)
        if asked.fix_time:
            shifted = shift_stream(log.streams[lidar], round(found.values[OFFSET] * NS_PER_S))
            log = log.changed(streams={**log.streams, lidar: shifted})
    if turned.any():
        faults.append(rotation_fault(lidar, found, seen, asked))
        if asked.fix_mounts:
            mount = turn_mount(log.lidars[lidar].mount_T_lidar, turned)
            log = log.changed(lidars={**log.lidars, lidar: replace(log.lidars[lidar], mount_T_lidar=mount)})
    return log, faults


def offset_fault(lidar: str, found: Estimate, asked: CalibrationConfig) -> Fault | None:
    """Describe a time offset; None for one that is not certain or does not matter."""
    late_s, sigma_s = -float(found.values[OFFSET]), float(found.sigma[OFFSET])
    if not found.shows_offset or abs(late_s) < max(MIN_SIGMAS * sigma_s, MIN_OFFSET_S):
        return None
    message = (
        f"stamps are {abs(late_s) * 1e3:.0f} ms {'late' if late_s > 0 else 'early'} against the poses of the ego "
        f"(sigma {sigma_s * 1e3:.0f} ms); {'corrected' if asked.fix_time else 'not corrected, which --fix-time does'}"
    )
    values = {"offset_s": late_s, "offset_sigma_s": sigma_s, "pose_error_m": found.pose_error_m}
    return Fault("time_offset", lidar, message, "corrected" if asked.fix_time else "kept", values=values)


def certain_rotation(found: Estimate) -> Array:
    """Return the rotation vector (3,), rad, that a mount lacks, with 0 about axes about which it is not certain or does not matter."""
    turn, sigma = found.values[ROLL : YAW + 1], found.sigma[ROLL : YAW + 1]
    return np.where(np.abs(turn) >= np.maximum(MIN_SIGMAS * sigma, MIN_ROTATION_RAD), turn, 0.0)


def rotation_fault(lidar: str, found: Estimate, seen: SweepPairs, asked: CalibrationConfig) -> Fault:
    """Describe the rotation of a mount."""
    words: list[str] = []
    values = {"pose_error_m": found.pose_error_m}
    for row, name in AXES.items():
        off_deg, sigma_deg = -np.degrees(found.values[row]), np.degrees(found.sigma[row])
        if certain_rotation(found)[row - ROLL] != 0:
            words.append(f"{name} {off_deg:+.2f} degrees (sigma {sigma_deg:.2f})")
        values |= {f"{name}_deg": float(off_deg), f"{name}_sigma_deg": float(sigma_deg)}
    course_rad = course_in_ego(seen)
    values["course_deg"] = float(np.degrees(course_rad))
    message = (
        f"its mount in the calibration is turned by {', '.join(words)} against the motion of the ego"
        f"{heading_words(float(found.values[YAW]), course_rad)}; "
        f"{'corrected' if asked.fix_mounts else 'not corrected, which --fix-calibration does'}"
    )
    return Fault("lidar_rotation", lidar, message, "corrected" if asked.fix_mounts else "kept", values=values)


def course_in_ego(seen: SweepPairs) -> float:
    """Compute the direction, rad, in which the ego moves in its own frame where it goes straight on: 0 for a car with a right heading.

    In turns, the ego's origin moves sideways by the yaw rate times its distance from the rear axle, which is left out.
    """
    velocity, known = velocities_at(seen.track, seen.t_ns)
    forward, sideways, turning = velocity[known][:, [0, 1, 5]].T
    (course, _), *_ = np.linalg.lstsq(np.stack([forward, turning], axis=1), sideways, rcond=None)
    return float(np.arctan(course))


def heading_words(yaw_rad: float, course_rad: float) -> str:
    """Say so where it is the heading of the poses that is turned rather than the mount: the ego would drive askew by them."""
    if abs(yaw_rad) < MIN_ROTATION_RAD[2] or abs(course_rad - yaw_rad) > abs(course_rad):
        return ""
    return f", or the heading of the poses is, by which the ego drives {np.degrees(course_rad):+.2f} degrees off its own axis"


def unseen_faults(lidar: str, found: Estimate | None, asked: CalibrationConfig) -> list[Fault]:
    """Say what cannot be corrected although the settings ask for it."""
    faults = []
    if asked.fix_time and (found is None or not found.shows_offset or found.sigma[OFFSET] > MAX_SIGMA_S):
        message = "stamps are not corrected: the ego's motion does not show whether they are off, which takes that it speeds up, brakes or turns"
        faults.append(Fault("unknown_offset", lidar, message, "kept"))
    if asked.fix_mounts and (found is None or found.sigma[YAW] > MAX_SIGMA_RAD):
        message = "the mount is not corrected: the ego's motion does not show whether it is turned"
        faults.append(Fault("unknown_rotation", lidar, message, "kept"))
    return faults
