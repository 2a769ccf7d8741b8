"""Lanes, inferred from markings where there are some, from the paths of vehicles elsewhere."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import count

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

from log2sim.datatypes import MapLane, Marking, RoadBorder, Scenario
from log2sim.geometry import Array, Polyline, wrap_angle
from log2sim.road.routes import (
    BESIDE_M,
    CLEARANCE_M,
    JOIN_M,
    LANE_M,
    MAX_LANE_M,
    MAX_TURN_RAD,
    MIN_PATH_M,
    DrivenPath,
    Route,
    collect_paths,
    continued,
    find_beside,
    match_path,
    merge_paths,
)
from log2sim.road.sections import (
    Connection,
    Strip,
    connect,
    continuations,
    cut_sections,
    find_conflicts,
    find_transitions,
    is_lane_change,
    join_conflicts,
    lay_out,
)

# Stations at which the distance to the next line is taken.
STRIP_STEP_M = 1.0
# Of a lane: from the narrowest of roadworks to the widest with parked cars in it, as two are 5.5 m wide at least (RASt 06: 2.75 m each).
MIN_WIDTH_M, MAX_WIDTH_M = 2.2, 5.5
# Lines nearer than this belong together: double lines, a curb beside an edge line.
SAME_LINE_M = 1.0
# Edges of a lane differ less in heading, also where it widens.
PARALLEL_RAD = float(np.deg2rad(8.0))
# Shorter strips are between arrows, letters and pieces of crosswalks: a dash and its gap are 9 m (RMS 1993) to 12 m long.
MIN_STRIP_M = 8.0
# Between two pieces of a strip whose lines are worn: the longest gap between dashes of motorways (12 m) and some more.
MAX_STRIP_GAP_M = 15.0
# How far the second piece may lie aside of where the first leads, and how much wider it may be: less than any next lane.
MAX_ASIDE_M, MAX_WIDENING_M = 0.5, 0.8
# What may be the edge of a lane.
RoadLine = Marking | RoadBorder


@dataclass(frozen=True, eq=False)
class LaneStrip:
    """A strip between two lines; its direction is that of one of them."""

    line: Polyline  # its middle
    width_m: Array  # `width_m`, `width_s_m`: (K,): widths and their stations
    width_s_m: Array
    left: str  # `left`, `right`: ids of the lines beside it; of the longest if there are several
    right: str
    confidence: float  # that both lines are there
    directed: float = 0.5  # probability that it leads the way of its line

    def reversed(self) -> LaneStrip:
        """Return the strip in the other direction."""
        s = self.line.length_m - self.width_s_m[::-1]
        line = Polyline(self.line.points_m[::-1])
        return replace(self, line=line, width_m=self.width_m[::-1], width_s_m=s, left=self.right, right=self.left)


def list_road_lines(markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[RoadLine]:
    """Return the lane lines and borders."""
    items: list[RoadLine] = [marking for marking in markings if marking.is_lane_line]
    items.extend(borders)
    return [item for item in items if len(item.points_m) > 1 and np.ptp(item.points_m[:, :2], axis=0).max() > 0]


def find_strips(markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[LaneStrip]:
    """Return the strips between lane lines and borders, from one end of the lines to the other."""
    items = list_road_lines(markings, borders)
    lines = [Polyline.through(item.points_m) for item in items]
    sides = [_Sides.of(line, k, lines) for k, line in enumerate(lines)]
    found = []
    for i, item in enumerate(items):
        back = Polyline(lines[i].points_m[::-1])
        for line, own in ((lines[i], sides[i]), (back, _Sides.of(back, i, lines))):
            for j in {int(v) for v in own.left[own.left >= 0]}:
                left, theirs = items[j], sides[j]
                # Stretches of rows at which each line is the nearest of the other.
                rows = np.flatnonzero(own.left == j)
                gap = line.at(own.s_m[rows])[:, None, :2] - lines[j].at(theirs.s_m)[None, :, :2]
                across = np.hypot(gap[..., 0], gap[..., 1]).argmin(axis=1)
                rows = rows[(theirs.left[across] == i) | (theirs.right[across] == i)]
                for run in np.split(rows, np.flatnonzero(np.diff(rows) > 2) + 1):
                    if len(run) < 2 or own.s_m[run[-1]] - own.s_m[run[0]] < STRIP_STEP_M:
                        continue
                    s, width = own.s_m[run], own.left_m[run]
                    middle = Polyline.through(line.offset(s, width / 2))
                    at = (s - s[0]) / (s[-1] - s[0]) * middle.length_m
                    found.append(LaneStrip(middle, width, at, left.id, item.id, left.confidence * item.confidence))
    return [strip for strip in _chained(_once(found)) if strip.line.length_m >= MIN_STRIP_M]


@dataclass(frozen=True, eq=False)
class _Sides:
    """Stations of a line, and for each the nearest lines to its left and right, -1 for none, with their distances."""

    s_m: Array
    left: NDArray[np.intp]
    right: NDArray[np.intp]
    left_m: Array

    @classmethod
    def of(cls, line: Polyline, k: int, lines: Sequence[Polyline]) -> _Sides:
        """Look to both sides of a line, which is `lines[k]` or its reverse."""
        s = np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / STRIP_STEP_M)), 1) + 1)
        points, heading = line.at(s)[:, :2], line.heading_at(s)
        nearest = {sign: np.full(len(s), np.inf) for sign in (1, -1)}
        which = {sign: np.full(len(s), -1) for sign in (1, -1)}
        for j, other in enumerate(lines):
            if j == k or not line.is_near(other, MAX_WIDTH_M):
                continue
            for turned in (0.0, np.pi):
                at = other.project(points, heading + turned)
                aside = -at.aside_m if turned == 0.0 else at.aside_m
                there = (at.s_m >= -STRIP_STEP_M / 2) & (at.s_m <= other.length_m + STRIP_STEP_M / 2)
                good = there & (np.abs(at.turn_rad) <= PARALLEL_RAD)
                for sign in (1, -1):
                    near = good & (sign * aside >= SAME_LINE_M) & (sign * aside < nearest[sign])
                    nearest[sign] = np.where(near, sign * aside, nearest[sign])
                    which[sign] = np.where(near, j, which[sign])
        for sign in (1, -1):
            which[sign][(nearest[sign] < MIN_WIDTH_M) | (nearest[sign] > MAX_WIDTH_M)] = -1
        return cls(s, which[1], which[-1], nearest[1])


def _once(strips: Sequence[LaneStrip]) -> list[LaneStrip]:
    """Drop strips that another, longer one holds: lines that lead opposite ways see the same one from both sides."""
    kept: list[LaneStrip] = []
    for strip in sorted(strips, key=lambda one: -one.line.length_m):
        middle = strip.line.at(np.linspace(0.0, strip.line.length_m, 9))
        heading = strip.line.heading_at(np.linspace(0.0, strip.line.length_m, 9))
        held = np.zeros(9, dtype=bool)
        for other in kept:
            for turned in (0.0, np.pi):
                at = other.line.project(middle[:, :2], heading + turned)
                held |= at.inside & (np.abs(at.aside_m) < MIN_WIDTH_M / 2) & (np.abs(at.turn_rad) < np.pi / 2)
        if held.mean() < 0.5:
            kept.append(strip)
    return kept


def _chained(strips: list[LaneStrip]) -> list[LaneStrip]:
    """Join strips that follow each other."""
    while True:
        both = [(strip, strip.reversed()) for strip in strips]
        gaps = [
            (gap, i, j, flip)
            for i, one in enumerate(both)
            for j, two in enumerate(both)
            if i != j
            for flip in ((False, False), (True, False), (False, True))
            if (gap := _gap(one[flip[0]], two[flip[1]])) is not None
        ]
        if not gaps:
            return strips
        _, i, j, flip = min(gaps)
        joined = _joined(both[i][flip[0]], both[j][flip[1]])
        strips = [strip for k, strip in enumerate(strips) if k not in (i, j)] + [joined]


def _gap(one: LaneStrip, two: LaneStrip) -> float | None:
    """Return the gap between the end of one strip and the start of another that continues it, else None."""
    (x, y, _), (u, v, _) = one.line.points_m[-1], two.line.points_m[0]
    if abs(u - x) > MAX_STRIP_GAP_M or abs(v - y) > MAX_STRIP_GAP_M:
        return None
    heading = one.line.heading_rad[-1]
    c, s = np.cos(heading), np.sin(heading)
    along, aside = (u - x) * c + (v - y) * s, (v - y) * c - (u - x) * s
    bend = float(wrap_angle(two.line.heading_rad[0] - heading))
    fits = abs(aside - along * bend / 2) <= MAX_ASIDE_M and abs(bend) <= PARALLEL_RAD
    fits &= -STRIP_STEP_M <= along <= MAX_STRIP_GAP_M and abs(one.width_m[-1] - two.width_m[0]) <= MAX_WIDENING_M
    return float(along) if fits else None


def _joined(one: LaneStrip, two: LaneStrip) -> LaneStrip:
    heading = one.line.heading_rad[-1]
    ahead = (two.line.points_m[:, :2] - one.line.points_m[-1, :2]) @ [np.cos(heading), np.sin(heading)]
    rest = two.line.points_m[int(np.argmax(ahead > 0.1)) :]
    line = Polyline.through(np.concatenate([one.line.points_m, rest]))
    longer = max(one, two, key=lambda strip: strip.line.length_m)
    shift = line.length_m - two.line.length_m
    known = two.width_s_m + shift > one.line.length_m
    s = np.concatenate([one.width_s_m, two.width_s_m[known] + shift])
    width = np.concatenate([one.width_m, two.width_m[known]])
    share = one.line.length_m / (one.line.length_m + two.line.length_m)
    confidence = share * one.confidence + (1 - share) * two.confidence
    return LaneStrip(line, width, s, longer.left, longer.right, confidence)


# How far interpolation may be from a point that is left out: below the centimeter to which lanes are exact.
TOLERANCE_M = 0.004
# Longest chord, so that heights and widths are sampled too.
MAX_STEP_M = 20.0


def thin(lane: MapLane) -> MapLane:
    """Drop the points of a lane that linear interpolation restores, with their widths (Ramer 1972, Douglas and Peucker 1973)."""
    columns = np.column_stack([lane.points_m, lane.width_m])
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
    rows = sorted(kept)
    return replace(lane, points_m=lane.points_m[rows], width_m=lane.width_m[rows])


# A line this near to the edge of a lane is its edge: vehicles, and so lanes along their paths, keep half a meter off the
# middle.
NEAR_M = 0.7
# Of a lane's length that a line has to accompany.
MIN_SHARE = 0.5


def name_lines(lanes: Sequence[MapLane], markings: Sequence[Marking], borders: Sequence[RoadBorder]) -> list[MapLane]:
    """Return lanes outside of junctions with the lines at their edges, where none are named; lanes side by side share one."""
    items = list_road_lines(markings, borders)
    lines = [Polyline.through(item.points_m) for item in items]
    found = list(lanes)
    for k, lane in enumerate(lanes):
        if lane.junction is not None:
            continue
        own = Polyline(lane.points_m)
        s = np.linspace(0.0, own.length_m, max(int(np.ceil(own.length_m)), 4) + 1)
        points, heading, half = own.at(s)[:, :2], own.heading_at(s), np.interp(s, own.s_m, lane.width_m) / 2
        best: dict[str, tuple[float, str | None]] = {"left": (0.0, lane.left), "right": (0.0, lane.right)}
        for line, item in zip(lines, items):
            if not own.is_near(line, half.max() + NEAR_M):
                continue
            for turned in (0.0, np.pi):
                at = line.project(points, heading + turned)
                aside = -at.aside_m if turned == 0.0 else at.aside_m
                along = at.inside & (np.abs(at.turn_rad) <= PARALLEL_RAD)
                for side, sign in (("left", 1), ("right", -1)):
                    share = float((along & (np.abs(sign * aside - half) <= NEAR_M)).mean())
                    if share >= MIN_SHARE and share > best[side][0] and getattr(lane, side) is None:
                        best[side] = share, item.id
        found[k] = replace(lane, left=best["left"][1], right=best["right"][1])
    return found


# A lane of its own overlaps the lanes that a path leaves by as much; two stretches nearer than twice of it become one.
OVERLAP_M = 10.0
# So far beyond the end of a lane a vehicle is still on it: less than half a step between two samples of its path.
BEYOND_M = 0.3


def find_covered(lanes: Sequence[MapLane], line: Polyline, aside_m: float | None = None) -> NDArray[np.bool_]:
    """Return whether each vertex (N,) of a path is within the width of some lane, or `aside_m` of its middle, along it."""
    xy, heading = line.points_m[:, :2], line.heading_rad
    covered = np.zeros(len(xy), dtype=bool)
    for lane in lanes:
        own = Polyline(lane.points_m)
        if not line.is_near(own, max(float(lane.width_m.max()) / 2, aside_m or 0.0)):
            continue
        middle = Polyline.through(lane.points_m)
        at = middle.project(xy, heading)
        half = np.maximum(np.interp(at.s_m, own.s_m, lane.width_m) / 2, aside_m or 0.0)
        along = (at.s_m >= -BEYOND_M) & (at.s_m <= middle.length_m + BEYOND_M)
        covered |= along & (np.abs(at.aside_m) <= half) & (np.abs(at.turn_rad) <= MAX_TURN_RAD)
    return covered


# Traffic that comes towards a vehicle within this distance is on the same road: two lanes each way and a strip between.
ONCOMING_M = 15.0
# Probabilities of a direction: somebody drives that way; the lane beside it, away from oncoming traffic, must lead the same
# way; the one towards oncoming traffic may lead either way; nothing is known. Not measured, but for the order.
DRIVEN, OUTER, INNER, UNKNOWN = 0.98, 0.9, 0.7, 0.5


def find_side_of_traffic(paths: Sequence[DrivenPath]) -> int:
    """Return 1 where oncoming traffic passes to the left (right-hand traffic), -1 where to the right, 0 if none is seen."""
    votes = 0.0
    for k, one in enumerate(paths):
        for two in paths[k + 1 :]:
            if not one.line.is_near(two.line, ONCOMING_M):
                continue
            at = one.line.project(two.line.points_m[:, :2], two.line.heading_rad + np.pi)
            meets = at.inside & (np.abs(at.aside_m) <= ONCOMING_M) & (np.abs(at.turn_rad) <= MAX_TURN_RAD / 2)
            votes += float(np.sign(at.aside_m[meets]).sum())
    return int(np.sign(votes))


def direct_strips(
    strips: Sequence[LaneStrip], paths: Sequence[DrivenPath], sides: Mapping[str, Marking | RoadBorder]
) -> list[LaneStrip]:
    """Turn strips the way that they lead, with the probability of it."""
    found = []
    for strip in strips:
        # The way that most vehicles drive it, by the lengths of their paths on it.
        along = 0
        for path in paths:
            for sign, turn in ((1, 0.0), (-1, np.pi)):
                at = strip.line.project(path.line.points_m[:, :2], path.line.heading_rad + turn)
                half = np.interp(at.s_m, strip.width_s_m, strip.width_m) / 2
                inside = at.inside & (np.abs(at.aside_m) <= half) & (np.abs(at.turn_rad) <= MAX_TURN_RAD)
                along += sign * int(inside.sum())
        driven = strip if along >= 0 else strip.reversed()
        found.append(replace(driven, directed=DRIVEN) if along else driven)
    traffic = find_side_of_traffic(paths) or 1
    beside = find_beside([strip.line for strip in found])
    for _ in range(len(found)):
        known = [strip.directed > UNKNOWN for strip in found]
        news = {}
        for pair in beside:
            if not known[pair.route] or known[pair.other] or pair.other in news:
                continue
            neighbor, strip = found[pair.route], found[pair.other]
            same, probability = True, OUTER
            if pair.aside_m[0] * traffic > 0:
                # Towards oncoming traffic it is the line between them that tells: a dashed line in the middle of a road with two
                # lanes parts its directions, one between more lanes those of one direction.
                both = {pair.route, pair.other}
                alone = not any(other.route in both and other.other not in both for other in beside)
                between = sides.get(neighbor.left if pair.aside_m[0] > 0 else neighbor.right)
                dashed = isinstance(between, Marking) and between.kind == "dashed" and between.color != "yellow"
                same, probability = dashed and not alone, INNER
            strip = strip if pair.same_way == same else strip.reversed()
            news[pair.other] = replace(strip, directed=probability * neighbor.directed)
        if not news:
            break
        turned = {k: strip.line is not found[k].line for k, strip in news.items()}
        found = [news.get(k, strip) for k, strip in enumerate(found)]
        if any(turned.values()):
            beside = find_beside([strip.line for strip in found])
    return found


# That there is a lane where one vehicle surely drove: others overtake, turn into yards or pass obstacles.
PATH_PROBABILITY = 0.6
# A point nearer than this to where a lane begins, or behind it, is left out.
MIN_AHEAD_M = 0.05
# Paths alone never prove a lane.
MAX_CONFIDENCE = 0.95


def infer_lanes(
    markings: Sequence[Marking], borders: Sequence[RoadBorder], scenario: Scenario
) -> tuple[tuple[MapLane, ...], tuple[str, ...]]:
    """Infer the lanes of a scenario, linked to each other, and notes on what is missing.

    Lanes lie between markings and borders that run side by side, in the direction of the traffic on them; where there are none
    they follow the paths of vehicles, those of two-wheelers only where nobody else drove. The paths of several vehicles
    in one lane make one lane; it branches where they part, merges where they meet, and where they cross is a junction. Every
    path lies within the width of some lane.

    Routes are merged from paths (`merge_paths`), cut where they conflict (`find_conflicts`) into sections that lie side by side
    (`lay_out`), and the ways of the vehicles from one section to the next become connections (`connect`).
    """
    driven = collect_paths(scenario)
    sides: dict[str, Marking | RoadBorder] = {marking.id: marking for marking in markings}
    sides |= {border.id: border for border in borders}
    marked = []  # routes along the strips between lines, in the direction of traffic
    for strip in direct_strips(find_strips(markings, borders), driven, sides):
        widths, span = (strip.width_m, strip.width_s_m), (0.0, strip.line.length_m)
        confidence = strip.confidence * strip.directed
        marked.append(Route(strip.line, *widths, (True, True), span, strip.left, strip.right, confidence))
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
    lanes = _linked_lanes(merge_paths(driven, marked), driven)
    lanes = [*lanes, *_free_lanes(lanes, driven)]
    lanes = name_lines(lanes, markings, borders)
    # The lane beside each that leads the other way, along at least half of it.
    flat = [k for k, lane in enumerate(lanes) if lane.junction is None]
    lines = [Polyline.through(lanes[k].points_m) for k in flat]
    best: dict[int, tuple[float, int]] = {}
    for pair in find_beside(lines):
        length = float(pair.s_m[-1] - pair.s_m[0])
        if not pair.same_way and length >= lines[pair.route].length_m / 2:
            best[pair.route] = max(best.get(pair.route, (0.0, -1)), (length, pair.other))
    for k, (_, other) in best.items():
        if best.get(other, (0.0, -1))[1] == k:
            lanes[flat[k]] = replace(lanes[flat[k]], opposite=lanes[flat[other]].id)
    return tuple(lanes), tuple(notes)


def _linked_lanes(routes: Sequence[Route], paths: Sequence[DrivenPath]) -> list[MapLane]:
    """Return the sections of routes and the connections between them as lanes with their links."""
    seen = [match_path(routes, path) for path in paths]
    whole = [continued(routes, path, match) for path, match in zip(paths, seen)]
    matches = [match_path(routes, path) for path in whole]
    beside = find_beside([route.line for route in routes])
    areas, crossing = join_conflicts(find_conflicts(routes, whole, matches))
    # Routes whose start (True) or end (False) some path passes, coming from or going to another.
    passed = set()
    for path, match in zip(whole, matches):
        for one, two in find_transitions(match):
            if is_lane_change(routes, path, one, two):
                continue
            if match.s_m[two.first] < JOIN_M:
                passed.add((two.route, True))
            if routes[one.route].line.length_m - match.s_m[one.last] < JOIN_M:
                passed.add((one.route, False))
    sections = cut_sections(routes, areas, beside, passed)
    strips = lay_out(routes, sections, beside)
    drivers: list[list[str]] = [[] for _ in strips]
    for path, match in zip(paths, seen):
        for k, strip in enumerate(strips):
            rows = [slice(run.first, run.last + 1) for run in match.runs if run.route == strip.section.route]
            s = np.concatenate([match.s_m[r] for r in rows]) if rows else np.zeros(0)
            if np.any((s > strip.section.first_m) & (s < strip.section.last_m)) and path.agent not in drivers[k]:
                drivers[k].append(path.agent)
    connections = connect(routes, strips, whole, matches)
    first = len(strips)
    links = [(c.origin, first + k) for k, c in enumerate(connections)]
    links += [(first + k, c.target) for k, c in enumerate(connections)]
    links += continuations(strips)
    names = [f"lane-{k + 1}" for k in range(first + len(connections))]
    after: list[list[str]] = [[] for _ in names]
    before: list[list[str]] = [[] for _ in names]
    for a, b in links:
        after[a].append(names[b])
        before[b].append(names[a])
    junction_of = _junctions(strips, connections, crossing)
    confidence_of = {path.agent: path.confidence for path in paths}
    lanes = []
    for k, strip in enumerate(strips):
        route, begin, end = routes[strip.section.route], strip.section.first_m, strip.section.last_m
        # Markings make the route along at least half of the section.
        low, high = route.marked_m or (np.inf, -np.inf)
        marked = min(end, high) - max(begin, low) >= (end - begin) / 2
        by_paths = _confidence(drivers[k], confidence_of)
        both = 1 - (1 - by_paths) * (1 - route.confidence) if marked else by_paths
        lanes.append(
            MapLane(
                names[k],
                strip.line.points_m,
                strip.width_m,
                route.left if marked else None,
                route.right if marked else None,
                tuple(before[k]),
                tuple(after[k]),
                None if strip.left is None else names[strip.left],
                None if strip.right is None else names[strip.right],
                inferred_from=("both" if drivers[k] else "markings") if marked else "paths",
                confidence=round(both, 3),
            )
        )
    for k, way in enumerate(connections, start=first):
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
    for a, b in links:  # linked lanes meet in exactly the same point
        points, lane, heading = lanes[b].points_m.copy(), lanes[b], Polyline(lanes[b].points_m).heading_rad[0]
        points[0] = lanes[a].points_m[-1]
        ahead = (points[1:, :2] - points[0, :2]) @ [np.cos(heading), np.sin(heading)]
        kept = np.concatenate([[0], 1 + np.flatnonzero(np.maximum.accumulate(ahead > MIN_AHEAD_M))])
        if len(kept) > 1:
            lanes[b] = replace(lane, points_m=points[kept], width_m=lane.width_m[kept])
    return [thin(lane) for lane in lanes]


def _junctions(strips: Sequence[Strip], connections: Sequence[Connection], crossing: frozenset[int]) -> dict[int, str]:
    """Name the areas in which lanes cross, branch or merge, or in which several leave one road side by side: these are one."""
    known = {c.area for c in connections}
    areas = DisjointSet(known)
    for strip in strips:
        if strip.right is not None:
            other = strips[strip.right].section
            for one, two in ((strip.section.start, other.start), (strip.section.end, other.end)):
                if one in known and two in known:
                    areas.merge(one, two)
    ways = Counter(areas[c.area] for c in connections)  # in the order of the connections
    crossed = {areas[area] for area in crossing & known}
    names = {area: f"junction-{k + 1}" for k, area in enumerate(a for a in ways if ways[a] > 1 or a in crossed)}
    return {area: names[areas[area]] for area in known if areas[area] in names}


def _confidence(agents: Sequence[str], confidence_of: dict[str, float]) -> float:
    missing = float(np.prod([1 - PATH_PROBABILITY * confidence_of.get(agent, 0.0) for agent in agents]))
    return round(min(1 - missing, MAX_CONFIDENCE), 3)


def add_missing_lanes(lanes: Sequence[MapLane], scenario: Scenario) -> tuple[MapLane, ...]:
    """Return lanes and, where paths of a scenario's vehicles leave them, more without links."""
    return (*lanes, *_free_lanes(lanes, collect_paths(scenario)))


