"""OpenDRIVE 1.7: the roads of a scenario as a file, with crosswalks and traffic lights, checked."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import MapFeatures, MapLane, Marking, Scenario, Signal
from log2sim.errors import ConfigError, ScenarioError
from log2sim.export.exporters import ExportPlacement, geo_reference, near_origin, on_map
from log2sim.export.roads.network import MarkFinder, Road, RoadMark, build_network
from log2sim.export.xml_text import element, escaped, number, read, require_number, write
from log2sim.geometry import Array, Polyline, wrap_angle
from log2sim.road.lane_graph import add_missing_lanes, infer_lanes

STANDING_M = 20.0  # length of the lane under an agent that stands, where nobody moves: its whole vehicle is on it
STANDING_WIDTH_M = 3.5  # of that lane, as of lanes along paths


def lanes(scenario: Scenario) -> tuple[MapLane, ...]:
    """Return the lanes of a scenario: those of its map features, else inferred ones, and more where paths leave them.

    Where no vehicle moves, there is a straight one under the agent that moves farthest.
    """
    features = scenario.map_features or MapFeatures()
    if features.lanes:
        return add_missing_lanes(features.lanes, scenario)
    found, _ = infer_lanes(features.markings, features.borders, scenario)
    if found:
        return found
    vehicles = [a for a in scenario.agents if a.category != "pedestrian"] or list(scenario.agents)
    agent = scenario.ego or max(vehicles, key=lambda a: np.hypot(np.ptp(a.waypoints.x_m), np.ptp(a.waypoints.y_m)))
    w = agent.waypoints
    x, y, yaw = (float(np.mean(v)) for v in (w.x_m, w.y_m, np.unwrap(w.yaw_rad)))
    ground = float(np.mean(w.z_m)) - agent.size_m[2] / 2
    ahead = np.array([-STANDING_M / 2, STANDING_M / 2])
    points = np.column_stack([x + ahead * np.cos(yaw), y + ahead * np.sin(yaw), [ground, ground]])
    width = np.full(2, max(STANDING_WIDTH_M, agent.size_m[1] + 0.8))
    return (MapLane("lane-1", points, width, inferred_from="paths", confidence=0.0),)


def edges_of(lane: MapLane) -> tuple[Array, Array]:
    """Return the left and the right edge (N, 3) of a lane, point by point."""
    heading = Polyline(lane.points_m).heading_rad
    left = np.column_stack([-np.sin(heading), np.cos(heading), np.zeros(len(heading))])
    half = lane.width_m[:, None] / 2
    return lane.points_m + left * half, lane.points_m - left * half


# Lamps face the traffic that they are for; posts beside the road turn them by some degrees towards it.
FACING_RAD = float(np.deg2rad(40.0))
# A light beyond a junction is at most so far from where its lanes end: across six lanes and two sidewalks.
REACH_M = 40.0
ASIDE_M = 12.0  # it is at most so far beside the middle of a lane: three lanes and a sidewalk


def signal_lanes(signal: Signal, lanes: Sequence[MapLane]) -> list[MapLane]:
    """Return the lanes into a junction that lead towards the face of a light; none where its heading is unknown."""
    if signal.heading_rad is None:
        return []
    by_id = {lane.id: lane for lane in lanes}
    found = []
    for lane in lanes:
        inside = [name for name in lane.successors if by_id[name].junction is not None]
        if lane.junction is not None or not inside:
            continue
        heading = float(Polyline(lane.points_m).heading_rad[-1])
        dx, dy = (signal.position_m - lane.points_m[-1])[:2]
        ahead, aside = dx * np.cos(heading) + dy * np.sin(heading), dy * np.cos(heading) - dx * np.sin(heading)
        facing = abs(float(wrap_angle(np.array([signal.heading_rad - heading - np.pi]))[0])) <= FACING_RAD
        if facing and -MARGIN_M <= ahead <= REACH_M and abs(aside) <= ASIDE_M:
            found.append(lane)
    return found


MARGIN_M = 5.0  # lights before the junction stand at the stop line, which may be behind where the lane ends
LIGHT_TYPE = "1000001"  # of a traffic light with three lamps, in the catalog "OpenDRIVE" that players know
LIGHT_HEIGHT_M, LIGHT_WIDTH_M = 0.9, 0.3  # of a signal head with three lamps of 200 mm (EN 12368)
DIGITS = 4
STEP_M = 0.5  # stations at which the nearest point of a road is looked for
MAX_ASIDE_M = 15.0  # crosswalks farther beside a road's reference line belong to another one


def road_objects(
    scenario: Scenario, roads: Sequence[Road]
) -> tuple[dict[int, list[tuple[Marking, float, float]]], dict[int, list[tuple[Signal, MapLane]]]]:
    """Return crosswalks with their stations and offsets, and traffic lights with their lanes, by the number of their road.

    Each crosswalk goes to the road whose reference line is nearest to its middle, each light to the first of its roads.
    """
    crosswalks: dict[int, list[tuple[Marking, float, float]]] = {}
    for marking in scenario.map_features.markings if scenario.map_features is not None else ():
        if marking.kind == "crosswalk":
            mx, my = marking.points_m[:, :2].mean(axis=0)
            places = []  # stations and offsets on the roads, infinite before and after them
            for road in roads:
                stations = np.linspace(0.0, road.line.length_m, max(int(road.line.length_m / STEP_M), 1) + 1)
                x, y, heading = road.line.at(stations).T
                k = int(np.hypot(x - mx, y - my).argmin())
                dx, dy, c, sine = mx - x[k], my - y[k], np.cos(heading[k]), np.sin(heading[k])
                aside = np.inf if abs(dx * c + dy * sine) > STEP_M else float(dy * c - dx * sine)
                places.append((float(stations[k]), aside, road.number))
            s, t, owner = min(places, key=lambda place: abs(place[1]))
            if abs(t) <= MAX_ASIDE_M:
                crosswalks.setdefault(owner, []).append((marking, s, t))
    signals: dict[int, list[tuple[Signal, MapLane]]] = {}
    owners = {lane.id: road.number for road in roads for lane in (*road.lanes, *road.opposite)}
    found = [lane for road in roads for lane in (*road.lanes, *road.opposite)]
    for signal in scenario.signals:
        for lane in signal_lanes(signal, found)[:1]:
            signals.setdefault(owners[lane.id], []).append((signal, lane))
    return crosswalks, signals


def _add_signals(
    parent: Element, road: Road, own: Sequence[tuple[Signal, MapLane]], placement: ExportPlacement
) -> None:
    """Add the traffic lights where the lanes end that they are for: at the end of the road, or for lanes against it at its start."""
    nodes = element("signals", parent) if own else parent
    for signal, lane in own:
        along = any(lane is other for other in road.lanes)
        s = road.line.length_m if along else 0.0
        x, y, heading = road.line.at(np.array([s]))[0]
        dx, dy, height = signal.position_m - [x, y, lane.points_m[-1, 2]]
        aside = float(dy * np.cos(heading) - dx * np.sin(heading))
        node = element(
            "signal", nodes, id=escaped(signal.id), name=escaped(signal.id), s=number(s, DIGITS),
            t=number(aside, DIGITS), dynamic="yes", orientation="+" if along else "-", zOffset=number(float(height), DIGITS),
            country="OpenDRIVE", type=LIGHT_TYPE, subtype="-1", value="-1", height=number(LIGHT_HEIGHT_M, 2),
            width=number(LIGHT_WIDTH_M, 2), hOffset="0", pitch="0", roll="0",
        )  # fmt: skip
        place = {key: number(float(v), DIGITS) for key, v in zip("xyz", signal.position_m - placement.origin_m)}
        element("positionInertial", node, **place, hdg=number(float(signal.heading_rad or 0.0), DIGITS))


# Stations may repeat the sum of lengths with as little as six decimals.
GAP_M = 1e-4


def require_roads(root: Element, where: str) -> None:
    """Raise unless every road has geometry without gaps along s, stations in order and lanes with a width.

    Raises `ScenarioError` that names the file and the road.
    """
    if root.tag != "OpenDRIVE" or root.find("header") is None:
        raise ScenarioError(f"{where}: its root is <{root.tag[:40]}>, expected <OpenDRIVE> with a <header>")
    roads = root.findall("road")
    if not roads:
        raise ScenarioError(f"{where}: has no roads, expected at least one")
    for road in roads:
        here, s, pieces = f"{where}: road '{road.get('id', '')[:40]}'", 0.0, road.findall("planView/geometry")
        for piece in pieces:
            start, length = (require_number(piece.get(key), f"{here}: geometry {key}") for key in ("s", "length"))
            if abs(start - s) > GAP_M or length <= 0:
                wrong = f"geometry at s={start:g} with length {length:g}"
                raise ScenarioError(f"{here}: {wrong}, expected s={s:g} and a positive length")
            s = start + length
        length = require_number(road.get("length"), f"{here}: length")
        if not pieces or abs(length - s) > GAP_M:
            raise ScenarioError(f"{here}: length {length:g}, but its geometry ends at {s:g}")
        for path in ("elevationProfile/elevation", "lanes/laneOffset", "lanes/laneSection"):
            last = -1.0
            for node in road.iterfind(path):
                s = require_number(node.get("s"), f"{here}: {node.tag} s")
                if s <= last:
                    wrong = f"{node.tag} at s={s:g} follows one at s={last:g}"
                    raise ScenarioError(f"{here}: {wrong}, expected stations in order")
                last = s
        sections = road.findall("lanes/laneSection")
        if not sections:
            raise ScenarioError(f"{here}: has no lanes, expected at least one <laneSection>")
        for lane in (lane for s in sections for lane in (*s.iterfind("left/lane"), *s.iterfind("right/lane"))):
            first = lane.find("width") if lane.find("width") is not None else lane.find("border")
            if first is None or require_number(first.get("sOffset"), f"{here}: width sOffset") != 0:
                raise ScenarioError(f"{here}: lane {lane.get('id', '')[:10]} has no width from its start on")


FILE_NAME = "road.xodr"
# Positions to 10 nm and angles to 1e-12 rad: no checker finds a gap between consecutive pieces.
LENGTH_DIGITS, ANGLE_DIGITS, CUBIC_DIGITS = 8, 12, 12
# A map whose nearest road is farther away belongs to another place.
FAR_M = 1000.0


def add_road_file(scenario: Scenario, folder: Path, map_path: Path | None) -> tuple[str, ExportPlacement]:
    """Write the road of a scenario into a folder, or a copy of the user's; return its name and the placement of agents on it.

    Raises `ScenarioError` when the user's file is no OpenDRIVE file that players can use. Raises `ConfigError` when its
    coordinates cannot be brought together with the scenario's.
    """
    if map_path is None:
        placement = near_origin(scenario)
        root = _document(scenario, placement)
        require_roads(root, FILE_NAME)
        write(root, folder / FILE_NAME)
        return FILE_NAME, placement
    root = read(map_path)
    require_roads(root, str(map_path))
    shutil.copyfile(map_path, folder / FILE_NAME)
    offset, turned = root.find("header/offset"), "0"
    values = [0.0, 0.0, 0.0]
    if offset is not None:
        turned = offset.get("hdg", "0")
        values = [require_number(offset.get(key, "0"), f"{map_path}: offset {key}") for key in "xyz"]
    if require_number(turned, f"{map_path}: offset hdg") != 0:
        raise ConfigError(
            f"--map {map_path}: its offset turns the map (hdg={turned[:20]}), which is not supported; use one with hdg=0"
        )
    x, y, z = values
    placement = on_map(scenario.map, (root.findtext("header/geoReference") or "").strip() or None, (x, y, z))
    # Where no agent is near any road the map is of another place, or in other coordinates.
    keys = ("x", "y", "length")
    pieces = root.iter("geometry")
    roads = np.array([[require_number(p.get(key), f"{map_path}: geometry {key}") for key in keys] for p in pieces])
    places = placement.forward(np.array([(a.waypoints.x_m[0], a.waypoints.y_m[0], 0.0, 0.0) for a in scenario.agents]))
    gaps = [(np.hypot(*(roads[:, :2] - place[:2]).T) - roads[:, 2]).min() for place in places]
    if min(gaps) > FAR_M:
        raise ConfigError(
            f"--map {map_path}: its roads are {min(gaps) / 1000:.0f} km away from all agents; is it the map of this place, and do"
            " its geoReference and offset, and the scenario's map, say where they lie?"
        )
    return FILE_NAME, placement


def _document(scenario: Scenario, placement: ExportPlacement) -> Element:
    """Return the OpenDRIVE document of a scenario's roads, with the same origin as the agents."""
    x0, y0, _ = placement.origin_m
    roads, junctions = build_network(lanes(scenario))
    spread = [r.line.at(np.linspace(0.0, r.line.length_m, 50))[:, :2] for r in roads]
    ends = np.concatenate(spread) - [x0, y0]
    (west, south), (east, north) = ends.min(axis=0), ends.max(axis=0)
    root = element("OpenDRIVE")
    header = element(
        "header", root, revMajor="1", revMinor="7", name=escaped(scenario.name), version="1", vendor="log2sim",
        north=number(north), south=number(south), east=number(east), west=number(west),
    )  # fmt: skip
    # The geographic reference: projected coordinates are those of the file plus its offset.
    if scenario.map.projection is not None:
        element("geoReference", header).text = geo_reference(scenario.map.projection)
    x, y, z = (float(a + b) for a, b in zip(scenario.map.offset_m, placement.origin_m))
    if (x, y, z) != (0.0, 0.0, 0.0):
        element("offset", header, x=number(x), y=number(y), z=number(z), hdg="0")
    marks, (crosswalks, signals) = MarkFinder(scenario), road_objects(scenario, roads)
    for road in roads:
        node = _add_road(root, road, placement, marks)
        own = crosswalks.get(road.number, ())
        nodes = element("objects", node) if own else node
        for marking, s, t in own:
            heading = float(road.line.at(np.array([s]))[0, 2])
            gap = marking.points_m[:, :2] - marking.points_m[:, :2].mean(axis=0)
            c, s_ = np.cos(heading), np.sin(heading)
            u, v = gap[:, 0] * c + gap[:, 1] * s_, gap[:, 1] * c - gap[:, 0] * s_
            crossing = element(
                "object", nodes, id=escaped(marking.id), name=escaped(marking.id), type="crosswalk", s=number(s, DIGITS), t=number(t, DIGITS),
                zOffset="0", orientation="none", hdg="0", pitch="0", roll="0", length=number(float(np.ptp(u)), DIGITS),
                width=number(float(np.ptp(v)), DIGITS), height="0",
            )  # fmt: skip
            outline = element("outline", element("outlines", crossing), id="0", closed="true", outer="true")
            for k, (a, b) in enumerate(zip(u.tolist(), v.tolist())):
                element("cornerLocal", outline, u=number(a, DIGITS), v=number(b, DIGITS), z="0", height="0", id=str(k))
        _add_signals(node, road, signals.get(road.number, ()), placement)
    for junction, name in junctions.items():
        parent = element("junction", root, name=escaped(name), id=str(junction), type="default")
        for k, road in enumerate(road for road in roads if road.junction == junction):
            incoming, lane = road.incoming
            node = element(
                "connection", parent, id=str(k), incomingRoad=str(incoming), connectingRoad=str(road.number), contactPoint="start",
            )  # fmt: skip
            element("laneLink", node, **{"from": str(lane), "to": "-1"})
    return root


