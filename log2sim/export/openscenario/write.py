"""Export to OpenSCENARIO XML 1.0, 1.1 and 1.2: `scenario.xosc` and its OpenDRIVE road.

It depends on the revision. 1.0 is for CARLA's ScenarioRunner, which does not spawn or delete entities and stops at such
an action, so agents wait `HIDDEN_DEPTH_M` or more below their first pose and return below after the last one; it also
lacks `greaterOrEqual` and `TrajectoryRef`. From 1.1 on agents are added and deleted.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import EGO, MARGIN_S, Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.export import xml_text
from log2sim.export.checks import require_start_as_in_scenario
from log2sim.export.exporters import EXTERNAL, Options
from log2sim.export.roads.opendrive import add_road_file
from log2sim.export.xml_text import element, escaped, number, unique_names
from log2sim.geometry import Array

PREFIX = "log2sim."  # prefix of the properties that only `log2sim import` reads


@dataclass(frozen=True)
class VehicleDefaults:
    """Values that OpenSCENARIO requires and scenarios do not contain; the limits are only wide enough for the scenario."""

    category: str  # openSCENARIO's vehicle category
    wheel_diameter_m: float
    max_steering_rad: float
    max_speed_mps: float
    max_acceleration_mps2: float
    tracks: bool = True  # whether an axle has two wheels


VEHICLE_DEFAULTS: Mapping[str, VehicleDefaults] = {
    "car": VehicleDefaults("car", 0.65, 0.6, 70.0, 10.0),
    "truck": VehicleDefaults("truck", 1.0, 0.7, 40.0, 8.0),
    "bus": VehicleDefaults("bus", 1.0, 0.7, 40.0, 8.0),
    "motorcycle": VehicleDefaults("motorbike", 0.6, 0.7, 80.0, 12.0, tracks=False),
    "cyclist": VehicleDefaults("bicycle", 0.68, 1.0, 20.0, 8.0, tracks=False),
    "bicycle": VehicleDefaults("bicycle", 0.68, 1.0, 20.0, 8.0, tracks=False),
    "other": VehicleDefaults("van", 0.65, 0.6, 70.0, 10.0),
}
PEDESTRIAN_MASS_KG = 75.0
# Wheelbase as a share of the length where the scenario has no rear axle, and track as a share of the width.
WHEELBASE_SHARE, TRACK_SHARE = 0.6, 0.85


def add_entity(parent: Element, agent: Agent, name: str, minor: int, *, external: bool) -> None:
    """Add the `ScenarioObject` of an agent for revision 1.`minor`; an `external` one is driven from outside."""
    scenario_object = element("ScenarioObject", parent, name=name)
    if agent.category == "pedestrian":
        about = {"model": "walker"} if minor == 0 else {}  # required by 1.0, deprecated since
        body = element(
            "Pedestrian", scenario_object, name=agent.category, mass=number(PEDESTRIAN_MASS_KG), pedestrianCategory="pedestrian", **about
        )  # fmt: skip
        _add_box(body, agent)
    else:
        kind = VEHICLE_DEFAULTS[agent.category]
        body = element("Vehicle", scenario_object, name=agent.category, vehicleCategory=kind.category)
        _add_box(body, agent)
        length, width, _ = agent.size_m
        fastest = float(np.abs(agent.waypoints.speed_mps).max())
        acceleration = number(kind.max_acceleration_mps2)
        element(
            "Performance", body, maxSpeed=number(max(kind.max_speed_mps, fastest)), maxAcceleration=acceleration, maxDeceleration=acceleration
        )  # fmt: skip
        wheelbase = 2 * agent.rear_axle_offset_m if agent.rear_axle_offset_m > 0 else WHEELBASE_SHARE * length
        shared = {
            "wheelDiameter": number(kind.wheel_diameter_m),
            "trackWidth": number(TRACK_SHARE * width if kind.tracks else 0.0),
            "positionZ": number(kind.wheel_diameter_m / 2),
        }
        axles = element("Axles", body)
        element("FrontAxle", axles, maxSteering=number(kind.max_steering_rad), positionX=number(wheelbase), **shared)
        element("RearAxle", axles, maxSteering="0", positionX="0", **shared)
    # The properties that players use (`type` of ScenarioRunner, `color` in its form or esmini's), then those for an import
    w = agent.waypoints
    values = {"type": "ego_vehicle" if agent.id == "ego" else "simulation"}
    if agent.color is not None:
        rgb = [int(v) for v in agent.color["rgb"]]
        values["color"] = ",".join(map(str, rgb)) if minor == 0 else "#" + "".join(f"{v:02X}" for v in rgb)
        values[PREFIX + "color_name"] = escaped(str(agent.color["name"]))
    values |= {
        PREFIX + "id": escaped(agent.id),
        PREFIX + "category": agent.category,
        PREFIX + "static": str(agent.static).lower(),
        PREFIX + "confidence": number(agent.confidence),
        PREFIX + "speed_mps": " ".join(number(v, 4) for v in w.speed_mps),
        PREFIX + "sigma_xy_m": " ".join(number(v, 4) for v in w.sigma_xy_m),
        PREFIX + "observed": "".join("1" if v else "0" for v in w.observed),
    }
    for key in w.OPTIONAL_FLOATS:
        if (column := getattr(w, key)) is not None:
            values[PREFIX + key] = " ".join(number(v, 4) for v in column)
    if agent.doubts:
        values[PREFIX + "doubts"] = escaped(json.dumps([doubt.to_dict() for doubt in agent.doubts]))
    properties = element("Properties", body)
    for name, value in values.items():
        element("Property", properties, name=name, value=value)
    if external and minor > 0:
        controller = element("Controller", element("ObjectController", scenario_object), name="ExternalController")
        properties = element("Properties", controller)
        element("Property", properties, name="esminiController", value="ExternalController")
        element("Property", properties, name="useGhost", value="false")


def _add_box(parent: Element, agent: Agent) -> None:
    length, width, height = agent.size_m
    box = element("BoundingBox", parent)
    element("Center", box, x=number(agent.rear_axle_offset_m), y="0", z=number(height / 2))
    element("Dimensions", box, width=number(width), length=number(length), height=number(height))


# Each waiting agent has a depth of its own, so that none overlaps another.
HIDDEN_DEPTH_M, HIDDEN_SPACING_M = 500.0, 10.0
# A polyline needs two vertices; an agent with one waypoint stays this long.
MIN_DURATION_S = 0.001
# "At or after t" in revisions with only "after".
JUST_BEFORE_S = 1e-6


@dataclass(frozen=True, eq=False)
class AgentStory:
    """What one agent does."""

    name: str
    vertices: Array  # (V, 5) t, x, y, z, heading of the reference point
    speed_mps: float  # at the start
    enters: bool  # whether it is absent before the vertices
    leaves: bool  # whether it is absent after them
    hidden_m: float  # how far below it waits in revisions without spawning
    external: bool  # whether it is driven from outside: it gets a place and a speed at the start, and nothing else
    start: Array  # (5,) the first vertex, or the pose at 0 s if its waypoints begin before


def add_storyboard(parent: Element, stories: list[AgentStory], duration_s: float, minor: int) -> None:
    """Add the `Storyboard` of all agents."""
    storyboard = element("Storyboard", parent)
    actions = element("Actions", element("Init", storyboard))
    for story in stories:
        if not story.enters or minor == 0:
            private = element("Private", actions, entityRef=story.name)
            below_m = story.hidden_m if story.enters else 0.0
            _add_position(element("TeleportAction", element("PrivateAction", private)), story.start, below_m)
            _add_speed(private, 0.0 if story.enters else story.speed_mps)
        if story.external:
            _add_external_control(actions[-1], minor)
    act = element("Act", element("Story", storyboard, name="scenario"), name="replay")
    for story in stories:
        if not story.external:
            _add_group(act, story, minor)
    _add_trigger(act, "StartTrigger", "at the start", 0.0, minor)
    _add_trigger(storyboard, "StopTrigger", "at the end", duration_s, minor)


def _add_external_control(private: Element, minor: int) -> None:
    """Hand the control over: to who reports states to esmini from 1.1 on, to who drives the vehicle in CARLA in 1.0."""
    control = element("ControllerAction", element("PrivateAction", private))
    if minor > 0:
        element("ActivateControllerAction", control, longitudinal="true", lateral="true")
        return
    controller = element("Controller", element("AssignControllerAction", control), name="external control")
    element("Property", element("Properties", controller), name="module", value="external_control")
    overridden = element("OverrideControllerValueAction", control)
    for pedal in ("Throttle", "Brake", "Clutch", "ParkingBrake", "SteeringWheel"):
        element(pedal, overridden, value="0", active="false")
    element("Gear", overridden, number="0", active="false")


def _add_group(act: Element, story: AgentStory, minor: int) -> None:
    """Add one agent's maneuver: it enters, follows its trajectory and leaves, or stops at the last vertex."""
    first_s, override = float(story.vertices[0, 0]), "override" if minor >= 2 else "overwrite"
    group = element("ManeuverGroup", act, name=f"{story.name} group", maximumExecutionCount="1")
    element("EntityRef", element("Actors", group, selectTriggeringEntities="false"), entityRef=story.name)
    maneuver = element("Maneuver", group, name=f"{story.name} maneuver")
    if story.enters:
        action, event = _event(maneuver, f"{story.name} enters", "parallel")
        if minor > 0:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=story.name)
            _add_position(element("AddEntityAction", entity), story.vertices[0])
        else:
            _add_position(element("TeleportAction", element("PrivateAction", action)), story.vertices[0])
        _add_trigger(event, "StartTrigger", f"{story.name} is seen", first_s, minor)
    action, event = _event(maneuver, f"{story.name} follows", "parallel")
    follow = element("FollowTrajectoryAction", element("RoutingAction", element("PrivateAction", action)))
    holder = element("TrajectoryRef", follow) if minor > 0 else follow
    trajectory = element("Trajectory", holder, name=f"{story.name} trajectory", closed="false")
    polyline = element("Polyline", element("Shape", trajectory))
    for row in story.vertices:
        _add_position(element("Vertex", polyline, time=number(row[0], 9)), row)
    element("Timing", element("TimeReference", follow), domainAbsoluteRelative="absolute", scale="1", offset="0")
    element("TrajectoryFollowingMode", follow, followingMode="position")
    _add_trigger(event, "StartTrigger", f"{story.name} may move", max(first_s, 0.0), minor)
    if not story.leaves:
        action, event = _event(maneuver, f"{story.name} stops", override)
        _add_speed(action, 0.0)
    else:
        action, event = _event(maneuver, f"{story.name} leaves", override)
        if minor > 0:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=story.name)
            element("DeleteEntityAction", entity)
        else:
            private = element("PrivateAction", action)
            _add_position(element("TeleportAction", private), story.vertices[-1], story.hidden_m)
    _add_trigger(event, "StartTrigger", f"{story.name} was seen", float(story.vertices[-1, 0]), minor)


