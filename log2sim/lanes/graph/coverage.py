"""Which parts of paths no lane holds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MapLane
from log2sim.geometry import Array
from log2sim.lanes.graph.driven_paths import MIN_PATH_M, DrivenPath
from log2sim.lanes.graph.matching import MAX_TURN_RAD
from log2sim.lanes.graph.polyline import Polyline
from log2sim.lanes.graph.routes import BESIDE_M, CLEARANCE_M, LANE_M, MAX_LANE_M

OVERLAP_M = 10.0
"""A lane of its own overlaps the lanes that a path leaves by as much; two stretches nearer than twice of it become one."""

BEYOND_M = 0.3
"""So far beyond the end of a lane a vehicle is still on it: less than half a step between two samples of its path."""


def find_covered(lanes: Sequence[MapLane], line: Polyline, aside_m: float | None = None) -> NDArray[np.bool_]:
    """Return whether each vertex (N,) of a path is within the width of some lane, or `aside_m` of its middle, along it."""
    xy, heading = line.points_m[:, :2], line.heading_rad
    covered = np.zeros(len(xy), dtype=bool)
    low, high = line.bounds_m
    for lane in lanes:
        reach = max(float(lane.width_m.max()) / 2, aside_m or 0.0)
        if np.any(lane.points_m[:, :2].min(axis=0) - reach > high) or np.any(
            lane.points_m[:, :2].max(axis=0) + reach < low
        ):
            continue
        middle = Polyline.through(lane.points_m)
        at = middle.project(xy, heading)
        way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane.points_m[:, :2], axis=0).T))])
        half = np.maximum(np.interp(at.s_m, way, lane.width_m) / 2, aside_m or 0.0)
        along = (at.s_m >= -BEYOND_M) & (at.s_m <= middle.length_m + BEYOND_M)
        covered |= along & (np.abs(at.aside_m) <= half) & (np.abs(at.turn_rad) <= MAX_TURN_RAD)
    return covered


def find_uncovered(lanes: Sequence[MapLane], path: DrivenPath) -> Iterator[tuple[Array, float]]:
    """Yield points (N, 3) and a width for each stretch of a path outside all lanes, `OVERLAP_M` longer on either side."""
    s = path.line.s_m
    off = np.flatnonzero(~find_covered(lanes, path.line, BESIDE_M if path.rank == 2 else None))
    if not len(off):
        return
    width = min(max(LANE_M, path.width_m + CLEARANCE_M), MAX_LANE_M)
    for run in np.split(off, np.flatnonzero(np.diff(s[off]) > 2 * OVERLAP_M) + 1):
        rows = np.flatnonzero((s >= s[run[0]] - OVERLAP_M) & (s <= s[run[-1]] + OVERLAP_M))
        if len(rows) >= 2 and s[rows[-1]] - s[rows[0]] >= MIN_PATH_M:
            yield path.line.points_m[rows], width
