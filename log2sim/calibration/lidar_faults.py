"""What is reported about the clock and the mount of a LiDAR: what is beyond doubt and large enough to matter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.calibration.motion_fit import MIN_SIGMAS, OFFSET, PITCH, ROLL, YAW, Estimate, X, Y, Z
from log2sim.calibration.sweep_pairs import SweepPairs
from log2sim.calibration.twists import velocities_at
from log2sim.config_sections import CalibrationConfig
from log2sim.datatypes import Fault, Treatment

# What is certain is reported if it matters: 0.2 m, which is how well agents are placed, at 10 m/s and to the side at 40 m; up or down, 0.7 m at 40 m, half
# of a car. Data sets are calibrated to less. Of heights only what moves the ground out of reach.
MIN_OFFSET_S = 0.02
MIN_ROTATION_RAD = {ROLL: 0.7 / 40.0, PITCH: 0.7 / 40.0, YAW: 0.2 / 40.0}
MIN_TRANSLATION_M = {X: 0.2, Y: 0.2, Z: 0.5}
# An estimate that is no better than this does not help who asks for a correction.
MAX_SIGMA_S, MAX_SIGMA_RAD = 0.05, np.deg2rad(1.0)
ANGLES = {ROLL: "roll", PITCH: "pitch", YAW: "yaw"}
TOO_FAR = {X: ("forward", "back"), Y: ("left", "right"), Z: ("up", "down")}


@dataclass(frozen=True, eq=False)
class Findings:
    """What a LiDAR is found to lack, and what was asked for.

    Attributes
    ----------
    lidar : str
    found : Estimate
    seen : SweepPairs
    asked : CalibrationConfig
    """

    lidar: str
    found: Estimate
    seen: SweepPairs
    asked: CalibrationConfig

    @property
    def offset_s(self) -> float:
        """What stamps lack, s; 0 where that is not certain or does not matter."""
        return self.certain(OFFSET, MIN_OFFSET_S) if self.found.shows_offset else 0.0

    @property
    def turn_rad(self) -> list[float]:
        """Rotation vector (3,), rad, that the mount lacks; 0 about axes about which it is not certain or does not matter."""
        return [self.certain(row, least) for row, least in MIN_ROTATION_RAD.items()]

    @property
    def shift_m(self) -> list[float]:
        """Translation (3,), m, that the mount lacks; 0 along axes along which it is not certain or does not matter."""
        return [self.certain(row, least) for row, least in MIN_TRANSLATION_M.items()]

    def certain(self, row: int, least: float) -> float:
        """Return a value, or 0 where chance can explain it or it is below what matters."""
        value = float(self.found.values[row])
        return value if abs(value) >= max(MIN_SIGMAS * self.found.sigma[row], least) else 0.0

    def faults(self) -> list[Fault]:
        """Describe what is wrong, and what cannot be corrected although it was asked for."""
        faults = unseen_faults(self.lidar, self.found, self.asked)
        if self.offset_s:
            faults.append(_offset_fault(self))
        if any(self.turn_rad):
            faults.append(_rotation_fault(self))
        if any(self.shift_m):
            faults.append(_translation_fault(self))
        return faults


def unseen_faults(lidar: str, found: Estimate | None, asked: CalibrationConfig) -> list[Fault]:
    """Say what cannot be corrected although the settings ask for it; without an estimate, that is all of it."""
    faults = []
    if asked.fix_time and (found is None or not found.shows_offset or found.sigma[OFFSET] > MAX_SIGMA_S):
        message = (
            "stamps are not corrected: the ego's motion does not show whether they are off, which takes that it speeds up, "
            "brakes or turns"
        )
        faults.append(Fault("unknown_offset", lidar, message, "kept"))
    if asked.fix_mounts and (found is None or found.sigma[YAW] > MAX_SIGMA_RAD):
        message = "the mount is not corrected: the ego's motion does not show whether it is turned"
        faults.append(Fault("unknown_rotation", lidar, message, "kept"))
    return faults


def _offset_fault(of: Findings) -> Fault:
    late_s, sigma_s = -of.offset_s, float(of.found.sigma[OFFSET])
    words, treatment = _treated(of.asked.fix_time, "--fix-time")
    message = (
        f"stamps are {abs(late_s) * 1e3:.0f} ms {'late' if late_s > 0 else 'early'} against the poses of the ego "
        f"(sigma {sigma_s * 1e3:.0f} ms); {words}"
    )
    values = {"offset_s": late_s, "offset_sigma_s": sigma_s, "pose_error_m": of.found.pose_error_m}
    return Fault("time_offset", of.lidar, message, treatment, values=values)


def _rotation_fault(of: Findings) -> Fault:
    off_deg, sigma_deg = -np.degrees(of.found.values), np.degrees(of.found.sigma)
    figures = [
        f"{name} {off_deg[row]:+.2f} degrees (sigma {sigma_deg[row]:.2f})"
        for (row, name), turn in zip(ANGLES.items(), of.turn_rad)
        if turn
    ]
    course_rad = course_in_ego(of.seen)
    words, treatment = _treated(of.asked.fix_mounts, "--fix-calibration")
    message = (
        f"its mount in the calibration is turned by {', '.join(figures)} against the motion of the ego"
        f"{_heading_words(of.turn_rad[2], course_rad)}; {words}"
    )
    values = {f"{name}_deg": float(off_deg[row]) for row, name in ANGLES.items()}
    values |= {f"{name}_sigma_deg": float(sigma_deg[row]) for row, name in ANGLES.items()}
    values |= {"course_deg": float(np.degrees(course_rad)), "pose_error_m": of.found.pose_error_m}
    return Fault("lidar_rotation", of.lidar, message, treatment, values=values)


def _translation_fault(of: Findings) -> Fault:
    figures = [
        f"{abs(shift):.2f} m too far {way[shift > 0]} (sigma {of.found.sigma[row]:.2f})"
        for (row, way), shift in zip(TOO_FAR.items(), of.shift_m)
        if shift
    ]
    words, treatment = _treated(of.asked.fix_mounts, "--fix-calibration")
    message = (
        f"its mount in the calibration, or the ego's origin, is {', '.join(figures)} by how the ego turns; {words}"
    )
    values = {f"{name}_m": -float(of.found.values[row]) for row, name in zip((X, Y, Z), "xyz")}
    values |= {f"{name}_sigma_m": float(of.found.sigma[row]) for row, name in zip((X, Y, Z), "xyz")}
    return Fault("lidar_translation", of.lidar, message, treatment, values=values)


def _treated(corrected: bool, option: str) -> tuple[str, Treatment]:
    return ("corrected", "corrected") if corrected else (f"not corrected, which {option} does", "kept")


def course_in_ego(seen: SweepPairs) -> float:
    """Compute the direction, rad, in which the ego moves in its own frame where it goes straight on: 0 for a car with a right heading.

    In turns, the ego's origin moves sideways by the yaw rate times its distance from the rear axle, which is left out.
    """
    velocity, known = velocities_at(seen.track, seen.t_ns)
    forward, sideways, turning = velocity[known][:, [0, 1, 5]].T
    (course, _), *_ = np.linalg.lstsq(np.stack([forward, turning], axis=1), sideways, rcond=None)
    return float(np.arctan(course))


def _heading_words(yaw_rad: float, course_rad: float) -> str:
    """Say so where it is the heading of the poses that is turned rather than the mount: the ego would drive askew by them."""
    if yaw_rad == 0 or abs(course_rad - yaw_rad) > abs(course_rad):
        return ""
    return f", or the heading of the poses is, by which the ego drives {np.degrees(course_rad):+.2f} degrees off its own axis"
