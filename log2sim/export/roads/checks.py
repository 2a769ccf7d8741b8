"""Checks of road networks: what players rely on and checkers of OpenDRIVE miss."""

from __future__ import annotations

from xml.etree.ElementTree import Element

from log2sim.errors import ScenarioError
from log2sim.export.xml_text import require_number

# Stations may repeat the sum of lengths with as little as six decimals.
GAP_M = 1e-4


def require_roads(root: Element, where: str) -> None:
    """Raise unless every road has geometry without gaps along s, stations in order and lanes with a width.

    Raises
    ------
    ScenarioError
        Naming the file and the road.
    """
    if root.tag != "OpenDRIVE" or root.find("header") is None:
        raise ScenarioError(f"{where}: its root is <{root.tag[:40]}>, expected <OpenDRIVE> with a <header>")
    roads = root.findall("road")
    if not roads:
        raise ScenarioError(f"{where}: has no roads, expected at least one")
    for road in roads:
        _require_geometry(road, f"{where}: road '{road.get('id', '')[:40]}'")
        _require_order(road, f"{where}: road '{road.get('id', '')[:40]}'")
        _require_widths(road, f"{where}: road '{road.get('id', '')[:40]}'")


def _require_geometry(road: Element, where: str) -> None:
    s = 0.0
    pieces = road.findall("planView/geometry")
    for piece in pieces:
        start, length = (require_number(piece.get(key), f"{where}: geometry {key}") for key in ("s", "length"))
        if abs(start - s) > GAP_M or length <= 0:
            raise ScenarioError(
                f"{where}: geometry at s={start:g} with length {length:g}, expected s={s:g} and a positive length"
            )
        s = start + length
    length = require_number(road.get("length"), f"{where}: length")
    if not pieces or abs(length - s) > GAP_M:
        raise ScenarioError(f"{where}: length {length:g}, but its geometry ends at {s:g}")


def _require_order(road: Element, where: str) -> None:
    for path in ("elevationProfile/elevation", "lanes/laneOffset", "lanes/laneSection"):
        last = -1.0
        for node in road.iterfind(path):
            s = require_number(node.get("s"), f"{where}: {node.tag} s")
            if s <= last:
                raise ScenarioError(
                    f"{where}: {node.tag} at s={s:g} follows one at s={last:g}, expected stations in order"
                )
            last = s


def _require_widths(road: Element, where: str) -> None:
    sections = road.findall("lanes/laneSection")
    if not sections:
        raise ScenarioError(f"{where}: has no lanes, expected at least one <laneSection>")
    for section in sections:
        for lane in (*section.iterfind("left/lane"), *section.iterfind("right/lane")):
            first = lane.find("width") if lane.find("width") is not None else lane.find("border")
            if first is None or require_number(first.get("sOffset"), f"{where}: width sOffset") != 0:
                raise ScenarioError(f"{where}: lane {lane.get('id', '')[:10]} has no width from its start on")
