"""Imports a scenario from an OpenSCENARIO file."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import VERSION, MapFrame, Scenario, Waypoints
from log2sim.errors import ConfigError, LogError, ScenarioError
from log2sim.export.exporters import ExportPlacement
from log2sim.export.openscenario.write import PREFIX, VEHICLE_DEFAULTS
from log2sim.export.xml_text import read, require_number, unescaped
from log2sim.files.documents import parse_unique
from log2sim.geometry import Array, wrap_angle

VERTEX_LIMIT = 10_000_000
# Headings may count whole turns; of larger ones not even the direction is left.
MAX_HEADING_RAD = 1e6


def _pose(node: Element, where: str) -> list[float]:
    """Return x, y, z, heading of the `WorldPosition` within an element; NaN for a missing heading."""
    world = node.find("Position/WorldPosition")
    if world is None:
        raise ScenarioError(f"{where}: a position that is no <WorldPosition>; only those can be read without the road")
    given = {"z": "0"} | world.attrib  # players take a missing height for 0
    x, y, z = (require_number(given.get(key), f"{where}: WorldPosition {key}") for key in "xyz")
    text = world.get("h")
    heading = float("nan") if text is None else require_number(text, f"{where}: WorldPosition h")
    if abs(heading) > MAX_HEADING_RAD:
        raise ScenarioError(f"{where}: WorldPosition h is {heading:g}, expected radians")
    return [x, y, z, heading]


CATEGORY_OF = {kind.category: category for category, kind in reversed(list(VEHICLE_DEFAULTS.items()))} | {
    "van": "car", "semitrailer": "truck", "trailer": "other", "tram": "other", "train": "other",
}  # fmt: skip
SIGMAS = ("sigma_xy_m", *Waypoints.OPTIONAL_FLOATS)
EGO_NAMES = ("ego", "hero")


def load(path: Path | str) -> Scenario:
    """Read an OpenSCENARIO XML file of revision 1.0 to 1.3.

    Raises `ScenarioError` when the file is no such file, or moves its entities in another way than by trajectories with
    times; names the entity and what was found.
    """
    path = Path(path)
    root = read(path)
    try:
        return _scenario(root, path)
    except (LogError, ConfigError) as error:
        raise ScenarioError(f"{path}: {error}") from None


def _scenario(root: Element, path: Path) -> Scenario:
    if root.tag != "OpenSCENARIO" or root.find("Entities") is None or root.find("Storyboard") is None:
        raise ScenarioError(
            f"its root is <{root.tag[:40]}>, expected <OpenSCENARIO> with <Entities> and a <Storyboard>"
        )
    declared = root.iterfind("ParameterDeclarations/ParameterDeclaration")
    parameters = {p.get("name", ""): p.get("value", "") for p in declared}
    for node in root.iter():  # references to parameters in attributes stand for their values
        for key, value in node.attrib.items():
            if value.startswith("$"):
                if value[1:] not in parameters:
                    raise ScenarioError(
                        f"<{node.tag}> {key}: {value[:40]!r} is no parameter of the file, expected one or a value"
                    )
                node.set(key, parameters[value[1:]])
    frame = _map(parameters.get("log2sim_map"))
    places = parameters.get("log2sim_origin_m", "0 0 0").split()
    origin = [require_number(v, "parameter log2sim_origin_m") for v in places]
    if len(origin) != 3:
        raise ScenarioError("parameter log2sim_origin_m: expected three numbers")
    target = parameters.get("log2sim_projection")
    target = None if target is None else unescaped(target)
    placement = ExportPlacement((origin[0], origin[1], origin[2]), frame.offset_m, frame.projection, target)
    # Return by entity the vertices (V, 5) t, x, y, z, heading of all its trajectories
    found: dict[str, list[Array]] = {}
    count = 0
    for group in root.iter("ManeuverGroup"):
        names = [ref.get("entityRef", "") for ref in group.iterfind("Actors/EntityRef")]
        for follow in group.iter("FollowTrajectoryAction") if names else ():
            where = f"entity '{names[0][:100]}'"
            timing = follow.find("TimeReference/Timing")
            if timing is None or timing.get("domainAbsoluteRelative") != "absolute":
                raise ScenarioError(
                    f"{where}: its trajectory has no <Timing> with an absolute domain; without it nothing has a time"
                )
            nodes = list(follow.iter("Vertex"))
            if not nodes:
                raise ScenarioError(f"{where}: its trajectory has no vertices of a polyline, expected at least one")
            scale, offset = (require_number(timing.get(key), f"{where}: Timing {key}") for key in ("scale", "offset"))
            traced = np.array(
                [[require_number(n.get("time"), f"{where}: Vertex time"), *_pose(n, where)] for n in nodes]
            )
            traced[:, 0] = offset + scale * traced[:, 0]
            # Fill in the direction of travel for vertices (V, 5) without a heading: leaving it out does not mean 0.
            absent = np.isnan(traced[:, 4])
            steps = np.diff(traced[:, 1:3], axis=0)
            moving = np.flatnonzero(np.hypot(*steps.T) > 0)
            if absent.any():
                travel = np.zeros(len(traced))
                if len(moving):
                    last = moving[np.clip(np.searchsorted(moving, np.arange(len(traced)), side="right") - 1, 0, None)]
                    travel = np.arctan2(steps[last, 1], steps[last, 0])
                traced[absent, 4] = travel[absent]
            count += len(names) * len(traced)
            if count > VERTEX_LIMIT:
                raise ScenarioError(
                    f"its entities have more than {VERTEX_LIMIT} vertices together; cut the file into parts"
                )
            for name in names:
                found.setdefault(name, []).append(traced)
    vertices = {name: np.concatenate(parts) for name, parts in found.items()}
    last_s = max((rows[-1, 0] for rows in vertices.values()), default=0.0)
    # By entity its initial position in the file.
    starts: dict[str, Element] = {}
    for private in root.iterfind("Storyboard/Init/Actions/Private"):
        teleport = private.find("PrivateAction/TeleportAction")
        if teleport is not None:
            starts.setdefault(private.get("entityRef", ""), teleport)
    agents = [
        _agent(o, vertices.get(o.get("name", "")), starts, last_s, placement)
        for o in root.iterfind("Entities/ScenarioObject")
    ]
    if not agents:
        raise ScenarioError("its <Entities> hold no <ScenarioObject>, expected at least one")
    header = root.find("FileHeader")
    title = header.get("description", "") if header is not None else ""
    text = parameters.get("log2sim_t0_ns", "0")
    if not re.fullmatch(r"-?[0-9]{1,19}", text):
        raise ScenarioError(f"parameter log2sim_t0_ns is {text[:40]!r}, expected nanoseconds")
    name = unescaped(parameters["log2sim_name"]) if "log2sim_name" in parameters else title or path.stem
    long_s = require_number(parameters.get("log2sim_duration_s", str(last_s)), "parameter log2sim_duration_s")
    return Scenario.from_dict({
        "scenario_version": VERSION, "name": name, "t0_ns": int(text), "duration_s": long_s,
        "map": {**vars(frame), "offset_m": list(frame.offset_m)}, "agents": agents, "cameras": [], "stages": [],
        "provenance": {"imported_from": path.name},
    })  # fmt: skip


def _map(text: str | None) -> MapFrame:
    if text is None:
        return MapFrame()
    try:
        entries = parse_unique(unescaped(text))
        frame = MapFrame(**{**entries, "offset_m": tuple(float(v) for v in entries["offset_m"])})
    except (ValueError, TypeError, KeyError, RecursionError):
        raise ScenarioError(f"parameter log2sim_map is {text[:60]!r}, expected the map that an export writes") from None
    if len(frame.offset_m) != 3:
        raise ScenarioError("parameter log2sim_map: offset_m, expected three numbers")
    return frame


def _agent(
    node: Element, vertices: Array | None, starts: Mapping[str, Element], last_s: float, placement: ExportPlacement
) -> dict[str, Any]:
    """Return the document of one agent."""
    name = node.get("name", "")
    where = f"entity '{name[:100]}'"
    body = next((b for b in (node.find(tag) for tag in ("Vehicle", "Pedestrian", "MiscObject")) if b is not None), None)
    box = body.find("BoundingBox") if body is not None else None
    center, size = (box.find("Center"), box.find("Dimensions")) if box is not None else (None, None)
    if body is None or center is None or size is None:
        raise ScenarioError(f"{where}: no <BoundingBox> in the file; entities out of catalogs are not read")
    properties = {p.get("name", ""): p.get("value", "") for p in body.iterfind("Properties/Property")}
    size_m = {key: require_number(size.get(key), f"{where}: Dimensions {key}") for key in ("length", "width", "height")}
    offset_m = require_number(center.get("x"), f"{where}: Center x")
    height_m = require_number(center.get("z"), f"{where}: Center z")
    if vertices is None:
        # Vertices (2, 5) of an entity that stands at its initial position.
        start = starts.get(name)
        if start is None:
            raise ScenarioError(
                f"{where}: has neither a trajectory nor a position at the start; nothing says where it is"
            )
        pose = _pose(start, where)
        vertices = np.nan_to_num(np.array([[0.0, *pose], [max(last_s, 1e-3), *pose]]))
    doubts: Any = []
    text = properties.get(PREFIX + "doubts")
    if text is not None:
        try:
            doubts = parse_unique(unescaped(text))
        except (ValueError, RecursionError):
            doubts = None
        if not isinstance(doubts, list):
            raise ScenarioError(f"{where}: property doubts is {text[:60]!r}, expected the list that an export writes")
    is_ego = properties.get("type") == "ego_vehicle" or name.lower() in EGO_NAMES
    own_id = properties.get(PREFIX + "id")
    if body.tag == "Vehicle":
        category = CATEGORY_OF.get(body.get("vehicleCategory", ""), "other")
    else:
        category = "other" if body.tag == "MiscObject" or body.get("pedestrianCategory") == "animal" else "pedestrian"
    return {
        "id": unescaped(own_id) if own_id is not None else "ego" if is_ego else name,
        "category": properties.get(PREFIX + "category") or category,
        "size_m": size_m,
        "color": _color(properties, where),
        "static": properties.get(PREFIX + "static", str(not np.ptp(vertices[:, 1:], axis=0).any()).lower()) == "true",
        "rear_axle_offset_m": offset_m,
        "confidence": require_number(properties.get(PREFIX + "confidence", "1"), f"{where}: property confidence"),
        "doubts": doubts,
        "quality": {},
        "waypoints": _waypoints(vertices, properties, placement, (offset_m, height_m), where),
    }  # fmt: skip


def _color(properties: Mapping[str, str], where: str) -> Mapping[str, Any] | None:
    text = properties.get("color")
    if text is None:
        return None
    name = unescaped(properties.get(PREFIX + "color_name", ""))
    if re.fullmatch(r"#[0-9A-Fa-f]{6}", text):
        return {"rgb": list(bytes.fromhex(text[1:])), "name": name}
    if not re.fullmatch(r"\s*[0-9]{1,3}\s*,\s*[0-9]{1,3}\s*,\s*[0-9]{1,3}\s*", text):
        raise ScenarioError(f"{where}: property color is {text[:40]!r}, expected #C81E1E or 200,30,30")
    return {"rgb": [int(v) for v in text.split(",")], "name": name}


def _waypoints(
    vertices: Array,
    properties: Mapping[str, str],
    placement: ExportPlacement,
    center_m: tuple[float, float],
    where: str,
) -> Mapping[str, Any]:
    """Return columns of waypoints of the box center, which is `center_m` ahead of and above the vertices.

    Speeds are the exported ones, or from the vertices if their number was changed.
    """
    speeds = _column(properties, "speed_mps", where)
    if speeds is not None and len(speeds) == 1:
        vertices = vertices[:1]
    exported = speeds is not None and len(speeds) == len(vertices)
    sigmas = {key: _column(properties, key, where) if exported else None for key in SIGMAS}
    observed = properties.get(PREFIX + "observed", "") if exported else ""
    if observed.strip("01"):
        raise ScenarioError(f"{where}: property {PREFIX}observed is {observed[:40]!r}, expected 0 and 1 alone")
    t, x, y, z, heading = vertices.T
    ahead_m, above_m = center_m
    centers = np.column_stack([x + ahead_m * np.cos(heading), y + ahead_m * np.sin(heading), z + above_m, heading])
    columns: dict[str, Any] = dict(zip(("x_m", "y_m", "z_m", "yaw_rad"), placement.back(centers).T))
    if not exported:  # along the heading
        steady = len(t) > 1 and np.all(np.diff(t) > 0)
        vx, vy = (np.gradient(v, t) if steady else np.zeros(len(t)) for v in (x, y))
        speeds = vx * np.cos(heading) + vy * np.sin(heading)
    columns |= {"t_s": t, "speed_mps": speeds}
    columns["sigma_xy_m"] = np.zeros(len(t))
    columns |= {key: sigma for key, sigma in sigmas.items() if sigma is not None and len(sigma) == len(t)}
    columns["yaw_rad"] = wrap_angle(columns["yaw_rad"])
    return {
        **{key: values.tolist() for key, values in columns.items()},
        "observed": [mark == "1" for mark in observed] if len(observed) == len(t) else [True] * len(t),
    }


def _column(properties: Mapping[str, str], name: str, where: str) -> Array | None:
    text = properties.get(PREFIX + name)
    where = f"{where}: property {PREFIX}{name}"
    return None if text is None else np.array([require_number(v, where) for v in text.split()])
