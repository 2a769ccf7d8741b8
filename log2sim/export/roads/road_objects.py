"""Crosswalks and traffic lights as objects and signals of OpenDRIVE."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import MapLane, Marking, Scenario, Signal
from log2sim.export.placement import ExportPlacement
from log2sim.export.roads.road import Road
from log2sim.export.roads.signal_lanes import signal_lanes
from log2sim.export.xml_text import element, escaped, number
from log2sim.geometry import Array

LIGHT_TYPE = "1000001"
"""Of a traffic light with three lamps, in the catalog "OpenDRIVE" that players know."""

LIGHT_HEIGHT_M, LIGHT_WIDTH_M = 0.9, 0.3
"""Of a signal head with three lamps of 200 mm (EN 12368)."""

DIGITS = 4

STEP_M = 0.5
"""Stations at which the nearest point of a road is looked for."""

MAX_ASIDE_M = 15.0
"""Crosswalks farther beside a road's reference line belong to another one."""


@dataclass(frozen=True)
class RoadObjects:
    """Crosswalks with their stations and offsets, and traffic lights with their lanes, by the number of the road that names them."""

    crosswalks: Mapping[int, Sequence[tuple[Marking, float, float]]]
    signals: Mapping[int, Sequence[tuple[Signal, MapLane]]]

    @classmethod
    def of(cls, scenario: Scenario, roads: Sequence[Road]) -> RoadObjects:
        """Give each crosswalk to the road whose reference line is nearest to its middle, each light to the first of its roads."""
        crosswalks: dict[int, list[tuple[Marking, float, float]]] = {}
        markings = scenario.map_features.markings if scenario.map_features is not None else ()
        for marking in markings:
            places = [(_place_on(road, marking.points_m[:, :2].mean(axis=0)), road.number) for road in roads]
            if marking.kind == "crosswalk" and places:
                (s, t), number_ = min(places, key=lambda place: abs(place[0][1]))
                if abs(t) <= MAX_ASIDE_M:
                    crosswalks.setdefault(number_, []).append((marking, s, t))
        signals: dict[int, list[tuple[Signal, MapLane]]] = {}
        lanes = [lane for road in roads for lane in (*road.lanes, *road.opposite)]
        for signal in scenario.signals:
            for lane in signal_lanes(signal, lanes)[:1]:
                owner = next(road.number for road in roads if any(lane is o for o in (*road.lanes, *road.opposite)))
                signals.setdefault(owner, []).append((signal, lane))
        return cls(crosswalks, signals)


def _place_on(road: Road, xy_m: Array) -> tuple[float, float]:
    """Return the station and offset of a point (2,) on a road; an infinite offset before and after it."""
    s = np.linspace(0.0, road.line.length_m, max(int(road.line.length_m / STEP_M), 1) + 1)
    x, y, heading = road.line.at(s).T
    k = int(np.hypot(x - xy_m[0], y - xy_m[1]).argmin())
    dx, dy = xy_m[0] - x[k], xy_m[1] - y[k]
    along = dx * np.cos(heading[k]) + dy * np.sin(heading[k])
    beyond = abs(along) > STEP_M
    return float(s[k]), np.inf if beyond else float(dy * np.cos(heading[k]) - dx * np.sin(heading[k]))


def add_objects(parent: Element, road: Road, objects: RoadObjects) -> None:
    """Add the crosswalks of a road."""
    own = objects.crosswalks.get(road.number, ())
    nodes = element("objects", parent) if own else parent
    for marking, s, t in own:
        heading = float(road.line.at(np.array([s]))[0, 2])
        _add_crosswalk(nodes, marking, (s, t, heading))


def _add_crosswalk(parent: Element, marking: Marking, place: tuple[float, float, float]) -> None:
    s, t, heading = place
    middle = marking.points_m.mean(axis=0)
    gap = marking.points_m[:, :2] - middle[:2]
    u, v = (
        gap[:, 0] * np.cos(heading) + gap[:, 1] * np.sin(heading),
        gap[:, 1] * np.cos(heading) - gap[:, 0] * np.sin(heading),
    )
    node = element(
        "object", parent, id=escaped(marking.id), name=escaped(marking.id), type="crosswalk", s=number(s, DIGITS), t=number(t, DIGITS),
        zOffset="0", orientation="none", hdg="0", pitch="0", roll="0", length=number(float(np.ptp(u)), DIGITS),
        width=number(float(np.ptp(v)), DIGITS), height="0",
    )  # fmt: skip
    outline = element("outline", element("outlines", node), id="0", closed="true", outer="true")
    for k, (a, b) in enumerate(zip(u, v)):
        element(
            "cornerLocal", outline, u=number(float(a), DIGITS), v=number(float(b), DIGITS), z="0", height="0", id=str(k)
        )


def add_signals(parent: Element, road: Road, objects: RoadObjects, placement: ExportPlacement) -> None:
    """Add the traffic lights where the lanes end that they are for: at the end of the road, or for lanes against it at its start."""
    own = objects.signals.get(road.number, ())
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
        at = signal.position_m - placement.origin_m
        place = {key: number(float(v), DIGITS) for key, v in zip("xyz", at)}
        element("positionInertial", node, **place, hdg=number(float(signal.heading_rad or 0.0), DIGITS))
