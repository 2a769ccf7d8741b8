"""Clouds as bird's-eye-view grids: heights, counts by slice and mean offsets in every cell, the input of the network.

Only geometry is used, no intensity, so that a network carries over to sensors that it was not trained on. Height slices
follow AVOD (Ku et al., IROS 2018) and MSFP (Lin et al. 2021, section 3), logarithmic counts PIXOR's and MV3D's density.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CHANNELS = 12
MIN_HEIGHT_M, MAX_HEIGHT_M = -0.5, 4.5
# Slices end at a bumper, a hood, a waist, a car's roof or a person's shoulders, a person's head, and above all but trucks.
SLICE_EDGES_M = (MIN_HEIGHT_M, 0.3, 0.7, 1.2, 1.8, 2.5, MAX_HEIGHT_M)
# The network halves the grid four times.
SIZE_MULTIPLE = 16
MIN_SIZE_CELLS = 64


def grid_window(
    xy: NDArray[np.float32], *, cell_m: float, range_m: float, center: Array
) -> tuple[Array, tuple[int, int]]:
    """Choose the part of the plane that a grid covers: the bounding box of the points in range.

    Parameters
    ----------
    xy : (N, 2) float32, m
    cell_m : float
    range_m : float
        Largest magnitude of x and y relative to `center`, m.
    center : (2,) float64, m
        Position of the sensor.

    Returns
    -------
    low : (2,) float64, m
        Lower corner, a multiple of the cell from `center` less the range.
    shape : (int, int)
        Cells along x and y, multiples of `SIZE_MULTIPLE`.
    """
    limit = int(np.ceil(2 * range_m / (cell_m * SIZE_MULTIPLE))) * SIZE_MULTIPLE
    corner = np.asarray(center, np.float64) - limit * cell_m / 2
    low, high = np.zeros(2), np.zeros(2)
    for axis in range(2):
        # Rows in range along both axes would need another pass; along one each, the window is at most larger.
        values = xy[:, axis]
        values = values[(values >= corner[axis]) & (values < corner[axis] + limit * cell_m)]
        if not len(values):
            return corner, (min(MIN_SIZE_CELLS, limit), min(MIN_SIZE_CELLS, limit))
        low[axis], high[axis] = values.min(), values.max()
    first, last = (np.clip(np.floor((v - corner) / cell_m), 0, limit - 1) for v in (low, high))
    needed = last - first + 1
    count = np.maximum(np.ceil(needed / SIZE_MULTIPLE) * SIZE_MULTIPLE, min(MIN_SIZE_CELLS, limit))
    # Even, so that the cells of the maps, twice as large, lie alike in every window.
    start = np.clip(first - (count - needed) // 2, 0, limit - count) // 2 * 2
    return corner + start * cell_m, (int(count[0]), int(count[1]))


def rasterize(xyz: NDArray[np.float32], *, cell_m: float, low: Array, shape: tuple[int, int]) -> NDArray[np.float32]:
    """Make the grid of a cloud.

    Parameters
    ----------
    xyz : (N, 3) float32, m
        Points whose z is the height above the ground; points outside the grid, of other heights or not finite are left out.
    cell_m : float
    low : (2,) float64, m
        Lower corner of the grid.
    shape : (int, int)
        Cells H along x and W along y.

    Returns
    -------
    (12, H, W) float32
        Greatest, mean and least height, each half; logarithm of the count; logarithms of the counts in six slices of
        height; mean offsets from the middle of the cell along x and y, in cells. All zero in an empty cell.
    """
    h, w = shape
    scale, (x0, y0) = np.float32(1 / cell_m), np.asarray(low, np.float32)
    x, y, z = (xyz[:, 0] - x0) * scale, (xyz[:, 1] - y0) * scale, xyz[:, 2]
    inside = np.flatnonzero(
        (x >= 0) & (x < h) & (y >= 0) & (y < w) & (z > np.float32(MIN_HEIGHT_M)) & (z < np.float32(MAX_HEIGHT_M))
    )
    out = np.zeros((CHANNELS, h * w), np.float32)
    if len(inside) == 0:
        return out.reshape(CHANNELS, h, w)
    x, y, z = x.take(inside), y.take(inside), z.take(inside)
    i, j = x.astype(np.intp), y.astype(np.intp)
    cell = i * w + j
    count = np.bincount(cell, minlength=h * w)
    used = np.flatnonzero(count)
    # One column for each cell with points, which are a tenth of all.
    number = np.empty(h * w, np.intp)
    number[used] = np.arange(len(used))
    column, points = number.take(cell), count.take(used).astype(np.float32)
    values = np.empty((CHANNELS, len(used)), np.float32)
    values[0].fill(-np.inf)
    values[2].fill(np.inf)
    np.maximum.at(values[0], column, z)
    np.minimum.at(values[2], column, z)
    for channel, of_points in ((1, z), (10, x - i.astype(np.float32)), (11, y - j.astype(np.float32))):
        values[channel] = np.bincount(column, of_points, minlength=len(used)) / points
    values[:3] /= 2
    values[3] = np.log1p(points) / 3
    values[10:12] -= np.float32(0.5)
    for edge in np.array(SLICE_EDGES_M[1:-1], np.float32):
        column += (z > edge) * len(used)
    values[4:10] = np.log1p(np.bincount(column, minlength=6 * len(used)).astype(np.float32)).reshape(6, -1) / 2
    for channel in range(CHANNELS):
        out[channel, used] = values[channel]
    return out.reshape(CHANNELS, h, w)
