"""Roads of OpenDRIVE out of lanes: those next to each other begin and end together, and become one road."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from log2sim.datatypes import MapFeatures, MapLane, Marking, RoadBorder, Scenario
from log2sim.export.roads.reference_line import ReferenceLine, fit
from log2sim.geometry import Array, Polyline
from log2sim.road.routes import Beside, find_beside

ALIGNED_M = 0.3  # lanes side by side whose ends are farther apart along the road than this are roads of their own
# An end that is linked with nothing may move back by so much: a vehicle beyond it still stands on the road with its
# rear.
FREE_M = 1.0


def is_connection(lane: MapLane, by_id: Mapping[str, MapLane]) -> bool:
    """Whether a lane of a junction leads from one lane outside to another."""
    if lane.junction is None or len(lane.predecessors) != 1 or len(lane.successors) != 1:
        return False
    return all(by_id[name].junction is None for name in (*lane.predecessors, *lane.successors))


def cut_together(lanes: Sequence[MapLane], refused: Collection[frozenset[str]] = ()) -> list[MapLane]:
    """Cut lanes outside of junctions where one beside them begins or ends; name for each part its neighbors.

    A part is linked with those before and after it, and lanes with the first and last parts of what they were linked with. The
    part k of a lane is called as the lane with "/k". Pairs of lanes that are `refused` are not taken for side by side.
    """
    by_id = {lane.id: lane for lane in lanes}
    plain = [lane for lane in lanes if not is_connection(lane, by_id)]
    lines = [Polyline.through(lane.points_m) for lane in plain]
    beside = [b for b in find_beside(lines) if _may_share(plain[b.route], plain[b.other], b, refused)]
    for b in list(beside):  # the same stretch as the other line has it
        order = slice(None, None, 1 if b.same_way else -1)
        aside = -b.aside_m if b.same_way else b.aside_m
        beside.append(Beside(b.other, b.route, b.other_s_m[order], b.s_m[order], aside[order], b.same_way))
    stations = _stations(plain, lines, beside)
    names = {lane.id: [lane.id] for lane in lanes}
    for lane, at in zip(plain, stations):
        if len(at) > 2:
            names[lane.id] = [f"{lane.id}/{k}" for k in range(1, len(at))]
    rows = {lane.id: row for row, lane in enumerate(plain)}
    found = []
    for lane in lanes:
        before = tuple(names[name][-1] for name in lane.predecessors)
        after = tuple(names[name][0] for name in lane.successors)
        links = [before, *((name,) for name in names[lane.id]), after]
        for k, name in enumerate(names[lane.id]):
            known: dict[str, Any] = {}
            for side in ("left_lane", "right_lane", "opposite"):
                other = getattr(lane, side)
                whole = other is not None and names[lane.id] == [lane.id] and names[other] == [other]
                known[side] = other if whole and frozenset((lane.id, other)) not in refused else None
            part = replace(lane, id=name, predecessors=links[k], successors=links[k + 2], **known)
            if lane.id in rows:
                row = rows[lane.id]
                begin_m, end_m = stations[row][k : k + 2]
                if begin_m != 0.0 or end_m != lines[row].length_m:
                    points = lines[row].part(begin_m, end_m)
                    ahead = begin_m + Polyline(points).s_m
                    width = np.interp(ahead, Polyline(part.points_m).s_m, part.width_m)
                    part = replace(part, points_m=points, width_m=width)
                part = replace(part, **_neighbors(row, stations, k, beside, plain, names))
            found.append(part)
    return found


def _may_share(lane: MapLane, other: MapLane, pair: Beside, refused: Collection[frozenset[str]]) -> bool:
    """Whether lanes side by side may share a road: neither has another neighbor there, and who drives the other way is to the left."""
    left = float(np.median(pair.aside_m)) > 0
    if frozenset((lane.id, other.id)) in refused or not (pair.same_way or left):
        return False
    if not pair.same_way:
        own, theirs = lane.opposite, other.opposite
    elif left:
        own, theirs = lane.left_lane, other.right_lane
    else:
        own, theirs = lane.right_lane, other.left_lane
    return own in (None, other.id) and theirs in (None, lane.id)


def _stations(lanes: Sequence[MapLane], lines: Sequence[Polyline], beside: Sequence[Beside]) -> list[list[float]]:
    """Return where each line is cut, its ends included: at cuts of those beside it, until there are no more."""
    cuts = [[0.0, line.length_m] for line in lines]
    free = [(not lane.predecessors, not lane.successors) for lane in lanes]
    for _ in lines:
        before = [list(at) for at in cuts]
        for pair in beside:
            for s in before[pair.route]:
                if pair.s_m[0] - ALIGNED_M <= s <= pair.s_m[-1] + ALIGNED_M:
                    _cut_at(cuts[pair.other], float(np.interp(s, pair.s_m, pair.other_s_m)), free[pair.other])
        if cuts == before:
            break
    return cuts


def _cut_at(cuts: list[float], s: float, free: tuple[bool, bool]) -> None:
    """Add a cut to those in order unless there is one; near an end that is free, move the end."""
    nearest = min(range(len(cuts)), key=lambda k: abs(cuts[k] - s))
    if abs(cuts[nearest] - s) <= ALIGNED_M or not cuts[0] < s < cuts[-1]:
        return
    if s - cuts[0] <= FREE_M and free[0]:
        cuts[0] = s
    elif cuts[-1] - s <= FREE_M and free[1]:
        cuts[-1] = s
    else:
        cuts.append(s)
        cuts.sort()


def _neighbors(
    row: int,
    stations: Sequence[Sequence[float]],
    k: int,
    beside: Sequence[Beside],
    plain: Sequence[MapLane],
    names: Mapping[str, Sequence[str]],
) -> dict[str, Any]:
    """Return the parts of other lanes beside the middle of part k of a lane; who drives the other way is to the left."""
    middle = (stations[row][k] + stations[row][k + 1]) / 2
    found = {}
    for pair in beside:
        if pair.route == row and pair.s_m[0] <= middle <= pair.s_m[-1]:
            left = float(np.median(pair.aside_m)) > 0
            there = float(np.interp(middle, pair.s_m, pair.other_s_m))
            at = int(np.searchsorted(stations[pair.other], there)) - 1
            parts = names[plain[pair.other].id]
            name = parts[min(max(at, 0), len(parts) - 1)]
            if pair.same_way:
                found["left_lane" if left else "right_lane"] = name
            else:
                found["opposite"] = name
    return found


LEVEL_M = 5.0  # length over which heights are averaged against their noise
EXACT_M = 0.002  # how far widths between stations may be from what is written


def elevation_profile(stations: Array, ground_m: Array, length_m: float) -> Array:
    """Fit cubics (K, 5) s, a, b, c, d through heights (N,) at the ends and their means every `LEVEL_M`, without overshoot.

    Before and after the stations the slope at the ends continues.
    """
    block = np.floor((stations - stations[0]) / LEVEL_M).astype(int)
    _, first, counts = np.unique(block, return_index=True, return_counts=True)
    s, z = (np.add.reduceat(v, first) / counts for v in (stations, ground_m))
    inner = (s > stations[0] + LEVEL_M / 4) & (s < stations[-1] - LEVEL_M / 4)
    s = np.concatenate([stations[:1], s[inner], stations[-1:]])
    z = np.concatenate([ground_m[:1], z[inner], ground_m[-1:]])
    grade = np.diff(z) / np.diff(s)
    z = np.concatenate([[z[0] - grade[0] * s[0]], z, [z[-1] + grade[-1] * (length_m - s[-1])]])
    return cubics_through(np.concatenate([[0.0], s, [length_m]]), z)


def cubics_through(stations: Array, values: Array) -> Array:
    """Return cubics (K, 5) s, a, b, c, d from station 0 on through values (N,) at stations (N,), without overshoot."""
    from scipy.interpolate import PchipInterpolator

    s, v = stations, np.asarray(values, dtype=np.float64)
    if s[0] > 1e-6:
        s, v = np.concatenate([[0.0], s]), np.concatenate([v[:1], v])
    apart = np.concatenate([np.diff(s) > 1e-6, [True]])
    s, v = s[apart], v[apart]
    if np.ptp(v) < EXACT_M / 10:
        return np.array([[0.0, v[0], 0.0, 0.0, 0.0]])
    d, c, b, a = PchipInterpolator(s, v).c
    first, *rest = np.column_stack([s[:-1], a, b, c, d])
    kept = [first]
    for row in rest:
        start, a, b, c, d = kept[-1]
        h = row[0] - start
        goes_on = [a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d), c + 3 * h * d, d]
        if np.abs(row[1:] - goes_on).max() > 2e-6:  # one that only continues the one before checkers call redundant
            kept.append(row)
    return np.array(kept)


USUAL_WIDTH_M = 0.12  # of lane lines: 12 cm on most roads (RMS 1993)


@dataclass(frozen=True)
class RoadMark:
    """A mark at the edge of a lane: its kind, "solid", "broken", "curb" or "none", color and width."""

    kind: str
    color: str = "standard"
    width_m: float = USUAL_WIDTH_M


class MarkFinder:
    """Finds the marks at the edges of lanes among markings and borders by their ids."""

    def __init__(self, scenario: Scenario) -> None:
        features = scenario.map_features or MapFeatures()
        items: list[Marking | RoadBorder] = [*features.markings, *features.borders]
        self.items: dict[str | None, Marking | RoadBorder] = {item.id: item for item in items}

    def mark(self, name: str | None) -> RoadMark:
        """Return the mark that the item of that id is; "none" where there is no such item."""
        item = self.items.get(name)
        if isinstance(item, RoadBorder):
            return RoadMark("curb" if item.kind == "curb" else "none")
        if item is None:
            return RoadMark("none")
        return RoadMark("broken" if item.kind == "dashed" else "solid", item.color or "standard", item.width_m)


# Roads go on straight for so long where nothing is known of what is before or after them, so that whole vehicles are
# on them.
EXTENSION_M = 10.0
STEP_M = 2.0  # stations at which widths are taken
TAPER_M = 10.0  # over so much of its length a lane changes to the width that it has in the next road


@dataclass(frozen=True, eq=False)
class End:
    """The start or the end of a lane as a road has it: x, y, z, heading (4,) of the road's cross section, and the lane's width."""

    pose: Array
    width_m: float


@dataclass(frozen=True, eq=False)
class Link:
    """What is before or after a road."""

    kind: str  # "road" or "junction"
    number: int  # its id
    # Lane ids of this road and those of the other, empty for a junction.
    lanes: Mapping[int, int] = field(default_factory=dict)
    point: int = 0  # start (0) or end (-1) of the other road


@dataclass(frozen=True, eq=False)
class Road:
    """A road whose reference line is the middle of one of the lanes that lead along it."""

    number: int  # its id
    lanes: tuple[MapLane, ...]  # along the line, from the left to the right: lane -1, -2,
    line: ReferenceLine
    # elevation, offset: (K, 5) stations and coefficients a, b, c, d of cubics: the height, and how far the left edge
    # of lane -1 is left of the line.
    elevation: Array
    offset: Array
    # widths, opposite_widths: of the lanes, along the line.
    widths: tuple[Array, ...]
    opposite: tuple[MapLane, ...] = ()  # against the line, from the right to the left: lane 1, 2,
    opposite_widths: tuple[Array, ...] = ()
    # Of a road that connects others in a junction: its id, and the road and lane from which it leads.
    junction: int | None = None
    incoming: tuple[int, int] = (0, 0)
    before: Link | None = None
    after: Link | None = None


def road_of_lanes(
    number: int,
    group: Sequence[MapLane],
    opposite: Sequence[MapLane],
    *,
    headings: tuple[float | None, float | None],
    free: tuple[bool, bool],
    met: Mapping[tuple[str, int], End],
) -> tuple[Road, dict[tuple[str, int], End]]:
    """Return a road of lanes side by side, some of which may lead the opposite way, and the ends of its lanes in their own direction.

    Near ends that meet those of lanes of other roads its lanes go over to their edges.
    """
    across = [*map(_turned, opposite[::-1]), *group]
    base = _surest(group)
    shared = [cross_heading(across, at) if h is None else h for at, h in zip((0, -1), headings)]
    poses = [None if f else np.array([*p[:2], h]) for f, p, h in zip(free, base.points_m[[0, -1]], shared)]
    line, stations = fit(base.points_m[:, :2], poses[0], poses[1])
    s = np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / STEP_M)), 1) + 1)
    edges = _edges(across, base, line.at(s))
    for at in (0, -1):
        near = np.clip(1.0 - np.abs(s - s[at]) / min(TAPER_M, line.length_m), 0.0, 1.0)
        near = near**2 * (3.0 - 2.0 * near)
        x, y, heading = line.at(s)[at]
        for row, lane in enumerate(across):
            other = met.get((lane.id, -1 - at if row < len(opposite) else at))
            if other is not None:
                aside = (other.pose[1] - y) * np.cos(heading) - (other.pose[0] - x) * np.sin(heading)
                for k, edge in ((row, aside + other.width_m / 2), (row + 1, aside - other.width_m / 2)):
                    edges[k] += (edge - edges[k, at]) * near
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


def _turned(lane: MapLane) -> MapLane:
    """Return a lane from its end to its start."""
    return replace(lane, points_m=lane.points_m[::-1], width_m=lane.width_m[::-1])


def cross_heading(group: Sequence[MapLane], at: int) -> float:
    """Return the heading of lanes at their start (0) or end (-1): square to the line across several of them."""
    if len(group) > 1:
        across = group[0].points_m[at] - group[-1].points_m[at]
        return float(np.arctan2(across[1], across[0]) - np.pi / 2)
    return float(Polyline(group[0].points_m).heading_rad[at])


def _surest(group: Sequence[MapLane]) -> MapLane:
    """Return the lane whose middle is the reference line of a road."""
    return max(group, key=lambda lane: (lane.confidence, -len(lane.id), lane.id))


def _edges(group: Sequence[MapLane], base: MapLane, reference: Array) -> Array:
    """Return how far left of points (N, 3) x, y, heading of a line the edges (G + 1, N) of G lanes are; neighbors share theirs.

    The middle of the lane `base` is the line itself.
    """
    share = np.linspace(0.0, 1.0, len(reference))
    heading = reference[:, 2]
    along = np.column_stack([np.cos(heading), np.sin(heading)])
    middles, widths = [], []
    for lane in group:
        line = Polyline(lane.points_m)
        feet = share * line.length_m
        for _ in range(8):  # from a guess to the stations straight across
            off = line.at(feet)[:, :2] - reference[:, :2]
            feet = np.clip(feet - (off * along).sum(axis=1), 0.0, line.length_m)
        gap = line.at(feet)[:, :2] - reference[:, :2]
        middle = gap[:, 1] * np.cos(heading) - gap[:, 0] * np.sin(heading)
        middles.append(np.zeros(len(share)) if lane is base else middle)
        widths.append(np.interp(feet, line.s_m, lane.width_m))
    m, h = np.array(middles), np.array(widths) / 2
    return np.concatenate([m[:1] + h[:1], (m[:-1] - h[:-1] + m[1:] + h[1:]) / 2, m[-1:] - h[-1:]])


@dataclass(frozen=True)
class _Place:
    """Where a lane is: in which road, and as which lane of it."""

    road: int
    lane: int

    @property
    def start(self) -> int:
        """Return the end of the road, 0 or -1, at which the lane starts."""
        return 0 if self.lane < 0 else -1

    @property
    def end(self) -> int:
        """Return the end of the road, 0 or -1, at which the lane ends."""
        return -1 - self.start


def build_network(lanes: Sequence[MapLane]) -> tuple[list[Road], dict[int, str]]:
    """Return the roads that lanes form, linked where it is clear which follows which, and the names of junctions elsewhere by id."""
    refused: set[frozenset[str]] = set()
    while True:
        parts = cut_together(lanes, refused)
        by_id = {lane.id: lane for lane in parts}
        crossing = {lane.id for lane in parts if is_connection(lane, by_id)}
        # Join groups whose leftmost lanes lead opposite ways, each to the left of the other; the surest lane leads along the road
        groups = _groups([lane for lane in parts if lane.id not in crossing], by_id)
        by_left = {group[0].id: group for group in groups}
        sides: list[tuple[list[MapLane], list[MapLane]]] = []
        taken: set[str] = set()
        for group in groups:
            if group[0].id in taken:
                continue
            other = by_left.get(str(group[0].opposite), [])
            if other:  # begins and ends with the lane, to the left of it
                leftmost, facing = group[0], _turned(other[0])
                heading = float(Polyline(leftmost.points_m).heading_rad[0])
                gap = facing.points_m[0] - leftmost.points_m[0]
                left = gap[1] * np.cos(heading) > gap[0] * np.sin(heading)
                other = other if other[0].opposite == leftmost.id and left and _aligned(leftmost, facing) else []
            taken |= {side[0].id for side in (group, other) if side}
            sides.append((group, other) if _surest([*group, *other]) in group else (other, group))
        plain = {k + 1: pair for k, pair in enumerate(sides)}
        place: dict[str, _Place] = {}
        for number, (group, opposite) in plain.items():
            place |= {lane.id: _Place(number, -1 - row) for row, lane in enumerate(group)}
            place |= {lane.id: _Place(number, 1 + row) for row, lane in enumerate(opposite)}
        torn = _torn(plain, place, by_id) - refused
        if not torn:
            break
        refused |= torn
    inside = sorted(crossing, key=list(by_id).index)
    place |= {name: _Place(len(plain) + k + 1, -1) for k, name in enumerate(inside)}
    names = list(dict.fromkeys(str(by_id[name].junction) for name in inside))
    number_of = {name: len(place) + k + 1 for k, name in enumerate(names)}
    headings = _shared_headings(plain, place)
    roads: list[Road] = []
    ends: dict[tuple[str, int], End] = {}
    # Those of more lanes first, since neighbors share an edge and the lane that goes on alone has to follow it.
    for number, (group, opposite) in sorted(plain.items(), key=lambda item: -len(item[1][0]) - len(item[1][1])):
        before, after = (_link([*group, *opposite], place, by_id, number_of, at) for at in (0, -1))
        # The ends, as far as they are there, of the lanes that those of the road are linked with, by lane and its start or end.
        met = {}
        for at, link in ((0, before), (-1, after)):
            for lane, name in _linked([*group, *opposite], place, at) if link and link.kind == "road" else ():
                own_end = -1 if place[lane.id].end == at else 0
                if (name, -1 - own_end) in ends:
                    met[lane.id, own_end] = ends[name, -1 - own_end]
        own_headings, free = (headings.get((number, 0)), headings.get((number, -1))), (before is None, after is None)
        road, own = road_of_lanes(number, group, opposite, headings=own_headings, free=free, met=met)
        roads.append(replace(road, before=before, after=after))
        ends.update(own)
    roads.sort(key=lambda road: road.number)
    for name in inside:
        lane = by_id[name]
        origin, target = lane.predecessors[0], lane.successors[0]
        one, two = place[origin], place[target]
        start, end = ends[origin, -1], ends[target, 0]  # it begins and ends as the roads that it connects
        line, stations = fit(lane.points_m[:, :2], start.pose[[0, 1, 3]], end.pose[[0, 1, 3]])
        ground_m = np.array([start.pose[2], *lane.points_m[1:-1, 2], end.pose[2]])
        width = cubics_through(np.array([0.0, line.length_m]), np.array([start.width_m, end.width_m]))
        profile = elevation_profile(stations, ground_m, line.length_m)
        road = Road(place[name].road, (lane,), line, profile, width * [1.0, 0.5, 0.5, 0.5, 0.5], (width,))
        before = Link("road", one.road, {-1: one.lane}, one.end)
        after = Link("road", two.road, {-1: two.lane}, two.start)
        junction = number_of[str(lane.junction)]
        roads.append(replace(road, junction=junction, incoming=(one.road, one.lane), before=before, after=after))
    return roads, {number: name for name, number in number_of.items()}


def _groups(lanes: Sequence[MapLane], by_id: Mapping[str, MapLane]) -> list[list[MapLane]]:
    """Return lanes side by side, from the left to the right, by their first lane's place in the list."""
    known = {lane.id for lane in lanes}
    found: list[list[MapLane]] = []
    seen: set[str] = set()
    for lane in lanes:
        if lane.id in seen:
            continue
        group = [lane]
        for side in ("left_lane", "right_lane"):
            while True:
                edge = group[0] if side == "left_lane" else group[-1]
                name = getattr(edge, side)
                taken = seen | {member.id for member in group}
                if name not in known or name in taken or not _aligned(edge, by_id[name]):
                    break
                group.insert(0 if side == "left_lane" else len(group), by_id[name])
        seen |= {member.id for member in group}
        found.append(group)
    return found


