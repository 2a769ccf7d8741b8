"""Infers lanes: from markings where there are some, from the paths of vehicles elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np

from log2sim.datatypes import MapLane, Marking, RoadBorder, Scenario
from log2sim.geometry import Array
from log2sim.lanes.graph.beside import find_beside
from log2sim.lanes.graph.conflicts import find_conflicts, find_transitions, is_lane_change
from log2sim.lanes.graph.connections import Connection, connect, continuations
from log2sim.lanes.graph.coverage import find_uncovered
from log2sim.lanes.graph.directions import direct_strips
from log2sim.lanes.graph.driven_paths import DrivenPath, collect_paths
from log2sim.lanes.graph.extension import continued
from log2sim.lanes.graph.junction_areas import Union, join_conflicts
from log2sim.lanes.graph.lane_changes import without_lane_changes
from log2sim.lanes.graph.lane_lines import name_lines
from log2sim.lanes.graph.matching import Match
from log2sim.lanes.graph.polyline import Polyline
from log2sim.lanes.graph.routes import JOIN_M, Route, match_path, merge_paths
from log2sim.lanes.graph.sections import Strip, cut_sections, lay_out
from log2sim.lanes.graph.strips import find_strips
from log2sim.lanes.graph.thinning import thin

PATH_PROBABILITY = 0.6
"""That there is a lane where one vehicle surely drove: others overtake, turn into yards or pass obstacles."""

MIN_AHEAD_M = 0.05
"""A point nearer than this to where a lane begins, or behind it, is left out."""

MAX_CONFIDENCE = 0.95
"""Paths alone never prove a lane."""


@dataclass(frozen=True, eq=False)
class _Graph:
    """Sections and connections, and what they came from."""

    routes: Sequence[Route]
    strips: Sequence[Strip]
    connections: Sequence[Connection]
    drivers: Sequence[Sequence[str]]
    crossing: frozenset[int]


def infer_lanes(
    markings: Sequence[Marking], borders: Sequence[RoadBorder], scenario: Scenario
) -> tuple[tuple[MapLane, ...], tuple[str, ...]]:
    """Infer the lanes of a scenario, linked to each other, and notes on what is missing.

    Lanes lie between markings and borders that run side by side, in the direction of the traffic on them; where there are none
    they follow the paths of vehicles, those of two-wheelers only where nobody else drove. The paths of several vehicles
    in one lane make one lane; it branches where they part, merges where they meet, and where they cross is a junction. Every
    path lies within the width of some lane.

    Notes
    -----
    Routes are merged from paths (`merge_paths`), cut where they conflict (`find_conflicts`) into sections that lie side by side
    (`lay_out`), and the ways of the vehicles from one section to the next become connections (`connect`).
    """
    driven = collect_paths(scenario)
    marked = _marked_routes(markings, borders, driven)
    notes = []
    if not marked:
        notes.append(
            "no lanes between markings: "
            + ("no two lines run side by side" if markings or borders else "none were found")
        )
    if not driven:
        notes.append("no lanes from paths: no vehicle moves")
    if not driven and not marked:
        return (), tuple(notes)
    paths = without_lane_changes(driven)
    graph = _graph(merge_paths(paths, marked), paths)
    lanes = _as_lanes(graph, {path.agent: path.confidence for path in driven})
    lanes = [*lanes, *_free_lanes(lanes, driven)]
    return _with_opposites(name_lines(lanes, markings, borders)), tuple(notes)


def _marked_routes(
    markings: Sequence[Marking], borders: Sequence[RoadBorder], paths: Sequence[DrivenPath]
) -> list[Route]:
    """Return routes along the strips between lines, in the direction of traffic."""
    sides: dict[str, Marking | RoadBorder] = {marking.id: marking for marking in markings}
    sides |= {border.id: border for border in borders}
    strips = direct_strips(find_strips(markings, borders), paths, sides)
    return [
        Route(
            strip.line,
            strip.width_m,
            strip.width_s_m,
            (True, True),
            (0.0, strip.line.length_m),
            strip.left,
            strip.right,
            strip.confidence * strip.directed,
        )
        for strip in strips
    ]


def _graph(routes: Sequence[Route], paths: Sequence[DrivenPath]) -> _Graph:
    seen = [match_path(routes, path) for path in paths]
    whole = [continued(routes, path, match) for path, match in zip(paths, seen)]
    matches = [match_path(routes, path) for path in whole]
    beside = find_beside([route.line for route in routes])
    areas = join_conflicts(routes, find_conflicts(routes, whole, matches), beside)
    sections = cut_sections(routes, areas, beside, _passed_ends(routes, whole, matches))
    strips = lay_out(routes, sections, beside)
    drivers: list[list[str]] = [[] for _ in strips]
    for path, match in zip(paths, seen):
        for k, strip in enumerate(strips):
            rows = [slice(run.first, run.last + 1) for run in match.runs if run.route == strip.section.route]
            s = np.concatenate([match.s_m[r] for r in rows]) if rows else np.zeros(0)
            if np.any((s > strip.section.first_m) & (s < strip.section.last_m)) and path.agent not in drivers[k]:
                drivers[k].append(path.agent)
    return _Graph(routes, strips, connect(routes, strips, whole, matches), drivers, areas.crossing)


def _passed_ends(
    routes: Sequence[Route], paths: Sequence[DrivenPath], matches: Sequence[Match]
) -> set[tuple[int, bool]]:
    """Return the routes whose start (True) or end (False) some path passes, coming from or going to another."""
    passed = set()
    for path, match in zip(paths, matches):
        for one, two in find_transitions(match):
            if is_lane_change(routes, path, one, two):
                continue
            if match.s_m[two.first] < JOIN_M:
                passed.add((two.route, True))
            if routes[one.route].line.length_m - match.s_m[one.last] < JOIN_M:
                passed.add((one.route, False))
    return passed


def _as_lanes(graph: _Graph, confidence_of: dict[str, float]) -> list[MapLane]:
    """Return sections and connections as lanes with their links."""
    first = len(graph.strips)
    links = [(c.origin, first + k) for k, c in enumerate(graph.connections)]
    links += [(first + k, c.target) for k, c in enumerate(graph.connections)]
    links += continuations(graph.strips)
    names = [f"lane-{k + 1}" for k in range(first + len(graph.connections))]
    after: list[list[str]] = [[] for _ in names]
    before: list[list[str]] = [[] for _ in names]
    for a, b in links:
        after[a].append(names[b])
        before[b].append(names[a])
    junction_of = _junctions(graph)
    lanes = []
    for k, strip in enumerate(graph.strips):
        route = graph.routes[strip.section.route]
        marked = _is_marked(route, strip)
        by_paths = _confidence(graph.drivers[k], confidence_of)
        origin = ("both" if graph.drivers[k] else "markings") if marked else "paths"
        both = 1 - (1 - by_paths) * (1 - route.confidence) if marked else by_paths
        left, right = (None if other is None else names[other] for other in (strip.left, strip.right))
        lanes.append(
            MapLane(
                names[k],
                strip.line.points_m,
                strip.width_m,
                route.left if marked else None,
                route.right if marked else None,
                tuple(before[k]),
                tuple(after[k]),
                left,
                right,
                inferred_from=origin,
                confidence=round(both, 3),
            )
        )
    for k, way in enumerate(graph.connections, start=first):
        lanes.append(
            MapLane(
                names[k],
                way.line.points_m,
                way.width_m,
                predecessors=tuple(before[k]),
                successors=tuple(after[k]),
                junction=junction_of.get(way.area),
                inferred_from="paths",
                confidence=_confidence(way.agents, confidence_of),
            )
        )
    return [thin(lane) for lane in _meeting(lanes, links)]


def _is_marked(route: Route, strip: Strip) -> bool:
    """Whether markings make the route along at least half of a section."""
    if route.marked_m is None:
        return False
    first, last = strip.section.first_m, strip.section.last_m
    return min(last, route.marked_m[1]) - max(first, route.marked_m[0]) >= (last - first) / 2


def _junctions(graph: _Graph) -> dict[int, str]:
    """Name the areas in which lanes cross, branch or merge, or in which several leave one road side by side: these are one."""
    union = Union(1 + max((c.area for c in graph.connections), default=0))
    known = {c.area for c in graph.connections}
    for strip in graph.strips:
        if strip.right is not None:
            other = graph.strips[strip.right].section
            for one, two in ((strip.section.start, other.start), (strip.section.end, other.end)):
                if one in known and two in known:
                    union.unite(one, two)
    ways = Counter(union.root(c.area) for c in graph.connections)
    crossing = {union.root(area) for area in graph.crossing & known}
    order = list(dict.fromkeys(union.root(c.area) for c in graph.connections))
    names = {area: f"junction-{k + 1}" for k, area in enumerate(a for a in order if ways[a] > 1 or a in crossing)}
    return {area: names[union.root(area)] for area in known if union.root(area) in names}


def _confidence(agents: Sequence[str], confidence_of: dict[str, float]) -> float:
    missing = float(np.prod([1 - PATH_PROBABILITY * confidence_of.get(agent, 0.0) for agent in agents]))
    return round(min(1 - missing, MAX_CONFIDENCE), 3)


def _meeting(lanes: Sequence[MapLane], links: Sequence[tuple[int, int]]) -> list[MapLane]:
    """Let linked lanes meet in exactly the same point."""
    found = list(lanes)
    for a, b in links:
        points, lane = found[b].points_m.copy(), found[b]
        points[0] = found[a].points_m[-1]
        ahead = (points[1:, :2] - points[0, :2]) @ _direction(lane)
        kept = np.concatenate([[0], 1 + np.flatnonzero(np.maximum.accumulate(ahead > MIN_AHEAD_M))])
        if len(kept) > 1:
            found[b] = replace(lane, points_m=points[kept], width_m=lane.width_m[kept])
    return found


def _direction(lane: MapLane) -> Array:
    heading = Polyline(lane.points_m).heading_rad[0]
    return np.array([np.cos(heading), np.sin(heading)])


def add_missing_lanes(lanes: Sequence[MapLane], scenario: Scenario) -> tuple[MapLane, ...]:
    """Return lanes and, where paths of a scenario's vehicles leave them, more without links."""
    return (*lanes, *_free_lanes(lanes, collect_paths(scenario)))


