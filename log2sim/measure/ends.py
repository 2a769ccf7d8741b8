"""Where the ends of a cluster are ends of its object: rays that pass beside them reach farther."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import wrap_angle

# Beside an end, so far is looked for what the rays reached there, in m at the end's range and as an angle.
BESIDE_M = 0.5
LEAST_RAD, MOST_RAD = np.deg2rad(0.6), np.deg2rad(6.0)
# What lies farther behind the end than this is something else.
BEHIND_M = 0.5
LEAST_POINTS = 2
TRIM = 0.01
SLOPE_MARGIN = 0.01


@dataclass(frozen=True, eq=False)
class Panorama:
    """Points of a cloud around their sensor, by rising azimuth.

    `azimuth` (N,) rad in the map frame, `range_m` (N,) and `slope` (N,) height over distance from the sensor, `obstacle`
    (N,) False on the ground, `place_of` (N,) where each point of the cloud went.
    """

    azimuth: NDArray[np.float32]
    range_m: NDArray[np.float32]
    slope: NDArray[np.float32]
    obstacle: NDArray[np.bool_]
    place_of: NDArray[np.intp]

    @classmethod
    def of(cls, xyz: NDArray[np.float32], sensor: NDArray[np.float32], ground: NDArray[np.bool_]) -> Panorama:
        """Sort points (N, 3) around a sensor (3,)."""
        from_sensor = xyz - sensor
        azimuth = np.arctan2(from_sensor[:, 1], from_sensor[:, 0])
        order = np.argsort(azimuth, kind="stable")
        range_m = np.hypot(from_sensor[:, 0], from_sensor[:, 1])
        place_of = np.empty(len(order), dtype=np.intp)
        place_of[order] = np.arange(len(order))
        slope = from_sensor[:, 2] / np.maximum(range_m, 1e-3)
        return cls(azimuth[order], range_m[order], slope[order], ~ground[order], place_of)

    def ends_seen(self, members: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Whether the right and the left end (2,) of the cluster at rows `members` are ends of its object.

        Beside an end of the object, rays at its height reach what is behind it. Where they stop at something nearer, or
        go on along the same thing, or where the sensor does not look at all, the object may go on too.
        """
        mine = self.place_of[members]
        azimuth, slope = self.azimuth[mine], self.slope[mine]
        middle = np.arctan2(np.sin(azimuth).sum(), np.cos(azimuth).sum())
        relative = wrap_angle(azimuth - middle)
        low, high = slope.min() - SLOPE_MARGIN, slope.max() + SLOPE_MARGIN
        seen = np.zeros(2, dtype=bool)
        for k, (edge, sign) in enumerate(((np.quantile(relative, TRIM), -1.0), (np.quantile(relative, 1 - TRIM), 1.0))):
            range_m = float(np.median(self.range_m[mine[np.abs(relative - edge) < LEAST_RAD]]))
            width = float(np.clip(BESIDE_M / max(range_m, 1e-3), LEAST_RAD, MOST_RAD))
            beside = self._between(*sorted((middle + edge, middle + edge + sign * width)))
            beside = beside[(self.slope[beside] >= low) & (self.slope[beside] <= high)]
            farther = self.range_m[beside] > range_m + BEHIND_M
            beyond = int(farther.sum())
            stopped = np.setdiff1d(beside[~farther & self.obstacle[beside]], mine, assume_unique=True)
            seen[k] = beyond >= max(LEAST_POINTS, len(stopped))
        return seen

    def _between(self, first: float, last: float) -> NDArray[np.intp]:
        """Places of the points whose azimuth lies between two angles less than a turn apart, first <= last."""
        shift = 2 * np.pi * np.floor((first + np.pi) / (2 * np.pi))
        first, last = first - shift, last - shift
        a, b = np.searchsorted(self.azimuth, [first, last])
        wrapped = np.arange(np.searchsorted(self.azimuth, last - 2 * np.pi))
        return np.concatenate([np.arange(a, b), wrapped])
