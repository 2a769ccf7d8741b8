"""Export to ASAM OpenLABEL 1.0.0: objects with a cuboid in the map at each frame; with `--log`, also their boxes in its pictures.

Frames are the synchronized moments of the log; without one, they are 0.1 s apart. Positions are coordinates of the scenario's
projection, as the frame's `transforms` from the ego to the map. A box in a picture is that of the whole cuboid, whether or not
something hides it.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from log2sim.datatypes import Agent, AgentTable, Lidar, Log, Scenario
from log2sim.errors import ConfigError
from log2sim.export.exporters import Options, SampledMotion, sample_steps
from log2sim.export.viewers import STEP_S, agent_steps, ego_pose
from log2sim.files.documents import write_json
from log2sim.geometry import NS_PER_S, Array, Camera
from log2sim.perception.lidar.projection import project_boxes_in_view, view_of

DECIMALS = 6  # of meters, and finer of radians; pixels have two
PINHOLE_COEFFICIENTS = 5  # that the schema asks for at least
options: tuple[str, ...] = ("log",)
loses = (
    "uncertainty and observed flags, speeds, times between frames, markings, lanes, traffic lights, map origin, stages; the "
    "rolling shutter of cameras"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the document."""
    log = options.log
    # The stamps (T,) of frames, and those of the pictures of cameras in each.
    if log is None:
        stamps, moves = agent_steps(scenario)
        pictures: list[dict[str, int]] = [{} for _ in stamps]
    else:
        start, stop = scenario.t0_ns, scenario.t0_ns + round(scenario.duration_s * NS_PER_S)
        ticks = [tick for tick in log.ticks() if start <= tick.t_ns <= stop]
        if not ticks:
            raise ConfigError(
                f"--log: log '{log.name}' has no moment between {start} and {stop} ns, the time of scenario '{scenario.name}'; give "
                "the log that it was made from"
            )
        stamps, pictures = np.array([tick.t_ns for tick in ticks], dtype=np.int64), [dict(t.image_ns) for t in ticks]
        t_s = (stamps - scenario.t0_ns) / NS_PER_S
        step_s = float(np.median(np.diff(t_s))) if len(t_s) > 1 else STEP_S
        moves = tuple((agent, sample_steps(agent, t_s, step_s)) for agent in scenario.agents)
    data: list[dict[str, dict[str, Any]]] = [{} for _ in stamps]
    for uid, (agent, move) in enumerate(moves, start=1):
        for k in np.flatnonzero(move.valid).tolist():
            center, half = move.position_m[k] + np.array(scenario.map.offset_m), float(move.yaw_rad[k]) / 2
            turn = np.array([0.0, 0.0, np.sin(half), np.cos(half)])
            values = [*_rounded(center), *_rounded(turn, 9), *_rounded(np.array(agent.size_m))]
            data[k][str(uid)] = {"cuboid": [{"name": "cuboid", "coordinate_system": "map", "val": values}]}
    if log is not None:
        for found, shown in zip(data, pictures, strict=True):
            for camera, t_ns in shown.items():
                for row, box in _boxes_px(scenario, log, camera, t_ns):
                    found.setdefault(str(row + 1), {}).setdefault("bbox", []).append(box)
    content = {}
    for k, (t_ns, shown) in enumerate(zip(stamps.tolist(), pictures)):
        streams = {name: {"stream_properties": {"timestamp": str(stamp)}} for name, stamp in shown.items()}
        transforms = _transforms(scenario, log, t_ns, moves, k)
        content[str(k)] = {
            "frame_properties": {"timestamp": str(t_ns), "transforms": transforms, "streams": streams},
            "objects": {uid: {"object_data": found} for uid, found in data[k].items()},
        }
    # The map, the ego in it, and the sensors on the ego and in the map
    systems: dict[str, Any] = {"map": {"type": "scene_cs", "parent": "", "children": []}}
    if scenario.ego is not None or (log is not None and log.ego is not None):
        systems["ego"] = {"type": "local_cs", "parent": "map", "children": []}
    sensors: list[Camera | Lidar] = [] if log is None else [*log.cameras.values(), *log.lidars.values()]
    for sensor in sensors:
        mount_T_sensor = (sensor.mount_T_cam if isinstance(sensor, Camera) else sensor.mount_T_lidar).copy()
        if sensor.mount == "map":
            mount_T_sensor[:3, 3] += scenario.map.offset_m
        pose = {"matrix4x4": _rounded(mount_T_sensor, 9)}
        systems[sensor.name] = {"type": "sensor_cs", "parent": sensor.mount, "pose_wrt_parent": pose}
    for name, system in systems.items():
        if system["parent"]:
            systems[system["parent"]]["children"].append(name)
    document = {
        "metadata": {"schema_version": "1.0.0", "name": scenario.name, "annotator": "log2sim"},
        "coordinate_systems": systems,
        "streams": {} if log is None else _streams(log),
        "objects": {
            str(uid): _object(agent, [k for k, found in enumerate(data) if str(uid) in found])
            for uid, agent in enumerate(scenario.agents, start=1)
        },
        "frames": content,
        "frame_intervals": _intervals(range(len(data))),
    }
    write_json(folder / "openlabel.json", {"openlabel": document})


