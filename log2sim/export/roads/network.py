"""Roads of OpenDRIVE out of lanes: those next to each other become one road."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from log2sim.datatypes import MapLane, Marking, RoadBorder, Scenario
from log2sim.export.roads.reference_line import ReferenceLine, fit
from log2sim.geometry import Array
from log2sim.road.polyline import Polyline

LEVEL_M = 5.0
"""Length over which heights are averaged against their noise."""

EXACT_M = 0.002
"""How far widths between stations may be from what is written."""


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
    return _merged_cubics(np.column_stack([s[:-1], a, b, c, d]))


def _merged_cubics(rows: Array) -> Array:
    """Drop cubics (K, 5) that only continue the one before, which checkers call redundant."""
    kept = [rows[0]]
    for row in rows[1:]:
        s, a, b, c, d = kept[-1]
        h = row[0] - s
        goes_on = [a + h * (b + h * (c + h * d)), b + h * (2 * c + 3 * h * d), c + 3 * h * d, d]
        if np.abs(row[1:] - goes_on).max() > 2e-6:
            kept.append(row)
    return np.array(kept)


USUAL_WIDTH_M = 0.12
"""Of lane lines: 12 cm on most roads (RMS 1993)."""


@dataclass(frozen=True)
class RoadMark:
    """A mark at the edge of a lane: its kind, "solid", "broken", "curb" or "none", color and width."""

    kind: str
    color: str = "standard"
    width_m: float = USUAL_WIDTH_M


@dataclass(frozen=True)
class MarkFinder:
    """Finds the marks at the edges of lanes among markings and borders by their ids."""

    sides: Mapping[str, Marking | RoadBorder]

    @classmethod
    def of(cls, scenario: Scenario) -> MarkFinder:
        """Collect the markings and borders of a scenario."""
        features = scenario.map_features
        found: dict[str, Marking | RoadBorder] = {}
        if features is not None:
            found |= {marking.id: marking for marking in features.markings}
            found |= {border.id: border for border in features.borders}
        return cls(found)

    def left_of(self, lane: MapLane) -> RoadMark:
        """Return the mark at the left edge of a lane."""
        return self._mark(lane.left)

    def right_of(self, lane: MapLane) -> RoadMark:
        """Return the mark at the right edge of a lane."""
        return self._mark(lane.right)

    def _mark(self, name: str | None) -> RoadMark:
        item = self.sides.get(name) if name is not None else None
        if isinstance(item, RoadBorder):
            return RoadMark("curb") if item.kind == "curb" else RoadMark("none")
        if item is None:
            return RoadMark("none")
        return RoadMark("broken" if item.kind == "dashed" else "solid", item.color or "standard", item.width_m)


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
    """

    kind: str
    number: int
    lanes: Mapping[int, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Road:
    """A road whose lanes all lead along its reference line, which is the middle of one of them.

    Attributes
    ----------
    number : int
        Its id.
    lanes : tuple of MapLane
        From the left to the right: lane -1, -2, ...
    elevation, offset : (K, 5) float64
        Stations and coefficients a, b, c, d of cubics: the height, and how far the left edge of lane -1 is left of the line.
    widths : tuple of (K, 5) float64
        Of the lanes.
    """

    number: int
    lanes: tuple[MapLane, ...]
    line: ReferenceLine
    elevation: Array
    offset: Array
    widths: tuple[Array, ...]
    junction: int | None = None
    before: Link | None = None
    after: Link | None = None


def road_of_lanes(
    number: int, group: Sequence[MapLane], headings: tuple[float | None, float | None], free: tuple[bool, bool]
) -> tuple[Road, dict[tuple[str, int], End]]:
    """Return a road of lanes side by side, and the ends of its lanes."""
    base = _base(group)
    turned = [cross_heading(group, at) if h is None else h for at, h in zip((0, -1), headings)]
    poses = [None if f else np.array([*p[:2], h]) for f, p, h in zip(free, base.points_m[[0, -1]], turned)]
    line, stations = fit(base.points_m[:, :2], poses[0], poses[1])
    s = _width_stations(line)
    edges = _edges(group, base, line.at(s))
    ends = {}
    for at in (0, -1):
        x, y, z = base.points_m[at]
        heading = turned[at] if not free[at] else float(line.at(np.array([0.0, line.length_m]))[at, 2])
        for row, lane in enumerate(group):
            middle, width = edges[row : row + 2, at].mean(), edges[row, at] - edges[row + 1, at]
            pose = np.array([x - middle * np.sin(heading), y + middle * np.cos(heading), z, heading])
            ends[lane.id, at] = End(pose, float(width))
    before, after = (EXTENSION_M if f else 0.0 for f in free)
    line = line.extended(before, after)
    stations = stations + before
    at_m = s + before
    widths = tuple(cubics_through(at_m, edges[row] - edges[row + 1]) for row in range(len(group)))
    elevation = elevation_profile(stations, base.points_m[:, 2], line.length_m)
    return Road(number, tuple(group), line, elevation, cubics_through(at_m, edges[0]), widths), ends


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


def _base(group: Sequence[MapLane]) -> MapLane:
    """Return the lane whose middle is the reference line: the surest."""
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


ALIGNED_M = 0.3
"""Lanes side by side whose ends are farther apart along the road than this are roads of their own."""


@dataclass(frozen=True)
class Connection:
    """A connecting road of a junction."""

    junction: int
    incoming: int
    connecting: int
    lane: int


@dataclass(frozen=True, eq=False)
class Network:
    """Roads and the junctions between them, by their ids and names."""

    roads: tuple[Road, ...]
    junctions: Mapping[int, str]
    connections: tuple[Connection, ...]


def build_network(lanes: Sequence[MapLane]) -> Network:
    """Return the roads that lanes form, linked where it is clear which follows which, and by junctions elsewhere."""
    by_id = {lane.id: lane for lane in lanes}
    crossing = {lane.id for lane in lanes if _is_connection(lane, by_id)}
    groups = _groups([lane for lane in lanes if lane.id not in crossing], by_id)
    place = {lane.id: (k + 1, -1 - row) for k, group in enumerate(groups) for row, lane in enumerate(group)}
    place |= {name: (len(groups) + k + 1, -1) for k, name in enumerate(sorted(crossing, key=list(by_id).index))}
    names = list(dict.fromkeys(str(by_id[name].junction) for name in by_id if name in crossing))
    number_of = {name: len(place) + k + 1 for k, name in enumerate(names)}
    plain = {k + 1: group for k, group in enumerate(groups)}
    headings = _shared_headings(plain, place, by_id)
    roads, ends = [], {}
    for number, group in plain.items():
        before, after = (_link(group, place, by_id, number_of, way) for way in ("predecessors", "successors"))
        road, own = road_of_lanes(
            number, group, (headings.get((number, 0)), headings.get((number, -1))), (before is None, after is None)
        )
        roads.append(replace(road, before=before, after=after))
        ends.update(own)
    connections = []
    for name in sorted(crossing, key=list(by_id).index):
        lane = by_id[name]
        origin, target = lane.predecessors[0], lane.successors[0]
        road = connecting_road(place[name][0], lane, ends[origin, -1], ends[target, 0])
        links = [Link("road", place[other][0], {-1: place[other][1]}) for other in (origin, target)]
        junction = number_of[str(lane.junction)]
        roads.append(replace(road, junction=junction, before=links[0], after=links[1]))
        connections.append(Connection(junction, place[origin][0], road.number, place[origin][1]))
    return Network(tuple(roads), {number: name for name, number in number_of.items()}, tuple(connections))


def _is_connection(lane: MapLane, by_id: Mapping[str, MapLane]) -> bool:
    """Whether a lane of a junction leads from one lane outside to another."""
    if lane.junction is None or len(lane.predecessors) != 1 or len(lane.successors) != 1:
        return False
    return all(by_id[name].junction is None for name in (*lane.predecessors, *lane.successors))


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
                if name is None or name not in known or name in taken or not _aligned(edge, by_id[name]):
                    break
                group.insert(0 if side == "left_lane" else len(group), by_id[name])
        seen |= {member.id for member in group}
        found.append(group)
    return found


def _aligned(one: MapLane, two: MapLane) -> bool:
    """Whether two lanes begin and end at the same line across the road."""
    for at in (0, -1):
        heading = Polyline(one.points_m).heading_rad[at]
        gap = two.points_m[at] - one.points_m[at]
        if abs(gap[0] * np.cos(heading) + gap[1] * np.sin(heading)) > ALIGNED_M:
            return False
    return True


def _link(
    group: Sequence[MapLane],
    place: Mapping[str, tuple[int, int]],
    by_id: Mapping[str, MapLane],
    number_of: Mapping[str, int],
    way: str,
) -> Link | None:
    """Return what follows a road: a junction, the one road to which its lanes go on and from which no other comes, or None."""
    back = "successors" if way == "predecessors" else "predecessors"
    names = [(lane, name) for lane in group for name in getattr(lane, way)]
    for _, name in names:
        junction = by_id[name].junction
        if _is_connection(by_id[name], by_id):
            return Link("junction", number_of[str(junction)])
    roads = {place[name][0] for _, name in names}
    if (
        len(roads) != 1
        or len({lane.id for lane, _ in names}) < len(names)
        or len({name for _, name in names}) < len(names)
    ):
        return None
    (number,) = roads
    others = [lane for name, lane in by_id.items() if place[name][0] == number]
    sources = {place[name][0] for lane in others for name in getattr(lane, back)}
    if sources != {place[group[0].id][0]} or any(len(getattr(lane, back)) > 1 for lane in others):
        return None
    return Link("road", number, {place[lane.id][1]: place[name][1] for lane, name in names})


def _shared_headings(
    plain: Mapping[int, Sequence[MapLane]], place: Mapping[str, tuple[int, int]], by_id: Mapping[str, MapLane]
) -> dict[tuple[int, int], float]:
    """Return the headings of cross sections where two roads meet, by road and end (0 or -1)."""
    found: dict[tuple[int, int], float] = {}
    for number, group in plain.items():
        for lane in group:
            for name in lane.successors:
                if by_id[name].junction is not None or (number, -1) in found:
                    continue
                other = place[name][0]
                one, two = cross_heading(group, -1), cross_heading(plain[other], 0)
                turn = float(np.angle(np.exp(1j * (two - one))))
                share = 0.5 if (len(group) > 1) == (len(plain[other]) > 1) else 0.0 if len(group) > 1 else 1.0
                found[number, -1] = found[other, 0] = one + share * turn
    return found
