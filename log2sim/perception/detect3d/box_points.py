"""The points inside boxes: which, how many, and at what time."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CELL_M = 2.0
# Cells are numbered in 16 bits, which numpy sorts by radix: the index covers 510 m along each axis.
MAX_CELLS = 255
# Cells are found in single precision, which must not lose a point on a face.
MARGIN_M = 0.01


@dataclass(frozen=True, eq=False)
class PointsOfBoxes:
    """Pairs of a box and a point in it, ordered by box; K pairs.

    Attributes
    ----------
    box : (K,) int
        Index of the box.
    point : (K,) int
        Index of the point.
    boxes : int
        Number of boxes M.
    """

    box: NDArray[np.intp]
    point: NDArray[np.intp]
    boxes: int

    @property
    def count(self) -> NDArray[np.int64]:
        """Number of points in each box (M,)."""
        return np.bincount(self.box, minlength=self.boxes).astype(np.int64)

    def mean(self, values: NDArray[np.floating[Any]]) -> Array:
        """Average values of the points (N,) over each box (M,); 0 for a box without points."""
        total = np.bincount(self.box, weights=values[self.point], minlength=self.boxes)
        count = self.count
        return np.divide(total, count, out=np.zeros(self.boxes), where=count > 0)


def points_of_boxes(xyz: NDArray[np.floating[Any]], center_m: Array, size_m: Array, yaw_rad: Array) -> PointsOfBoxes:
    """Find the points in each of many upright boxes.

    Parameters
    ----------
    xyz : (N, 3) float, m
        Points that are not finite are in no box.
    center_m, size_m : (M, 3) float64, m
        Length, width, height.
    yaw_rad : (M,) float64

    Notes
    -----
    Points are sorted into cells of `CELL_M` once; every box is compared with those of its own cells. For 100 boxes this
    takes a hundredth of comparing each with all points.
    """
    none = np.zeros(0, np.intp)
    if not len(center_m) or not len(xyz):
        return PointsOfBoxes(none, none, len(center_m))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    half = np.asarray(size_m, np.float64) / 2
    reach = np.stack(
        [np.abs(c) * half[:, 0] + np.abs(s) * half[:, 1], np.abs(s) * half[:, 0] + np.abs(c) * half[:, 1]], 1
    )
    reach += MARGIN_M
    low, high = center_m[:, :2] - reach, center_m[:, :2] + reach
    corner = low.min(axis=0)
    cell = np.maximum(CELL_M, (high.max(axis=0) - corner) / MAX_CELLS)
    box, candidate = candidates(xyz, corner, cell, low, high)
    d = xyz[candidate].astype(np.float64) - center_m[box]
    along = np.abs(d[:, 0] * c[box] + d[:, 1] * s[box])
    across = np.abs(d[:, 1] * c[box] - d[:, 0] * s[box])
    inside = (along <= half[box, 0]) & (across <= half[box, 1]) & (np.abs(d[:, 2]) <= half[box, 2])
    return PointsOfBoxes(box[inside], candidate[inside], len(center_m))


def candidates(
    xyz: NDArray[np.floating[Any]], corner: Array, cell: Array, low: Array, high: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pair each box with the points in the cells that its bounding rectangle `low` to `high`, (M, 2) each, touches.

    Parameters
    ----------
    corner, cell : (2,) float64, m
        Lower corner of all rectangles, and sides of a cell.

    Returns
    -------
    box, point : (K,) int
        Indices, ordered by box.
    """
    first, last = (np.clip((v - corner) // cell, 0, MAX_CELLS).astype(np.intp) for v in (low, high))
    place = [(xyz[:, axis] - xyz.dtype.type(corner[axis])) / xyz.dtype.type(cell[axis]) for axis in range(2)]
    top = last.max(axis=0)
    near = np.flatnonzero(
        (place[0] >= 0) & (place[0] < top[0] + 1) & (place[1] >= 0) & (place[1] < top[1] + 1) & np.isfinite(xyz[:, 2])
    )
    code = place[0][near].astype(np.uint16) * np.uint16(MAX_CELLS + 1) + place[1][near].astype(np.uint16)
    order = near[np.argsort(code, kind="stable")]
    edges = np.concatenate([[0], np.cumsum(np.bincount(code, minlength=(MAX_CELLS + 1) ** 2))])
    # One run of cells for each box and each of its rows.
    rows = last[:, 0] - first[:, 0] + 1
    box = np.repeat(np.arange(len(low)), rows)
    row = first[box, 0] + ramp(rows)
    start = edges[row * (MAX_CELLS + 1) + first[box, 1]]
    length = edges[row * (MAX_CELLS + 1) + last[box, 1] + 1] - start
    return np.repeat(box, length), order[np.repeat(start, length) + ramp(length)]


def ramp(counts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Count 0, 1, ... anew for each of `counts`: [2, 3] gives [0, 1, 0, 1, 2]."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