def _event(maneuver: Element, name: str, priority: str) -> tuple[Element, Element]:
    event = element("Event", maneuver, name=name, priority=priority, maximumExecutionCount="1")
    return element("Action", event, name=f"{name} action"), event


def _add_position(parent: Element, vertex: Array, below_m: float = 0.0) -> None:
    """Add a position with all six numbers: for a missing one players use the road's, or none."""
    _, x, y, z, heading = (float(v) for v in vertex)
    element(
        "WorldPosition", element("Position", parent),
        x=number(x), y=number(y), z=number(z - below_m), h=number(heading, 9), p="0", r="0",
    )  # fmt: skip


def _add_speed(parent: Element, speed_mps: float) -> None:
    action = element("SpeedAction", element("LongitudinalAction", element("PrivateAction", parent)))
    element("SpeedActionDynamics", action, dynamicsShape="step", value="0", dynamicsDimension="time")
    element("AbsoluteTargetSpeed", element("SpeedActionTarget", action), value=number(speed_mps, 4))


def _add_trigger(parent: Element, tag: str, name: str, t_s: float, minor: int) -> None:
    """Add a trigger by time; its edge is "none", since "rising" never occurs for a condition that holds from the start."""
    group = element("ConditionGroup", element(tag, parent))
    condition = element("Condition", group, name=name, delay="0", conditionEdge="none")
    if minor > 0:
        when = {"rule": "greaterOrEqual", "value": number(t_s, 9)}
    else:
        when = {"rule": "greaterThan", "value": number(t_s - JUST_BEFORE_S, 9)}
    element("SimulationTimeCondition", element("ByValueCondition", condition), **when)