def _free_lanes(lanes: Sequence[MapLane], paths: Sequence[DrivenPath]) -> list[MapLane]:
    """Return lanes without links over the stretches of paths outside the lanes, `OVERLAP_M` longer on either side."""
    found: list[MapLane] = []
    taken = {lane.id for lane in lanes}
    for path in paths:
        s = path.line.s_m
        off = np.flatnonzero(~find_covered([*lanes, *found], path.line, BESIDE_M if path.rank == 2 else None))
        width = min(max(LANE_M, path.width_m + CLEARANCE_M), MAX_LANE_M)
        confidence = round(min(PATH_PROBABILITY * path.confidence, MAX_CONFIDENCE), 3)
        for run in np.split(off, np.flatnonzero(np.diff(s[off]) > 2 * OVERLAP_M) + 1) if len(off) else ():
            rows = np.flatnonzero((s >= s[run[0]] - OVERLAP_M) & (s <= s[run[-1]] + OVERLAP_M))
            if len(rows) < 2 or s[rows[-1]] - s[rows[0]] < MIN_PATH_M:
                continue
            line = Polyline.through(path.line.points_m[rows])
            name = next(n for k in count(len(lanes) + len(found) + 1) if (n := f"lane-{k}") not in taken)
            taken.add(name)
            full = np.full(len(line.points_m), width)
            found.append(thin(MapLane(name, line.points_m, full, inferred_from="paths", confidence=confidence)))
    return found
