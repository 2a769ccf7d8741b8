"""Which ends of a cluster are ends of its object: next to a real end, LiDAR rays reach farther."""

from __future__ import annotations

from collections.abc import Sequence
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

    def ends_visible(self, members: Sequence[NDArray[np.intp]]) -> NDArray[np.bool_]:
        """Decide which of the right and the left end (R, 2) of clusters are ends of their objects.

        Parameters
        ----------
        members : R arrays (n,) of int
            Rows of each cluster's points in the cloud, at least one.

        Notes
        -----
        Next to an end of the object, rays at its height reach what lies behind it. If they stop at something nearer, if
        they hit the same surface, or if there are no rays at all, the object may extend beyond what was seen.
        """
        clusters = _Clusters.of(self, members)
        end, edge = clusters.ends()
        range_m = clusters.ranges_near(edge)
        width = np.clip(WINDOW_M / np.maximum(range_m, 1e-3), MIN_WINDOW_RAD, MAX_WINDOW_RAD) / STEP_RAD
        sign = np.array([-1, 1])
        beside = np.sort([edge + 2 * sign, edge + sign * np.round(width).astype(np.int64)], axis=0)
        window, row = self._between(*beside.reshape(2, -1))
        slope, low, high = self.slope[row], *(np.repeat(v, 2)[window] for v in clusters.slopes())
        found = np.flatnonzero((slope >= low) & (slope <= high))
        found = found[~clusters.contain(window[found] // 2, row[found])]
        window, row = window[found], row[found]
        least_m = np.maximum(clusters.extended_face_ranges(end, window, self.azimuth[row]), range_m.ravel()[window])
        beyond = self.range_m[row] > least_m + MIN_DEPTH_STEP_M
        ends = end.size
        rays = np.bincount(window[beyond], minlength=ends)
        blocked = np.bincount(window[~beyond & self.obstacle[row]], minlength=ends)
        return np.asarray(rays >= np.maximum(MIN_RAYS_BEYOND, blocked)).reshape(-1, 2)

    def _between(self, first: NDArray[np.int64], last: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Find the rows with an azimuth in each window (W,) from `first` up to `last`, less than a turn later: window (n,), row (n,)."""
        first, last = first % STEPS_PER_TURN, first % STEPS_PER_TURN + last - first
        wrapped = np.maximum(last - STEPS_PER_TURN, 0)
        bounds = np.stack([first, np.minimum(last, STEPS_PER_TURN - 1), wrapped]).astype(np.uint16)
        begin, end, rest = np.searchsorted(self.azimuth, bounds)
        start = np.stack([begin, np.zeros_like(begin)], axis=1).ravel()
        count = np.stack([np.maximum(end - begin, 0), rest], axis=1).ravel()
        ordinal = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        return np.repeat(np.arange(len(count)) // 2, count), np.repeat(start, count) + ordinal


@dataclass(frozen=True, eq=False)
class _Clusters:
    """Points of R clusters, one cluster after the other, each in the order of their azimuths.

    Attributes
    ----------
    index : AzimuthIndex
    count, start : (R,) int
        Number of points of each cluster, and the place of its first.
    group : (K,) int
        The cluster of each point.
    row : (K,) int
        The point in the index.
    azimuth : (K,) int64
        In steps, negative for the points of a cluster that lie before the azimuth at which a turn begins.
    """

    index: AzimuthIndex
    count: NDArray[np.intp]
    start: NDArray[np.intp]
    group: NDArray[np.intp]
    row: NDArray[np.intp]
    azimuth: NDArray[np.int64]

    @classmethod
    def of(cls, index: AzimuthIndex, members: Sequence[NDArray[np.intp]]) -> _Clusters:
        """Sort the points of clusters, given as rows of the cloud."""
        count = np.array([len(rows) for rows in members])
        start, group = np.cumsum(count) - count, np.repeat(np.arange(len(count)), count)
        row = np.sort(group * len(index.rank) + index.rank[np.concatenate(members)]) - group * len(index.rank)
        azimuth = index.azimuth[row].astype(np.int64)
        across = azimuth[start + count - 1] - azimuth[start] > STEPS_PER_TURN // 2
        if across.any():
            azimuth = np.where(across[group] & (azimuth >= STEPS_PER_TURN // 2), azimuth - STEPS_PER_TURN, azimuth)
            order = np.lexsort((azimuth, group))
            row, azimuth = row[order], azimuth[order]
        return cls(index, count, start, group, row, azimuth)

    def ends(self) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
        """Return the place (R, 2) of the points at the ends, stray ones left out, and their azimuths (R, 2)."""
        cut = np.minimum(np.round(TRIM * (self.count - 1)).astype(np.intp), MAX_TRIMMED_POINTS)
        end = np.stack([self.start + cut, self.start + self.count - 1 - cut], axis=1)
        return end, self.azimuth[end]

    def ranges_near(self, edge: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the upper median (R, 2) of the ranges of a cluster's points around azimuths (R, 2)."""
        # Azimuths of different clusters are so far apart that those of all clusters are sorted, windows across their ends included.
        own = 3 * STEPS_PER_TURN
        ordered, first = self.group * own + self.azimuth, own * np.arange(len(edge))[:, None] + edge
        low = np.searchsorted(ordered, first - MIN_WINDOW_STEPS + 1).ravel().tolist()
        high = np.searchsorted(ordered, first + MIN_WINDOW_STEPS).ravel().tolist()
        ranges = self.index.range_m[self.row]
        return np.array([upper_median(ranges[a:b]) for a, b in zip(low, high)]).reshape(-1, 2)

    def slopes(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return the slopes (R,), (R,) between which rays are at the height of a cluster."""
        slope = self.index.slope[self.row]
        low, high = np.minimum.reduceat(slope, self.start), np.maximum.reduceat(slope, self.start)
        return low - np.float32(SLOPE_MARGIN), high + np.float32(SLOPE_MARGIN)

    def contain(self, group: NDArray[np.intp], row: NDArray[np.intp]) -> NDArray[np.bool_]:
        """Mark points (n,) of the index that belong to a cluster (n,)."""
        size = len(self.index.rank)
        own, wanted = np.sort(self.group * size + self.row), group * size + row
        place = np.minimum(np.searchsorted(own, wanted), len(own) - 1)
        return np.asarray(own[place] == wanted)

    def extended_face_ranges(
        self, end: NDArray[np.intp], window: NDArray[np.intp], azimuth: NDArray[np.uint16]
    ) -> NDArray[np.float64]:
        """Range (n,) in m, at azimuths (n,), of the face that ends at an end of a cluster, were it to go on; 0 at a corner.

        Parameters
        ----------
        end : (R, 2) int
            See `ends`.
        window : (n,) int
            Twice the cluster, plus one at its left end.
        azimuth : (n,) uint16
        """
        xy = self.index.range_m[self.row, None] * _direction(self.index.azimuth[self.row])
        near, points = [], []
        for side in range(2):
            x, y = (xy - xy[end[self.group, side]]).T
            point = np.flatnonzero(np.hypot(x, y) < FACE_M)
            near.append(2 * self.group[point] + side)
            points.append(xy[point])
        of, (x, y) = np.concatenate(near), np.concatenate(points).T
        count = np.maximum(np.bincount(of, minlength=end.size), 1)

        def total(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray(np.bincount(of, values, minlength=end.size), dtype=np.float64)

        center_x, center_y = total(x) / count, total(y) / count
        x, y = x - center_x[of], y - center_y[of]
        xx, cross, yy = total(x * x), total(x * y), total(y * y)
        # Eigenvalues and first eigenvector of a symmetric matrix of two rows.
        mean, radius = (xx + yy) / 2, np.hypot((xx - yy) / 2, cross)
        is_face = (count > 2) & (mean - radius <= MAX_FLATNESS * (mean + radius))
        angle, ray = np.arctan2(2 * cross, xx - yy) / 2, _direction(azimuth)
        along_x, along_y = np.cos(angle), np.sin(angle)
        sine = ray[:, 0] * along_y[window] - ray[:, 1] * along_x[window]
        distance = (center_x * along_y - center_y * along_x)[window]
        meets_m = distance / np.where(sine == 0, np.inf, sine)
        return np.where(is_face[window], np.where(meets_m > 0, meets_m, np.inf), 0.0)


def _direction(azimuth: NDArray[np.uint16]) -> NDArray[np.float64]:
    """Return unit vectors (n, 2) of azimuths (n,) in steps."""
    return np.take(_unit_vectors(), azimuth, axis=0)


@lru_cache(maxsize=1)
def _unit_vectors() -> NDArray[np.float64]:
    """Return unit vectors (`STEPS_PER_TURN` + 1, 2) of all azimuths: a look-up takes a tenth of a sine and a cosine."""
    angle = np.arange(STEPS_PER_TURN + 1) * STEP_RAD
    return np.stack([np.cos(angle), np.sin(angle)], axis=-1)
