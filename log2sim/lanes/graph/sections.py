"""Sections: stretches of routes between junctions, side by side with others of the same road."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.graph.beside import Beside
from log2sim.lanes.graph.junction_areas import MIN_SECTION_M, Areas
from log2sim.lanes.graph.polyline import Polyline
from log2sim.lanes.graph.routes import Route

FREE, CUT = -1, -2
"""What a section ends at, if not at a junction: nothing that is known, or its own continuation beside other lanes."""

FIRST_M = 3.0
"""Of a path that begins or ends within a junction, this much is a section, from which its way through the junction leads on."""

MIN_LENGTH_M = 0.5
"""Shorter sections are what rounding leaves: a sample of a path."""

TAPER_M = 10.0
"""Over this length a lane comes to the width that it has beside others: 6 cm a meter at most."""


@dataclass(frozen=True)
class Section:
    """A stretch of a route.

    Attributes
    ----------
    route : int
    first_m, last_m : float
        Stations on the route.
    start, end : int
        The area there, `FREE` or `CUT`.
    """

    route: int
    first_m: float
    last_m: float
    start: int
    end: int


@dataclass(frozen=True, eq=False)
class Strip:
    """A section's ground.

    Attributes
    ----------
    section : Section
    line : Polyline
        Its center line.
    width_m : (N,) float64
        At the vertices.
    left, right : int or None
        Sections beside it, as indices, which have the same ends.
    """

    section: Section
    line: Polyline
    width_m: Array
    left: int | None = None
    right: int | None = None


def cut_sections(
    routes: Sequence[Route], areas: Areas, beside: Sequence[Beside], ends: set[tuple[int, bool]]
) -> list[Section]:
    """Return the sections between junctions, cut where a lane beside them begins or ends.

    `ends` names the routes, and whether it is the start, whose first or last station a path enters or leaves by another route.
    """
    cuts = _find_cuts(routes, areas, beside)
    found = []
    for k, route in enumerate(routes):
        length = route.line.length_m
        first, start = 0.0, FREE
        for low, high, area in areas.stretches.get(k, []):
            low, high = _with_ends(low, high, length, ((k, True) in ends, (k, False) in ends))
            if low - first > 1e-6:
                found += _pieces(k, (first, low), (start, area), cuts.get(k, []))
            first, start = high, area
        if length - first > 1e-6:
            found += _pieces(k, (first, length), (start, FREE), cuts.get(k, []))
    return found


def _with_ends(low: float, high: float, length: float, entered: tuple[bool, bool]) -> tuple[float, float]:
    """Leave a section before and after a stretch of a junction where the route itself begins or ends in it."""
    room = min(FIRST_M, (high - low) / 3)
    if low < room and not entered[0]:
        low = room
    if high > length - room and not entered[1]:
        high = length - room
    return low, high


def _pieces(k: int, span: tuple[float, float], ends: tuple[int, int], cuts: Iterable[float]) -> list[Section]:
    if span[1] - span[0] < MIN_LENGTH_M:
        return []
    inner = [c for c in sorted(cuts) if span[0] + MIN_SECTION_M < c < span[1] - MIN_SECTION_M]
    at = [span[0], *inner, span[1]]
    kinds = [ends[0], *([CUT] * len(inner)), ends[1]]
    return [Section(k, a, b, x, y) for a, b, x, y in zip(at, at[1:], kinds, kinds[1:])]


def _find_cuts(routes: Sequence[Route], areas: Areas, beside: Sequence[Beside]) -> dict[int, list[float]]:
    """Return stations of routes at which a lane beside them begins or ends, and those across from them."""
    cuts: dict[int, list[float]] = {k: [] for k in range(len(routes))}

    def add(route: int, s: float) -> bool:
        if any(abs(s - c) < MIN_SECTION_M for c in (*cuts[route], 0.0, routes[route].line.length_m)):
            return False
        if any(low - MIN_SECTION_M < s < high + MIN_SECTION_M for low, high, _ in areas.stretches.get(route, [])):
            return False
        cuts[route].append(s)
        return True

    for k, route in enumerate(routes):
        for s in route.marked_m or ():
            add(k, s)
    same = [pair for pair in beside if pair.same_way]
    for pair in same:
        for k in (0, -1):
            add(pair.route, float(pair.s_m[k]))
            add(pair.other, float(pair.other_s_m[k]))
    grown = True
    while grown:
        grown = False
        for pair in same:
            for s in list(cuts[pair.route]):
                if pair.s_m[0] <= s <= pair.s_m[-1]:
                    grown |= add(pair.other, float(np.interp(s, pair.s_m, pair.other_s_m)))
    return cuts


def lay_out(routes: Sequence[Route], sections: Sequence[Section], beside: Sequence[Beside]) -> list[Strip]:
    """Give sections their ground: those side by side share their edges, and begin and end at the same line across."""
    strips: list[Strip | None] = [None] * len(sections)
    halves = _end_halves(routes, sections, groups := _groups(sections, beside))
    for group in groups:
        for k, strip in zip(group, _lay_out_group(routes, sections, group, halves)):
            strips[k] = strip
    return [strip for strip in strips if strip is not None]


def _groups(sections: Sequence[Section], beside: Sequence[Beside]) -> list[list[int]]:
    """Return sections that lie side by side from end to end, each group from the left to the right."""
    by_route: dict[int, list[int]] = {}
    for k, section in enumerate(sections):
        by_route.setdefault(section.route, []).append(k)
    right_of: dict[int, int] = {}
    for pair in beside:
        if not pair.same_way or pair.aside_m[0] > 0:
            continue
        for k in by_route.get(pair.route, []):
            if _overlap(sections[k], pair) < 0.5 * (sections[k].last_m - sections[k].first_m):
                continue
            ends = np.interp([sections[k].first_m, sections[k].last_m], pair.s_m, pair.other_s_m)
            ends += np.array([min(sections[k].first_m - pair.s_m[0], 0.0), max(sections[k].last_m - pair.s_m[-1], 0.0)])
            for j in by_route.get(pair.other, []):
                off = np.abs(ends - [sections[j].first_m, sections[j].last_m])
                if off.max() <= 1.5 * MIN_SECTION_M and k not in right_of and j not in right_of.values():
                    right_of[k] = j
    starts = [k for k in range(len(sections)) if k not in right_of.values()]
    return [_chain(k, right_of) for k in starts]


def _chain(k: int, right_of: Mapping[int, int]) -> list[int]:
    chain = [k]
    while chain[-1] in right_of:
        chain.append(right_of[chain[-1]])
    return chain


def _overlap(section: Section, pair: Beside) -> float:
    return float(min(section.last_m, pair.s_m[-1]) - max(section.first_m, pair.s_m[0]))


def _offsets(
    routes: Sequence[Route], sections: Sequence[Section], group: Sequence[int]
) -> tuple[Polyline, Array, Array, Array]:
    """Return the base line of a group, and of its lanes (G, N): offsets from it, default half widths and heights."""
    base = min(group, key=lambda k: sections[k].route)
    section = sections[base]
    line = Polyline.through(routes[section.route].line.part(section.first_m, section.last_m))
    heading = line.heading_rad
    along, left = (
        np.column_stack([np.cos(heading), np.sin(heading)]),
        np.column_stack([-np.sin(heading), np.cos(heading)]),
    )
    offsets, halves, heights = [], [], []
    for k in group:
        other = routes[sections[k].route]
        if k == base:
            s, points = section.first_m + line.s_m, line.points_m
        else:
            s = other.line.project(line.points_m[:, :2], heading).s_m
            for _ in range(4):
                points = other.line.at(s)
                s = s - ((points - line.points_m)[:, :2] * along).sum(axis=1)
            points = other.line.at(s)
        offsets.append(((points - line.points_m)[:, :2] * left).sum(axis=1) if k != base else np.zeros(len(s)))
        halves.append(other.width_at(s) / 2)
        heights.append(points[:, 2])
    return line, np.array(offsets), np.array(halves), np.array(heights)


def _edges(offsets: Array, halves: Array) -> Array:
    """Return the edges (G + 1, N) of G lanes from the left to the right: neighbors meet in the middle."""
    outer_left, outer_right = offsets[:1] + halves[:1], offsets[-1:] - halves[-1:]
    inner = (offsets[:-1] - halves[:-1] + offsets[1:] + halves[1:]) / 2
    return np.concatenate([outer_left, inner, outer_right])


def _end_halves(
    routes: Sequence[Route], sections: Sequence[Section], groups: Sequence[Sequence[int]]
) -> dict[tuple[int, float, int], float]:
    """Return half widths at cuts, by route, station and side (1 left, -1 right), of the sections that have a neighbor there."""
    found: dict[tuple[int, float, int], float] = {}
    for group in groups:
        if len(group) == 1:
            continue
        _, offsets, halves, _ = _offsets(routes, sections, group)
        edges = _edges(offsets, halves)
        for row, k in enumerate(group):
            section = sections[k]
            for kind, s, at in ((section.start, section.first_m, 0), (section.end, section.last_m, -1)):
                if kind != CUT:
                    continue
                if row > 0:
                    found[section.route, s, 1] = float(edges[row, at] - offsets[row, at])
                if row < len(group) - 1:
                    found[section.route, s, -1] = float(offsets[row, at] - edges[row + 1, at])
    return found


def _lay_out_group(
    routes: Sequence[Route],
    sections: Sequence[Section],
    group: Sequence[int],
    halves_at: Mapping[tuple[int, float, int], float],
) -> list[Strip]:
    line, offsets, halves, heights = _offsets(routes, sections, group)
    edges = _edges(offsets, halves)
    for row, lane, side in ((0, 0, 1), (-1, len(group) - 1, -1)):
        section = sections[group[lane]]
        for kind, s, since in (
            (section.start, section.first_m, line.s_m),
            (section.end, section.last_m, line.length_m - line.s_m),
        ):
            wanted = halves_at.get((section.route, s, side))
            if kind == CUT and wanted is not None:
                taper = np.clip(1 - since / min(TAPER_M, line.length_m), 0.0, 1.0)
                eased = taper * taper * (3 - 2 * taper)
                edges[row] += side * eased * (wanted - halves[lane])
    out = []
    for row, k in enumerate(group):
        middle, width = (edges[row] + edges[row + 1]) / 2, edges[row] - edges[row + 1]
        points = line.offset(line.s_m, middle)
        points[:, 2] = heights[row]
        left = group[row - 1] if row > 0 else None
        right = group[row + 1] if row + 1 < len(group) else None
        out.append(Strip(sections[k], Polyline(points), width, left, right))
    return out
