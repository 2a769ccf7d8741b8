"""Lanes, lines, edges and crosswalks as map features of ScenarioNet."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import MapFeatures, MapLane, Marking, Scenario
from log2sim.export.roads.lanes import lanes
from log2sim.export.roads.signal_lanes import signal_lanes
from log2sim.geometry import Array
from log2sim.lanes.graph.polyline import Polyline

SPACING_M = 1.0
"""Of points of lanes, as MetaDrive's own maps have them."""

LINE_TYPE = {
    ("solid", "white"): "ROAD_LINE_SOLID_SINGLE_WHITE", ("dashed", "white"): "ROAD_LINE_BROKEN_SINGLE_WHITE",
    ("solid", "yellow"): "ROAD_LINE_SOLID_SINGLE_YELLOW", ("dashed", "yellow"): "ROAD_LINE_BROKEN_SINGLE_YELLOW",
}  # fmt: skip
"""Types of lane lines by kind and color; MetaDrive has none for lines of unknown color, which are written as white."""


def map_features(scenario: Scenario, origin_m: Array) -> dict[str, Any]:
    """Return the map features of a scenario by their ids, relative to an origin (3,)."""
    found = {lane.id: _lane(lane, origin_m) for lane in lanes(scenario)}
    features = scenario.map_features or MapFeatures()
    for marking in features.markings:
        entry = _marking(marking, origin_m)
        found |= {} if entry is None else {marking.id: entry}
    for border in features.borders:
        found[border.id] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": border.points_m - origin_m, "kind": border.kind}
    return found


def _lane(lane: MapLane, origin_m: Array) -> dict[str, Any]:
    line = Polyline.through(lane.points_m, SPACING_M)
    own = Polyline(lane.points_m).s_m
    width = np.interp(line.s_m / line.length_m * own[-1], own, lane.width_m)
    beside = {"left_neighbor": lane.left_lane, "right_neighbor": lane.right_lane}
    return {
        "type": "LANE_SURFACE_STREET",
        "polyline": line.points_m - origin_m,
        "width": np.column_stack([width / 2, width / 2]),
        "entry_lanes": list(lane.predecessors),
        "exit_lanes": list(lane.successors),
        **{key: [] if name is None else [name] for key, name in beside.items()},
        "inferred_from": lane.inferred_from,
        "confidence": lane.confidence,
        "junction": lane.junction,
    }


def _marking(marking: Marking, origin_m: Array) -> dict[str, Any] | None:
    points = marking.points_m - origin_m
    if marking.kind == "crosswalk":
        return {"type": "CROSSWALK", "polygon": points}
    if marking.is_lane_line:
        return {"type": LINE_TYPE[marking.kind, marking.color or "white"], "polyline": points}
    return None


LIGHT_STATE = {
    "red": "LANE_STATE_STOP", "red_yellow": "LANE_STATE_CAUTION", "yellow": "LANE_STATE_CAUTION", "green": "LANE_STATE_GO",
    "off": "LANE_STATE_UNKNOWN", "unknown": "LANE_STATE_UNKNOWN",
}  # fmt: skip
"""States of traffic lights, as Waymo names them."""


def dynamic_map_states(scenario: Scenario, t_s: Array, origin_m: Array) -> dict[str, Any]:
    """Return the traffic lights of a scenario by the lanes that they are for, with their states at times (T,).

    A light is for the lanes into a junction that lead towards its face and end nearest to it; MetaDrive has one a lane.
    """
    found: dict[str, Any] = {}
    names = lanes(scenario)
    for signal in scenario.signals:
        for lane in signal_lanes(signal, names):
            state = {"object_state": [LIGHT_STATE[str(s)] for s in signal.at(t_s)]}
            meta = {
                "track_length": len(t_s),
                "type": "TRAFFIC_LIGHT",
                "object_id": lane.id,
                "dataset": "log2sim",
                "signal": signal.id,
            }
            found[lane.id] = {
                "type": "TRAFFIC_LIGHT", "state": state, "lane": lane.id, "stop_point": lane.points_m[-1] - origin_m, "metadata": meta,
            }  # fmt: skip
    return found
