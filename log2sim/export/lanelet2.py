"""Export of the road to Lanelet2 (OSM XML): lanelets, their borders, stop lines, crosswalks and traffic lights.

`lanelet2_map.osm`, and `map_projector_info.yaml`, with which Autoware takes `local_x` and `local_y` of its nodes. Lanes beside each
other share a way and those behind each other its ends, as routing needs it. Nodes have latitude and longitude; where the place of
the map is not known, they are around 0, 0.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import MapFeatures, MapFrame, MapLane, Marking, RoadBorder, Scenario
from log2sim.export import xml_text
from log2sim.export.exporters import Options, project_points
from log2sim.export.roads.network import MarkFinder
from log2sim.export.roads.opendrive import LIGHT_HEIGHT_M, LIGHT_WIDTH_M, edges_of, lanes, signal_lanes
from log2sim.export.xml_text import element
from log2sim.geometry import Array, Polyline, wrap_angle

SHARED_M = 0.5  # edges whose ends are nearer than this are one way: lanes of log2sim are measured to some decimeters
STOP_M = 8.0  # from a stop line to where its lane ends: across a crosswalk
SIGN_M, SIGN_BOTTOM_M = 0.9, 2.0  # of a usual stop sign
TURN_RAD = float(np.deg2rad(30.0))  # less is straight on
TYPE_OF_MARK = {
    "solid": ("line_thin", "solid"), "broken": ("line_thin", "dashed"), "curb": ("curbstone", "high"), "none": ("virtual", None),
}  # fmt: skip
Way = tuple[str, str]  # of a lane, "left" or "right"
options: tuple[str, ...] = ()
loses = (
    "agents, states of traffic lights, widths of lines, confidences of lanes and markings, arrows; a stop line without a light "
    "gets a stop sign at its right end (`log2sim_assumed`), since Lanelet2 has no stop line by itself; `location` is always urban, and speed limits are not known"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the map."""
    import shapely

    draft = _Draft(scenario.map)
    roads, marks = lanes(scenario), MarkFinder(scenario)
    way_of = _add_borders(draft, roads, marks)
    features = scenario.map_features or MapFeatures()
    stops = [(m, draft.way(m.points_m, type="stop_line")) for m in features.markings if m.kind == "stop_line"]
    rules: dict[str, list[int]] = {lane.id: [] for lane in roads}
    lit: set[int] = set()  # stop lines of lights
    for signal in scenario.signals:
        ahead = signal_lanes(signal, roads)
        # The lower edge of its housing, from the left to the right of who looks at it.
        across = 0.0 if signal.heading_rad is None else signal.heading_rad + np.pi / 2
        side = np.array([np.cos(across), np.sin(across), 0.0]) * LIGHT_WIDTH_M / 2
        bottom = signal.position_m - [0.0, 0.0, LIGHT_HEIGHT_M / 2]
        tags = {
            "subtype": "red_yellow_green",
            "height": f"{LIGHT_HEIGHT_M:g}",
            "log2sim_id": xml_text.escaped(signal.id),
        }
        light = draft.way(np.stack([bottom - side, bottom + side]), type="traffic_light", **tags)
        if not ahead:
            continue
        lines = [number for stop, number in stops if any(_ends_at(lane, stop) for lane in ahead)][:1]
        members = [("way", light, "refers"), *(("way", number, "ref_line") for number in lines)]
        lit |= set(lines)
        rule = draft.relation(members, type="regulatory_element", subtype="traffic_light")
        for lane in ahead:
            rules[lane.id].append(rule)
    for stop, number in stops:
        ahead = [lane for lane in roads if number not in lit and _ends_at(lane, stop)]
        if ahead:
            members = [("way", _add_sign(draft, stop, ahead[0]), "refers"), ("way", number, "ref_line")]
            rule = draft.relation(members, type="regulatory_element", subtype="traffic_sign", log2sim_assumed="yes")
            for lane in ahead:
                rules[lane.id].append(rule)
    for lane in roads:
        members = [("way", way_of[lane.id, side], side) for side in ("left", "right")]
        members += [("relation", rule, "regulatory_element") for rule in rules[lane.id]]
        tags = {"subtype": "road", "location": "urban", "one_way": "yes", "participant:vehicle": "yes"}
        if lane.junction is not None:  # where it leads, as Autoware's signals need it
            heading = Polyline(lane.points_m).heading_rad
            turn = float(wrap_angle(heading[-1] - heading[0]))
            tags["turn_direction"] = "straight" if abs(turn) < TURN_RAD else "left" if turn > 0 else "right"
        draft.relation(members, type="lanelet", **tags, log2sim_id=xml_text.escaped(lane.id))
    for marking in features.markings:
        if marking.kind == "crosswalk":
            # The long sides of the rectangle around it, both in the direction of people.
            outline = shapely.MultiPoint(marking.points_m[:, :2]).minimum_rotated_rectangle.exterior
            ring, z = np.array(outline.coords)[:4], np.full(2, marking.points_m[:, 2].mean())
            if np.hypot(*(ring[1] - ring[0])) < np.hypot(*(ring[2] - ring[1])):
                ring = np.roll(ring, -1, axis=0)
            sides = (np.column_stack([ring[side], z]) for side in ([3, 2], [0, 1]))
            edges = [draft.way(points, type="pedestrian_marking") for points in sides]
            members = [("way", number, side) for number, side in zip(edges, ("left", "right"))]
            tags = {"subtype": "crosswalk", "one_way": "no", "participant:pedestrian": "yes"}
            draft.relation(members, type="lanelet", **tags)
    xml_text.write(draft.document(), folder / "lanelet2_map.osm")
    (folder / "map_projector_info.yaml").write_text("projector_type: Local\n", encoding="utf-8")


