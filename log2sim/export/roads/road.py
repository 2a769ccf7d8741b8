"""One road of OpenDRIVE out of lanes side by side, or out of a lane that connects two roads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from log2sim.datatypes import MapLane
from log2sim.export.roads.cubics import cubics_through, elevation_profile
from log2sim.export.roads.reference_line import ReferenceLine, fit
from log2sim.geometry import Array
from log2sim.lanes.graph.polyline import Polyline

EXTENSION_M = 10.0
"""Roads go on straight for so long where nothing is known of what is before or after them, so that whole vehicles are on them."""

STEP_M = 2.0
"""Stations at which widths are taken."""


@dataclass(frozen=True, eq=False)
class End:
    """The start or the end of a lane as a road has it: x, y, z, heading (4,) of the road's cross section, and the lane's width."""

    pose: Array
    width_m: float


@dataclass(frozen=True, eq=False)
class Link:
    """What is before or after a road.

    Attributes
    ----------
    kind : str
        "road" or "junction".
    number : int
        Its id.
    lanes : mapping of int to int
        Lane ids of this road and those of the other, empty for a junction.
    point : int
        Start (0) or end (-1) of the other road.
    """

    kind: str
    number: int
    lanes: Mapping[int, int] = field(default_factory=dict)
    point: int = 0


@dataclass(frozen=True, eq=False)
class Road:
    """A road whose reference line is the middle of one of the lanes that lead along it.

    Attributes
    ----------
    number : int
        Its id.
    lanes : tuple of MapLane
        Along the line, from the left to the right: lane -1, -2, ...
    line : ReferenceLine
    elevation, offset : (K, 5) float64
        Stations and coefficients a, b, c, d of cubics: the height, and how far the left edge of lane -1 is left of the line.
    widths, opposite_widths : tuple of (K, 5) float64
        Of the lanes, along the line.
    opposite : tuple of MapLane
        Against the line, from the right to the left: lane 1, 2, ...
    junction : int or None
    before, after : Link or None
    """

    number: int
    lanes: tuple[MapLane, ...]
    line: ReferenceLine
    elevation: Array
    offset: Array
    widths: tuple[Array, ...]
    opposite: tuple[MapLane, ...] = ()
    opposite_widths: tuple[Array, ...] = ()
    junction: int | None = None
    before: Link | None = None
    after: Link | None = None


def road_of_lanes(
    number: int,
    group: Sequence[MapLane],
    opposite: Sequence[MapLane],
    headings: tuple[float | None, float | None],
    free: tuple[bool, bool],
) -> tuple[Road, dict[tuple[str, int], End]]:
    """Return a road of lanes side by side, some of which may lead the opposite way, and the ends of its lanes in their own direction."""
    across = [*map(turned, opposite[::-1]), *group]
    base = surest(group)
    shared = [cross_heading(across, at) if h is None else h for at, h in zip((0, -1), headings)]
    poses = [None if f else np.array([*p[:2], h]) for f, p, h in zip(free, base.points_m[[0, -1]], shared)]
    line, stations = fit(base.points_m[:, :2], poses[0], poses[1])
    s = _width_stations(line)
    edges = _edges(across, base, line.at(s))
    ends = {}
    for at in (0, -1):
        x, y, z = base.points_m[at]
        heading = shared[at] if not free[at] else float(line.at(np.array([0.0, line.length_m]))[at, 2])
        for row, lane in enumerate(across):
            middle, width = edges[row : row + 2, at].mean(), edges[row, at] - edges[row + 1, at]
            own, turn = (-1 - at, np.pi) if row < len(opposite) else (at, 0.0)
            pose = np.array([x - middle * np.sin(heading), y + middle * np.cos(heading), z, heading + turn])
            ends[lane.id, own] = End(pose, float(width))
    before, after = (EXTENSION_M if f else 0.0 for f in free)
    line = line.extended(before, after)
    stations = stations + before
    at_m = s + before
    widths = tuple(cubics_through(at_m, edges[row] - edges[row + 1]) for row in range(len(across)))
    elevation = elevation_profile(stations, base.points_m[:, 2], line.length_m)
    middle = len(opposite)
    return Road(
        number, tuple(group), line, elevation, cubics_through(at_m, edges[middle]), widths[middle:], tuple(opposite),
        widths[:middle][::-1],
    ), ends  # fmt: skip


def turned(lane: MapLane) -> MapLane:
    """Return a lane from its end to its start."""
    return replace(lane, points_m=lane.points_m[::-1], width_m=lane.width_m[::-1])


def connecting_road(number: int, lane: MapLane, start: End, end: End) -> Road:
    """Return a road of one lane that begins and ends as the roads that it connects."""
    points = lane.points_m.copy()
    line, stations = fit(points[:, :2], start.pose[[0, 1, 3]], end.pose[[0, 1, 3]])
    points[[0, -1], 2] = start.pose[2], end.pose[2]
    width = cubics_through(np.array([0.0, line.length_m]), np.array([start.width_m, end.width_m]))
    elevation = elevation_profile(stations, points[:, 2], line.length_m)
    return Road(number, (lane,), line, elevation, width * [1.0, 0.5, 0.5, 0.5, 0.5], (width,))


def cross_heading(group: Sequence[MapLane], at: int) -> float:
    """Return the heading of lanes at their start (0) or end (-1): square to the line across several of them."""
    if len(group) > 1:
        across = group[0].points_m[at] - group[-1].points_m[at]
        return float(np.arctan2(across[1], across[0]) - np.pi / 2)
    return float(Polyline(group[0].points_m).heading_rad[at])


def surest(group: Sequence[MapLane]) -> MapLane:
    """Return the lane whose middle is the reference line of a road."""
    return max(group, key=lambda lane: (lane.confidence, -len(lane.id), lane.id))


def _width_stations(line: ReferenceLine) -> Array:
    return np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / STEP_M)), 1) + 1)


def _edges(group: Sequence[MapLane], base: MapLane, reference: Array) -> Array:
    """Return how far left of points (N, 3) x, y, heading of a line the edges (G + 1, N) of G lanes are; neighbors share theirs.

    The middle of the lane `base` is the line itself.
    """
    share = np.linspace(0.0, 1.0, len(reference))
    heading = reference[:, 2]
    middles, widths = [], []
    for lane in group:
        line = Polyline(lane.points_m)
        feet = _across(reference, line, share * line.length_m)
        gap = line.at(feet)[:, :2] - reference[:, :2]
        middle = gap[:, 1] * np.cos(heading) - gap[:, 0] * np.sin(heading)
        middles.append(np.zeros(len(share)) if lane is base else middle)
        widths.append(np.interp(feet, line.s_m, lane.width_m))
    m, h = np.array(middles), np.array(widths) / 2
    return np.concatenate([m[:1] + h[:1], (m[:-1] - h[:-1] + m[1:] + h[1:]) / 2, m[-1:] - h[-1:]])


def _across(reference: Array, line: Polyline, s: Array) -> Array:
    """Return the stations (N,) of a line straight across from points (N, 3) x, y, heading, starting from a guess."""
    along = np.column_stack([np.cos(reference[:, 2]), np.sin(reference[:, 2])])
    for _ in range(8):
        gap = line.at(s)[:, :2] - reference[:, :2]
        s = np.clip(s - (gap * along).sum(axis=1), 0.0, line.length_m)
    return np.asarray(s)