def _torn(
    plain: Mapping[int, tuple[Sequence[MapLane], Sequence[MapLane]]],
    place: Mapping[str, _Place],
    by_id: Mapping[str, MapLane],
) -> set[frozenset[str]]:
    """Return pairs of neighbors in a road, by their names before cuts, that go on in different roads or junctions at one end of it.

    A road has one neighbor at each end, so that such lanes would lose their links.
    """
    found: set[frozenset[str]] = set()
    for group, opposite in plain.values():
        across = [*opposite[::-1], *group]
        for at in (0, -1):
            reached: dict[str, set[tuple[int, str | None]]] = {lane.id: set() for lane in across}
            for lane, name in _linked(across, place, at):
                inside = is_connection(by_id[name], by_id)
                reached[lane.id].add((0, by_id[name].junction) if inside else (place[name].road, None))
            linked = [k for k, lane in enumerate(across) if reached[lane.id]]
            for one, two in pairwise(linked):
                if reached[across[one].id] != reached[across[two].id]:
                    found.add(frozenset(across[k].id.partition("/")[0] for k in (one, one + 1)))
    return found


def _aligned(one: MapLane, two: MapLane) -> bool:
    """Whether two lanes begin and end at the same line across the road, seen from either."""
    for at in (0, -1):
        gap = two.points_m[at] - one.points_m[at]
        headings = [float(Polyline(lane.points_m).heading_rad[at]) for lane in (one, two)]
        if min(abs(gap[0] * np.cos(h) + gap[1] * np.sin(h)) for h in headings) > ALIGNED_M:
            return False
    return True


