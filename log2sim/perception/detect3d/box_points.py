"""The points inside boxes: which, how many, and at what time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

CELL_M = 1.0
# Cells are numbered in 16 bits, which numpy sorts by radix.
MAX_CELLS = 250
# Cells are found in single precision, which must not lose a point on a face.
MARGIN_M = 0.01


@dataclass(frozen=True, eq=False)
class PointsOfBoxes:
    """Pairs of a box and a point in it, ordered by box; K pairs."""

    box: NDArray[np.intp]  # (K,): index of the box
    point: NDArray[np.intp]  # (K,): index of the point
    boxes: int  # number of boxes M

    def take(self, index: NDArray[np.intp]) -> PointsOfBoxes:
        """Take the pairs of the boxes at `index` (K,), which are numbered anew in that order."""
        counts = self.count
        starts = np.cumsum(counts) - counts
        pairs = np.repeat(starts[index], counts[index]) + ramp(counts[index])
        return PointsOfBoxes(np.repeat(np.arange(len(index)), counts[index]), self.point[pairs], len(index))

    def sample(self, most: int) -> PointsOfBoxes:
        """Take at most `most` pairs of each box, evenly spaced in their order."""
        counts = self.count
        step = -(-counts // most)
        chosen = np.flatnonzero(ramp(counts) % np.maximum(step, 1).take(self.box) == 0)
        return PointsOfBoxes(self.box.take(chosen), self.point.take(chosen), self.boxes)

    @cached_property
    def count(self) -> NDArray[np.int64]:
        """Number of points in each box (M,)."""
        return np.bincount(self.box, minlength=self.boxes).astype(np.int64)

    def mean(self, values: NDArray[np.floating[Any]]) -> Array:
        """Average values of the points (N,) over each box (M,); 0 for a box without points."""
        total = np.bincount(self.box, weights=values.take(self.point), minlength=self.boxes)
        count = self.count
        return np.divide(total, count, out=np.zeros(self.boxes), where=count > 0)


def points_of_boxes(
    xyz: NDArray[np.floating[Any]],
    center_m: Array,
    size_m: Array,
    yaw_rad: Array,
    usable: NDArray[np.bool_] | None = None,
) -> PointsOfBoxes:
    """Find the points in each of many upright boxes.

    `xyz`: (N, 3), m: points that are not finite are in no box. `center_m`, `size_m`: (M, 3), m: length, width, height.
    `yaw_rad`: (M,). `usable`: (N,): the points that count; by default all.

    Points in cells of `CELL_M` that a box touches are sorted by cell; every box is compared with those of its own cells.
    A point within rounding, 1e-5 m at 100 m, of a face may be on either side of it.
    """
    none = np.zeros(0, np.intp)
    if not len(center_m) or not len(xyz):
        return PointsOfBoxes(none, none, len(center_m))
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    half = np.asarray(size_m, np.float64) / 2
    reach = bounding_reach(size_m, yaw_rad) + MARGIN_M
    low, high = center_m[:, :2] - reach, center_m[:, :2] + reach
    # Cells over all boxes; those of the last row and column are for points outside.
    corner, kind = low.min(axis=0), xyz.dtype.type
    extent = high.max(axis=0) - corner
    cell_m = np.maximum(CELL_M, extent / MAX_CELLS)
    shape = np.ceil(extent / cell_m).astype(np.intp) + 1
    with np.errstate(invalid="ignore"):
        at = [((xyz[:, axis] - kind(corner[axis])) * kind(1 / cell_m[axis])).astype(np.int32) for axis in range(2)]
    # Of what is below the corner or NaN, the sign makes a large number: outside, too.
    row, column = (np.minimum(v.view(np.uint32), np.uint32(n - 1)).astype(np.uint16) for v, n in zip(at, shape))
    code = row * np.uint16(shape[1]) + column
    # One run of cells for each box and each of its rows.
    first, last = (np.clip((v - corner) // cell_m, 0, shape - 2).astype(np.intp) for v in (low, high))
    rows = last[:, 0] - first[:, 0] + 1
    box = np.repeat(np.arange(len(low)), rows)
    start = (first[box, 0] + ramp(rows)) * shape[1]
    begin, end, count = start + first[box, 1], start + last[box, 1] + 1, int(shape.prod())
    touched = np.cumsum(np.bincount(begin, minlength=count) - np.bincount(end, minlength=count)) > 0
    counted = touched.take(code)
    near = np.flatnonzero(counted if usable is None else counted & usable)
    code = code.take(near)
    order = near.take(np.argsort(code, kind="stable"))
    edges = np.concatenate([[0], np.cumsum(np.bincount(code, minlength=count))])
    start, length = edges[begin], edges[end] - edges[begin]
    box, place = np.repeat(box, length), np.repeat(start, length) + ramp(length)
    # Column by column, in the points' own precision and the order of their cells: this is where the time goes.
    columns = [xyz[:, axis].take(order) for axis in range(3)]
    center, (long, wide, high) = center_m.T.astype(xyz.dtype), half.T.astype(xyz.dtype)
    c, s = (v.astype(xyz.dtype).take(box) for v in (c, s))
    x, y, z = (columns[axis].take(place) - center[axis].take(box) for axis in range(3))
    inside = np.flatnonzero(
        (np.abs(x * c + y * s) <= long.take(box))
        & (np.abs(y * c - x * s) <= wide.take(box))
        & (np.abs(z) <= high.take(box))
    )
    return PointsOfBoxes(box.take(inside), order.take(place.take(inside)), len(center_m))


def most_points(counts: NDArray[np.float32], low: Array, cell_m: float, center_m: Array, reach_m: Array) -> Array:
    """Add up counts in cells (H, W) within bounding rectangles (M,): at least as many as there are points in each.

    `low`: (2,), m: lower corner of the cells. `center_m`, `reach_m`: (M, 2), m: centers and half sides of the rectangles.

    By a table of sums (Crow, SIGGRAPH 1984), in time that does not depend on the sizes of the rectangles.
    """
    import cv2

    table = cv2.integral(counts, sdepth=cv2.CV_64F)
    limit = np.array(counts.shape)
    first = np.clip(np.floor((center_m - reach_m - low) / cell_m), 0, limit).astype(np.intp)
    last = np.clip(np.ceil((center_m + reach_m - low) / cell_m), 0, limit).astype(np.intp)
    (i0, j0), (i1, j1) = first.T, last.T
    return np.asarray(table[i1, j1] - table[i0, j1] - table[i1, j0] + table[i0, j0])


def bounding_reach(size_m: Array, yaw_rad: Array) -> Array:
    """Compute half the sides (M, 2), m, of the bounding rectangles along x and y of boxes, size (M, 2 or more)."""
    c, s = np.abs(np.cos(yaw_rad)), np.abs(np.sin(yaw_rad))
    half = np.asarray(size_m, np.float64) / 2
    return np.stack([c * half[:, 0] + s * half[:, 1], s * half[:, 0] + c * half[:, 1]], axis=1)


def ramp(counts: NDArray[np.intp]) -> NDArray[np.intp]:
    """Count 0, 1, ... anew for each of `counts`: [2, 3] gives [0, 1, 0, 1, 2]."""
    ends = np.cumsum(counts)
    return np.arange(ends[-1] if len(ends) else 0) - np.repeat(ends - counts, counts)
