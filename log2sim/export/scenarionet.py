"""Export to scenario descriptions of ScenarioNet, which MetaDrive reads.

One scenario and the two tables of a data set, `dataset_summary.pkl` and `dataset_mapping.pkl`. The files hold plain Python values and arrays whose pickle references only `numpy.ndarray`, so that they load under any
version of NumPy and without this package.
"""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import GROUP_OF, VERSION, Agent, MapFeatures, MapLane, Scenario
from log2sim.errors import ScenarioError
from log2sim.export.exporters import Options, SampledMotion, file_name, near_origin, sample_steps, step_times
from log2sim.export.roads.opendrive import lanes, signal_lanes
from log2sim.geometry import NS_PER_S, Array, Polyline

SPACING_M = 1.0  # of points of lanes, as MetaDrive's own maps have them
# Types of lane lines by kind and color; MetaDrive has none for lines of unknown color, which are written as white.
LINE_TYPE = {
    ("solid", "white"): "ROAD_LINE_SOLID_SINGLE_WHITE", ("dashed", "white"): "ROAD_LINE_BROKEN_SINGLE_WHITE",
    ("solid", "yellow"): "ROAD_LINE_SOLID_SINGLE_YELLOW", ("dashed", "yellow"): "ROAD_LINE_BROKEN_SINGLE_YELLOW",
}  # fmt: skip


def map_features(scenario: Scenario, origin_m: Array) -> dict[str, Any]:
    """Return the map features of a scenario by their ids, relative to an origin (3,)."""
    found = {lane.id: _lane(lane, origin_m) for lane in lanes(scenario)}
    features = scenario.map_features or MapFeatures()
    for marking in features.markings:
        points = marking.points_m - origin_m
        if marking.kind == "crosswalk":
            found[marking.id] = {"type": "CROSSWALK", "polygon": points}
        elif marking.is_lane_line:
            found[marking.id] = {"type": LINE_TYPE[marking.kind, marking.color or "white"], "polyline": points}
    for border in features.borders:
        found[border.id] = {"type": "ROAD_EDGE_BOUNDARY", "polyline": border.points_m - origin_m, "kind": border.kind}
    return found


def _lane(lane: MapLane, origin_m: Array) -> dict[str, Any]:
    line = Polyline.through(lane.points_m, SPACING_M)
    own = Polyline(lane.points_m).s_m
    width = np.interp(line.s_m / line.length_m * own[-1], own, lane.width_m)
    beside = {"left_neighbor": lane.left_lane, "right_neighbor": lane.right_lane}
    return {
        "type": "LANE_SURFACE_STREET", "polyline": line.points_m - origin_m,
        "width": np.column_stack([width / 2, width / 2]), "entry_lanes": list(lane.predecessors),
        "exit_lanes": list(lane.successors), **{key: [] if name is None else [name] for key, name in beside.items()},
        "inferred_from": lane.inferred_from, "confidence": lane.confidence, "junction": lane.junction,
    }  # fmt: skip


# States of traffic lights, as Waymo names them.
LIGHT_STATE = {
    "red": "LANE_STATE_STOP", "red_yellow": "LANE_STATE_CAUTION", "yellow": "LANE_STATE_CAUTION", "green": "LANE_STATE_GO",
    "off": "LANE_STATE_UNKNOWN", "unknown": "LANE_STATE_UNKNOWN",
}  # fmt: skip


def dynamic_map_states(scenario: Scenario, t_s: Array, origin_m: Array) -> dict[str, Any]:
    """Return the traffic lights of a scenario by the lanes that they are for, with their states at times (T,).

    A light is for the lanes into a junction that lead towards its face and end nearest to it; MetaDrive has one a lane.
    """
    found: dict[str, Any] = {}
    names = lanes(scenario)
    for signal in scenario.signals:
        for lane in signal_lanes(signal, names):
            state = {"object_state": [LIGHT_STATE[str(s)] for s in signal.at(t_s)]}
            meta = {"type": "TRAFFIC_LIGHT", "object_id": lane.id, "dataset": "log2sim", "signal": signal.id}
            found[lane.id] = {
                "type": "TRAFFIC_LIGHT", "state": state, "lane": lane.id, "stop_point": lane.points_m[-1] - origin_m,
                "metadata": {"track_length": len(t_s), **meta},
            }  # fmt: skip
    return found


