"""Roads of OpenDRIVE out of lanes: those side by side become one road, those of a junction its connecting roads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from log2sim.datatypes import MapLane
from log2sim.export.roads.cutting import ALIGNED_M, cut_together, is_connection
from log2sim.export.roads.road import Link, Road, connecting_road, cross_heading, road_of_lanes, surest, turned
from log2sim.lanes.graph.polyline import Polyline


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


@dataclass(frozen=True)
class _Place:
    """Where a lane is: in which road, as which lane of it, and whether it leads along it."""

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


def build_network(lanes: Sequence[MapLane]) -> Network:
    """Return the roads that lanes form, linked where it is clear which follows which, and by junctions elsewhere."""
    refused: set[frozenset[str]] = set()
    while True:
        parts = cut_together(lanes, refused)
        by_id = {lane.id: lane for lane in parts}
        crossing = {lane.id for lane in parts if is_connection(lane, by_id)}
        sides = _with_opposites(_groups([lane for lane in parts if lane.id not in crossing], by_id))
        plain = {k + 1: pair for k, pair in enumerate(sides)}
        place = {}
        for number, (group, opposite) in plain.items():
            place |= {lane.id: _Place(number, -1 - row) for row, lane in enumerate(group)}
            place |= {lane.id: _Place(number, 1 + row) for row, lane in enumerate(opposite)}
        torn = _torn(plain, place, crossing) - refused
        if not torn:
            break
        refused |= torn
    inside = sorted(crossing, key=list(by_id).index)
    place |= {name: _Place(len(plain) + k + 1, -1) for k, name in enumerate(inside)}
    names = list(dict.fromkeys(str(by_id[name].junction) for name in inside))
    number_of = {name: len(place) + k + 1 for k, name in enumerate(names)}
    headings = _shared_headings(plain, place, by_id)
    roads, ends = [], {}
    for number, (group, opposite) in plain.items():
        before, after = (_link([*group, *opposite], place, by_id, number_of, at) for at in (0, -1))
        road, own = road_of_lanes(
            number,
            group,
            opposite,
            (headings.get((number, 0)), headings.get((number, -1))),
            (before is None, after is None),
        )
        roads.append(replace(road, before=before, after=after))
        ends.update(own)
    connections = []
    for name in inside:
        lane = by_id[name]
        origin, target = lane.predecessors[0], lane.successors[0]
        one, two = place[origin], place[target]
        road = connecting_road(place[name].road, lane, ends[origin, -1], ends[target, 0])
        before, after = (
            Link("road", one.road, {-1: one.lane}, one.end),
            Link("road", two.road, {-1: two.lane}, two.start),
        )
        junction = number_of[str(lane.junction)]
        roads.append(replace(road, junction=junction, before=before, after=after))
        connections.append(Connection(junction, one.road, road.number, one.lane))
    return Network(tuple(roads), {number: name for name, number in number_of.items()}, tuple(connections))


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


def _with_opposites(groups: Sequence[list[MapLane]]) -> list[tuple[list[MapLane], list[MapLane]]]:
    """Join groups whose leftmost lanes lead opposite ways, each to the left of the other; the surest lane leads along the road."""
    by_left = {group[0].id: group for group in groups}
    found: list[tuple[list[MapLane], list[MapLane]]] = []
    taken: set[str] = set()
    for group in groups:
        if group[0].id in taken:
            continue
        other = by_left.get(str(group[0].opposite), [])
        if other and not (other[0].opposite == group[0].id and _faces(group[0], turned(other[0]))):
            other = []
        taken |= {side[0].id for side in (group, other) if side}
        found.append((group, other) if surest([*group, *other]) in group else (other, group))
    return found


def _faces(lane: MapLane, other: MapLane) -> bool:
    """Whether another lane begins and ends with a lane, to the left of it."""
    heading = float(Polyline(lane.points_m).heading_rad[0])
    gap = other.points_m[0] - lane.points_m[0]
    return bool(gap[1] * np.cos(heading) > gap[0] * np.sin(heading)) and _aligned(lane, other)


def _torn(
    plain: Mapping[int, tuple[Sequence[MapLane], Sequence[MapLane]]], place: Mapping[str, _Place], crossing: Set[str]
) -> set[frozenset[str]]:
    """Return pairs of lanes that share a road, by their names before cuts, and at one end of it go on in different roads.

    A road has one neighbor at each end, so that such lanes would lose their links.
    """
    found: set[frozenset[str]] = set()
    for group, opposite in plain.values():
        across = [*opposite[::-1], *group]
        for at in (0, -1):
            reached: dict[str, set[int | None]] = {lane.id: set() for lane in across}
            for lane, name in _linked(across, place, at):
                reached[lane.id].add(None if name in crossing else place[name].road)
            linked = [lane for lane in across if reached[lane.id]]
            for one, two in pairwise(linked):
                if reached[one.id] != reached[two.id]:
                    found |= {frozenset(n.id.partition("/")[0] for n in pair) for pair in pairwise(across)}
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
    there = {(place[name].road, _met_at(lane, name, place, at)) for lane, name in names}
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
    return [
        (lane, name) for lane in group for name in (lane.successors if place[lane.id].end == at else lane.predecessors)
    ]


def _met_at(lane: MapLane, name: str, place: Mapping[str, _Place], at: int) -> int:
    """Return at which end, 0 or -1, of its road a lane adjoins another one whose road meets it at `at`."""
    return place[name].start if place[lane.id].end == at else place[name].end


def _shared_headings(
    plain: Mapping[int, tuple[Sequence[MapLane], Sequence[MapLane]]],
    place: Mapping[str, _Place],
    by_id: Mapping[str, MapLane],
) -> dict[tuple[int, int], float]:
    """Return the headings of cross sections where two roads meet, by road and end (0 or -1)."""
    found: dict[tuple[int, int], float] = {}
    across = {number: [*map(turned, opposite[::-1]), *group] for number, (group, opposite) in plain.items()}
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
