"""What both versions of the data set hold of a segment, and the stamps of its frames.

Letters in shapes: F frames, B boxes, H rows and W columns of a range image.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.datatypes.log import ROTATION_TOLERANCE
from log2sim.geometry import NS_PER_S, Array, nearest_rotation
from log2sim.logs.stamps import MAX_TIME_S

# Enumerations of dataset.proto and label.proto, by their numbers.
CAMERAS = {
    1: "FRONT", 2: "FRONT_LEFT", 3: "FRONT_RIGHT", 4: "SIDE_LEFT", 5: "SIDE_RIGHT", 6: "REAR_LEFT", 7: "REAR", 8: "REAR_RIGHT",
}  # fmt: skip
LASERS = {1: "TOP", 2: "FRONT", 3: "SIDE_LEFT", 4: "SIDE_RIGHT", 5: "REAR"}
TYPES = {1: "vehicle", 2: "pedestrian", 3: "sign", 4: "cyclist"}
TOP = 1
FRONT_CAMERA = 1

# Of calibrations; larger ones are damaged.
MAX_SIDE_PX, MAX_BEAMS = 100_000, 4096


@dataclass(frozen=True, eq=False)
class CameraCalibration:
    """Calibration of a camera as the data set has it."""

    intrinsic: Array  # (9,): f_u, f_v, c_u, c_v, k1, k2, p1, p2, k3
    vehicle_T_camera: Array  # (4, 4): the camera's frame has x forward, y left, z up
    width_px: int
    height_px: int
    direction: int  # RollingShutterReadOutDirection

    @property
    def is_usable(self) -> bool:
        """Whether these are the intrinsics, finite and with focal lengths above 0, and the size of a camera."""
        usable = self.intrinsic.shape == (9,) and np.isfinite(self.intrinsic).all() and min(self.intrinsic[:2]) > 0
        low, high = sorted((self.width_px, self.height_px))
        return bool(usable) and 0 < low <= high <= MAX_SIDE_PX


@dataclass(frozen=True, eq=False)
class LaserCalibration:
    """Calibration of a LiDAR."""

    vehicle_T_lidar: Array  # (4, 4)
    # (n,): of the beams from the lowest to the highest; empty where they are spread evenly between the limits
    inclinations_rad: Array
    limits_rad: tuple[float, float]  # lowest and highest inclination


@dataclass(frozen=True, eq=False)
class ImageTimes:
    """When an image was taken, and from where."""

    world_T_vehicle: Array | None  # (4, 4): pose of the vehicle at `pose_s`
    # Unix times, and the duration of the exposure of one line; 0 where the data set has none
    pose_s: float
    shutter_s: float
    trigger_s: float
    readout_done_s: float

    @property
    def is_timed(self) -> bool:
        """Whether the begin and the end of the exposure are stated."""
        return 0 < self.trigger_s <= self.readout_done_s < MAX_TIME_S

    def middle_ns(self) -> int | None:
        """Return the middle of the exposure of the middle line; None where the data set does not state it.

        The first line is exposed from the trigger on, the last one until its readout at the end (comments of CameraImage in
        dataset.proto): half a shutter after the trigger and half a shutter before the end lie the middles of both.
        """
        if not self.is_timed:
            return self.pose_ns()
        return round((self.trigger_s + (self.readout_done_s - self.trigger_s) / 2) * NS_PER_S)

    def readout_s(self) -> float | None:
        """Return the time from the middle of the first line's exposure to that of the last one's."""
        span_s = self.readout_done_s - self.trigger_s - self.shutter_s
        return span_s if self.trigger_s > 0 and 0 < span_s < 1 else None

    def pose_ns(self) -> int | None:
        """Return the stamp of the pose; None where the data set has none."""
        return round(self.pose_s * NS_PER_S) if 0 < self.pose_s < MAX_TIME_S else None


@dataclass(frozen=True, eq=False)
class FrameRow:
    """One frame: a turn of the TOP LiDAR with the images taken during it."""

    stamp_ns: int  # of the first column of the TOP LiDAR's turn
    world_T_vehicle: Array  # (4, 4): defines the frame of points and labels, about the middle of the turn
    images: dict[int, ImageTimes]
    lasers: tuple[int, ...]  # numbers of the LiDARs with points


@dataclass(frozen=True, eq=False)
class RangeImages:
    """Range images of one LiDAR in one frame."""

    # (H, W, C) each: first the range in m, not positive where nothing returned
    returns: tuple[NDArray[np.float32], ...]
    # (H, W, 6): roll, pitch, yaw, x, y, z of the vehicle in the world at the time of each pixel
    poses: NDArray[np.float32] | None


@dataclass(frozen=True, eq=False)
class BoxTable:
    """Labeled boxes, in 3D in the vehicle's frame or upright in an image."""

    frame: NDArray[np.int64]  # (B,): index of the frame
    track_id: NDArray[np.str_]  # (B,)
    kind: NDArray[np.int64]  # (B,): type by its number in label.proto
    center: Array  # (B, 3) or (B, 2): m, or px
    size: Array  # (B, 3) or (B, 2): length, width, height in m, or length (along u) and width (along v) in px
    heading_rad: Array  # (B,)
    lost: int = 0  # further boxes, which cannot be read or are of no frame

    @classmethod
    def of(cls, frame: ArrayLike, track_id: ArrayLike, kind: ArrayLike, box: Array, lost: int) -> BoxTable:
        """Build the table of columns (B,) and boxes (B, 4 to 7): center, size and, if it is stated, heading."""
        n = box.shape[1] // 2
        heading = box[:, -1] if box.shape[1] % 2 else np.zeros(len(box))
        frames, kinds = np.asarray(frame, dtype=np.int64), np.asarray(kind, dtype=np.int64)
        return cls(frames, np.asarray(track_id, dtype=np.str_), kinds, box[:, :n], box[:, n : 2 * n], heading, lost)

    def take(self, rows: NDArray[Any]) -> BoxTable:
        """Return some of the rows."""
        return replace(self, **{name: column[rows] for name, column in vars(self).items() if name != "lost"})