REVISIONS = {"1.0": 0, "1.1": 1, "1.2": 2}  # the second number
NEWEST = "1.2"
options: tuple[str, ...] = ("revision", "map", "ego")
loses = (
    "states of traffic lights, confidences of lanes and markings, cameras, quality, stages and provenance; players take a"
    " cyclist for a bicycle and what is 'other' for a van (an import does not), and ScenarioRunner takes over no sizes"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the scenario and its road."""
    minor = REVISIONS.get(options.revision or NEWEST)
    if minor is None:
        known = ", ".join(REVISIONS)
        raise ConfigError(f"--revision {options.revision}: OpenSCENARIO XML is written as one of {known}")
    external = options.ego is not None
    if external:
        # Raise unless there is an ego on wheels from the start, which another program can drive.
        driver = str(options.ego)
        if driver != EXTERNAL:
            raise ConfigError(f"--ego {driver}: expected '{EXTERNAL}', an ego that another program drives")
        ego = scenario.ego
        if ego is None or ego.category == "pedestrian":
            raise ConfigError(f"--ego {EXTERNAL}: scenario '{scenario.name}' has no agent '{EGO}' with wheels to drive")
        if ego.waypoints.t_s[0] > MARGIN_S:
            first_s = float(ego.waypoints.t_s[0])
            raise ConfigError(f"--ego {EXTERNAL}: the ego appears at {first_s:g} s, expected it from the start on")
    road, placement = add_road_file(scenario, folder, options.map)
    names = unique_names(a.id for a in scenario.agents)
    duration_s = max(scenario.duration_s, *(float(a.waypoints.t_s[-1]) for a in scenario.agents))
    driven = [external and agent.id == EGO for agent in scenario.agents]
    # What each agent does: of the center of its rear axle on the ground, with unwrapped headings.
    stories = []
    for k, (agent, name, flag) in enumerate(zip(scenario.agents, names, driven)):
        w, axle_m = agent.waypoints, agent.rear_axle_offset_m
        states = placement.forward(np.column_stack([w.x_m, w.y_m, w.z_m, np.unwrap(w.yaw_rad)]))
        heading = states[:, 3]
        ahead = np.column_stack([axle_m * np.cos(heading), axle_m * np.sin(heading)])
        back = np.column_stack([ahead, np.full(len(w), agent.size_m[2] / 2)])
        vertices = np.column_stack([w.t_s, states[:, :3] - back, heading])
        if len(vertices) == 1:
            vertices = np.repeat(vertices, 2, axis=0) + np.outer([0, MIN_DURATION_S], [1, 0, 0, 0, 0])
        enters, leaves = bool(w.t_s[0] > MARGIN_S), bool(vertices[-1, 0] < duration_s - MARGIN_S)
        # Players refuse a negative initial speed; a reversing agent takes its speed from the trajectory at once.
        speed_mps, hidden_m = max(float(w.speed_mps[0]), 0.0), HIDDEN_DEPTH_M + HIDDEN_SPACING_M * k
        start = np.array([np.interp(max(vertices[0, 0], 0.0), vertices[:, 0], column) for column in vertices.T])
        stories.append(AgentStory(name, vertices, speed_mps, enters, leaves, hidden_m, flag, start))
    # Box centers and headings at the start (A, 4); NaN for agents added later.
    _, x, y, z, heading = np.array([story.start for story in stories]).T
    late, below_m = np.array([s.enters for s in stories]), np.array([s.hidden_m for s in stories])
    z = np.where(late, np.nan if minor > 0 else z - below_m, z)
    ahead_m = np.array([a.rear_axle_offset_m for a in scenario.agents])
    up_m = np.array([a.size_m[2] for a in scenario.agents]) / 2
    boxes = np.column_stack([x + ahead_m * np.cos(heading), y + ahead_m * np.sin(heading), z + up_m, heading])
    require_start_as_in_scenario(scenario.agents, boxes)
    root = element("OpenSCENARIO")
    # A leading "CARLA:" in the description would switch ScenarioRunner to left-handed axes.
    # When the scenario begins: the file's date too, so that the same scenario gives the same file
    try:
        moment = datetime(1970, 1, 1, tzinfo=UTC) + timedelta(seconds=scenario.t0_ns // 1_000_000_000)
    except OverflowError:
        moment = datetime(1970, 1, 1, tzinfo=UTC)
    element(
        "FileHeader", root, revMajor="1", revMinor=str(minor), date=moment.replace(tzinfo=None).isoformat(timespec="seconds"), author="log2sim",
        description=f"log2sim: {escaped(scenario.name)}",
    )  # fmt: skip
    # What an import needs of the scenario as a whole; 1.0 and 1.1 have no properties without an agent.
    values = {
        "log2sim_name": escaped(scenario.name),
        "log2sim_t0_ns": str(scenario.t0_ns),
        "log2sim_duration_s": number(scenario.duration_s, 9),
        "log2sim_map": escaped(json.dumps(vars(scenario.map))),
        "log2sim_origin_m": " ".join(number(v) for v in placement.origin_m),
    }
    if placement.target is not None:
        values["log2sim_projection"] = escaped(placement.target)
    parameters = element("ParameterDeclarations", root)
    for name, value in values.items():
        element("ParameterDeclaration", parameters, name=name, parameterType="string", value=value)
    element("CatalogLocations", root)
    element("LogicFile", element("RoadNetwork", root), filepath=road)
    entities = element("Entities", root)
    for agent, name, flag in zip(scenario.agents, names, driven):
        add_entity(entities, agent, name, minor, external=flag)
    add_storyboard(root, stories, duration_s, minor)
    xml_text.write(root, folder / "scenario.xosc")
