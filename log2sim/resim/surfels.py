"""Surfaces as discs: found around the points of each sweep, then joined over sweeps, as fine as they were seen.

Surfels of points: Pfister et al., SIGGRAPH 2000; of LiDAR sweeps: Behley & Stachniss, RSS 2018.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.files.arrays import Columns, DiskBackedMap
from log2sim.geometry import Array
from log2sim.resim.rays import Floats, Pattern, Shots, angles_of

NEIGHBORS = 16
BLOCK = 2048  # points at a time: what is known of their neighbors stays in the cache
SURFACE_SCALE_M = 0.03  # noise of a LiDAR; what lies farther off a plane counts less for it
MAX_RADIUS_M = 1.0
# Of what is flat: its roughness against how wide its points lie across, and as such; and that width, twice the usual noise.
FLAT_RATIO, FLAT_M, MIN_WIDTH_M = 0.4, 0.08, 0.02
# Of a cell that is flat: share of its points with a plane, and length of their mean normal.
FLAT_SHARE, MIN_COHERENCE = 0.35, 0.8
# Cells of the finest level; each is twice as large as the one before.
CELL_M, LEVELS = 0.06, 6
# Squares of the plane that hold whole cells of every level: for the cells, few of which lie at a border, and for the discs.
GRID_TILE_M, TILE_M = CELL_M * 2**10, CELL_M * 2**8
TILES_BYTES = 256 << 20  # of surfels in memory, 40 bytes each: more than a LiDAR sees from one place
Tile = tuple[int, int]
RADIUS_PER_CELL = 0.8  # discs of neighboring cells overlap, so that no ray passes between them


@dataclass(frozen=True, eq=False)
class Material(Columns):
    """What becomes of rays that meet discs; columns as of `Surfels`."""

    intensity: Floats
    share: Floats
    returned: Floats


@dataclass(frozen=True, eq=False)
class Surfels(Columns):
    """Discs, S of them."""

    center_m: Floats  # (S, 3) in the frame of what they belong to; of the map less its shift
    normal: (
        Floats  # (S, 3) toward where they were seen from; 0 for what faces every ray as it has no plane, such as leaves
    )
    radius_m: Floats  # (S,)
    intensity: Floats  # (S,) mean; NaN where unknown
    share: Floats  # (S,) of the rays that meet the disc, how many end there: less than 1 for leaves, fences and edges
    returned: Floats  # (S,) of the rays that end there, how many come back

    @property
    def material(self) -> Material:
        """Return what becomes of rays."""
        return Material(self.intensity, self.share, self.returned)


def joined(parts: Iterable[Surfels]) -> Surfels:
    """Concatenate surfels of one frame."""
    return Surfels.join(list(parts) or [no_surfels()])


def no_surfels() -> Surfels:
    """Return none."""
    return Surfels(*(np.zeros((0, 3) if k < 2 else 0, np.float32) for k in range(6)))


@dataclass(frozen=True, eq=False)
class LocalSurface:
    """What the surface is like around each of the points of a sweep, in the sensor's frame."""

    normal: Floats  # (N, 3): toward the sensor; 0 where there is no plane
    radius_m: Floats  # (N,): half the distance to the next rays on that surface
    noise_m: float  # of ranges on flat surfaces that face the sensor; NaN without such


