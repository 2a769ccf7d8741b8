"""Connections: the ways of vehicles from one section to the next."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.graph.conflicts import is_lane_change
from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import Match
from log2sim.lanes.graph.polyline import Polyline
from log2sim.lanes.graph.routes import Route
from log2sim.lanes.graph.sections import CUT, FREE, Strip

BLEND_M = 15.0
"""Over this length from its ends a connection comes from the lanes' middles to the path that was driven."""

MISSED_M = 3.0
"""A path that is first seen, or last, this far from the end of a section did not pass it."""

MIN_LENGTH_M = 1.0
"""Sections that are nearer meet."""


@dataclass(frozen=True, eq=False)
class Connection:
    """A way from the end of a section to the start of another.

    Attributes
    ----------
    origin, target : int
        Sections.
    line : Polyline
    width_m : (N,) float64
    area : int
        Where it is.
    agents : tuple of str
        Who drove it.
    """

    origin: int
    target: int
    line: Polyline
    width_m: Array
    area: int
    agents: tuple[str, ...]


def connect(
    routes: Sequence[Route], strips: Sequence[Strip], paths: Sequence[DrivenPath], matches: Sequence[Match]
) -> list[Connection]:
    """Return a connection for each pair of sections that some path leads from one to the other, through an area."""
    driven: dict[tuple[int, int], list[tuple[DrivenPath, Array]]] = {}
    for path, match in zip(paths, matches):
        for origin, target, span in _passages(routes, strips, path, match):
            points = _fitted(path.line.part(*span), strips[origin], strips[target])
            driven.setdefault((origin, target), []).append((path, points))
    out = []
    for (origin, target), ways in sorted(driven.items()):
        lead = min(path.rank == 2 for path, _ in ways)
        kept = [(path, points) for path, points in ways if (path.rank == 2) == lead]
        line = Polyline(_mean([points for _, points in kept]))
        ends = strips[origin].width_m[-1], strips[target].width_m[0]
        width = np.interp(line.s_m, [0.0, line.length_m], ends)
        names = tuple(dict.fromkeys(path.agent for path, _ in kept))
        out.append(Connection(origin, target, line, width, strips[origin].section.end, names))
    return out


def _passages(
    routes: Sequence[Route], strips: Sequence[Strip], path: DrivenPath, match: Match
) -> Iterator[tuple[int, int, tuple[float, float]]]:
    """Yield pairs of sections that a path passes in turn, and its stations at the end of one and the start of the other."""
    visits = _visits(strips, match)
    for (one, _, k), (two, j, _) in itertools.pairwise(visits):
        a, b = strips[one].section, strips[two].section
        if a.end < 0 or a.end != b.start:
            continue
        out, into = a.last_m - match.s_m[k], match.s_m[j] - b.first_m
        runs = [next(run for run in match.runs if run.first <= i <= run.last) for i in (k, j)]
        beside = runs[0] != runs[1] and is_lane_change(routes, path, *runs)
        if out > MISSED_M or into > MISSED_M or (beside and a.route != b.route and k + 1 == j):
            continue
        span = float(path.line.s_m[k] + out), float(path.line.s_m[j] - into)
        if span[1] - span[0] >= MIN_LENGTH_M:
            yield one, two, span


def _visits(strips: Sequence[Strip], match: Match) -> list[tuple[int, int, int]]:
    """Return the sections that a path visits, each with its first and last sample there."""
    visits: list[tuple[int, int, int]] = []
    for run in match.runs:
        if run.route < 0:
            continue
        own = [k for k, strip in enumerate(strips) if strip.section.route == run.route]
        rows = np.arange(run.first, run.last + 1)
        for k in sorted(own, key=lambda k: strips[k].section.first_m):
            section = strips[k].section
            inside = rows[(match.s_m[rows] >= section.first_m - 1e-6) & (match.s_m[rows] <= section.last_m + 1e-6)]
            if len(inside):
                visits.append((k, int(inside[0]), int(inside[-1])))
    return visits


def _fitted(points: Array, origin: Strip, target: Strip) -> Array:
    """Bend a path (N, 3) so that it begins and ends on the middles of the lanes, in their directions."""
    line = Polyline.through(points)
    s, length = line.s_m, line.length_m
    reach = length if length <= 2 * BLEND_M else BLEND_M
    moved = line.points_m.copy()
    for end, strip, since, sign in ((0, origin, s, 1.0), (-1, target, length - s, -1.0)):
        other = -1 if end == 0 else 0
        u = np.clip(since / reach, 0.0, 1.0)
        gap = strip.line.points_m[other] - line.points_m[end]
        wanted, own = strip.line.heading_rad[other], line.heading_rad[end]
        slope = sign * np.array([np.cos(wanted) - np.cos(own), np.sin(wanted) - np.sin(own), 0.0])
        fade, swing = (1 - u) ** 2 * (1 + 2 * u), u * (1 - u) ** 2 * reach
        moved += fade[:, None] * gap + swing[:, None] * slope
    return moved


def _mean(ways: Sequence[Array]) -> Array:
    """Return the median of polylines (N, 3) that begin and end together, at equal shares of their lengths."""
    if len(ways) == 1:
        return ways[0]
    count = max(len(points) for points in ways)
    share = np.linspace(0.0, 1.0, count)
    columns = []
    for points in ways:
        line = Polyline(points)
        columns.append(line.at(share * line.length_m))
    middle: Array = np.median(columns, axis=0)
    return middle


def continuations(strips: Sequence[Strip]) -> list[tuple[int, int]]:
    """Return pairs of sections of which one goes on as the other."""
    order = sorted(range(len(strips)), key=lambda k: (strips[k].section.route, strips[k].section.first_m))
    return [(a, b) for a, b in itertools.pairwise(order) if _meets(strips[a], strips[b])]


def _meets(one: Strip, two: Strip) -> bool:
    a, b = one.section, two.section
    return a.route == b.route and a.end == CUT == b.start and a.end != FREE
