"""Where the ends of a cluster are ends of its object: rays that pass beside them reach farther."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.perception.box_fitting import upper_median

# Beside an end, so far is looked for what the rays reached there, in m at the end's range and as an angle.
WINDOW_M = 0.5
MIN_WINDOW_RAD, MAX_WINDOW_RAD = np.deg2rad(0.6), np.deg2rad(6.0)
# What lies farther behind the end than this is something else.
MIN_DEPTH_STEP_M = 0.5
MIN_RAYS_BEYOND = 2
TRIM = 0.01
SLOPE_MARGIN = 0.01
# A turn in steps that 16 bits hold.
TURN = 60_000
STEP_RAD = 2 * np.pi / TURN


@dataclass(frozen=True, eq=False)
class AzimuthIndex:
    """Points of a cloud around their sensor, by rising azimuth.

    `azimuth` (N,) in `STEP_RAD` from -pi, in the map frame; `range_m` (N,); `slope` (N,) height over distance from the
    sensor; `obstacle` (N,) False on the ground; `place_of` (N,) where each point of the cloud went.
    """

    azimuth: NDArray[np.uint16]
    range_m: NDArray[np.float32]
    slope: NDArray[np.float32]
    obstacle: NDArray[np.bool_]
    place_of: NDArray[np.intp]

    @classmethod
    def of(cls, xyz: NDArray[np.float32], sensor: NDArray[np.float32], ground: NDArray[np.bool_]) -> AzimuthIndex:
        """Sort points (N, 3) around a sensor (3,)."""
        x, y, z = (xyz - sensor).T
        # Whole numbers of 16 bits are sorted by their digits, ten times as fast as angles.
        azimuth = ((np.arctan2(y, x) + np.pi) / STEP_RAD).astype(np.uint16)
        order = np.argsort(azimuth, kind="stable")
        range_m = np.hypot(x, y)
        place_of = np.empty(len(order), dtype=np.intp)
        place_of[order] = np.arange(len(order))
        slope = z / np.maximum(range_m, 1e-3)
        return cls(azimuth[order], range_m[order], slope[order], ~ground[order], place_of)

    def ends_visible(self, members: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether the right and the left end (2,) of the cluster at rows `members` are ends of its object.

        Beside an end of the object, rays at its height reach what is behind it. Where they stop at something nearer, or
        go on along the same thing, or where the sensor does not look at all, the object may go on too.
        """
        mine = self.place_of[members]
        # Counted from one of its points, no azimuth of an object runs over the end of the turn.
        start = int(self.azimuth[mine[0]]) - TURN // 2
        turned = (self.azimuth[mine].astype(np.int64) - start) % TURN
        order = np.argsort(turned, kind="stable")
        mine, turned = mine[order], turned[order]
        slope, taken = self.slope[mine], np.zeros(len(self.azimuth), dtype=bool)
        taken[mine] = True
        low, high = slope.min() - SLOPE_MARGIN, slope.max() + SLOPE_MARGIN
        cut = round(TRIM * (len(mine) - 1))
        seen = np.zeros(2, dtype=bool)
        for k, (place, sign) in enumerate(((cut, -1), (len(mine) - 1 - cut, 1))):
            near_end = np.abs(turned - turned[place]) * STEP_RAD < MIN_WINDOW_RAD
            range_m = upper_median(self.range_m[mine[near_end]])
            width = float(np.clip(WINDOW_M / max(range_m, 1e-3), MIN_WINDOW_RAD, MAX_WINDOW_RAD)) / STEP_RAD
            edge = int(turned[place]) + start
            beside = self._between(*sorted((edge, edge + sign * round(width))))
            slopes = self.slope[beside]
            beside = beside[(slopes >= low) & (slopes <= high)]
            farther = self.range_m[beside] > range_m + MIN_DEPTH_STEP_M
            stopped = ~farther & self.obstacle[beside] & ~taken[beside]
            seen[k] = farther.sum() >= max(MIN_RAYS_BEYOND, int(stopped.sum()))
        return seen

    def _between(self, first: int, last: int) -> NDArray[np.intp]:
        """Places of the points with an azimuth from `first` up to `last`, less than a turn later."""
        first, last = first % TURN, first % TURN + last - first
        a, b, wrapped = np.searchsorted(
            self.azimuth, np.array([first, min(last, TURN - 1), max(last - TURN, 0)], np.uint16)
        )
        return np.concatenate([np.arange(a, b), np.arange(wrapped)])
