"""Walls and fences: the points of an agent that are a part of something much longer are no evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import Timeline
from log2sim.datatypes import CATEGORY, Agent, Obstacles
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.box_fitting import rotate

# Points up to this far outside a box may be its own: error of a box.
MARGIN_M = 0.3
# Thickness to either side of what counts as one surface; walls are flatter, the sides of cars recede by more at their ends.
SURFACE_M = 0.2
# Surfaces are followed along cells of this length over gaps of at most this many of them. Between the sides of parked
# vehicles there is a gap of their distance and of two rounded corners.
CELL_M, MAX_EMPTY_CELLS = 0.25, 2
# A surface is followed so far from the middle of a box.
REACH_M = 15.0
# Share of the points in a box that are on its surface.
MIN_SURFACE_SHARE = 0.6
MIN_POINTS, MIN_CELLS = 12, 4
# A surface that is longer than the longest of the category by this is none of its sides.
EXCESS_M = 0.5
BOTTOM_M = 0.3


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that the points in a box are on.

    Attributes
    ----------
    share : float
        Of the points in the box that are on it.
    length_m : float
        Without a gap, within and beyond the box.
    beyond_m : (2,) float64
        Of it beyond either end of the box.
    """

    share: float
    length_m: float
    beyond_m: Array


def surface_of(agent: Agent, cloud: Obstacles, t_s: float) -> Surface | None:
    """Follow the surface that the points of an agent at a time are on; None with few points."""
    state = agent.at(t_s, margin_s=0.1)
    if not state.valid[0]:
        return None
    xy = np.array([state.x_m[0], state.y_m[0]])
    bottom = state.z_m[0] - agent.size_m[2] / 2
    x, y = (xy - cloud.origin[:2]).astype(np.float32)
    reach = REACH_M
    near = np.flatnonzero(np.abs(cloud.xyz[:, 0] - x) <= reach)
    near = near[np.abs(cloud.xyz[near, 1] - y) <= reach]
    z = cloud.xyz[near, 2] + (cloud.origin[2] - bottom)
    near = near[z > BOTTOM_M]
    yaw = float(state.yaw_rad[0])
    local = rotate((cloud.xyz[near, :2] - np.array([x, y])).astype(np.float64), -yaw)
    sensor = rotate(cloud.sensor[:2].astype(np.float64) + cloud.origin[:2] - xy, -yaw)
    half = np.array(agent.size_m[:2]) / 2
    inside = (np.abs(local) <= half + MARGIN_M).all(axis=1)
    if inside.sum() < MIN_POINTS:
        return None
    found = [_along(local, inside, half, sensor, axis) for axis in (0, 1)]
    found = [f for f in found if f is not None]
    return max(found, key=lambda f: f.share) if found else None


def _along(local: Array, inside: NDArray[np.bool_], half: Array, sensor: Array, axis: int) -> Surface | None:
    side = 1.0 if sensor[1 - axis] >= 0 else -1.0
    u, v = local[:, axis], local[:, 1 - axis] * side
    cell = np.floor(u / CELL_M).astype(np.int64)
    cells = np.unique(cell[inside])
    if len(cells) < MIN_CELLS:
        return None
    front = np.array([np.quantile(v[inside & (cell == k)], 0.8) for k in cells])
    at = (cells + 0.5) * CELL_M
    i, j = np.triu_indices(len(at), 1)
    slope = float(np.median((front[j] - front[i]) / (at[j] - at[i])))
    offset = float(np.median(front - slope * at))
    on = np.abs(v - slope * u - offset) <= SURFACE_M
    own = np.sort(cell[on & inside])
    if len(own) < MIN_POINTS:
        return None
    share = float(on[inside].mean())
    occupied = np.unique(cell[on])
    start = int(np.searchsorted(occupied, own[len(own) // 2]))
    gaps = np.diff(occupied) > MAX_EMPTY_CELLS + 1
    before, after = np.flatnonzero(gaps[:start]), np.flatnonzero(gaps[start:])
    low = occupied[before[-1] + 1] if len(before) else occupied[0]
    high = occupied[start + after[0]] if len(after) else occupied[-1]
    ends = np.array([low, high + 1]) * CELL_M
    beyond = np.maximum(np.array([-half[axis] - ends[0], ends[1] - half[axis]]), 0.0)
    return Surface(share, float(ends[1] - ends[0]), beyond)