def _free_lanes(lanes: Sequence[MapLane], paths: Sequence[DrivenPath]) -> list[MapLane]:
    """Return lanes without links over what is left of paths outside the lanes."""
    found: list[MapLane] = []
    taken = {lane.id for lane in lanes}
    for path in paths:
        for points, width in find_uncovered([*lanes, *found], path):
            line = Polyline.through(points)
            name = next(n for k in count(len(lanes) + len(found) + 1) if (n := f"lane-{k}") not in taken)
            taken.add(name)
            confidence = round(min(PATH_PROBABILITY * path.confidence, MAX_CONFIDENCE), 3)
            full = np.full(len(line.points_m), width)
            found.append(thin(MapLane(name, line.points_m, full, inferred_from="paths", confidence=confidence)))
    return found


def _with_opposites(lanes: Sequence[MapLane]) -> tuple[MapLane, ...]:
    """Name for each lane the one beside it that leads the other way, along at least half of it."""
    flat = [k for k, lane in enumerate(lanes) if lane.junction is None]
    lines = [Polyline.through(lanes[k].points_m) for k in flat]
    best: dict[int, tuple[float, int]] = {}
    for pair in find_beside(lines):
        length = float(pair.s_m[-1] - pair.s_m[0])
        if not pair.same_way and length >= lines[pair.route].length_m / 2:
            best[pair.route] = max(best.get(pair.route, (0.0, -1)), (length, pair.other))
    found = list(lanes)
    for k, (_, other) in best.items():
        if best.get(other, (0.0, -1))[1] == k:
            found[flat[k]] = replace(found[flat[k]], opposite=lanes[flat[other]].id)
    return tuple(found)