def _link(
    group: Sequence[MapLane],
    place: Mapping[str, _Place],
    by_id: Mapping[str, MapLane],
    number_of: Mapping[str, int],
    at: int,
) -> Link | None:
    """Return what adjoins a road at its start (0) or end (-1).

    That is a junction, the one road with which its lanes are linked there one to one, and no others there, or None.
    """
    names = _linked(group, place, at)
    for _, name in names:
        if is_connection(by_id[name], by_id):
            return Link("junction", number_of[str(by_id[name].junction)])
    own = place[group[0].id].road
    # At which end of its road a lane adjoins another one.
    touched = [place[name].start if place[lane.id].end == at else place[name].end for lane, name in names]
    there = {(place[name].road, end) for (_, name), end in zip(names, touched)}
    if len(there) != 1 or any(len(set(side)) < len(names) for side in zip(*((a.id, b) for a, b in names))):
        return None
    ((number, point),) = there
    others = [lane for name, lane in by_id.items() if place[name].road == number]
    back = {(name, lane.id) for lane, name in _linked(others, place, point)}
    if back != {(lane.id, name) for lane, name in names} or number == own:
        return None
    return Link("road", number, {place[lane.id].lane: place[name].lane for lane, name in names}, point)


def _linked(group: Sequence[MapLane], place: Mapping[str, _Place], at: int) -> list[tuple[MapLane, str]]:
    """Return the lanes of a road with those that adjoin them at its start (0) or end (-1)."""
    ends_here = {lane.id: place[lane.id].end == at for lane in group}
    return [(a, name) for a in group for name in (a.successors if ends_here[a.id] else a.predecessors)]


def _shared_headings(
    plain: Mapping[int, tuple[Sequence[MapLane], Sequence[MapLane]]], place: Mapping[str, _Place]
) -> dict[tuple[int, int], float]:
    """Return the headings of cross sections where two roads meet, by road and end (0 or -1)."""
    found: dict[tuple[int, int], float] = {}
    across = {number: [*map(_turned, opposite[::-1]), *group] for number, (group, opposite) in plain.items()}
    for number, sides in plain.items():
        for lane in (*sides[0], *sides[1]):
            for name in lane.successors:
                one, two = place[lane.id], place[name]
                if two.road not in plain or (number, one.end) in found or (two.road, two.start) in found:
                    continue
                turns = [0.0 if where.lane < 0 else np.pi for where in (one, two)]
                first = cross_heading(across[number], one.end) + turns[0]
                turn = float(np.angle(np.exp(1j * (cross_heading(across[two.road], two.start) + turns[1] - first))))
                wide = [len(across[k]) > 1 for k in (number, two.road)]
                share = 0.5 if wide[0] == wide[1] else 0.0 if wide[0] else 1.0
                found[number, one.end] = first + share * turn - turns[0]
                found[two.road, two.start] = first + share * turn - turns[1]
    return found
