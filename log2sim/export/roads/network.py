"""Roads of OpenDRIVE out of lanes: those side by side become one road, those of a junction its connecting roads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from log2sim.datatypes import MapLane
from log2sim.export.roads.road import Link, Road, connecting_road, cross_heading, road_of_lanes
from log2sim.lanes.graph.polyline import Polyline

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
