"""Sections and junctions: where routes branch, merge and cross, and how vehicles go from one to the next."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.cluster.hierarchy import DisjointSet

from log2sim.geometry import Array, Polyline, Projection, crossings
from log2sim.road.routes import JOIN_M, JUMP_M, LANE_M, MAX_LANE_M, STAY_M, Beside, DrivenPath, Match, Route, Run

# A path that is turned less against a route follows it: within its lane a vehicle turns by a degree or two.
ALIGNED_RAD = float(np.deg2rad(2.0))
# How far before it leaves a route a path may begin to turn.
MAX_TURNOFF_M = 20.0
# Routes that differ less in heading run side by side; a path from one to the other changes lanes.
CHANGE_RAD = float(np.deg2rad(10.0))
# Between where two lanes touch and where a junction begins: vehicles there overlap no lane but their own.
MARGIN_M = 2.0
# Half of the length of the place where two lanes cross at a small angle.
MAX_HALF_M = 15.0


@dataclass(frozen=True)
class Conflict:
    """Stretches of routes that share ground."""

    intervals: tuple[tuple[int, float, float], ...]  # route, and its stations from and to, m
    crossing: bool  # whether lanes cross there; else they branch, merge or follow each other


def find_transitions(match: Match) -> Iterator[tuple[Run, Run]]:
    """Yield consecutive runs of a path on two routes, or on one that it comes back to."""
    on = [run for run in match.runs if run.route >= 0]
    for one, two in pairwise(on):
        if one.route != two.route or abs(match.s_m[two.first] - match.s_m[one.last]) > JUMP_M:
            yield one, two


def find_conflicts(routes: Sequence[Route], paths: Sequence[DrivenPath], matches: Sequence[Match]) -> list[Conflict]:
    """Return where routes cross, and where paths go from one to another without being beside each other."""
    found = []
    for path, match in zip(paths, matches):
        if path.rank < 2 or len({run.route for run in match.runs}) > 1:
            for one, two in find_transitions(match):
                if not is_lane_change(routes, path, one, two):
                    found.append(_transition(routes, path, match, one, two))
    for i, a in enumerate(routes):
        for j, b in enumerate(routes[i:], start=i):
            for s, t in crossings(a.line, b.line):
                turn = float(a.line.heading_at(s) - b.line.heading_at(t))
                sine, cosine = max(abs(np.sin(turn)), 1e-3), abs(np.cos(turn))
                wide_a, wide_b = float(a.width_at(s)), float(b.width_at(t))
                half_a, half_b = (
                    min((other / 2 + own / 2 * cosine) / sine, MAX_HALF_M) + MARGIN_M
                    for own, other in ((wide_a, wide_b), (wide_b, wide_a))
                )
                intervals = _held(routes, i, s - half_a, s + half_a), _held(routes, j, t - half_b, t + half_b)
                found.append(Conflict(intervals, crossing=True))
    return found


def _held(routes: Sequence[Route], k: int, first: float, last: float) -> tuple[int, float, float]:
    """Return a stretch of route k as far as the route goes."""
    return k, max(float(first), 0.0), min(float(last), routes[k].line.length_m)


def is_lane_change(routes: Sequence[Route], path: DrivenPath, one: Run, two: Run) -> bool:
    """Whether a path goes from a route to one that runs beside it, before and after."""
    if one.route == two.route:
        return False
    for other, k in ((two.route, one.last), (one.route, two.first)):
        line = routes[other].line
        at = line.project(path.line.points_m[k : k + 1, :2], path.line.heading_rad[k : k + 1])
        there = JOIN_M < at.s_m[0] < line.length_m - JOIN_M
        if not there or not STAY_M / 2 <= abs(at.aside_m[0]) <= MAX_LANE_M or abs(at.turn_rad[0]) > 2 * CHANGE_RAD:
            return False
    return True


def _transition(routes: Sequence[Route], path: DrivenPath, match: Match, one: Run, two: Run) -> Conflict:
    """Return the stretches between leaving a route and following another."""
    rows = np.arange(one.first, two.last + 1)
    xy, heading, s = path.line.points_m[rows, :2], path.line.heading_rad[rows], path.line.s_m[rows]
    a, b = (routes[run.route].line.project(xy, heading) for run in (one, two))
    leave, arrive = one.last - one.first, two.first - one.first
    # The last row before and the first one after that are aligned with the route, else the ones farthest away.
    before, after = np.arange(leave + 1), np.arange(arrive, len(s))
    before = before[s[before] >= s[leave] - MAX_TURNOFF_M]
    after = after[s[after] <= s[arrive] + MAX_TURNOFF_M]
    straight = before[np.abs(a.turn_rad[before]) <= ALIGNED_RAD]
    aligned = after[np.abs(b.turn_rad[after]) <= ALIGNED_RAD]
    begin = straight[-1] if len(straight) else before[0]
    end = aligned[0] if len(aligned) else after[-1]
    apart, together = leave + _until_apart(a, slice(leave, None)), arrive - _until_apart(b, slice(arrive, None, -1))
    own = match.s_m[rows]
    first = own[max(min(begin, together), 0)] if together <= leave else own[begin]
    length = routes[one.route].line.length_m
    last = max(own[leave], min(a.s_m[apart], length))
    enter = min(own[arrive], max(b.s_m[together], 0.0)) if b.inside[together] else own[arrive]
    out = max(own[end], own[apart] if apart >= arrive else -np.inf)
    room = JUMP_M if s[arrive] - s[leave] < JUMP_M else 0.0
    if length - own[leave] < JOIN_M and own[arrive] < JOIN_M:  # one goes on as the other
        return Conflict(((one.route, length - room, length), (two.route, 0.0, room)), crossing=False)
    last = length if length - own[leave] < JOIN_M else last
    enter = 0.0 if own[arrive] < JOIN_M else enter
    left = _held(routes, one.route, min(first, own[leave] - JUMP_M), last)
    return Conflict((left, _held(routes, two.route, enter, max(out, own[arrive] + JUMP_M))), crossing=False)


def _until_apart(at: Projection, rows: slice) -> int:
    """Return after how many of some rows a path is a lane beside a route, or off its ends; the last of them if it never is."""
    mask = (np.abs(at.aside_m[rows]) >= LANE_M) | ~at.inside[rows]
    return int(mask.argmax()) if mask.any() else len(mask) - 1


# Between two conflicts nearer than this no vehicle can wait: they are one junction.
MIN_SECTION_M = 4.0
# First and last station on a route, and the conflict or area that it belongs to.
Stretch = tuple[float, float, int]


def join_conflicts(conflicts: Sequence[Conflict]) -> tuple[dict[int, list[Stretch]], frozenset[int]]:
    """Join conflicts whose stretches overlap, or leave no section between them, on any route, to areas.

    Returns `stretches`: by route, in order and apart; `crossing`: areas in which lanes cross.
    """
    areas = DisjointSet(range(len(conflicts)))
    stretches: dict[int, list[Stretch]] = {}
    for k, conflict in enumerate(conflicts):
        for route, first, last in conflict.intervals:
            stretches.setdefault(route, []).append((first, last, k))
    for route, items in stretches.items():
        merged: list[Stretch] = []
        for first, last, k in sorted(items):
            if merged and first - merged[-1][1] < MIN_SECTION_M:
                areas.merge(k, merged[-1][2])
                merged[-1] = (merged[-1][0], max(merged[-1][1], last), k)
            else:
                merged.append((first, last, k))
        stretches[route] = merged
    crossing = frozenset(areas[k] for k, conflict in enumerate(conflicts) if conflict.crossing)
    return {route: [(a, b, areas[k]) for a, b, k in items] for route, items in stretches.items()}, crossing


# What a section ends at, if not at a junction: nothing that is known, or its own continuation beside other lanes.
FREE, CUT = -1, -2
# Of a path that begins or ends within a junction, this much is a section, from which its way through the junction leads on.
FIRST_M = 3.0
# Shorter sections are what rounding leaves: a sample of a path.
MIN_LENGTH_M = 0.5
# Over this length a lane comes to the width that it has beside others: 6 cm a meter at most.
TAPER_M = 10.0


@dataclass(frozen=True)
class Section:
    """A stretch of a route."""

    route: int
    first_m: float  # `first_m`, `last_m`: stations on the route
    last_m: float
    start: int  # `start`, `end`: the area there, `FREE` or `CUT`
    end: int


@dataclass(frozen=True, eq=False)
class Strip:
    """A section's ground."""

    section: Section
    line: Polyline  # its center line
    width_m: Array  # (N,): at the vertices
    left: int | None = None  # `left`, `right`: sections beside it, as indices, which have the same ends
    right: int | None = None


