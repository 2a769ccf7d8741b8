"""Rays against discs: discs are laid into the picture that the sensor's rays make, then each ray meets its few exactly.

Splatting of surfels (Zwicker et al., SIGGRAPH 2001) with the plane of each disc in place of its middle.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.resim.rays import Floats, Rays, bin_of
from log2sim.resim.surfels import Surfels

CELL_RAD = np.float32(np.deg2rad(0.2))
MARGIN_RAD = np.float32(np.deg2rad(0.05))  # around what a disc covers, for what angles leave out
MAX_HALF_WIDTH_RAD = np.float32(np.deg2rad(20.0))  # of a disc in the sensor's picture
MIN_RANGE_M = 0.5
CHUNK = 150_000  # discs at a time: their columns stay in the cache
THICKNESS_M = 0.08  # discs this far behind the first one, across their plane, are the same surface
MIN_FACING = 0.02


@dataclass(frozen=True, eq=False)
class RayGrid:
    """Rays in the order of the rows and columns of their picture, those at the seam on both ends."""

    ray: NDArray[np.intp]  # (E,): index of a ray
    azimuth: Floats  # (E,)
    elevation: Floats  # (E,)
    start: NDArray[np.int32]  # (R * C + 1,): first entry of each cell
    columns: int
    rows: int
    low_az: np.float32
    low_el: np.float32


def grid_of(rays: Rays) -> RayGrid:
    """Sort the rays of a sweep into cells of azimuth and elevation."""
    margin, turn = MAX_HALF_WIDTH_RAD + CELL_RAD, np.float32(2 * np.pi)
    left, right = rays.azimuth < -np.pi + margin, rays.azimuth > np.pi - margin
    index = np.concatenate([np.arange(len(rays.azimuth)), np.flatnonzero(left), np.flatnonzero(right)])
    azimuth = np.concatenate([rays.azimuth, rays.azimuth[left] + turn, rays.azimuth[right] - turn])
    elevation = rays.elevation[index]
    low_az, low_el = np.float32(-np.pi - margin), elevation.min() - CELL_RAD
    columns = int((turn + 2 * margin) / CELL_RAD) + 1
    row = ((elevation - low_el) / CELL_RAD).astype(np.int64)
    cell = row * columns + ((azimuth - low_az) / CELL_RAD).astype(np.int64)
    rows = int(row.max()) + 2
    order = np.argsort(cell, kind="stable")
    start = np.zeros(rows * columns + 1, np.int32)
    np.cumsum(np.bincount(cell, minlength=rows * columns), out=start[1:])
    return RayGrid(index[order], azimuth[order], elevation[order], start, columns, rows, low_az, np.float32(low_el))


@dataclass(frozen=True, eq=False)
class Meetings:
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
    return Meetings(*(np.concatenate([getattr(m, k) for m in found]) for k in Meetings.__dataclass_fields__))


def _met(rays: Rays, grid: RayGrid, center: Floats, normal: Floats, radius: Floats, first: int) -> Meetings:
    to_sensor = rays.bin_T_map.astype(np.float32)
    middle = to_sensor[len(to_sensor) // 2]
    seen = center @ middle[:3, :3].T + middle[:3, 3]
    bins = bin_of(np.arctan2(seen[:, 1], seen[:, 0]))
    # Where the sensor is when it looks there.
    seen = np.einsum("nij,nj->ni", to_sensor[bins, :3, :3], center) + to_sensor[bins, :3, 3]
    azimuth = np.arctan2(seen[:, 1], seen[:, 0])
    flat_m = np.hypot(seen[:, 0], seen[:, 1])
    distance = np.hypot(flat_m, seen[:, 2])
    elevation = np.arctan2(seen[:, 2], flat_m)
    # Half the angles that a disc covers: less for one that is seen from its side.
    turned = np.einsum("nij,nj->ni", to_sensor[bins, :3, :3], normal)
    c, s = np.cos(azimuth), np.sin(azimuth)
    across = c * turned[:, 1] - s * turned[:, 0]
    upward = (flat_m * turned[:, 2] - seen[:, 2] * (c * turned[:, 0] + s * turned[:, 1])) / np.maximum(distance, 0.01)
    free = np.maximum(distance - radius - rays.spread_m, 0.1)
    half_az = (radius * np.sqrt(np.maximum(1 - across**2, 0)) + rays.spread_m) / np.maximum(
        free * flat_m / np.maximum(distance, 0.01), 0.1
    )
    half_el = (radius * np.sqrt(np.maximum(1 - upward**2, 0)) + rays.spread_m) / free
    half_az, half_el = np.minimum(half_az, MAX_HALF_WIDTH_RAD), np.minimum(half_el, MAX_HALF_WIDTH_RAD)
    near = distance > MIN_RANGE_M / 2
    low_row = ((elevation - half_el - grid.low_el) / CELL_RAD).astype(np.int64)
    high_row = ((elevation + half_el - grid.low_el) / CELL_RAD).astype(np.int64)
    near &= (high_row >= 0) & (low_row < grid.rows)
    low_row, high_row = np.maximum(low_row, 0), np.minimum(high_row, grid.rows - 1)
    own = np.flatnonzero(near)
    disc, row = _expanded(own, low_row[own], high_row[own] + 1)
    low = ((azimuth - half_az - grid.low_az) / CELL_RAD).astype(np.int64)
    high = ((azimuth + half_az - grid.low_az) / CELL_RAD).astype(np.int64)
    begin = grid.start[row * grid.columns + low[disc]].astype(np.int64)
    end = grid.start[row * grid.columns + high[disc] + 1].astype(np.int64)
    some = end > begin
    disc, entry = _expanded(disc[some], begin[some], end[some])
    # Cells are wider than what a disc covers of them.
    beside = np.abs(grid.azimuth.take(entry) - azimuth.take(disc)) < (half_az + MARGIN_RAD).take(disc)
    kept = np.flatnonzero(beside)
    disc, entry = disc[kept], entry[kept]
    kept = np.flatnonzero(np.abs(grid.elevation.take(entry) - elevation.take(disc)) < (half_el + MARGIN_RAD).take(disc))
    disc, ray = disc[kept], grid.ray[entry[kept]]
    # Column by column: sums over three axes by einsum take three times as long.
    slope, along, plane, away2 = np.zeros((4, len(ray)), np.float32)
    for axis in range(3):
        d, n = rays.direction[:, axis].take(ray), normal[:, axis].take(disc)
        offset = center[:, axis].take(disc) - rays.origin[:, axis].take(ray)
        slope += n * d
        along += offset * d
        plane += n * offset
        away2 += offset * offset
    rough = np.asarray(~normal.any(axis=1))[disc]
    with np.errstate(divide="ignore", invalid="ignore"):
        t = np.where(rough, along, plane / slope)
    # From the middle of the disc to where the ray meets its plane.
    off2 = t * (t - 2 * along) + away2
    weight = 1 - off2 / radius[disc] ** 2
    met = (weight > 0) & (t > MIN_RANGE_M) & (rough | (np.abs(slope) > MIN_FACING))
    facing = np.where(rough, np.float32(1), np.abs(slope))
    return Meetings(ray[met], (disc[met] + first).astype(np.int32), t[met], facing[met], weight[met])


def _expanded(
    index: NDArray[np.int64], begin: NDArray[np.int64], end: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Repeat each index for every number from its begin up to its end, and return those numbers."""
    count = end - begin
    total = np.cumsum(count)
    which = np.repeat(np.arange(len(index)), count)
    return index[which], np.arange(len(which)) - (total - count - begin)[which]


