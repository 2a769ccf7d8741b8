"""OpenDRIVE 1.7: the roads of a scenario as a file, or the user's own file in their place."""

from __future__ import annotations

import shutil
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import MapFrame, MapLane, Scenario
from log2sim.errors import ConfigError
from log2sim.export.placement import ExportPlacement, geo_reference, near_origin, on_map
from log2sim.export.roads.checks import require_roads
from log2sim.export.roads.lanes import lanes
from log2sim.export.roads.marks import MarkFinder, RoadMark
from log2sim.export.roads.network import Network, build_network
from log2sim.export.roads.road import Road
from log2sim.export.roads.road_objects import RoadObjects, add_objects, add_signals
from log2sim.export.xml_text import element, escaped, number, read, require_number, write
from log2sim.geometry import Array

FILE_NAME = "road.xodr"
# Positions to 10 nm and angles to 1e-12 rad: no checker finds a gap between consecutive pieces.
LENGTH_DIGITS, ANGLE_DIGITS, CUBIC_DIGITS = 8, 12, 12
# A map whose nearest road is farther away belongs to another place.
FAR_M = 1000.0


def add_road_file(scenario: Scenario, folder: Path, map_path: Path | None) -> tuple[str, ExportPlacement]:
    """Write the road of a scenario into a folder, or a copy of the user's; return its name and the placement of agents on it.

    Raises
    ------
    ScenarioError
        When the user's file is no OpenDRIVE file that players can use.
    ConfigError
        When its coordinates cannot be brought together with the scenario's.
    """
    if map_path is None:
        placement = near_origin(scenario)
        root = document(scenario, placement)
        require_roads(root, FILE_NAME)
        write(root, folder / FILE_NAME)
        return FILE_NAME, placement
    root = read(map_path)
    require_roads(root, str(map_path))
    shutil.copyfile(map_path, folder / FILE_NAME)
    return FILE_NAME, _placement_on(root, scenario, map_path)


def _placement_on(root: Element, scenario: Scenario, map_path: Path) -> ExportPlacement:
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
    _require_near(root, scenario, placement, map_path)
    return placement


def _require_near(root: Element, scenario: Scenario, placement: ExportPlacement, map_path: Path) -> None:
    """Raise when no agent is near any road: the map is of another place, or in other coordinates."""
    pieces = list(root.iter("geometry"))
    roads = np.array(
        [[require_number(p.get(key), f"{map_path}: geometry {key}") for key in ("x", "y", "length")] for p in pieces]
    )
    firsts = [(a.waypoints.x_m[0], a.waypoints.y_m[0], 0.0, 0.0) for a in scenario.agents]
    gaps = [
        (np.hypot(*(roads[:, :2] - state[:2]).T) - roads[:, 2]).min() for state in placement.forward(np.array(firsts))
    ]
    if min(gaps) > FAR_M:
        raise ConfigError(
            f"--map {map_path}: its roads are {min(gaps) / 1000:.0f} km away from all agents; is it the map of this place, and do"
            " its geoReference and offset, and the scenario's map, say where they lie?"
        )


def document(scenario: Scenario, placement: ExportPlacement) -> Element:
    """Return the OpenDRIVE document of a scenario's roads, with the same origin as the agents."""
    x0, y0, _ = placement.origin_m
    network = build_network(lanes(scenario))
    spread = [r.line.at(np.linspace(0.0, r.line.length_m, 50))[:, :2] for r in network.roads]
    ends = np.concatenate(spread) - [x0, y0]
    (west, south), (east, north) = ends.min(axis=0), ends.max(axis=0)
    root = element("OpenDRIVE")
    header = element(
        "header", root, revMajor="1", revMinor="7", name=escaped(scenario.name), version="1", vendor="log2sim",
        north=number(north), south=number(south), east=number(east), west=number(west),
    )  # fmt: skip
    _add_place(header, scenario.map, placement)
    marks, objects = MarkFinder.of(scenario), RoadObjects.of(scenario, network.roads)
    for road in network.roads:
        node = _add_road(root, road, placement, marks)
        add_objects(node, road, objects)
        add_signals(node, road, objects, placement)
    for junction, name in network.junctions.items():
        _add_junction(root, junction, name, network)
    return root