STEP_S = 0.1  # MetaDrive assumes this step
DATASET = "log2sim"
PROTOCOL = 5
MOVED_M = 1.0  # MetaDrive's summaries count an object as moving beyond this
# MetaDrive's types of participants. It keeps OTHER in the file and does not show it.
TYPE_OF_GROUP = {"vehicle": "VEHICLE", "two_wheeler": "CYCLIST", "pedestrian": "PEDESTRIAN", "other": "OTHER"}
Value = dict[str, Any]
options: tuple[str, ...] = ()
loses = (
    "times between steps of 0.1 s and outside the ego's life, uncertainty and observed flags, stop lines and other markings "
    "that are no lines, colors of lines where unknown, cameras, stages; MetaDrive itself takes over no height, and shows no agents of category other and cyclists and pedestrians in sizes of its own"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the description and the two tables."""
    description = scenario_description(scenario)
    name = f"sd_{DATASET}_{VERSION}_{file_name(scenario.name)}.pkl"

    def plain(value: Any) -> Any:  # lists in place of arrays, as summaries hold them
        if isinstance(value, dict):
            return {k: plain(v) for k, v in value.items()}
        return value.tolist() if isinstance(value, np.ndarray) else value

    files = {name: description, "dataset_summary.pkl": {name: plain(description["metadata"])}}
    for file, value in (files | {"dataset_mapping.pkl": {name: ""}}).items():
        with (folder / file).open("wb") as opened:
            _Pickler(opened, protocol=PROTOCOL).dump(value)


def scenario_description(scenario: Scenario) -> Value:
    """Return the scenario description as a dictionary of plain values and arrays with T steps of 0.1 s from the ego's first.

    Raises `ScenarioError` when the scenario has no ego.
    """
    ego = scenario.ego
    if ego is None:
        raise ScenarioError(
            f"scenario '{scenario.name}' has no agent 'ego', which MetaDrive follows; choose one with --ego AGENT"
        )
    t_s = step_times(ego.waypoints.t_s[0], ego.waypoints.t_s[-1], STEP_S, len(scenario.agents))
    origin = np.array(near_origin(scenario).origin_m)
    moves = {agent.id: sample_steps(agent, t_s, STEP_S) for agent in scenario.agents}
    tracks = {a.id: _track(a, moves[a.id], origin) for a in scenario.agents if moves[a.id].valid.any()}
    left_out = {a.id: "not alive at any step of the ego" for a in scenario.agents if a.id not in tracks}
    features = map_features(scenario, origin)
    lights = dynamic_map_states(scenario, t_s, origin)
    objects = {}
    for name, track in tracks.items():
        valid = track["state"]["valid"]
        path, after_first = track["state"]["position"][valid, :2], valid[int(valid.argmax()) :]
        objects[name] = {
            "type": track["type"], "object_id": name, "track_length": len(valid),
            "moving_distance": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()), "valid_length": int(valid.sum()),
            "continuous_valid_length": int(after_first.argmin()) if not after_first.all() else len(after_first),
        }  # fmt: skip
    metadata = {
        "id": scenario.name, "scenario_id": scenario.name, "dataset": DATASET,
        "history_metadata": dict(scenario.provenance), "metadrive_processed": False, "coordinate": "metadrive",
        "ts": t_s - t_s[0], "sample_rate": STEP_S, "t0_ns": scenario.t0_ns + round(t_s[0] * NS_PER_S),
        "timestamps_ns": scenario.t0_ns + np.round(t_s * NS_PER_S).astype(np.int64),
        "map": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(scenario.map).items()},
        "sdc_id": ego.id, "position_offset_m": origin.tolist(), "left_out": left_out, "object_summary": objects,
    }  # fmt: skip
    lines = [feature["polyline" if "polyline" in feature else "polygon"] for feature in features.values()]
    moving = [o["type"] for o in objects.values() if o["moving_distance"] > MOVED_M]
    kinds = [o["type"] for o in objects.values()]
    states = Counter(state for light in lights.values() for state in light["state"]["object_state"])
    metadata["number_summary"] = {
        "num_objects": len(objects), "object_types": sorted(set(kinds)), "num_objects_each_type": dict(Counter(kinds)),
        "num_moving_objects": len(moving), "num_moving_objects_each_type": dict(Counter(moving)),
        "num_traffic_lights": len(lights), "num_traffic_light_types": sorted(states),
        "num_traffic_light_each_step": dict(states), "num_map_features": len(features),
        "map_height_diff": float(np.ptp(np.concatenate(lines)[:, 2])),
    }  # fmt: skip
    return {
        "id": scenario.name, "version": f"{DATASET}_{VERSION}", "length": len(t_s), "tracks": tracks,
        "dynamic_map_states": lights, "map_features": features, "metadata": metadata,
    }  # fmt: skip


def _track(agent: Agent, move: SampledMotion, origin: Array) -> Value:
    kind = TYPE_OF_GROUP[GROUP_OF[agent.category]]
    sizes = {key: np.where(move.valid, size, 0.0) for key, size in zip(("length", "width", "height"), agent.size_m)}
    position = np.where(move.valid[:, None], move.position_m - origin, 0.0)
    return {
        "type": kind,
        "state": {
            "position": position, "heading": move.yaw_rad, "velocity": move.velocity_mps, "valid": move.valid, **sizes,
        },
        "metadata": {
            "type": kind, "object_id": agent.id, "track_length": len(move.valid), "dataset": DATASET,
            "category": agent.category, "static": agent.static,
            "color": dict(agent.color) if agent.color is not None else None, "confidence": agent.confidence,
            "doubts": [doubt.to_dict() for doubt in agent.doubts], "rear_axle_offset_m": agent.rear_axle_offset_m,
        },
    }  # fmt: skip


class _Pickler(pickle.Pickler):
    """Pickles arrays as calls of `numpy.ndarray` on their bytes: NumPy's own form references modules that NumPy 2 moved."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.ndarray, (value.shape, value.dtype.str, bytearray(value.tobytes()))
        return NotImplemented