def cut_sections(
    routes: Sequence[Route],
    areas: Mapping[int, Sequence[Stretch]],
    beside: Sequence[Beside],
    ends: set[tuple[int, bool]],
) -> list[Section]:
    """Return the sections between junctions, cut where a lane beside them begins or ends.

    `areas` are the stretches of junctions by route. `ends` names the routes, and whether it is the start, whose first or last station a path enters or leaves by another route.
    """
    cuts = _find_cuts(routes, areas, beside)
    found = []
    for k, route in enumerate(routes):
        length, first, start = route.line.length_m, 0.0, FREE
        for low, high, area in (*areas.get(k, ()), (length, length, FREE)):
            if area != FREE:
                # Where the route itself begins or ends in a junction, a section is left before and after it.
                room = min(FIRST_M, (high - low) / 3)
                low = room if low < room and (k, True) not in ends else low
                high = length - room if high > length - room and (k, False) not in ends else high
            if low - first >= MIN_LENGTH_M:
                inner = [c for c in sorted(cuts[k]) if first + MIN_SECTION_M < c < low - MIN_SECTION_M]
                at, kinds = [first, *inner, low], [start, *([CUT] * len(inner)), area]
                found += [Section(k, a, b, x, y) for a, b, x, y in zip(at, at[1:], kinds, kinds[1:])]
            first, start = high, area
    return found