def _add_place(header: Element, frame: MapFrame, placement: ExportPlacement) -> None:
    """Add the geographic reference: projected coordinates are those of the file plus its offset."""
    if frame.projection is not None:
        element("geoReference", header).text = geo_reference(frame.projection)
    x, y, z = (float(a + b) for a, b in zip(frame.offset_m, placement.origin_m))
    if (x, y, z) != (0.0, 0.0, 0.0):
        element("offset", header, x=number(x), y=number(y), z=number(z), hdg="0")


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
    for piece in road.line.pieces:
        geometry = element(
            "geometry", plan, s=number(piece.s_m, LENGTH_DIGITS), x=number(piece.x_m - x0, LENGTH_DIGITS),
            y=number(piece.y_m - y0, LENGTH_DIGITS), hdg=number(piece.heading_rad, ANGLE_DIGITS), length=number(piece.length_m, LENGTH_DIGITS),
        )  # fmt: skip
        if piece.curvature_1pm == 0:
            element("line", geometry)
        else:
            element("arc", geometry, curvature=number(piece.curvature_1pm, ANGLE_DIGITS))
    profile = element("elevationProfile", parent)
    for s, a, *rest in road.elevation:
        _add_cubic(profile, "elevation", "s", s, [a - z0, *rest])
    element("lateralProfile", parent)
    _add_lanes(parent, road, marks)
    return parent


def _add_lanes(parent: Element, road: Road, marks: MarkFinder) -> None:
    """Add lanes -1, -2, ... to the right of the left edge of the first, and 1, 2, ... to the left of it."""
    parts = element("lanes", parent)
    for s, *rest in road.offset:
        _add_cubic(parts, "laneOffset", "s", s, rest)
    section = element("laneSection", parts, s="0")
    if road.opposite:
        left = element("left", section)
        for row in reversed(range(len(road.opposite))):
            _add_lane(left, road, 1 + row, road.opposite[row], road.opposite_widths[row], marks)
    middle = element("lane", element("center", section), id="0", type="none", level="false")
    _add_mark(middle, marks.left_of(road.lanes[0]))
    right = element("right", section)
    for row, (lane, widths) in enumerate(zip(road.lanes, road.widths)):
        _add_lane(right, road, -1 - row, lane, widths, marks)


def _add_lane(parent: Element, road: Road, id: int, lane: MapLane, widths: Array, marks: MarkFinder) -> None:
    node = element("lane", parent, id=str(id), type="driving", level="false")
    links = element("link", node)
    for tag, link in (("predecessor", road.before), ("successor", road.after)):
        if link is not None and id in link.lanes:
            element(tag, links, id=str(link.lanes[id]))
    for s, *rest in widths:
        _add_cubic(node, "width", "sOffset", s, rest)
    _add_mark(node, marks.right_of(lane))


def _add_mark(lane: Element, mark: RoadMark) -> None:
    element(
        "roadMark", lane, sOffset="0", type=mark.kind, weight="standard", color=mark.color, width=number(mark.width_m, 3)
    )  # fmt: skip


def _add_junction(root: Element, junction: int, name: str, network: Network) -> None:
    parent = element("junction", root, name=escaped(name), id=str(junction), type="default")
    for k, connection in enumerate(c for c in network.connections if c.junction == junction):
        node = element(
            "connection", parent, id=str(k), incomingRoad=str(connection.incoming),
            connectingRoad=str(connection.connecting), contactPoint="start",
        )  # fmt: skip
        element("laneLink", node, **{"from": str(connection.lane), "to": "-1"})


def _add_cubic(parent: Element, tag: str, station: str, s: float, coefficients: list[float]) -> None:
    values = {name: number(float(v), CUBIC_DIGITS) for name, v in zip("abcd", coefficients)}
    element(tag, parent, **{station: number(float(s), LENGTH_DIGITS)}, **values)