def local_surface(shots: Shots, pattern: Pattern) -> LocalSurface:
    """Fit planes to the rays around each ray by iteratively reweighted least squares."""
    view = shots.direction.astype(np.float64)
    azimuth, elevation = angles_of(view @ pattern.level_R_sensor.T)
    lines = pattern.elevation_rad
    if len(lines):
        row = np.interp(elevation, lines, np.arange(len(lines)))
        gap = np.gradient(lines)[np.rint(row).astype(np.intp)]
    else:
        row, gap = elevation / pattern.gap_rad, np.full(len(elevation), pattern.gap_rad)
    # More firings than lines: they are closer to each other, and their noise is the same.
    plane = np.column_stack([azimuth / (3 * pattern.step_rad), row])
    # A tree that is not balanced is built in half the time, and as fast to ask where points lie as evenly as these.
    tree = cKDTree(plane, balanced_tree=False, compact_nodes=False)
    count = min(NEIGHBORS, len(plane))
    near = tree.query(plane, k=count)[1].reshape(len(plane), count)
    normal, rough, narrow, away = _planes((view * shots.range_m[:, None]).astype(np.float32), shots.range_m, near)
    flat = (rough < FLAT_RATIO * narrow) & (rough < FLAT_M) & (narrow > MIN_WIDTH_M) & (away < FLAT_M)
    facing = -np.einsum("ni,ni->n", normal, view)
    normal *= np.where(facing < 0, -1.0, 1.0)[:, None]
    facing = np.abs(facing)
    flat &= facing > 0.01
    # A step of the ray along azimuth or elevation, and where it leads on the plane.
    level = np.column_stack([-np.sin(azimuth), np.cos(azimuth), np.zeros(len(azimuth))]) @ pattern.level_R_sensor
    upward = np.cross(view, level)
    with np.errstate(divide="ignore", invalid="ignore"):
        slant = [np.hypot(1, np.einsum("ni,ni->n", normal, axis) / facing) for axis in (level, upward)]
    reach = np.maximum(pattern.step_rad * np.where(flat, slant[0], 1), gap * np.where(flat, slant[1], 1))
    normal[~flat] = 0
    noise = _noise_m(azimuth, row, shots.range_m, near, flat & (facing > 0.7)) if count > 2 else np.nan
    radius = np.minimum(0.6 * shots.range_m * reach, MAX_RADIUS_M)
    return LocalSurface(normal.astype(np.float32), radius.astype(np.float32), noise)


def _planes(points: Floats, range_m: Floats, near: NDArray[np.intp]) -> tuple[Array, Array, Array, Array]:
    """Return normals (N, 3) of planes through the neighbors (N, K) of points, how rough and wide these are, and how far off each point is, m."""
    normal, sizes = np.zeros((len(points), 3)), np.zeros((3, len(points)))
    columns = np.ascontiguousarray(points.T)
    for begin in range(0, len(points), BLOCK):
        part = slice(begin, begin + BLOCK)
        rows = np.ascontiguousarray(near[part].T)
        offset = [column.take(rows) - column[part] for column in columns]
        weight = 1 / (1 + ((range_m.take(rows) - range_m[part]) / np.float32(0.5)) ** 2)
        for _ in range(3):
            weight /= weight.sum(axis=0)
            mean = [(weight * column).sum(axis=0) for column in offset]
            x, y, z = (column - middle for column, middle in zip(offset, mean))
            wx, wy, wz = weight * x, weight * y, weight * z
            pairs = (wx, x), (wx, y), (wx, z), (wy, y), (wy, z), (wz, z)
            values, axis = smallest_axis(*((a * b).sum(axis=0, dtype=np.float64) for a, b in pairs))
            nx, ny, nz = axis.astype(np.float32)
            off = x * nx + y * ny + z * nz
            weight = 1 / (1 + (off / np.float32(SURFACE_SCALE_M)) ** 2) ** 2
        normal[part] = axis.T
        sizes[:2, part] = np.sqrt(np.maximum(values[:2], 0))
        sizes[2, part] = np.abs((axis * mean).sum(axis=0))
    return normal, *sizes


def _noise_m(azimuth: Array, row: Array, range_m: Floats, near: NDArray[np.intp], flat: NDArray[np.bool_]) -> float:
    """Return the noise of ranges: how far those on flat surfaces are off the line through their neighbors on the same line of the LiDAR, NaN without such.

    Planes through several lines of a LiDAR would count as noise what is always the same, the offsets of its lasers.
    """
    own = np.flatnonzero(flat)
    left, right = near[own, 1], near[own, 2]
    a, b = azimuth[left] - azimuth[own], azimuth[right] - azimuth[own]
    between = (a * b < 0) & (np.abs(row[left] - row[own]) < 0.2) & (np.abs(row[right] - row[own]) < 0.2)
    if between.sum() < 30:
        return np.nan
    own, left, right, share = own[between], left[between], right[between], (a / (a - b))[between]
    off = range_m[own] - (1 - share) * range_m[left] - share * range_m[right]
    # Of a normal distribution half lies within 0.6745 standard deviations.
    return float(np.median(np.abs(off) / np.sqrt(1 + share**2 + (1 - share) ** 2)) / 0.6745)


