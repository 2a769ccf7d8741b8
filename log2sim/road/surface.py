"""The height of the ground on a raster from points of sweeps, and their intensity relative to the road."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Log, Sweep
from log2sim.files.arrays import Columns
from log2sim.geometry import Array
from log2sim.perception.lidar.cloud import MAX_OBSTACLE_HEIGHT_M, cloud_origin, estimate_ground, sweep_to_map
from log2sim.road.ground_map import Raster
from log2sim.road.road_users import Boxes, covered

# With 29 bytes each, 350 MB.
MAX_POINTS = 12_000_000
# Farther away rings are meters apart and points hit the road at less than 3 degrees.
REACH_M = 45.0
# Curbs and banks are within this of the smooth ground of a single sweep; so are tires, which lower points of other sweeps replace.
NEAR_GROUND_M = 0.4
# What is higher hides the ground behind it.
MIN_HIDING_HEIGHT_M = 0.3
# Points that fill what is below the lowest beam are this far apart.
FILL_STEP_M = 0.1
# Directions around a LiDAR, of each of which the lowest return is taken: neighboring points are at most half a degree apart.
DIRECTIONS = 720
# Points above the ground that are kept of a sweep: about one a degree in both directions.
MAX_HIDING_POINTS = 20_000
# Beams of LiDARs are at least 0.1 degrees apart; in between, the ego's pitch moves points of one beam from bin to bin.
ELEVATION_BIN_RAD = np.radians(0.2)
ELEVATION_BINS = 900


@dataclass(frozen=True, eq=False)
class GroundPoints(Columns):
    """Points near the ground, N of all sweeps."""

    xy: NDArray[np.float32]  # (N, 2), m: from the north-west corner of the raster: east, south
    z: NDArray[np.float32]  # (N,), m: from the height of reference
    range_m: NDArray[np.float32]  # (N,): from the sensor
    intensity: NDArray[np.float32]  # (N,): NaN where unknown
    # (N,) int16: number of the elevation from the sensor, from straight down in steps of `ELEVATION_BIN_RAD`
    beam: NDArray[np.int16]
    lidar: NDArray[np.int8]  # (N,) int8: number of the LiDAR

    @classmethod
    def join(cls, parts: Sequence[Self]) -> Self:
        """Concatenate those of several sweeps; none give none."""
        if not parts:
            xy, none = np.zeros((0, 2), np.float32), np.zeros(0, np.float32)
            return cls(xy, none, none, none, np.zeros(0, np.int16), np.zeros(0, np.int8))
        return super().join(parts)


def take_sweep(
    log: Log, lidar: str, sweep: Sweep, raster: Raster, users: Sequence[Boxes], *, most: int, z0_m: float, hides: bool
) -> tuple[GroundPoints, Array] | None:
    """Find the points of a sweep near the ground on a raster, but for those under road users, and what stands above it.

    `most`: points that are kept near the ground. `z0_m`: height of reference, m, map frame. `hides`: whether what stands is asked for.

    Returns what is near the ground and points (H, 3), m, map frame, of what hides it; None where no pose is known.
    """
    mapped = sweep_to_map(log, lidar, sweep, compensate=True)
    if mapped is None or not len(mapped[0]):
        return None
    xyz, t_s = mapped
    middle_ns = sweep.stamp_ns + round(float(t_s.mean(dtype=np.float64)) * 1e9)
    map_T_lidar, known = log.map_T_sensor(lidar, middle_ns)
    sensor = map_T_lidar[0, :3, 3] if known[0] else np.asarray(xyz.mean(axis=0))
    origin = np.array([sensor[0], sensor[1], cloud_origin(log, sweep.stamp_ns)[1]])
    local = (xyz - origin).astype(np.float32)
    ground = estimate_ground(local, np.zeros(2), 0.0)
    within = np.flatnonzero(np.hypot(local[:, 0], local[:, 1]) < REACH_M)
    local = local[within]
    height = local[:, 2] - ground.at(local[:, :2])
    hiding: Array = np.zeros((0, 3))
    if hides:
        standing = (height > MIN_HIDING_HEIGHT_M) & (height < MAX_OBSTACLE_HEIGHT_M)
        above = within[standing]
        above = above[:: max(len(above) // MAX_HIDING_POINTS, 1)]
        # Nothing was measured below the lowest return of a direction: the side of a vehicle next to the sensor hides the ground as
        # well, which points every `FILL_STEP_M` down to it stand for.
        away = xyz[within] - sensor
        level = np.hypot(away[:, 0], away[:, 1])
        slope = np.divide(away[:, 2], level, out=np.full(len(away), np.inf), where=level > 0)
        turn = np.arctan2(away[:, 1], away[:, 0]) / (2 * np.pi) + 0.5
        direction = np.minimum((turn * DIRECTIONS).astype(np.int64), DIRECTIONS - 1)
        least = np.full(DIRECTIONS, np.inf)
        np.minimum.at(least, direction, slope)
        standing &= (slope <= least[direction]) & np.isfinite(slope)
        count = np.ceil(height[standing] / FILL_STEP_M).astype(np.int64)
        below = np.repeat(xyz[within[standing]], count, axis=0)
        below[:, 2] -= FILL_STEP_M * (np.arange(len(below)) - np.repeat(np.cumsum(count) - count, count) + 1)
        hiding = np.concatenate([xyz[above], below])
    near = within[np.abs(height) < NEAR_GROUND_M]
    near = near[:: -(-len(near) // most)] if len(near) > most else near
    cell, inside = raster.index_of(xyz[near, :2])
    near, cell = near[inside], cell[inside]
    near = near[~covered(users, raster, cell)]
    away = (xyz[near] - sensor) @ (map_T_lidar[0, :3, :3] if known[0] else np.eye(3))
    range_m = np.linalg.norm(away, axis=1)
    usable = range_m > 0
    beam = (np.arcsin(np.clip(away[usable, 2] / range_m[usable], -1, 1)) + np.pi / 2) / ELEVATION_BIN_RAD
    near, x0, y1 = near[usable], raster.extent_m[0], raster.extent_m[3]
    points = GroundPoints(
        np.stack([xyz[near, 0] - x0, y1 - xyz[near, 1]], axis=1).astype(np.float32),
        (xyz[near, 2] - z0_m).astype(np.float32),
        range_m[usable].astype(np.float32),
        np.full(len(near), np.nan, np.float32) if sweep.intensity is None else sweep.intensity[near],
        np.minimum(beam, ELEVATION_BINS - 1).astype(np.int16),
        np.full(len(near), list(log.lidars).index(lidar), np.int8),
    )
    return points, hiding


ROUNDS = 5
# Noise of LiDAR ranges is 2 to 3 cm: points this far above the surface of their cell lie on something else ...
ABOVE_M = 0.05
# ... and this far below it are reflections, or the street beside the edge of a curb within the cell.
BELOW_M = 0.12
# Points at this range weigh half: their height errs with the pitch of the ego, 0.1 degrees or 3 cm there.
HALF_WEIGHT_RANGE_M = 15.0
# Points of a cell count as one of this many at most, so that a standing ego does not outweigh the neighbors.
FULL_WEIGHT = 4.0
# Ground this far from any point is not known but filled.
MAX_FILLED_M = 1.0
# What the path of the ego says of the ground beside it is smoothed over this long.
PATH_CELL_M, PATH_SMOOTHING_CELLS = 2.0, 1.5
# Ahead of the path its grade goes on, as it was over this long, for as far as cameras see the ground finely.
GRADE_BASE_M, EXTENSION_M = 5.0, 30
# Rings of a LiDAR are up to about a meter apart where pictures are still fine.
WARP_SMOOTHING_M = 0.6
UNKNOWN_WEIGHT = np.float32(0.05)


@dataclass(frozen=True, eq=False)
class Surface:
    """Heights of the ground."""

    raster: Raster
    z_m: NDArray[np.float32]  # (R, C): above the height of reference, everywhere
    known: NDArray[np.bool_]  # (R, C): where points are near

    def smoothed(self) -> Surface:
        """Return the surface that pictures are laid on: cells of half the resolution, smoothed over `WARP_SMOOTHING_M`.

        At a distance of ten times its height a camera moves what it shows by ten times an error of the height: the noise of
        single rings would bend straight lines.
        """
        coarse = self.raster.coarser(2)
        rows, columns = coarse.shape
        padding = ((0, 2 * rows - self.z_m.shape[0]), (0, 2 * columns - self.z_m.shape[1]))
        z, known = (np.pad(a, padding, mode="edge").astype(np.float32) for a in (self.z_m, self.known))
        trust = np.maximum(known, UNKNOWN_WEIGHT)
        weight, heavy = (cv2.resize(a, (columns, rows), interpolation=cv2.INTER_AREA) for a in (trust, trust * z))
        spread = WARP_SMOOTHING_M / coarse.resolution_m
        total, sums = (cv2.GaussianBlur(a, (0, 0), spread, borderType=cv2.BORDER_REPLICATE) for a in (weight, heavy))
        return Surface(coarse, np.asarray(sums / total, np.float32), np.asarray(weight > 0.5))


def estimate_surface(points: GroundPoints, raster: Raster, path: Array, z0_m: float) -> Surface:
    """Estimate the ground of a raster.

    `path`: (K, 3), m: places on the ground, map frame, which say how high it is where there are no points. `z0_m`:
    height of reference, m.
    """
    base = _base_of(path, raster, z0_m)
    cell, count = cells_of_points(points, raster), raster.shape[0] * raster.shape[1]
    z = points.z - base.ravel()[cell]
    near = (1 / (1 + (points.range_m / HALF_WEIGHT_RANGE_M) ** 2)).astype(np.float32)
    # Means of the lowest heights that agree, from the mean of a cell down: in each round points too far above the last mean are
    # left out, so that it sinks through grass and tires until it rests on points that are all within the noise.
    heavy, weights = (near * z).astype(np.float64), near.astype(np.float64)
    kept: NDArray[Any] = np.ones(len(z), dtype=bool)
    for k in range(ROUNDS + 1):
        # A weight of 0 takes less time than a copy of the rows that are left.
        weight, total = (np.bincount(cell, a * kept, count).astype(np.float64, copy=False) for a in (weights, heavy))
        mean = np.divide(total, weight, out=np.zeros(count), where=weight > 0)
        wide = 2.0 ** max(ROUNDS - 2 - k, 0)
        off = z - mean.astype(np.float32).take(cell)
        kept = (off < wide * ABOVE_M) & (off > -wide * BELOW_M)
    raw_weight, raw_middle = (a.reshape(raster.shape).astype(np.float32) for a in (weight, mean))
    # Smoothed by a Gaussian of one cell with their weights.
    raw_weight = np.minimum(raw_weight, FULL_WEIGHT)
    soft, sums = (cv2.GaussianBlur(a, (5, 5), 1.0) for a in (raw_weight, raw_weight * raw_middle))
    middle = np.divide(sums, soft, out=np.zeros_like(sums), where=soft > 0)
    measured = soft > 0.05
    filled = fill(np.where(measured, middle, 0), measured.astype(np.float32))
    distance = cv2.distanceTransform((~measured).astype(np.uint8), cv2.DIST_L2, 3)
    return Surface(raster, base + filled, distance * raster.resolution_m <= MAX_FILLED_M)


def cells_of_points(points: GroundPoints, raster: Raster) -> NDArray[np.int64]:
    """Return the number of the cell (N,) of points; the raster has the north-west corner of that of the points."""
    column, row = (
        (points.xy[:, k] / np.float32(raster.resolution_m)).astype(np.int32).clip(0, raster.shape[1 - k] - 1)
        for k in range(2)
    )
    cell = np.multiply(row, raster.shape[1], dtype=np.int64)
    cell += column
    return np.asarray(cell, dtype=np.int64)


def fill(values: NDArray[np.float32], weight: NDArray[np.float32]) -> NDArray[np.float32]:
    """Fill cells (R, C) without weight from those around them, smoothly; zeros where nothing has any.

    Pull and push over a pyramid, Gortler et al., The Lumigraph (1996), section 3.4.2.
    """
    if min(values.shape) < 2:
        known = weight > 0
        mean = float(values[known].mean()) if known.any() else 0.0
        return np.where(known, values, np.float32(mean)).astype(np.float32)
    half = (-(-values.shape[1] // 2), -(-values.shape[0] // 2))
    low_weight = cv2.resize(weight, half, interpolation=cv2.INTER_AREA)
    low_sum = cv2.resize(weight * values, half, interpolation=cv2.INTER_AREA)
    low = np.divide(low_sum, low_weight, out=np.zeros_like(low_sum), where=low_weight > 0)
    below = fill(low, np.minimum(4 * low_weight, 1))
    around = cv2.resize(below, values.shape[::-1], interpolation=cv2.INTER_LINEAR)
    own = np.minimum(weight, 1)
    return np.asarray(own * values + (1 - own) * around, dtype=np.float32)


def _base_of(path: Array, raster: Raster, z0_m: float) -> NDArray[np.float32]:
    """Height (R, C) of the nearest places of a path, smoothed, above the height of reference; 0 without a path."""
    if not len(path):
        return np.zeros(raster.shape, dtype=np.float32)
    coarse = raster.coarser(max(round(PATH_CELL_M / raster.resolution_m), 1))
    rows, columns = np.mgrid[: coarse.shape[0], : coarse.shape[1]]
    # Straight on at both ends, with the grade of the last meters.
    parts = [path]
    for end, inner in ((path[0], path), (path[-1], path[::-1])):
        far = np.hypot(*(inner[:, :2] - end[:2]).T) >= GRADE_BASE_M
        if far.any():
            step = (end - inner[int(np.argmax(far))]) / GRADE_BASE_M
            parts.append(end + np.arange(1, EXTENSION_M + 1)[:, None] * step)
    path = np.concatenate(parts)
    _, nearest = cKDTree(path[:, :2]).query(coarse.xy_of(rows, columns).reshape(-1, 2))
    z = (path[nearest, 2] - z0_m).reshape(coarse.shape).astype(np.float32)
    z = cv2.GaussianBlur(z, (0, 0), PATH_SMOOTHING_CELLS, borderType=cv2.BORDER_REPLICATE)
    return upsample(z, round(coarse.resolution_m / raster.resolution_m), raster.shape)


def upsample(values: NDArray[np.float32], factor: int, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Interpolate a coarse raster (r, c) or (r, c, K) bilinearly onto one with `factor` cells for each of its cells, along both axes."""
    rows, columns = (min(-(-n // factor), k) for n, k in zip(shape, values.shape))
    fine = cv2.resize(values[:rows, :columns], (columns * factor, rows * factor), interpolation=cv2.INTER_LINEAR)
    return np.asarray(fine[: shape[0], : shape[1]], dtype=np.float32)


# The usual return of the road is this much of the full scale: paint, of three to ten times its reflectivity, is not clipped at once.
USUAL = 0.2
# Reflectors return a hundred times as much as the road; more than this says nothing about paint, but would smear.
MAX_RELATIVE = 1.5 / USUAL
# Points higher above the surface than noise and slopes between cells lie on something else.
ON_SURFACE_M = 0.1
LEVELS = 512
# Fewer points of a beam do not tell what is usual for it.
MIN_POINTS = 50
# A LiDAR spot grows by 1 to 3 mm a meter: at this range it is as long as a cell of 5 cm.
SHARP_RANGE_M = 20.0
# Points count in cells this near to theirs, in cells: first those nearly in it, then those within the gaps between rings.
SPREADS = (0.8, 2.5)
MIN_WEIGHT = 0.02


def map_intensity(
    points: GroundPoints, surface: Surface, raster: Raster, road: NDArray[np.bool_]
) -> NDArray[np.float32]:
    """Map relative intensities of points onto a raster: (R, C) in [0, 1], NaN where there are none.

    `surface`: points off it are left out. `road`: (r, c) bool: cells of the surface's raster that are road surely,
    because the ego drove there.
    """
    cell = cells_of_points(points, surface.raster)
    kept = np.isfinite(points.intensity) & (np.abs(points.z - surface.z_m.ravel()[cell]) < ON_SURFACE_M)
    relative = normalize(points, kept, kept & road.ravel()[cell])
    kept &= np.isfinite(relative)
    fine = cells_of_points(points, raster)[kept]
    weight = 1 / (1 + (points.range_m[kept] / SHARP_RANGE_M) ** 2)
    count = raster.shape[0] * raster.shape[1]
    total = np.bincount(fine, weight, count).astype(np.float32).reshape(raster.shape)
    sums = np.bincount(fine, weight * relative[kept], count).astype(np.float32).reshape(raster.shape)
    out = np.full(raster.shape, np.nan, np.float32)
    for spread in SPREADS:
        near, near_sums = (cv2.GaussianBlur(a, (0, 0), spread) for a in (total, sums))
        free = np.isnan(out) & (near > MIN_WEIGHT / spread**2)
        out[free] = near_sums[free] / near[free]
    return np.asarray(np.minimum(out * np.float32(USUAL), 1))


def normalize(points: GroundPoints, ground: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Divide intensities by what is usual for their LiDAR and beam: (N,) relative ones, NaN where that is not known.

    On the ground a beam has one range and one angle of incidence, so that one number for each elevation takes out range,
    incidence and the gain of the beam's detector at once. Usual is the mean of the middle half of the intensities: of points
    on the ego's way (`road`), or of the ground all around where these are too few.
    """
    out = np.full(len(points.z), np.nan, np.float32)
    for lidar in np.flatnonzero(np.bincount(points.lidar[ground])):
        own = points.lidar == lidar
        rows = np.flatnonzero(own & ground)
        top = float(np.percentile(points.intensity[rows], 99.5))
        if top <= 0:
            continue
        usual = _usual(points, np.flatnonzero(own & road), top)
        around = _usual(points, rows, top)
        usual = np.where(np.isfinite(usual), usual, around)
        with np.errstate(divide="ignore", invalid="ignore"):
            out[rows] = points.intensity[rows] / usual[points.beam[rows]]
    return np.where(np.isfinite(out), np.minimum(out, np.float32(MAX_RELATIVE)), np.nan).astype(np.float32)


def _usual(points: GroundPoints, rows: NDArray[np.intp], top: float) -> NDArray[np.float32]:
    """Mean of the middle half of the intensities by beam (ELEVATION_BINS,); NaN with too few points, or where they are 0."""
    level = np.clip(points.intensity[rows] / top * LEVELS, 0, LEVELS - 1).astype(np.int64)
    index = points.beam[rows].astype(np.int64) * LEVELS + level
    shape = (ELEVATION_BINS, LEVELS)
    count = np.bincount(index, minlength=ELEVATION_BINS * LEVELS).reshape(shape).astype(np.float64)
    sums = np.bincount(index, points.intensity[rows], ELEVATION_BINS * LEVELS).reshape(shape)
    total = count.sum(axis=1, keepdims=True)
    upto = np.cumsum(count, axis=1)
    middle = np.clip(np.minimum(upto, 0.75 * total) - np.maximum(upto - count, 0.25 * total), 0, None)
    mean: Array = np.divide(sums, count, out=np.zeros(shape), where=count > 0)
    usual = np.divide((middle * mean).sum(axis=1), middle.sum(axis=1), out=np.zeros(len(total)), where=total[:, 0] > 0)
    return np.where((total[:, 0] >= MIN_POINTS) & (usual > 0), usual, np.nan).astype(np.float32)
