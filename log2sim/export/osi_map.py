"""Lanes, lane boundaries, road markings and traffic lights of ASAM OSI."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import MapFeatures, MapLane, Scenario
from log2sim.export.roads.lanes import edges_of, lanes
from log2sim.export.roads.marks import MarkFinder, RoadMark
from log2sim.geometry import Array

LIGHT_SIZE_M = (0.3, 0.3, 0.9)
"""Length, width and height of a signal head with three lamps of 200 mm (EN 12368); not measured."""

BOUNDARY_TYPE = {"solid": "SOLID_LINE", "broken": "DASHED_LINE", "curb": "CURB", "none": "NO_LINE"}
BOUNDARY_COLOR = {"white": "WHITE", "yellow": "YELLOW", "standard": "UNKNOWN"}
LIGHT = {
    "red": ("RED", "CONSTANT"), "red_yellow": ("YELLOW", "CONSTANT"), "yellow": ("YELLOW", "CONSTANT"), "green": ("GREEN", "CONSTANT"),
    "off": ("UNKNOWN", "OFF"), "unknown": ("UNKNOWN", "UNKNOWN"),
}  # fmt: skip
"""Color and mode by state; OSI has one lamp a light, so that red with yellow is written as yellow."""


@dataclass(frozen=True, eq=False)
class StaticMap:
    """What every frame repeats: messages of OSI, and the first id that is free."""

    lanes: list[Any]
    boundaries: list[Any]
    markings: list[Any]
    next_id: int


def static_map(osi: Any, scenario: Scenario, first: int) -> StaticMap:
    """Return the lanes of a scenario with their boundaries, and markings that are no lines, numbered from `first` on."""
    found = lanes(scenario)
    marks = MarkFinder.of(scenario)
    number_of = {lane.id: first + k for k, lane in enumerate(found)}
    boundaries, messages = [], []
    for k, lane in enumerate(found):
        sides = [first + len(found) + 2 * k + side for side in (0, 1)]
        for number, points, mark in zip(sides, edges_of(lane), (marks.left_of(lane), marks.right_of(lane))):
            boundaries.append(_boundary(osi, number, points, mark))
        messages.append(_lane(osi, lane, number_of, sides))
    free = first + 3 * len(found)
    features = scenario.map_features or MapFeatures()
    others = [marking for marking in features.markings if not marking.is_lane_line]
    painted = [_marking(osi, free + k, marking.points_m, marking.color) for k, marking in enumerate(others)]
    return StaticMap(messages, boundaries, painted, free + len(painted))


def _points(osi: Any, points: Array) -> list[Any]:
    return [osi.Vector3d(x=x, y=y, z=z) for x, y, z in points.tolist()]


def _boundary(osi: Any, number: int, points: Array, mark: RoadMark) -> Any:
    kind = osi.LaneBoundary.Classification
    return osi.LaneBoundary(
        id=osi.Identifier(value=number),
        boundary_line=[osi.LaneBoundary.BoundaryPoint(position=p, width=mark.width_m) for p in _points(osi, points)],
        classification=kind(type=kind.Type[BOUNDARY_TYPE[mark.kind]], color=kind.Color[BOUNDARY_COLOR[mark.color]]),
    )


def _lane(osi: Any, lane: MapLane, number_of: dict[str, int], sides: Sequence[int]) -> Any:
    kind = osi.Lane.Classification
    inside = lane.junction is not None
    before, after = ([number_of[name] for name in names] for names in (lane.predecessors, lane.successors))
    open_end: list[int | None] = [None]
    pairs = [(a, b) for a in before or open_end for b in after or open_end if before or after]
    beside = [
        [] if name is None else [osi.Identifier(value=number_of[name])] for name in (lane.left_lane, lane.right_lane)
    ]
    return osi.Lane(
        id=osi.Identifier(value=number_of[lane.id]),
        classification=kind(
            type=kind.Type.INTERSECTION if inside else kind.Type.DRIVING,
            subtype=kind.Subtype.UNKNOWN if inside else kind.Subtype.NORMAL,
            centerline=_points(osi, lane.points_m),
            centerline_is_driving_direction=True,
            left_adjacent_lane_id=beside[0],
            right_adjacent_lane_id=beside[1],
            lane_pairing=[_pairing(osi, a, b) for a, b in pairs],
            left_lane_boundary_id=[osi.Identifier(value=sides[0])],
            right_lane_boundary_id=[osi.Identifier(value=sides[1])],
        ),
        source_reference=[osi.ExternalReference(type="io.log2sim.lane", identifier=[lane.id, lane.inferred_from])],
    )


def _pairing(osi: Any, before: int | None, after: int | None) -> Any:
    ends = {"antecessor_lane_id": before, "successor_lane_id": after}
    known = {key: osi.Identifier(value=number) for key, number in ends.items() if number is not None}
    return osi.Lane.Classification.LanePairing(**known)


def _marking(osi: Any, number: int, points: Array, color: str | None) -> Any:
    kind = osi.RoadMarking.Classification
    low, high = points.min(axis=0), points.max(axis=0)
    x, y, z = ((low + high) / 2).tolist()
    length, width, _ = (high - low).tolist()
    paint = {"white": kind.Color.WHITE, "yellow": kind.Color.YELLOW}.get(color or "", kind.Color.UNKNOWN)
    return osi.RoadMarking(
        id=osi.Identifier(value=number),
        base=osi.BaseStationary(
            position=osi.Vector3d(x=x, y=y, z=z),
            dimension=osi.Dimension3d(length=length, width=width, height=0.0),
            orientation=osi.Orientation3d(roll=0.0, pitch=0.0, yaw=0.0),
            base_polygon=[osi.Vector2d(x=px - x, y=py - y) for px, py, _ in points.tolist()],
        ),
        classification=kind(type=kind.Type.SYMBOLIC_TRAFFIC_SIGN, monochrome_color=paint),
    )


def traffic_lights(osi: Any, scenario: Scenario, first: int, t_s: float) -> list[Any]:
    """Return the traffic lights of a scenario with their states at a time, numbered from `first` on."""
    kind = osi.TrafficLight.Classification
    length, width, height = LIGHT_SIZE_M
    out = []
    for number, signal in enumerate(scenario.signals, start=first):
        x, y, z = signal.position_m.tolist()
        color, mode = LIGHT[str(signal.at(np.array([t_s]))[0])]
        turn = osi.Orientation3d(roll=0.0, pitch=0.0, yaw=float(signal.heading_rad or 0.0))
        base = osi.BaseStationary(
            position=osi.Vector3d(x=x, y=y, z=z),
            dimension=osi.Dimension3d(length=length, width=width, height=height),
            orientation=turn,
        )
        classified = kind(
            color=kind.Color[color], mode=kind.Mode[mode], icon=kind.Icon.NONE, is_out_of_service=mode == "OFF"
        )
        reference = osi.ExternalReference(type="io.log2sim.signal", identifier=[signal.id])
        out.append(
            osi.TrafficLight(
                id=osi.Identifier(value=number), base=base, classification=classified, source_reference=[reference]
            )
        )
    return out