@dataclass(frozen=True, eq=False)
class Hits:
    """What each of N rays ends on.

    Attributes
    ----------
    range_m : (N,) float32
        Infinite where it meets nothing.
    facing : (N,) float32
        Cosine between ray and normal.
    surfel : (N,) int32
        The first disc; -1 without.
    intensity, returned : (N,) float32
        Of the discs there: their mean intensity, and how many of their rays come back.
    """

    range_m: Floats
    facing: Floats
    surfel: NDArray[np.int32]
    intensity: Floats
    returned: Floats


def first_hits(met: Meetings, surfels: Surfels, count: int, rng: np.random.Generator) -> Hits:
    """Let each of `count` rays end on the first disc that stops it; discs of one surface are averaged.

    One draw a ray decides on all discs that lie within a meter of range, as they are of one fence or one tree.
    """
    share = surfels.share[met.surfel]
    stops = share > 0.98
    open_ = np.flatnonzero(~stops)
    draws = rng.random((count, 8), dtype=np.float32)
    stops[open_] = draws[met.ray[open_], met.range_m[open_].astype(np.int32) % 8] < share[open_]
    ray, surfel, t = met.ray[stops], met.surfel[stops], met.range_m[stops]
    first = np.full(count, np.inf, np.float32)
    np.minimum.at(first, ray, t)
    depth = (t - first[ray]) * met.facing[stops]
    same = depth < THICKNESS_M
    which = np.full(count, -1, np.int32)
    at = depth == 0
    which[ray[at]] = surfel[at]
    ray, surfel, t = ray[same], surfel[same], t[same]
    facing, weight = met.facing[stops][same], met.weight[stops][same]
    total = np.bincount(ray, weight, count)

    def mean(values: Floats) -> Floats:
        with np.errstate(invalid="ignore"):
            return (np.bincount(ray, weight * values, count) / total).astype(np.float32)

    distance = mean(t)
    distance[which < 0] = np.inf
    strength = surfels.intensity[surfel]
    return Hits(distance, mean(facing), which, mean(np.nan_to_num(strength)), mean(surfels.returned[surfel]))