def _find_cuts(
    routes: Sequence[Route], areas: Mapping[int, Sequence[Stretch]], beside: Sequence[Beside]
) -> dict[int, list[float]]:
    """Return stations of routes at which a lane beside them begins or ends, and those across from them."""
    cuts: dict[int, list[float]] = {k: [] for k in range(len(routes))}

    def add(route: int, s: float) -> bool:
        near = any(abs(s - c) < MIN_SECTION_M for c in (*cuts[route], 0.0, routes[route].line.length_m))
        if near or any(low - MIN_SECTION_M < s < high + MIN_SECTION_M for low, high, _ in areas.get(route, ())):
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
    strips: dict[int, Strip] = {}
    halves_at = _end_halves(routes, sections, groups := _groups(sections, beside))
    for group in groups:
        line, _, halves, heights, edges = _offsets(routes, sections, group)
        ends = ("start", "first_m", line.s_m), ("end", "last_m", line.length_m - line.s_m)
        for row, side in ((0, 1), (-1, -1)):
            section = sections[group[row]]
            for kind, station, since in ends:
                wanted = halves_at.get((section.route, getattr(section, station), side))
                if getattr(section, kind) == CUT and wanted is not None:
                    taper = np.clip(1 - since / min(TAPER_M, line.length_m), 0.0, 1.0)
                    edges[row] += side * (taper * taper * (3 - 2 * taper)) * (wanted - halves[row])
        for row, k in enumerate(group):
            points = line.offset(line.s_m, (edges[row] + edges[row + 1]) / 2)
            points[:, 2] = heights[row]
            left = group[row - 1] if row > 0 else None
            right = group[row + 1] if row + 1 < len(group) else None
            strips[k] = Strip(sections[k], Polyline(points), edges[row] - edges[row + 1], left, right)
    return [strips[k] for k in range(len(sections))]


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
            first, last = sections[k].first_m, sections[k].last_m
            if min(last, pair.s_m[-1]) - max(first, pair.s_m[0]) < 0.5 * (last - first):
                continue
            ends = np.interp([first, last], pair.s_m, pair.other_s_m)
            ends += np.array([min(first - pair.s_m[0], 0.0), max(last - pair.s_m[-1], 0.0)])
            for j in by_route.get(pair.other, []):
                off = np.abs(ends - [sections[j].first_m, sections[j].last_m])
                if off.max() <= 1.5 * MIN_SECTION_M and k not in right_of and j not in right_of.values():
                    right_of[k] = j
    chains = [[k] for k in range(len(sections)) if k not in right_of.values()]
    for chain in chains:
        while chain[-1] in right_of:
            chain.append(right_of[chain[-1]])
    return chains