def rigid(numbers: Array) -> Array | None:
    """Return the transform (4, 4) of 16 numbers in rows, its rotation made exact; None when they are none."""
    if numbers.shape != (16,) or not np.isfinite(numbers).all() or np.abs(numbers).max() > 1e9:
        return None
    out = numbers.reshape(4, 4).copy()
    rotation = out[:3, :3]
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        return None
    # Version 2 may hold them in single precision.
    out[:3, :3], out[3] = nearest_rotation(rotation), (0.0, 0.0, 0.0, 1.0)
    return out


Stamps = NDArray[np.int64]

# The TOP LiDAR turns ten times a second.
NOMINAL_PERIOD_NS = 100_000_000
MIN_PERIOD_NS, MAX_PERIOD_NS = 80_000_000, 120_000_000
# Times that are farther from the stamp of their frame are damaged.
MAX_LAG_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Stamps of F frames in order."""

    start_ns: Stamps  # (F,): of the first column of the TOP LiDAR's turn
    period_ns: Stamps  # (F,): duration of the turn, to the start of the next one
    pose_ns: Stamps  # (F,): of the pose that defines the vehicle's frame, to which points are compensated

    @classmethod
    def of(cls, frames: list[FrameRow], notes: list[str]) -> FrameTimes:
        """Determine the stamps of frames in order; `notes` takes what is assumed."""
        start = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
        step = np.diff(start)
        whole = (step >= MIN_PERIOD_NS) & (step <= MAX_PERIOD_NS)
        usual = round(float(np.median(step[whole]))) if whole.any() else NOMINAL_PERIOD_NS
        period = np.append(np.where(whole, step, usual), usual)
        # Comments of Frame in dataset.proto: the pose is about the one in the middle of the frame.
        pose, unknown = start + period // 2, 0
        for k, frame in enumerate(frames):
            front = frame.images.get(FRONT_CAMERA)
            stamp = plausible_stamp(None if front is None else front.pose_ns(), frame.stamp_ns)
            pose[k] = pose[k] if stamp is None else stamp
            unknown += stamp is None
        if unknown:
            notes.append(
                f"the time of the vehicle's pose, taken from the image of {unknown} of {len(frames)} frames' FRONT camera, is "
                "missing there: the middle of the LiDAR's turn is assumed"
            )
        return cls(start, period, pose)

    def at_turn(self, frame: NDArray[np.int64] | np.intp, turn: NDArray[np.float64]) -> Stamps:
        """Return the stamps (N,) at shares of the turns (N,) of frames (N,), or of one."""
        return self.start_ns[frame] + np.round(turn * self.period_ns[frame]).astype(np.int64)


def plausible_stamp(stamp: int | None, frame_ns: int) -> int | None:
    """Return a stamp, ns, if it is known and within `MAX_LAG_NS` of that of its frame; else None."""
    return stamp if stamp is not None and abs(stamp - frame_ns) <= MAX_LAG_NS else None