def smallest_axis(xx: Array, xy: Array, xz: Array, yy: Array, yz: Array, zz: Array) -> tuple[Array, Array]:
    """Return the eigenvalues (3, N), increasing, of symmetric matrices, whose entries (N,) are given, and the unit axes (3, N) of the first.

    By the angle of the characteristic cubic (Smith, 1961), and the largest row of the adjugate.
    """
    third = (xx + yy + zz) / 3
    x, y, z = xx - third, yy - third, zz - third
    size = np.sqrt(np.maximum((x * x + y * y + z * z) / 6 + (xy * xy + xz * xz + yz * yz) / 3, 1e-30))
    det = x * (y * z - yz * yz) - xy * (xy * z - yz * xz) + xz * (xy * yz - y * xz)
    angle = np.arccos(np.clip(det / (2 * size**3), -1, 1)) / 3
    low, high = third + 2 * size * np.cos(angle + 2 * np.pi / 3), third + 2 * size * np.cos(angle)
    x, y, z = xx - low, yy - low, zz - low
    # What is left is of rank two: every row of its adjugate lies along the axis, and the one with the largest diagonal is longest.
    a, b, c = y * z - yz * yz, x * z - xz * xz, x * y - xy * xy
    ab, ac, bc = yz * xz - xy * z, xy * yz - xz * y, xy * xz - x * yz
    first, second = (a >= b) & (a >= c), b >= c
    rows = ((a, ab, ac), (ab, b, bc), (ac, bc, c))
    axis = np.stack([np.where(first, one, np.where(second, two, three)) for one, two, three in rows])
    norm = np.sqrt((axis * axis).sum(axis=0))
    none = norm < 1e-20
    axis[:, none] = [[0], [0], [1]]
    return np.stack([low, 3 * third - low - high, high]), axis / np.where(none, 1, norm)


def by_tile(points: Array | Floats, side_m: float) -> Iterator[tuple[Tile, NDArray[np.intp]]]:
    """Return the rows of points (N, 3), m, in each tile of the plane."""
    tile = np.floor(points[:, :2] / side_m).astype(np.int64)
    number = (tile[:, 0] << 32) + tile[:, 1]
    order = np.argsort(number, kind="stable")
    number = number[order]
    for rows in np.split(order, np.flatnonzero(number[1:] != number[:-1]) + 1):
        if len(rows):
            yield (int(tile[rows[0], 0]), int(tile[rows[0], 1])), rows


class Tiles(DiskBackedMap[Tile, Surfels]):
    """Surfels of what stands, by tile; of a large world those near the sensor are in memory, and the others in a file."""

    def __init__(self, surfels: Surfels | None = None) -> None:
        super().__init__(lambda surfels: list(vars(surfels).values()), Surfels, TILES_BYTES)
        self.add(surfels or no_surfels())

    def __reduce__(self) -> tuple[Any, ...]:
        """Return a copy for other processes, which have no file yet."""
        return Tiles, (joined(self.values()),)

    def add(self, surfels: Surfels) -> None:
        """Add more."""
        for tile, rows in by_tile(surfels.center_m, TILE_M):
            self[tile] = joined([self.get(tile, no_surfels()), surfels.take(rows)])

    def near(self, x_m: float, y_m: float, reach_m: float) -> list[Tile]:
        """Return the tiles that have something within a reach, or may have."""
        tiles = np.array(list(self), np.int64).reshape(-1, 2)
        outside = np.abs(tiles + 0.5 - np.array([x_m, y_m]) / TILE_M) - 0.5
        near = np.hypot(*np.maximum(outside, 0).T) * TILE_M < reach_m
        return sorted((int(x), int(y)) for x, y in tiles[near])


