"""Export to scenario descriptions of ScenarioNet, which MetaDrive's `ScenarioEnv` replays.

The files hold plain Python values and arrays whose pickle references only `numpy.ndarray`, so that they load under any
version of NumPy and without this package.
"""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import GROUP_OF, VERSION, Agent, Scenario
from log2sim.errors import ScenarioError
from log2sim.export.exporters import Options
from log2sim.export.placement import near_origin
from log2sim.export.sampling import SampledMotion, file_name, sample_steps, step_times
from log2sim.export.scenarionet_map import dynamic_map_states, map_features
from log2sim.geometry import NS_PER_S, Array

STEP_S = 0.1  # MetaDrive assumes this step
DATASET = "log2sim"
PROTOCOL = 5
MOVED_M = 1.0  # MetaDrive's summaries count an object as moving beyond this

# MetaDrive's types of participants. It keeps OTHER in the file and does not show it.
TYPE_OF_GROUP = {"vehicle": "VEHICLE", "two_wheeler": "CYCLIST", "pedestrian": "PEDESTRIAN", "other": "OTHER"}

Value = dict[str, Any]


class ScenarioNet:
    """One scenario and the two tables of a data set, `dataset_summary.pkl` and `dataset_mapping.pkl`."""

    options: tuple[str, ...] = ()
    loses = (
        "times between steps of 0.1 s and outside the ego's life, uncertainty and observed flags, stop lines and other markings "
        "that are no lines, colors of lines where unknown, cameras, stages; MetaDrive itself takes over no height, and shows no agents of category other and cyclists and pedestrians in sizes of its own"
    )

    def write(self, scenario: Scenario, folder: Path, options: Options) -> None:
        """Write the description and the two tables."""
        description = describe(scenario)
        name = f"sd_{DATASET}_{VERSION}_{file_name(scenario.name)}.pkl"
        _dump(description, folder / name)
        _dump({name: _without_arrays(description["metadata"])}, folder / "dataset_summary.pkl")
        _dump({name: ""}, folder / "dataset_mapping.pkl")


def describe(scenario: Scenario) -> Value:
    """Return the scenario description as a dictionary of plain values and arrays with T steps of 0.1 s from the ego's first.

    Raises
    ------
    ScenarioError
        When the scenario has no ego.
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
    metadata = {
        **_metadata(scenario, t_s),
        "sdc_id": ego.id,
        "position_offset_m": origin.tolist(),
        "left_out": left_out,
        "object_summary": {k: _object_summary(k, track) for k, track in tracks.items()},
    }
    metadata["number_summary"] = _number_summary(metadata["object_summary"], features, lights)
    return {
        "id": scenario.name,
        "version": f"{DATASET}_{VERSION}",
        "length": len(t_s),
        "tracks": tracks,
        "dynamic_map_states": lights,
        "map_features": features,
        "metadata": metadata,
    }


def _metadata(scenario: Scenario, t_s: Array) -> Value:
    """Describe place, time and origin of a description with steps at times (T,)."""
    return {
        "id": scenario.name,
        "scenario_id": scenario.name,
        "dataset": DATASET,
        "history_metadata": dict(scenario.provenance),
        "metadrive_processed": False,
        "coordinate": "metadrive",
        "ts": t_s - t_s[0],
        "sample_rate": STEP_S,
        "t0_ns": scenario.t0_ns + round(t_s[0] * NS_PER_S),
        "timestamps_ns": scenario.t0_ns + np.round(t_s * NS_PER_S).astype(np.int64),
        "map": {k: list(v) if isinstance(v, tuple) else v for k, v in asdict(scenario.map).items()},
    }


def _track(agent: Agent, move: SampledMotion, origin: Array) -> Value:
    kind = TYPE_OF_GROUP[GROUP_OF[agent.category]]
    sizes = {key: np.where(move.valid, size, 0.0) for key, size in zip(("length", "width", "height"), agent.size_m)}
    return {
        "type": kind,
        "state": {
            "position": np.where(move.valid[:, None], move.position_m - origin, 0.0),
            "heading": move.yaw_rad,
            "velocity": move.velocity_mps,
            "valid": move.valid,
            **sizes,
        },
        "metadata": {
            "type": kind,
            "object_id": agent.id,
            "track_length": len(move.valid),
            "dataset": DATASET,
            "category": agent.category,
            "static": agent.static,
            "color": dict(agent.color) if agent.color is not None else None,
            "confidence": agent.confidence,
            "doubts": [doubt.to_dict() for doubt in agent.doubts],
            "rear_axle_offset_m": agent.rear_axle_offset_m,
        },
    }


def _object_summary(name: str, track: Value) -> Value:
    valid = track["state"]["valid"]
    path = track["state"]["position"][valid, :2]
    after_first = valid[int(valid.argmax()) :]
    return {
        "type": track["type"],
        "object_id": name,
        "track_length": len(valid),
        "moving_distance": float(np.linalg.norm(np.diff(path, axis=0), axis=1).sum()),
        "valid_length": int(valid.sum()),
        "continuous_valid_length": int(after_first.argmin()) if not after_first.all() else len(after_first),
    }


def _number_summary(objects: Value, features: Value, lights: Value) -> Value:
    heights = np.concatenate(
        [feature["polyline" if "polyline" in feature else "polygon"][:, 2] for feature in features.values()]
    )
    moving = [o["type"] for o in objects.values() if o["moving_distance"] > MOVED_M]
    kinds = [o["type"] for o in objects.values()]
    states = Counter(state for light in lights.values() for state in light["state"]["object_state"])
    return {
        "num_objects": len(objects),
        "object_types": sorted(set(kinds)),
        "num_objects_each_type": dict(Counter(kinds)),
        "num_moving_objects": len(moving),
        "num_moving_objects_each_type": dict(Counter(moving)),
        "num_traffic_lights": len(lights),
        "num_traffic_light_types": sorted(states),
        "num_traffic_light_each_step": dict(states),
        "num_map_features": len(features),
        "map_height_diff": float(np.ptp(heights)),
    }


def _without_arrays(value: Any) -> Any:
    """Replace arrays by lists, as summaries hold them."""
    if isinstance(value, dict):
        return {k: _without_arrays(v) for k, v in value.items()}
    return value.tolist() if isinstance(value, np.ndarray) else value


class _Pickler(pickle.Pickler):
    """Pickles arrays as calls of `numpy.ndarray` on their bytes: NumPy's own form references modules that NumPy 2 moved."""

    def reducer_override(self, value: Any) -> Any:
        if isinstance(value, np.ndarray):
            return np.ndarray, (value.shape, value.dtype.str, bytearray(value.tobytes()))
        return NotImplemented


def _dump(value: Value, file: Path) -> None:
    with file.open("wb") as opened:
        _Pickler(opened, protocol=PROTOCOL).dump(value)


EXPORTER = ScenarioNet()