def _offsets(
    routes: Sequence[Route], sections: Sequence[Section], group: Sequence[int]
) -> tuple[Polyline, Array, Array, Array, Array]:
    """Return the base line of a group, and of its G lanes: offsets from it, default half widths and heights (G, N), and edges.

    Edges (G + 1, N) are from the left to the right; neighbors meet in the middle.
    """
    base = min(group, key=lambda k: sections[k].route)
    section = sections[base]
    line = Polyline.through(routes[section.route].line.part(section.first_m, section.last_m))
    c, s = np.cos(line.heading_rad), np.sin(line.heading_rad)
    along, left = np.column_stack([c, s]), np.column_stack([-s, c])
    columns = []
    for k in group:
        other = routes[sections[k].route]
        if k == base:
            at, points = section.first_m + line.s_m, line.points_m
        else:
            at = other.line.project(line.points_m[:, :2], line.heading_rad).s_m
            for _ in range(4):
                at = at - ((other.line.at(at) - line.points_m)[:, :2] * along).sum(axis=1)
            points = other.line.at(at)
        columns.append((((points - line.points_m)[:, :2] * left).sum(axis=1), other.width_at(at) / 2, points[:, 2]))
    offsets, halves, heights = (np.array(column) for column in zip(*columns))
    inner = (offsets[:-1] - halves[:-1] + offsets[1:] + halves[1:]) / 2
    edges = np.concatenate([offsets[:1] + halves[:1], inner, offsets[-1:] - halves[-1:]])
    return line, offsets, halves, heights, edges


def _end_halves(
    routes: Sequence[Route], sections: Sequence[Section], groups: Sequence[Sequence[int]]
) -> dict[tuple[int, float, int], float]:
    """Return half widths at cuts, by route, station and side (1 left, -1 right), of the sections that have a neighbor there."""
    found: dict[tuple[int, float, int], float] = {}
    for group in groups:
        if len(group) == 1:
            continue
        _, offsets, _, _, edges = _offsets(routes, sections, group)
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


# Over this length from its ends a connection comes from the lanes' middles to the path that was driven.
BLEND_M = 15.0
# A path that is first seen, or last, this far from the end of a section did not pass it.
MISSED_M = 3.0
# Sections that are nearer meet.
MIN_CONNECTION_M = 1.0


@dataclass(frozen=True, eq=False)
class Connection:
    """A way from the end of a section to the start of another."""

    origin: int  # `origin`, `target`: sections
    target: int
    line: Polyline
    width_m: Array  # (N,)
    area: int  # where it is
    agents: tuple[str, ...]  # who drove it


