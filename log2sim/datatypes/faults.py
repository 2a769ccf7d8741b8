"""Faults of sensors, their clocks and mounts, and of the ego's poses, as far as the data of a log show them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from log2sim.geometry import NS_PER_S

FAULT_KINDS = {
    "frozen_images": "a camera repeats a picture while the ego or the scene moves",
    "black_images": "pictures of a camera show nothing",
    "missing_images": "a camera gives no pictures for longer than usual",
    "repeated_sweeps": "a LiDAR repeats a sweep",
    "missing_sweeps": "a LiDAR gives no sweeps for longer than usual",
    "sparse_sweeps": "sweeps have next to no points",
    "pose_jump": "the ego's position jumps farther than the ego can drive",
    "frozen_poses": "the ego's pose stays while the ego moves",
    "sparse_poses": "poses are farther apart than usual and are interpolated by the ego's motion",
    "time_offset": "the stamps of a sensor are off against the poses",
    "unknown_offset": "stamps were to be corrected, but the ego's motion does not show their offset",
    "lidar_rotation": "the mount of a LiDAR is rotated against its calibration",
    "lidar_translation": "the mount of a LiDAR, or the ego's origin, is elsewhere than in the calibration",
    "unknown_rotation": "a mount was to be corrected, but the ego's motion does not show its rotation",
    "camera_rotation": "the mount of a camera is rotated against its calibration",
    "swapped_cameras": "cameras have each other's calibration",
    "wrong_mount": "the mount of a camera is inverted, or its images are turned",
    "road_pose": "the pose of a roadside unit is off against the ego's map",
    "road_clock": "the stamps of a roadside unit are off against the ego's clock",
    "unknown_road_pose": "the vehicle sees too little of what a roadside unit sees to say whether its pose is right",
    "wrong_road_pose": "the vehicle saw through what a roadside unit sees, and no pose near its own makes both fit",
}
"""The kinds of faults that a run looks for, and what each means."""

Treatment = Literal["left_out", "corrected", "kept"]


@dataclass(frozen=True)
class Fault:
    """One fault of a sensor, its clock or mount, or of the ego's poses.

    Attributes
    ----------
    kind : str
        One of `FAULT_KINDS`.
    sensor : str
        Camera or LiDAR; "ego" for poses.
    message : str
        One line for people: what was found, when, and what was done about it.
    treatment : {"left_out", "corrected", "kept"}
        Whether the run does not use the records or poses in question, uses corrected ones, or uses them as they are.
    start_ns, end_ns : int or None
        First and last stamp of what is at fault; None for the whole log.
    values : mapping of str to float
        Figures by name with unit, estimates with their standard deviations: "offset_s", "offset_sigma_s".
    """

    kind: str
    sensor: str
    message: str
    treatment: Treatment
    start_ns: int | None = None
    end_ns: int | None = None
    values: Mapping[str, float] = field(default_factory=dict)

    def to_dict(self, t0_ns: int) -> dict[str, Any]:
        """Return the entry of `schemas/report-1.json` `faults`, with times in s after the stamp `t0_ns`."""
        start_s, end_s = (None if t is None else (t - t0_ns) / NS_PER_S for t in (self.start_ns, self.end_ns))
        return {
            "kind": self.kind,
            "sensor": self.sensor,
            "message": self.message,
            "treatment": self.treatment,
            "start_s": start_s,
            "end_s": end_s,
            "values": dict(self.values),
        }
