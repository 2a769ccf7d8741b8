"""Stamps of frames: start and length of the TOP LiDAR's turn, and the time of the pose that defines the vehicle's frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.logs.waymo.segment import FRONT_CAMERA, FrameRow

Stamps = NDArray[np.int64]

# The TOP LiDAR turns ten times a second.
NOMINAL_PERIOD_NS = 100_000_000
MIN_PERIOD_NS, MAX_PERIOD_NS = 80_000_000, 120_000_000
# Times that are farther from the stamp of their frame are damaged.
MAX_LAG_NS = 1_000_000_000


@dataclass(frozen=True, eq=False)
class FrameTimes:
    """Stamps of F frames in order.

    Attributes
    ----------
    start_ns : (F,) int64
        Of the first column of the TOP LiDAR's turn.
    period_ns : (F,) int64
        Duration of the turn, to the start of the next one.
    pose_ns : (F,) int64
        Of the pose that defines the vehicle's frame, to which points are compensated.
    """

    start_ns: Stamps
    period_ns: Stamps
    pose_ns: Stamps

    @classmethod
    def of(cls, frames: list[FrameRow], notes: list[str]) -> FrameTimes:
        """Determine the stamps of frames in order; `notes` takes what is assumed."""
        start = np.array([frame.stamp_ns for frame in frames], dtype=np.int64)
        step = np.diff(start)
        whole = (step >= MIN_PERIOD_NS) & (step <= MAX_PERIOD_NS)
        usual = round(float(np.median(step[whole]))) if whole.any() else NOMINAL_PERIOD_NS
        period = np.append(np.where(whole, step, usual), usual)
        # Comments of Frame in dataset.proto: the pose is about the one in the middle of the frame.
        pose = start + period // 2
        unknown = 0
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

    def at_turn(self, frame: NDArray[np.int64], turn: NDArray[np.float64]) -> Stamps:
        """Return the stamps (N,) at shares of the turns (N,) of frames (N,)."""
        return self.start_ns[frame] + np.round(turn * self.period_ns[frame]).astype(np.int64)


def plausible_stamp(stamp: int | None, frame_ns: int) -> int | None:
    """Return a stamp, ns, if it is known and within `MAX_LAG_NS` of that of its frame; else None."""
    return stamp if stamp is not None and abs(stamp - frame_ns) <= MAX_LAG_NS else None
