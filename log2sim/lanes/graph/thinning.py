"""Lanes with as few points as keep their shape."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapLane
from log2sim.geometry import Array

TOLERANCE_M = 0.004
"""How far interpolation may be from a point that is left out: below the centimeter to which lanes are exact."""

MAX_STEP_M = 20.0
"""Longest chord, so that heights and widths are sampled too."""


def thin(lane: MapLane) -> MapLane:
    """Drop the points of a lane that linear interpolation restores, with their widths."""
    kept = _kept_rows(np.column_stack([lane.points_m, lane.width_m]))
    return replace(lane, points_m=lane.points_m[kept], width_m=lane.width_m[kept])


def _kept_rows(columns: Array) -> NDArray[np.intp]:
    """Return the rows to keep of x, y, z, width (N, 4), by repeated splitting (Ramer 1972, Douglas and Peucker 1973)."""
    kept, stack = {0, len(columns) - 1}, [(0, len(columns) - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(columns[a : b + 1, :2], axis=0).T))])
        share = (way / way[-1])[:, None]
        off = np.abs(columns[a : b + 1] - (columns[a] + share * (columns[b] - columns[a]))).max(axis=1)
        k = a + int(off.argmax())
        if off.max() <= TOLERANCE_M:
            if way[-1] <= MAX_STEP_M:
                continue
            k = a + int(np.searchsorted(way, way[-1] / 2))
        if k in (a, b):
            k = (a + b) // 2
        kept.add(k)
        stack += [(a, k), (k, b)]
    return np.array(sorted(kept))