class SurfelGrid:
    """Joins points of many sweeps cell by cell; its memory grows with the surfaces, not with the sweeps.

    The columns of a cell are sums: of points, center, normal, planes, radius, intensities, and how many of these there are.
    """

    PENDING_ROWS = 20_000

    def __init__(self, key: NDArray[np.int64] | None = None, sums: Array | None = None) -> None:
        self._key = np.zeros(0, np.int64) if key is None else key
        self._sums = np.zeros((0, 11)) if sums is None else sums
        self._pending: list[tuple[NDArray[np.int64], Array]] = []

    @property
    def nbytes(self) -> int:
        """Return the memory that it takes."""
        return sum(k.nbytes + s.nbytes for k, s in [(self._key, self._sums), *self._pending])

    def arrays(self) -> tuple[NDArray[np.int64], Array]:
        """Return what it can be made of again."""
        self._join()
        return self._key, self._sums

    def add(self, points: Array, normal: Floats, radius_m: Floats, intensity: Floats) -> None:
        """Add points (N, 3), m, that are less than 30 km from the origin."""
        level = np.clip(np.ceil(np.log2(radius_m / (RADIUS_PER_CELL * CELL_M))), 0, LEVELS - 1).astype(np.int64)
        known = np.isfinite(intensity)
        one, known_intensity = np.ones(len(points)), np.where(known, intensity, 0.0)
        sums = np.column_stack(
            [one, points, normal, normal.any(axis=1), radius_m, known_intensity, known.astype(float)]
        )
        self._pending.append(_summed(_keys(points, level), sums))
        # As many as there are cells: each is sorted a few times, and an agent seen for long takes no more than its surface.
        if sum(len(k) for k, _ in self._pending) > max(self.PENDING_ROWS, len(self._key)):
            self._join()

    def _join(self) -> None:
        if not self._pending:
            return
        parts = [(self._key, self._sums), *self._pending]
        self._key, self._sums = _summed(np.concatenate([k for k, _ in parts]), np.concatenate([s for _, s in parts]))
        self._pending = []

    def surfels(self) -> Surfels:
        """Return a disc for each cell, without coarse ones where there are finer ones."""
        self._join()
        level = self._key >> 60
        count = self._sums[:, 0]
        center = self._sums[:, 1:4] / count[:, None]
        sums, normal = self._sums, self._sums[:, 4:7].copy()
        length = np.linalg.norm(normal, axis=1)
        flat = (sums[:, 7] > FLAT_SHARE * count) & (length > MIN_COHERENCE * sums[:, 7])
        normal[flat] /= length[flat, None]
        normal[~flat] = 0
        _lend_planes(center, normal, flat, level)
        keep = np.ones(len(count), dtype=bool)
        for coarse in range(1, LEVELS):
            own, finer = np.flatnonzero(level == coarse), np.flatnonzero(level < coarse)
            if len(own) and len(finer):
                covered, cell = np.unique(_keys(center[finer], np.full(len(finer), coarse)), return_inverse=True)
                points = np.append(np.bincount(cell, count[finer]), 0)
                at = np.searchsorted(covered, self._key[own])
                found = np.append(covered, -1)[at] == self._key[own]
                keep[own] = ~found | (points[at] < count[own])
        sums, normal, center, count, level = sums[keep], normal[keep], center[keep], count[keep], level[keep]
        radius = np.maximum(sums[:, 8] / count, RADIUS_PER_CELL * CELL_M * 2.0**level)
        with np.errstate(divide="ignore", invalid="ignore"):
            intensity = sums[:, 9] / sums[:, 10]
        one = np.ones(len(count))
        columns = (center, normal, radius, intensity, one, one)
        return Surfels(*(c.astype(np.float32) for c in columns))


def _lend_planes(center: Array, normal: Array, flat: NDArray[np.bool_], level: NDArray[np.int64]) -> None:
    """Give cells without a plane that of a flat one near them on which they lie; `normal` is changed."""
    some, rough = np.flatnonzero(flat), np.flatnonzero(~flat)
    if not len(some) or not len(rough):
        return
    reach = 4 * CELL_M * 2.0 ** level[rough]
    distance, near = cKDTree(center[some]).query(center[rough], k=1, distance_upper_bound=float(reach.max()))
    found = distance < reach
    rough, near = rough[found], some[near[found]]
    off = np.abs(np.einsum("ni,ni->n", center[rough] - center[near], normal[near]))
    on = off < SURFACE_SCALE_M
    normal[rough[on]] = normal[near[on]]


def _keys(points: Array, level: NDArray[np.int64]) -> NDArray[np.int64]:
    cell = np.floor(points / (CELL_M * 2.0 ** level[:, None])).astype(np.int64) + (1 << 19)
    keys: NDArray[np.int64] = (level << 60) | (cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2]
    return keys


def _summed(key: NDArray[np.int64], sums: Array) -> tuple[NDArray[np.int64], Array]:
    if not len(key):
        return key, sums
    order = np.argsort(key, kind="stable")
    key = key[order]
    first = np.flatnonzero(np.append(True, key[1:] != key[:-1]))
    return key[first], np.add.reduceat(sums[order], first, axis=0)
