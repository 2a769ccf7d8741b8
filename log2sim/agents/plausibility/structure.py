"""Walls and fences: points of an agent that are part of something much longer are no evidence for it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import Timeline
from log2sim.agents.plausibility.box_table import BoxTable
from log2sim.agents.plausibility.free_space import MAX_LAG_S
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, Agent, Obstacles
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.box_fitting import rotate

# Points up to this far outside a box may be its own: error of a box.
MARGIN_M = 0.3
# Thickness to either side of what counts as one surface. Walls are flatter; what else the points of a vehicle show, its
# second side, its roof and its windows, recedes by more.
SURFACE_M = 0.2
# Shares of the points in a box that are nearly all, and most, of them.
MIN_SURFACE_SHARE, MIN_MOST_SHARE = 0.85, 0.5
# Surfaces are followed along cells of this length over at most so many empty ones: 0.5 m is less than the distance of parked
# vehicles with their two rounded corners.
CELL_M, MAX_EMPTY_CELLS = 0.25, 2
# A surface that is longer than the longest vehicle of its category by this is no side of one.
EXCESS_M = 0.5
# Fewer points, or points in fewer cells (1 m of a side), show no surface.
MIN_POINTS, MIN_CELLS = 12, 4
# Points below may be curbs.
BOTTOM_M = 0.3
# The points in each cell of a surface that are nearest to the sensor, without the strays.
FRONT_QUANTILE = 0.8
# Ticks that are searched for each agent, evenly spread over its life: standing structure looks much the same at all of them.
SEARCHED_TICKS = 3


@dataclass(frozen=True, eq=False)
class Surface:
    """The surface that the points in a box are on.

    Attributes
    ----------
    share : float
        Of the points in the box that are on it.
    length_m : float
        Of the surface, without a gap, in the box and beyond.
    """

    share: float
    length_m: float


def structure_shares(
    agents: Sequence[Agent], clouds: Sequence[Obstacles | None], timeline: Timeline
) -> tuple[Array, Array]:
    """Return shares (A,), (A,) of the searched ticks at which nearly all and most points of a vehicle are on a longer surface.

    A few ticks, evenly spread over the life of an agent, are searched: standing structure shows the same at all of them.
    """
    shares = np.zeros((2, len(agents)))
    stamp_of = {k: cloud.stamp_ns for k, cloud in enumerate(clouds) if cloud is not None}
    ticks = np.array(list(stamp_of), dtype=np.intp)
    rows = [i for i, agent in enumerate(agents) if GROUP_OF[agent.category] == "vehicle"]
    if len(ticks) == 0 or not rows:
        return shares[0], shares[1]
    stamps = np.array(list(stamp_of.values()), dtype=np.int64)
    boxes = BoxTable.of([agents[i] for i in rows], (stamps - timeline.t0_ns) / NS_PER_S, margin_s=MAX_LAG_S)
    for row, i in enumerate(rows):
        alive = np.flatnonzero(boxes.present[row])
        searched = alive[np.unique(np.linspace(0, len(alive) - 1, min(len(alive), SEARCHED_TICKS)).astype(np.intp))]
        longest_m = MAX_SIZE_M[agents[i].category][0] + EXCESS_M
        found = [_surface_at(boxes, row, int(k), clouds[ticks[k]], longest_m) for k in searched]
        longer = [s.share for s in found if s is not None and s.length_m > longest_m]
        for k, least in enumerate((MIN_SURFACE_SHARE, MIN_MOST_SHARE)):
            shares[k, i] = sum(share >= least for share in longer) / max(len(searched), 1)
    return shares[0], shares[1]


def _surface_at(boxes: BoxTable, row: int, column: int, cloud: Obstacles | None, reach_m: float) -> Surface | None:
    """Follow the surface of one agent in one cloud up to `reach_m` from its center."""
    if cloud is None:
        return None
    center, size, yaw = boxes.center_m[row, column] - cloud.origin, boxes.size_m[row], float(boxes.yaw_rad[row, column])
    near = cloud.near(boxes.center_m[row, column, :2], reach_m)
    near = near[cloud.xyz[near, 2] > center[2] - size[2] / 2 + BOTTOM_M]
    local = rotate(cloud.xyz[near, :2].astype(np.float64) - center[:2], -yaw)
    sensor = rotate(cloud.sensor_of(near)[:2].astype(np.float64) - center[:2], -yaw)
    return find_surface(local, size[:2], sensor)


def find_surface(local: Array, size_m: Array, sensor: Array) -> Surface | None:
    """Find the surface that most points in a box are on, along its length or its width.

    Parameters
    ----------
    local : (N, 2) float64, m
        Points in and around the box, in its axes, relative to its center.
    size_m : (2,) float64
        Length and width.
    sensor : (2,) float64, m
        Likewise.

    Returns
    -------
    Surface or None
        None with too few points in the box.
    """
    inside: NDArray[np.bool_] = np.all(np.abs(local) <= size_m / 2 + MARGIN_M, axis=1)
    if inside.sum() < MIN_POINTS:
        return None
    found = [
        _along(local[:, axis], local[:, 1 - axis] * (1 if sensor[1 - axis] >= 0 else -1), inside) for axis in (0, 1)
    ]
    return max((s for s in found if s is not None), key=lambda s: s.share, default=None)


def _along(u: Array, v: Array, inside: NDArray[np.bool_]) -> Surface | None:
    """Follow the surface of the points `inside` along u; v grows toward the sensor."""
    cell = np.floor(u / CELL_M).astype(np.int64)
    order = np.flatnonzero(inside)[np.lexsort((v[inside], cell[inside]))]
    cells, first, count = np.unique(cell[order], return_index=True, return_counts=True)
    if len(cells) < MIN_CELLS:
        return None
    front = v[order[first + (FRONT_QUANTILE * (count - 1)).astype(np.intp)]]
    at = (cells + 0.5) * CELL_M
    i, j = np.triu_indices(len(at), 1)
    slope = np.median((front[j] - front[i]) / (at[j] - at[i]))  # Theil (1950)
    on = np.abs(v - slope * u - np.median(front - slope * at)) <= SURFACE_M
    own = np.sort(cell[on & inside])
    if len(own) < MIN_POINTS:
        return None
    occupied = np.unique(cell[on])
    gap = np.flatnonzero(np.diff(occupied) > MAX_EMPTY_CELLS + 1)
    middle = int(np.searchsorted(occupied, own[len(own) // 2]))
    start = int(gap[gap < middle].max(initial=-1)) + 1
    end = int(gap[gap >= middle].min(initial=len(occupied) - 1))
    return Surface(float(on[inside].mean()), float((occupied[end] - occupied[start] + 1) * CELL_M))
