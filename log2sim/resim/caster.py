"""Rays against discs: discs are laid into the picture that the sensor's rays make, then each ray meets its few exactly.

Splatting of surfels (Zwicker et al., SIGGRAPH 2001) with the plane of each disc in place of its middle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.files.arrays import Columns
from log2sim.resim.rays import Floats, Rays, bin_of
from log2sim.resim.surfels import Surfels

CELL_RAD, ROW_RAD = np.float32(np.deg2rad(0.1)), np.float32(np.deg2rad(0.2))  # of azimuth and of elevation
# Of half the angles that a disc covers: meanwhile a fast ego comes a tenth nearer to what is beside it.
MARGIN = np.float32(1.1)
MAX_HALF_WIDTH_RAD = np.float32(np.deg2rad(20.0))  # of a disc in the sensor's picture
MIN_RANGE_M = 0.5
CHUNK = 30_000  # discs at a time: their columns stay in the cache
# A quarter of the usual noise: rays that look one way start within it where the LiDAR spins.
SAME_START_M = np.float32(0.005)
THICKNESS_M = 0.08  # discs this far behind the first one, across their plane, are the same surface
MIN_FACING = 0.02


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays in the order of the rows and columns of their picture, those at the seam on both ends."""

    ray: NDArray[np.intp]  # (E,): index of a ray
    direction: Floats  # (3, E): in the axes of the map
    start: NDArray[np.int32]  # (R * C + 1,): first entry of each cell
    columns: int
    # (B + 1,): how many of the B rows of `ROW_RAD` from `low_el` up to each have a ray; others are left out
    rank: NDArray[np.int64]
    low_az: np.float32
    low_el: np.float32

    def rows_of(self, elevation: Floats, half: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the first row (N,) that angles with half a width reach, and the one after the last."""
        last = len(self.rank) - 2
        low, high = (((elevation + side - self.low_el) / ROW_RAD).astype(np.int64) for side in (-half, half))
        return self.rank[np.clip(low, 0, last)], self.rank[np.clip(high, -1, last) + 1]


def grid_of(rays: Rays) -> RayGrid:
    """Sort the rays of a sweep into cells of azimuth and elevation."""
    margin, turn = MAX_HALF_WIDTH_RAD + CELL_RAD, np.float32(2 * np.pi)
    left, right = rays.azimuth < -np.pi + margin, rays.azimuth > np.pi - margin
    index = np.concatenate([np.arange(len(rays.azimuth)), np.flatnonzero(left), np.flatnonzero(right)])
    azimuth = np.concatenate([rays.azimuth, rays.azimuth[left] + turn, rays.azimuth[right] - turn])
    elevation = rays.elevation[index]
    low_az, low_el = np.float32(-np.pi - margin), elevation.min() - CELL_RAD
    columns = int((turn + 2 * margin) / CELL_RAD) + 1
    row = ((elevation - low_el) / ROW_RAD).astype(np.int64)
    used = np.bincount(row) > 0
    rank = np.concatenate([[0], np.cumsum(used)])
    row = rank[row]
    cell = row * columns + ((azimuth - low_az) / CELL_RAD).astype(np.int64)
    rows = int(rank[-1])
    order = np.sort((cell << 32) | np.arange(len(cell))) & 0xFFFFFFFF  # numbers are sorted faster than their indices
    start = np.zeros(rows * columns + 1, np.int32)
    np.cumsum(np.bincount(cell, minlength=rows * columns), out=start[1:])
    index = index[order]
    direction = np.ascontiguousarray(rays.direction[index].T)
    return RayGrid(index, direction, start, columns, rank, low_az, np.float32(low_el))


@dataclass(frozen=True, eq=False)
class Meetings(Columns):
    """Rays that meet discs, M of them."""

    ray: NDArray[np.intp]
    surfel: NDArray[np.int32]
    range_m: Floats
    facing: Floats  # cosine between ray and normal
    weight: Floats  # 1 in the middle of the disc, 0 at its edge


def meetings(rays: Rays, grid: RayGrid, surfels: Surfels, center: Floats, normal: Floats) -> Meetings:
    """Intersect the rays with all discs; `center` and `normal` (S, 3) are theirs in the map less the shift of the rays."""
    found = []
    for first in range(0, len(surfels), CHUNK):
        part = slice(first, first + CHUNK)
        found.append(_met(rays, grid, center[part], normal[part], surfels.radius_m[part], first))
    if not found:
        found.append(_met(rays, grid, center, normal, surfels.radius_m, 0))
    return Meetings.join(found)


def _met(rays: Rays, grid: RayGrid, center: Floats, normal: Floats, radius: Floats, first: int) -> Meetings:
    to_sensor = rays.bin_T_map.astype(np.float32)
    middle = to_sensor[len(to_sensor) // 2]
    bins = bin_of(np.arctan2(_row(middle, 1, center.T), _row(middle, 0, center.T)))
    # Where the sensor is when it looks there, and the discs from there.
    start = -np.einsum("bji,bj->bi", rays.bin_T_map[:, :3, :3], rays.bin_T_map[:, :3, 3]).astype(np.float32)
    offset = np.stack([center[:, axis] - start[:, axis].take(bins) for axis in range(3)])
    turn = [[to_sensor[:, i, j].take(bins) for j in range(3)] for i in range(3)]
    x, y, z = (_dot(turn[axis], offset) for axis in range(3))
    flat_m = np.sqrt(x * x + y * y)
    distance = np.sqrt(flat_m * flat_m + z * z)
    elevation = np.arctan2(z, flat_m)
    free = np.maximum(distance - radius - rays.spread_m, 0.1)
    # Most discs are far away, and lie between two lines of the LiDAR even if they face it.
    low_row, high_row = grid.rows_of(elevation, np.minimum((radius + rays.spread_m) / free, MAX_HALF_WIDTH_RAD))
    own = np.flatnonzero((high_row > low_row) & (distance > MIN_RANGE_M / 2))
    x, y, z, flat_m, distance, elevation, free, radius = (
        v.take(own) for v in (x, y, z, flat_m, distance, elevation, free, radius)
    )
    offset, turn = offset.take(own, axis=1), [[v.take(own) for v in row] for row in turn]
    normal = normal.take(own, axis=0).T.copy()
    # What has no plane faces the sensor.
    rough = ~normal.any(axis=0)
    normal[:, rough] = offset[:, rough] / distance[rough]
    azimuth = np.arctan2(y, x)
    # Half the angles that a disc covers: less for one that is seen from its side.
    nx, ny, nz = (_dot(turn[axis], normal) for axis in range(3))
    across = (x * ny - y * nx) / np.maximum(flat_m, 0.01)
    upward = (flat_m * nz - z * (x * nx + y * ny) / np.maximum(flat_m, 0.01)) / np.maximum(distance, 0.01)
    half_az = (radius * np.sqrt(np.maximum(1 - across**2, 0)) + rays.spread_m) / np.maximum(
        free * flat_m / np.maximum(distance, 0.01), 0.1
    )
    half_el = (radius * np.sqrt(np.maximum(1 - upward**2, 0)) + rays.spread_m) / free
    half_az, half_el = (np.minimum(half * MARGIN, MAX_HALF_WIDTH_RAD) for half in (half_az, half_el))
    low_row, high_row = grid.rows_of(elevation, half_el)
    disc, row = _expanded(np.arange(len(own)), low_row, high_row)
    row *= grid.columns
    low = ((azimuth - half_az - grid.low_az) / CELL_RAD).astype(np.int64)
    high = ((azimuth + half_az - grid.low_az) / CELL_RAD).astype(np.int64) + 1
    begin = grid.start.take(row + low.take(disc)).astype(np.int64)
    end = grid.start.take(row + high.take(disc)).astype(np.int64)
    some = np.flatnonzero(end > begin)
    disc, entry = _expanded(disc.take(some), begin.take(some), end.take(some))
    # Column by column: sums over three axes by einsum take three times as long.
    ray = [grid.direction[axis].take(entry) for axis in range(3)]
    facing = [normal[axis].take(disc) for axis in range(3)]
    apart = [offset[axis].take(disc) for axis in range(3)]
    plane, away2 = _dot(normal, offset).take(disc), (distance * distance).take(disc)
    if rays.spread_m > SAME_START_M:
        whose, begins = grid.ray.take(entry), start[bins[own]]
        apart = [apart[k] + begins[:, k].take(disc) - rays.origin[:, k].take(whose) for k in range(3)]
        plane, away2 = _dot(facing, apart), _dot(apart, apart)
    slope, along = _dot(ray, facing), _dot(ray, apart)
    with np.errstate(divide="ignore", invalid="ignore"):
        t = plane / slope
    # From the middle of the disc to where the ray meets its plane.
    off2 = t * (t - 2 * along) + away2
    weight = np.asarray(1 - off2 / (radius * radius).take(disc), np.float32)
    slope = np.abs(slope)
    met = np.flatnonzero((weight > 0) & (t > MIN_RANGE_M) & (slope > MIN_FACING))
    surfel = (own.take(disc.take(met)) + first).astype(np.int32)
    return Meetings(grid.ray.take(entry.take(met)), surfel, t.take(met), slope.take(met), weight.take(met))


def _expanded(
    index: NDArray[np.int64], begin: NDArray[np.int64], end: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Repeat each index for every number from its begin up to its end, and return those numbers."""
    count = end - begin
    which = np.repeat(np.arange(len(count)), count)
    number = (begin - (np.cumsum(count) - count)).take(which)
    number += np.arange(len(number))
    return index.take(which), number


def _dot(a: Any, b: Any) -> Floats:
    """Return the products (N,) of vectors whose three columns are given."""
    out: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


def _row(pose: Floats, axis: int, points: Any) -> Floats:
    """Return a coordinate (N,) of points, whose three columns are given, moved by a pose (4, 4)."""
    out: Floats = _dot(pose[axis], points) + pose[axis, 3]
    return out


@dataclass(frozen=True, eq=False)
class Hits:
    """What each of N rays ends on.

    Attributes
    ----------
    range_m : (N,) float32
        Infinite where it meets nothing.
    surfel : (N,) int32
        The first disc; -1 without.
    intensity, returned : (N,) float32
        Of the discs there: their mean intensity, and how many of their rays come back.
    """

    range_m: Floats
    surfel: NDArray[np.int32]
    intensity: Floats
    returned: Floats


def first_hits(met: Meetings, surfels: Surfels, count: int, rng: np.random.Generator) -> Hits:
    """Let each of `count` rays end on the first disc that stops it; discs of one surface are averaged.

    One draw a ray decides on all discs that lie within a meter of range, as they are of one fence or one tree.
    """
    share = surfels.share.take(met.surfel)
    stops = share > 0.98
    open_ = np.flatnonzero(~stops)
    draws = rng.random((count, 8), dtype=np.float32)
    stops[open_] = draws[met.ray[open_], met.range_m[open_].astype(np.int32) % 8] < share[open_]
    kept = np.flatnonzero(stops)
    ray, t = met.ray.take(kept), met.range_m.take(kept)
    first = np.full(count, np.inf)  # in double precision `ufunc.at` takes a twentieth of the time
    np.minimum.at(first, ray, t.astype(np.float64))
    depth = (t - first.take(ray).astype(np.float32)) * met.facing.take(kept)
    which = np.full(count, -1, np.int32)
    at = np.flatnonzero(depth == 0)
    which[ray[at]] = met.surfel[kept[at]]
    same = np.flatnonzero(depth < THICKNESS_M)
    kept, ray, t = kept.take(same), ray.take(same), t.take(same)
    surfel, weight = met.surfel.take(kept), met.weight.take(kept)
    total = np.bincount(ray, weight, count)

    def mean(values: Floats) -> Floats:
        with np.errstate(invalid="ignore"):
            return (np.bincount(ray, weight * values, count) / total).astype(np.float32)

    distance = mean(t)
    distance[which < 0] = np.inf
    strength = np.nan_to_num(surfels.intensity).take(surfel)
    return Hits(distance, which, mean(strength), mean(surfels.returned.take(surfel)))
