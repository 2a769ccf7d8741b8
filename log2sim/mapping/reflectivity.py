"""LiDAR intensity on a raster, relative to what the road usually returns to each beam, so that paint stands out."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.mapping.ground_points import ELEVATION_BINS, GroundPoints
from log2sim.mapping.raster import Raster
from log2sim.mapping.surface import Surface, cells_of_points

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

    Parameters
    ----------
    points : GroundPoints
    surface : Surface
        Points off it are left out.
    raster : Raster
    road : (r, c) bool
        Cells of the surface's raster that are road surely, because the ego drove there.
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
    return np.asarray(np.minimum(out * np.float32(USUAL), 1), dtype=np.float32)


def normalize(points: GroundPoints, ground: NDArray[np.bool_], road: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Divide intensities by what is usual for their LiDAR and beam: (N,) relative ones, NaN where that is not known.

    Notes
    -----
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