class _Draft:
    """Nodes, ways and relations, numbered in one row as Lanelet2 asks for it."""

    def __init__(self, frame: MapFrame) -> None:
        self.frame = frame
        self.places: dict[int, Array] = {}  # nodes, map frame
        self.parts: dict[str, list[Element]] = {"way": [], "relation": []}
        self.ids = itertools.count(1)

    def nodes(self, points_m: Array) -> list[int]:
        """Add a node at each point (N, 3); return their numbers."""
        numbers = [next(self.ids) for _ in points_m]
        self.places |= dict(zip(numbers, points_m))
        return numbers

    def way(self, points: Array | Sequence[int], **tags: str) -> int:
        """Add a way along points (N, 3), or along nodes; return its number."""
        numbers = self.nodes(points) if isinstance(points, np.ndarray) else points
        way = element("way", id=str(next(self.ids)))
        for number in numbers:
            element("nd", way, ref=str(number))
        return self._tagged("way", way, tags)

    def relation(self, members: Sequence[tuple[str, int, str]], **tags: str) -> int:
        """Add a relation of members, each with its kind, number and role; return its number."""
        relation = element("relation", id=str(next(self.ids)))
        for kind, number, role in members:
            element("member", relation, type=kind, ref=str(number), role=role)
        return self._tagged("relation", relation, tags)

    def _tagged(self, kind: str, item: Element, tags: dict[str, str]) -> int:
        _tag(item, tags)
        self.parts[kind].append(item)
        return int(item.attrib["id"])

    def document(self) -> Element:
        """Return all of it, nodes first, with latitude, longitude and height."""
        root = element("osm", version="0.6", generator="log2sim")
        points = np.array(list(self.places.values())).reshape(-1, 3)
        longitude, latitude = project_points(self.frame, points)
        height = points[:, 2] + self.frame.offset_m[2]
        for number, (x, y, _), lat, lon, ele in zip(self.places, points.tolist(), latitude, longitude, height):
            node = element("node", root, id=str(number), lat=f"{lat:.11f}", lon=f"{lon:.11f}")
            _tag(node, {"ele": f"{ele:.4f}", "local_x": f"{x:.4f}", "local_y": f"{y:.4f}"})
        root.extend((*self.parts["way"], *self.parts["relation"]))
        for item in root:
            item.attrib |= {"version": "1", "visible": "true"}
        return root


