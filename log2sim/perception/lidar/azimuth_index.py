"""Which ends of a cluster are ends of its object: next to a real end, LiDAR rays reach farther."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from log2sim.perception.box_fitting import upper_median

# Width of the window next to an end in which ranges are compared, in m at the end's range, and its limits as an angle: a
# narrower one holds no ray of a usual LiDAR (0.1 to 0.4 degrees apart), a wider one reaches the next object.
WINDOW_M = 0.5
MIN_WINDOW_RAD, MAX_WINDOW_RAD = np.deg2rad(0.6), np.deg2rad(6.0)
# A return this much farther than the end belongs to something behind the object.
MIN_DEPTH_STEP_M = 0.5
MIN_RAYS_BEYOND = 2
# Share of a cluster's points skipped at each end, so that a stray one is not taken for the end.
TRIM, MAX_TRIMMED_POINTS = 0.01, 2
# Points this near to an end form the face that ends there; a corner has more than this share of their variance across.
FACE_M, MAX_FLATNESS = 1.5, 0.05
SLOPE_MARGIN = 0.01
# Azimuths are integer steps that fit into 16 bits; one turn has this many.
STEPS_PER_TURN = 60_000
STEP_RAD = 2 * np.pi / STEPS_PER_TURN
MIN_WINDOW_STEPS = round(MIN_WINDOW_RAD / STEP_RAD)


@dataclass(frozen=True, eq=False)
class AzimuthIndex:
    """Points of a cloud around their sensor, sorted by azimuth.

    Attributes
    ----------
    azimuth : (N,) uint16
        In steps of `STEP_RAD` from -pi, map frame, not decreasing.
    range_m : (N,) float32
        Horizontal distance from the sensor.
    slope : (N,) float32
        Height over horizontal distance, relative to the sensor.
    obstacle : (N,) bool
        False for points on the ground.
    rank : (N,) int
        Position of every point of the cloud in the columns above.
    """

    azimuth: NDArray[np.uint16]
    range_m: NDArray[np.float32]
    slope: NDArray[np.float32]
    obstacle: NDArray[np.bool_]
    rank: NDArray[np.intp]

    @classmethod
    def of(cls, xyz: NDArray[np.float32], sensor: NDArray[np.float32], ground: NDArray[np.bool_]) -> AzimuthIndex:
        """Sort points (N, 3) by their azimuth around a sensor (3,); `ground` (N,) marks those on the ground."""
        x, y, z = (xyz - sensor).T
        # NumPy sorts 16-bit integers by radix, ten times as fast as angles.
        azimuth = ((np.arctan2(y, x) + np.pi) / STEP_RAD).astype(np.uint16)
        order = np.argsort(azimuth, kind="stable")
        range_m = np.hypot(x, y)
        rank = np.empty(len(order), dtype=np.intp)
        rank[order] = np.arange(len(order))
        slope = z / np.maximum(range_m, 1e-3)
        return cls(azimuth[order], range_m[order], slope[order], ~ground[order], rank)

    def ends_visible(self, members: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Decide whether the right and the left end (2,) of a cluster are ends of its object.

        Parameters
        ----------
        members : (n,) int
            Rows of the cluster's points in the cloud.

        Notes
        -----
        Next to an end of the object, rays at its height reach what lies behind it. If they stop at something nearer, if
        they hit the same surface, or if there are no rays at all, the object may extend beyond what was seen.
        """
        mine = np.sort(self.rank[members])
        azimuth = self.azimuth[mine].astype(np.int64)
        if azimuth[-1] - azimuth[0] > STEPS_PER_TURN // 2:
            # The cluster lies across the azimuth at which a turn begins.
            later = int(np.searchsorted(azimuth, STEPS_PER_TURN // 2))
            mine = np.concatenate([mine[later:], mine[:later]])
            azimuth = np.concatenate([azimuth[later:] - STEPS_PER_TURN, azimuth[:later]])
        slope, is_member = self.slope[mine], np.zeros(len(self.azimuth), dtype=bool)
        is_member[mine] = True
        low, high = slope.min() - SLOPE_MARGIN, slope.max() + SLOPE_MARGIN
        ranges = self.range_m[mine]
        cut = min(round(TRIM * (len(mine) - 1)), MAX_TRIMMED_POINTS)
        visible = np.zeros(2, dtype=bool)
        xy: NDArray[np.float64] | None = None
        for k, (end, sign) in enumerate(((cut, -1), (len(mine) - 1 - cut, 1))):
            edge = int(azimuth[end])
            first, last = np.searchsorted(azimuth, (edge - MIN_WINDOW_STEPS + 1, edge + MIN_WINDOW_STEPS))
            range_m = upper_median(ranges[first:last])
            width = min(max(WINDOW_M / max(range_m, 1e-3), MIN_WINDOW_RAD), MAX_WINDOW_RAD) / STEP_RAD
            window = self._between(*sorted((edge + 2 * sign, edge + sign * round(width))))
            slopes = self.slope[window]
            beside = np.flatnonzero((slopes >= low) & (slopes <= high) & ~is_member[window])
            if len(beside) < MIN_RAYS_BEYOND:
                continue
            xy = ranges[:, None] * _direction(self.azimuth[mine]) if xy is None else xy
            face_m = _extended_face_range(xy, xy[end], self.azimuth[window][beside])
            beyond = self.range_m[window][beside] > np.maximum(face_m, range_m) + MIN_DEPTH_STEP_M
            blocked = ~beyond & self.obstacle[window][beside]
            visible[k] = beyond.sum() >= max(MIN_RAYS_BEYOND, int(blocked.sum()))
        return visible

    def _between(self, first: int, last: int) -> slice | NDArray[np.intp]:
        """Find the rows with an azimuth from `first` up to `last`, less than a turn later."""
        first, last = first % STEPS_PER_TURN, first % STEPS_PER_TURN + last - first
        bounds = np.array([first, min(last, STEPS_PER_TURN - 1), max(last - STEPS_PER_TURN, 0)], np.uint16)
        a, b, wrapped = np.searchsorted(self.azimuth, bounds).tolist()
        return np.concatenate([np.arange(a, b), np.arange(wrapped)]) if wrapped else slice(a, b)


def _extended_face_range(
    xy: NDArray[np.float64], end: NDArray[np.float64], azimuth: NDArray[np.uint16]
) -> NDArray[np.float64]:
    """Range (n,) in m at azimuths (n,) of the face of points (m, 2) that ends at one of them, were it to go on; 0 at a corner."""
    face = xy[np.hypot(*(xy - end).T) < FACE_M]
    if len(face) <= 2:
        return np.zeros(len(azimuth))
    center = face.mean(axis=0)
    x, y = (face - center).T
    xx, cross, yy = float(x @ x), float(x @ y), float(y @ y)
    # Eigenvalues and first eigenvector of a symmetric matrix of two rows.
    mean, radius = (xx + yy) / 2, math.hypot((xx - yy) / 2, cross)
    if mean - radius > MAX_FLATNESS * (mean + radius):
        return np.zeros(len(azimuth))
    angle, ray = math.atan2(2 * cross, xx - yy) / 2, _direction(azimuth)
    along_x, along_y = math.cos(angle), math.sin(angle)
    sine = ray[:, 0] * along_y - ray[:, 1] * along_x
    meets_m = (center[0] * along_y - center[1] * along_x) / np.where(sine == 0, np.inf, sine)
    return np.where(meets_m > 0, meets_m, np.inf)


def _direction(azimuth: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return unit vectors (n, 2) of azimuths (n,) in steps."""
    return np.take(_unit_vectors(), azimuth, axis=0)


@lru_cache(maxsize=1)
def _unit_vectors() -> NDArray[np.float64]:
    """Return unit vectors (`STEPS_PER_TURN` + 1, 2) of all azimuths: a look-up takes a tenth of a sine and a cosine."""
    angle = np.arange(STEPS_PER_TURN + 1) * STEP_RAD
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