def connect(
    routes: Sequence[Route], strips: Sequence[Strip], paths: Sequence[DrivenPath], matches: Sequence[Match]
) -> list[Connection]:
    """Return a connection for each pair of sections that some path leads from one to the other, through an area."""
    driven: dict[tuple[int, int], list[tuple[DrivenPath, Array]]] = {}
    for path, match in zip(paths, matches):
        for origin, target, span in _passages(routes, strips, path, match):
            # Bent so that it begins and ends on the middles of the lanes, in their directions.
            line = Polyline.through(path.line.part(*span))
            points, s, length = line.points_m.copy(), line.s_m, line.length_m
            reach = length if length <= 2 * BLEND_M else BLEND_M
            for end, lane, since, sign in ((0, origin, s, 1.0), (-1, target, length - s, -1.0)):
                toward, other = strips[lane].line, -1 - end
                u = np.clip(since / reach, 0.0, 1.0)
                gap = toward.points_m[other] - line.points_m[end]
                wanted, own = toward.heading_rad[other], line.heading_rad[end]
                slope = sign * np.array([np.cos(wanted) - np.cos(own), np.sin(wanted) - np.sin(own), 0.0])
                fade, swing = (1 - u) ** 2 * (1 + 2 * u), u * (1 - u) ** 2 * reach
                points += fade[:, None] * gap + swing[:, None] * slope
            driven.setdefault((origin, target), []).append((path, points))
    out = []
    for (origin, target), ways in sorted(driven.items()):
        lead = min(path.rank == 2 for path, _ in ways)
        kept = [(path, points) for path, points in ways if (path.rank == 2) == lead]
        lines = [Polyline(points) for _, points in kept]
        share = np.linspace(0.0, 1.0, max(len(line.points_m) for line in lines))
        middle = np.median([line.at(share * line.length_m) for line in lines], axis=0)
        line = Polyline(middle) if len(lines) > 1 else lines[0]
        ends = strips[origin].width_m[-1], strips[target].width_m[0]
        width = np.interp(line.s_m, [0.0, line.length_m], ends)
        names = tuple(dict.fromkeys(path.agent for path, _ in kept))
        out.append(Connection(origin, target, line, width, strips[origin].section.end, names))
    return out


def _passages(
    routes: Sequence[Route], strips: Sequence[Strip], path: DrivenPath, match: Match
) -> Iterator[tuple[int, int, tuple[float, float]]]:
    """Yield pairs of sections that a path passes in turn, and its stations at the end of one and the start of the other."""
    visits: list[tuple[int, int, int]] = []  # of sections: which, and the first and last sample there
    for run in match.runs:
        rows = np.arange(run.first, run.last + 1)
        own = [k for k, strip in enumerate(strips) if strip.section.route == run.route]
        for k in sorted(own, key=lambda k: strips[k].section.first_m):
            section = strips[k].section
            inside = rows[(match.s_m[rows] >= section.first_m - 1e-6) & (match.s_m[rows] <= section.last_m + 1e-6)]
            if len(inside):
                visits.append((k, int(inside[0]), int(inside[-1])))
    for (one, _, k), (two, j, _) in pairwise(visits):
        a, b = strips[one].section, strips[two].section
        if a.end < 0 or a.end != b.start:
            continue
        out, into = a.last_m - match.s_m[k], match.s_m[j] - b.first_m
        runs = [next(run for run in match.runs if run.first <= i <= run.last) for i in (k, j)]
        beside = runs[0] != runs[1] and is_lane_change(routes, path, *runs)
        if out > MISSED_M or into > MISSED_M or (beside and a.route != b.route and k + 1 == j):
            continue
        span = float(path.line.s_m[k] + out), float(path.line.s_m[j] - into)
        if span[1] - span[0] >= MIN_CONNECTION_M:
            yield one, two, span


def continuations(strips: Sequence[Strip]) -> list[tuple[int, int]]:
    """Return pairs of sections of which one goes on as the other."""
    order = sorted(range(len(strips)), key=lambda k: (strips[k].section.route, strips[k].section.first_m))
    pairs = [(a, b, strips[a].section, strips[b].section) for a, b in pairwise(order)]
    return [(a, b) for a, b, one, two in pairs if one.route == two.route and one.end == CUT == two.start]