def _rounded(values: Array, digits: int = DECIMALS) -> list[float]:
    return [round(float(v), digits) for v in np.ravel(values)]


def _boxes_px(scenario: Scenario, log: Log, camera: str, t_ns: int) -> list[tuple[int, dict[str, Any]]]:
    """Return the place among the agents and the box of each that is in a picture; of cameras on the ego not the ego."""
    view = view_of(log, camera, t_ns)
    if view is None:
        return []
    table = AgentTable.of(scenario.agents, np.array([(t_ns - scenario.t0_ns) / NS_PER_S]))
    hidden = scenario.ego if view.camera.mount == "ego" else None
    rows = [k for k in np.flatnonzero(table.present[:, 0]).tolist() if scenario.agents[k] is not hidden]
    found = project_boxes_in_view(view, table.center_m[rows, 0], table.size_m[rows], table.yaw_rad[rows, 0])
    out = []
    for i in np.flatnonzero(found.valid).tolist():
        low, high = found.box_px[i, :2], found.box_px[i, 2:]
        value = [*_rounded((low + high) / 2, 2), *_rounded(high - low, 2)]
        out.append((rows[i], {"name": camera, "coordinate_system": camera, "val": value}))
    return out


def _transforms(
    scenario: Scenario, log: Log | None, t_ns: int, moves: Sequence[tuple[Agent, SampledMotion]], k: int
) -> dict[str, Any]:
    """Return the pose of the ego in the map, where there is one: that of the log, else that of its box."""
    map_T_ego = None
    if log is not None and log.ego is not None:
        poses, known = log.ego.at(np.array([t_ns]))
        map_T_ego = poses[0] if known[0] else None
    else:
        own = next(((agent, move) for agent, move in moves if agent is scenario.ego and move.valid[k]), None)
        if own is not None:
            map_T_ego = ego_pose(own[0], own[1].position_m[k], float(own[1].yaw_rad[k]))
    if map_T_ego is None:
        return {}
    moved = map_T_ego.copy()
    moved[:3, 3] += scenario.map.offset_m
    return {"ego_to_map": {"src": "ego", "dst": "map", "transform_src_to_dst": {"matrix4x4": _rounded(moved, 9)}}}


def _streams(log: Log) -> dict[str, Any]:
    streams: dict[str, Any] = {}
    for camera in log.cameras.values():
        size = {"width_px": camera.width_px, "height_px": camera.height_px}
        if camera.distortion_model == "fisheye":
            K = camera.K
            lens = {
                "focal_length_x": float(K[0, 0]), "focal_length_y": float(K[1, 1]),
                "center_x_px": float(K[0, 2]), "center_y_px": float(K[1, 2]), "lens_coeffs": list(camera.distortion),
            }  # fmt: skip
            intrinsics = {"intrinsics_fisheye": size | lens}
        else:
            missing = max(PINHOLE_COEFFICIENTS - len(camera.distortion), 0)
            matrix = np.column_stack([camera.K, np.zeros(3)])
            lens = {"camera_matrix": _rounded(matrix), "distortion_coeffs": [*camera.distortion, *[0.0] * missing]}
            intrinsics = {"intrinsics_pinhole": size | lens}
        streams[camera.name] = {"type": "camera", "stream_properties": intrinsics}
    return streams | {name: {"type": "lidar"} for name in log.lidars}


def _object(agent: Agent, frames: Sequence[int]) -> dict[str, Any]:
    about: dict[str, Any] = {
        "num": [{"name": "confidence", "val": round(agent.confidence, DECIMALS)}],
        "boolean": [{"name": "static", "val": agent.static}],
        "text": [{"name": f"doubt {k}", "val": doubt.sentence} for k, doubt in enumerate(agent.doubts, start=1)],
    }
    if agent.color is not None:
        about["text"].append({"name": "color", "val": agent.color["name"]})
    about = {kind: values for kind, values in about.items() if values}
    return {"name": agent.id, "type": agent.category, "object_data": about, "frame_intervals": _intervals(frames)}


def _intervals(frames: Sequence[int]) -> list[dict[str, int]]:
    """Return the runs of successive frames."""
    runs = np.split(np.array(frames, dtype=np.int64), np.flatnonzero(np.diff(frames) != 1) + 1)
    return [{"frame_start": int(run[0]), "frame_end": int(run[-1])} for run in runs if len(run)]
