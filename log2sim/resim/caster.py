"""Rays against discs: discs are laid into the picture that the sensor's rays make, then each ray meets its few exactly.

Splatting of surfels (Zwicker et al., SIGGRAPH 2001) with the plane of each disc in place of its middle.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.files.arrays import Columns
from log2sim.resim.rays import Floats, Rays
from log2sim.resim.surfels import Material, Surfels

CELL_RAD, ROW_RAD = np.float32(np.deg2rad(0.1)), np.float32(np.deg2rad(0.2))  # of azimuth and of elevation
# Of half the angles that a disc covers: meanwhile a fast ego comes a tenth nearer to what is beside it.
MARGIN = np.float32(1.1)
MAX_HALF_WIDTH_RAD = np.float32(np.deg2rad(20.0))  # of a disc in the sensor's picture
MIN_RANGE_M = 0.5
CHUNK = 30_000  # discs at a time: their columns stay in the cache
RUN = 8  # rays of one row that a disc may meet; those that a wider one may are cut to several such runs
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


def meetings(rays: Rays, grid: RayGrid, surfels: Surfels) -> list[Meetings]:
    """Intersect the rays with all discs, which are in the map less the shift of the rays; in parts that stay in the cache."""
    to_sensor = rays.bin_T_map.astype(np.float32)
    # Where the sensor is when it looks there.
    start = -np.einsum("bji,bj->bi", rays.bin_T_map[:, :3, :3], rays.bin_T_map[:, :3, 3]).astype(np.float32)
    found: list[Meetings] = []
    for first in range(0, max(len(surfels), 1), CHUNK):
        found += _met(rays, grid, to_sensor, start, surfels.take(slice(first, first + CHUNK)), first)
    return found


def _met(rays: Rays, grid: RayGrid, to_sensor: Floats, start: Floats, discs: Surfels, first: int) -> Iterator[Meetings]:
    center, radius, spread = discs.center_m.T, discs.radius_m, np.float32(rays.spread_m)
    bins = rays.bins_toward(len(discs), lambda _: center)
    offset = [center[axis] - start[:, axis].take(bins) for axis in range(3)]
    turn = [[to_sensor[:, i, j].take(bins) for j in range(3)] for i in range(3)]
    x, y, z = (_dot(turn[axis], offset) for axis in range(3))
    flat_m = np.maximum(np.sqrt(x * x + y * y), np.float32(0.01))
    distance = np.maximum(np.sqrt(_dot(offset, offset)), np.float32(0.01))
    # What has no plane faces the sensor.
    rough = (_dot(discs.normal.T, discs.normal.T) == 0) / distance
    normal = [axis + rough * away for axis, away in zip(discs.normal.T, offset)]
    # Half the angles that a disc covers: less for one that is seen from its side.
    nx, ny, nz = (_dot(turn[axis], normal) for axis in range(3))
    across = (x * ny - y * nx) / flat_m
    upward = (flat_m * nz - z * (x * nx + y * ny) / flat_m) / distance
    free = np.maximum(distance - radius - spread, np.float32(0.1))
    half_az = radius * np.sqrt(np.maximum(1 - across * across, 0)) + spread
    half_az /= np.maximum(free * flat_m / distance, np.float32(0.1))
    half_el = (radius * np.sqrt(np.maximum(1 - upward * upward, 0)) + spread) / free
    half_az, half_el = (np.minimum(half * MARGIN, MAX_HALF_WIDTH_RAD) for half in (half_az, half_el))
    azimuth = np.arctan2(y, x) - grid.low_az
    low, high = (((azimuth + side) / CELL_RAD).astype(np.int64) for side in (-half_az, half_az))
    low_row, high_row = grid.rows_of(np.arctan2(z, flat_m), half_el)
    rows = (high_row - low_row) * (distance > MIN_RANGE_M / 2)
    # The rays of each row that a disc may meet, which follow each other.
    disc, cell = _expanded(low_row * grid.columns + low, rows, grid.columns)
    begin, cell = grid.start.take(cell), cell + (high - low + 1).take(disc)
    which, entry, longer = _runs(begin, grid.start.take(cell) - begin)
    disc = disc.take(which)
    # Column by column: sums over three axes by einsum take three times as long.
    facing, apart = ([column.take(disc) for column in columns] for columns in (normal, offset))
    plane, thin = _dot(normal, offset).take(disc), np.reciprocal(radius * radius).take(disc)
    apart_starts = rays.spread_m > SAME_START_M
    place = [column.take(disc) for column in center] if apart_starts else []
    # Of every run the first ray, then the second: what is known of a disc is read once for all of them.
    for k, count in enumerate(longer):
        now = entry[:count] + k
        ray, facing = [column.take(now) for column in grid.direction], [column[:count] for column in facing]
        if apart_starts:
            whose = grid.ray.take(now)
            apart = [place[axis][:count] - rays.origin[:, axis].take(whose) for axis in range(3)]
            plane = _dot(facing, apart)
        slope = _dot(ray, facing)
        with np.errstate(divide="ignore", invalid="ignore"):
            t = plane[:count] / slope
            # From the middle of the disc to where the ray meets its plane.
            off = [t * column - away[:count] for column, away in zip(ray, apart)]
            weight = 1 - _dot(off, off) * thin[:count]
        slope = np.abs(slope)
        met = np.flatnonzero((weight > 0) & (t > MIN_RANGE_M) & (slope > MIN_FACING))
        surfel = (disc.take(met) + first).astype(np.int32)
        yield Meetings(grid.ray.take(now.take(met)), surfel, t.take(met), slope.take(met), weight.take(met))


def _runs(begin: NDArray[np.int32], count: NDArray[np.int32]) -> tuple[NDArray[np.intp], NDArray[np.int64], list[int]]:
    """Cut `count` entries from `begin` on to runs of at most `RUN`, the longest first.

    Returns whose each run is (R,), its first entry (R,), and how many runs have more than 0, 1, 2 ... entries.
    """
    which = np.flatnonzero(count)
    entry, left = begin.take(which).astype(np.int64), count.take(which)
    long = np.flatnonzero(left > RUN)
    if len(long):
        more, rest = _expanded(entry.take(long) + RUN, (left.take(long) - 1) // RUN, RUN)
        long = long.take(more)
        end = entry.take(long) + left.take(long)
        which, entry, left = (np.append(which, which.take(long)), np.append(entry, rest), np.append(left, end - rest))
    lacking = (RUN - np.minimum(left, RUN)).astype(np.uint8)
    order = np.argsort(lacking, kind="stable")
    longer = np.cumsum(np.bincount(lacking, minlength=RUN))[::-1]
    return which.take(order), entry.take(order), longer.tolist()


def _expanded(
    first: NDArray[np.int64], count: NDArray[np.signedinteger[Any]], step: int
) -> tuple[NDArray[np.intp], NDArray[np.int64]]:
    """Return `count` times the index of each number, and as many numbers: first, first + step, first + 2 step ...

    In place of `np.repeat`, which takes three times as long where counts differ.
    """
    some = np.flatnonzero(count)
    end = np.cumsum(count.take(some))
    which = np.full(int(end[-1]) if len(end) else 0, 0)
    which[end[:-1]] = 1
    np.cumsum(which, out=which)
    number = (first.take(some) - step * (end - count.take(some))).take(which)
    number += np.arange(0, step * len(which), step)
    return some.take(which), number


def _dot(a: Any, b: Any) -> Floats:
    """Return the products (N,) of vectors whose three columns are given."""
    out: Floats = a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
    return out


@dataclass(frozen=True, eq=False)
class Hits:
    """What each of N rays ends on."""

    range_m: Floats  # infinite where it meets nothing
    surfel: NDArray[np.int32]  # the first disc; -1 without
    intensity: Floats  # mean of the discs there
    returned: Floats  # how many of the rays that end on the discs there come back


def first_hits(parts: Sequence[Meetings], material: Material, count: int, rng: np.random.Generator) -> Hits:
    """Let each of `count` rays end on the first disc that stops it; discs of one surface are averaged.

    One draw a ray decides on all discs that lie within a meter of range, as they are of one fence or one tree.
    """
    draws = rng.random((count, 8), dtype=np.float32)
    first, stopped = np.full(count, np.inf), []  # in double precision `ufunc.at` takes a twentieth of the time
    for met in parts:
        share = material.share.take(met.surfel)
        stops = share > 0.98
        some = np.flatnonzero(~stops)
        slab = met.range_m.take(some).astype(np.int64) % 8
        stops[some] = draws.take(met.ray.take(some) * 8 + slab) < share.take(some)
        stopped.append(stops)
        some = np.flatnonzero(stops)
        np.minimum.at(first, met.ray.take(some), met.range_m.take(some).astype(np.float64))
    nearest, which = first.astype(np.float32), np.full(count, -1, np.int32)
    total, *sums = np.zeros((4, count))
    for met, stops in zip(parts, stopped):
        depth = (met.range_m - nearest.take(met.ray)) * met.facing
        some = np.flatnonzero(stops & (depth < THICKNESS_M))
        ray, t = met.ray.take(some), met.range_m.take(some)
        surfel, weight = met.surfel.take(some), met.weight.take(some)
        np.add.at(total, ray, weight.astype(np.float64))
        values = t, np.nan_to_num(material.intensity.take(surfel)), material.returned.take(surfel)
        for of, value in zip(sums, values):
            np.add.at(of, ray, (weight * value).astype(np.float64))
        some = np.flatnonzero(t == nearest.take(ray))
        which[ray.take(some)] = surfel.take(some)
    with np.errstate(invalid="ignore"):
        distance, strength, returned = ((of / total).astype(np.float32) for of in sums)
    distance[which < 0] = np.inf
    return Hits(distance, which, strength, returned)