def _tag(item: Element, tags: dict[str, str]) -> None:
    for key, value in tags.items():
        element("tag", item, k=key, v=value)


def _add_borders(draft: _Draft, roads: Sequence[MapLane], marks: MarkFinder) -> dict[Way, int]:
    """Add the edges of all lanes; return the number of the way at each side of each."""
    edges = {(lane.id, side): edge for lane in roads for side, edge in zip(("left", "right"), edges_of(lane))}
    same: dict[Way, Way] = {}
    for lane in roads:
        for beside, theirs, step in ((lane.left_lane, "right", 1), (lane.opposite, "left", -1)):
            if beside is None or (beside, theirs) not in edges or (beside, theirs) in same:
                continue
            gap = edges[lane.id, "left"][[0, -1]] - edges[beside, theirs][::step][[0, -1]]
            if np.hypot(gap[:, 0], gap[:, 1]).max() <= SHARED_M:
                same[lane.id, "left"] = (beside, theirs)
    number_of = {key: draft.nodes(edge) for key, edge in edges.items() if key not in same}
    # One node where ways meet: which node stands for each, and the middle of all of them.
    stands: dict[int, int] = {}

    def root(number: int) -> int:
        while number in stands:
            number = stands[number]
        return number

    def end(lane: MapLane, side: str, at: int) -> int:
        own = (lane.id, side)
        other = same.get(own, own)
        reversed_ = own != other and other[1] == side
        return number_of[other][-1 - at if reversed_ else at]

    by_id = {lane.id: lane for lane in roads}
    for lane in roads:
        for name in lane.successors:
            for side in ("left", "right"):
                a, b = root(end(lane, side, -1)), root(end(by_id[name], side, 0))
                if a != b:
                    stands[b] = a
    met: dict[int, list[Array]] = {}
    for number in {*stands, *stands.values()}:
        met.setdefault(root(number), []).append(draft.places[number])
    for number, points in met.items():
        draft.places[number] = np.mean(points, axis=0)
    for number in stands:
        del draft.places[number]
    way_of = {}
    for (name, side), numbers in number_of.items():
        border = by_id[name].left if side == "left" else by_id[name].right
        item, mark = marks.items.get(border), marks.mark(border)
        if isinstance(item, RoadBorder) and item.kind == "edge":
            tags = {"type": "road_border"}
        else:
            kind, subtype = TYPE_OF_MARK[mark.kind]
            tags = {"type": kind} | ({"subtype": subtype} if subtype else {})
            tags |= {"color": mark.color} if mark.color in ("white", "yellow") else {}
        way_of[name, side] = draft.way([root(n) for n in numbers], **tags)
    return way_of | {key: way_of[other] for key, other in same.items()}


def _add_sign(draft: _Draft, stop: Marking, lane: MapLane) -> int:
    """Add the stop sign of a stop line as its lower edge, at the end of the line that is to the right of a lane."""
    heading = float(Polyline(lane.points_m).heading_rad[-1])
    right = np.array([np.sin(heading), -np.cos(heading), 0.0])
    end = stop.points_m[-1 if float((stop.points_m[-1] - stop.points_m[0]) @ right) > 0 else 0]
    end = end + np.array([0.0, 0.0, SIGN_BOTTOM_M])
    tags = {"subtype": "stop_sign", "height": f"{SIGN_M:g}", "log2sim_assumed": "yes"}
    return draft.way(np.stack([end, end + SIGN_M * right]), type="traffic_sign", **tags)


def _ends_at(lane: MapLane, stop: Marking) -> bool:
    """Whether a lane ends at a stop line: near it and within its ends."""
    x, y = lane.points_m[-1, :2]
    ends = stop.points_m[[0, -1], :2]
    heading = float(Polyline(lane.points_m).heading_rad[-1])
    along = (ends[:, 0] - x) * np.cos(heading) + (ends[:, 1] - y) * np.sin(heading)
    aside = (ends[:, 1] - y) * np.cos(heading) - (ends[:, 0] - x) * np.sin(heading)
    return bool(np.abs(along.mean()) <= STOP_M and aside.min() <= 0 <= aside.max())