def _add_road(root: Element, road: Road, placement: ExportPlacement, marks: MarkFinder) -> Element:
    x0, y0, z0 = placement.origin_m
    parent = element(
        "road", root, name=escaped(" ".join(lane.id for lane in (*road.opposite[::-1], *road.lanes))), length=number(road.line.length_m, LENGTH_DIGITS),
        id=str(road.number), junction=str(road.junction or -1), rule="RHT",
    )  # fmt: skip
    links = element("link", parent)
    for tag, link in (("predecessor", road.before), ("successor", road.after)):
        if link is not None:
            there = {"contactPoint": "end" if link.point else "start"} if link.kind == "road" else {}
            element(tag, links, elementType=link.kind, elementId=str(link.number), **there)
    plan = element("planView", parent)
    for s, x, y, heading, length, curvature in road.line.pieces.tolist():
        geometry = element(
            "geometry", plan, s=number(s, LENGTH_DIGITS), x=number(x - x0, LENGTH_DIGITS), y=number(y - y0, LENGTH_DIGITS),
            hdg=number(heading, ANGLE_DIGITS), length=number(length, LENGTH_DIGITS),
        )  # fmt: skip
        shape = {"curvature": number(curvature, ANGLE_DIGITS)} if curvature else {}
        element("arc" if curvature else "line", geometry, **shape)
    profile = element("elevationProfile", parent)
    for s, a, *rest in road.elevation:
        _add_cubic(profile, "elevation", "s", s, [a - z0, *rest])
    element("lateralProfile", parent)
    # Lanes -1, -2, ... to the right of the left edge of the first, and 1, 2, ... to the left of it.
    parts = element("lanes", parent)
    for s, *rest in road.offset:
        _add_cubic(parts, "laneOffset", "s", s, rest)
    section = element("laneSection", parts, s="0")
    if road.opposite:
        left = element("left", section)
        for row in reversed(range(len(road.opposite))):
            _add_lane(left, road, 1 + row, road.opposite[row], road.opposite_widths[row], marks)
    middle = element("lane", element("center", section), id="0", type="none", level="false")
    _add_mark(middle, marks.mark(road.lanes[0].left))
    right = element("right", section)
    for row, (lane, widths) in enumerate(zip(road.lanes, road.widths)):
        _add_lane(right, road, -1 - row, lane, widths, marks)
    return parent


def _add_lane(parent: Element, road: Road, id: int, lane: MapLane, widths: Array, marks: MarkFinder) -> None:
    node = element("lane", parent, id=str(id), type="driving", level="false")
    links = element("link", node)
    for tag, link in (("predecessor", road.before), ("successor", road.after)):
        if link is not None and id in link.lanes:
            element(tag, links, id=str(link.lanes[id]))
    for s, *rest in widths:
        _add_cubic(node, "width", "sOffset", s, rest)
    _add_mark(node, marks.mark(lane.right))


def _add_mark(lane: Element, mark: RoadMark) -> None:
    element(
        "roadMark", lane, sOffset="0", type=mark.kind, weight="standard", color=mark.color, width=number(mark.width_m, 3)
    )  # fmt: skip


def _add_cubic(parent: Element, tag: str, station: str, s: float, coefficients: list[float]) -> None:
    values = {name: number(float(v), CUBIC_DIGITS) for name, v in zip("abcd", coefficients)}
    element(tag, parent, **{station: number(float(s), LENGTH_DIGITS)}, **values)
