"""Export to CommonRoad 2020a: lanes as lanelets, agents as obstacles, and the ego's task as planning problem.

`ZAM_<name>-1_1_T-1.xml`, and `agents.csv` with the agent behind each of its numbers. Written without CommonRoad's own library: each year's release has other modules, all releases pin a protobuf version
that conflicts with other packages, and its writer truncates decimals and dates files by the day of writing.
"""

from __future__ import annotations

import re
from datetime import UTC, datetime
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import Agent, Scenario, Signal
from log2sim.errors import ScenarioError
from log2sim.export import xml_text
from log2sim.export.csv_table import write_csv_table
from log2sim.export.exporters import Options, SampledMotion, sample_motion, sample_steps, step_times
from log2sim.export.roads.network import MarkFinder
from log2sim.export.roads.opendrive import edges_of, lanes, signal_lanes
from log2sim.export.xml_text import element
from log2sim.geometry import NS_PER_S, Array

VERSION = "2020a"
STEP_S = 0.1
DECIMALS = 9
GOAL_S = 1.0  # tolerance of the time at which the goal is reached
GOAL_LENGTH_M = 6.0
GOAL_SIDE_M = 1.0
GOAL_YAW_RAD = 0.35
GOAL_SPEED_MPS = 3.0
TYPE_OF_CATEGORY = {
    "car": "car", "truck": "truck", "bus": "bus", "motorcycle": "motorcycle", "cyclist": "bicycle",
    "bicycle": "bicycle", "pedestrian": "pedestrian", "other": "unknown",
}  # fmt: skip
LIGHT = {
    "red": "red", "red_yellow": "redYellow", "yellow": "yellow", "green": "green", "off": "inactive", "unknown": "inactive",
}  # fmt: skip
LINE_MARKING = {"solid": "solid", "broken": "dashed", "curb": "curb", "none": "no_marking"}
# Static obstacles have types of their own, without pedestrians: those are dynamic obstacles that do not move.
STATIC_TYPE = dict.fromkeys(("car", "truck", "bus", "motorcycle", "bicycle"), "parkedVehicle") | {"other": "unknown"}
options: tuple[str, ...] = ()
loses = (
    "colors, uncertainty and observed flags, times between steps of 0.1 s and before the ego's first, the ego's way "
    "between start and goal, confidences of lanes, crosswalks, states of traffic lights beyond the log, when static vehicles were first and last seen, cameras, stages; text ids (in agents.csv)"
)


def write(scenario: Scenario, folder: Path, options: Options) -> None:
    """Write the scenario file and the table of agents."""
    # The ego, and all steps from its first waypoint to the last of any agent.
    ego = scenario.ego
    if ego is None:
        raise ScenarioError(
            f"scenario '{scenario.name}' has no agent 'ego', which the planning problem needs; choose one with --ego AGENT"
        )
    start, stop = ego.waypoints.t_s[0], ego.waypoints.t_s[-1]
    if stop - start < STEP_S:
        raise ScenarioError(f"agent 'ego': lives {stop - start:g} s, a planning problem needs {STEP_S} s or more")
    t_s = step_times(start, max(a.waypoints.t_s[-1] for a in scenario.agents), STEP_S)
    words = "".join(word[:1].upper() + word[1:] for word in re.findall("[A-Za-z0-9]+", scenario.name))[:50]
    name = f"ZAM_{words or 'Scenario'}-1_1_T-1"  # benchmark ids have letters and digits alone
    # The document with its header, dated by the start of the scenario so that the same scenario gives the same bytes.
    root = element("commonRoad", None, commonRoadVersion=VERSION, benchmarkID=name, timeStepSize=_decimal(STEP_S))
    root.set("date", datetime.fromtimestamp(scenario.t0_ns // NS_PER_S, UTC).date().isoformat())
    root.attrib |= {"author": "log2sim", "affiliation": "", "source": xml_text.escaped(scenario.name)}
    frame = scenario.map
    place = {"geoNameId": "-999", "gpsLatitude": "999", "gpsLongitude": "999"}  # CommonRoad's values for unknown ones
    if frame.latitude_deg is not None and frame.longitude_deg is not None:
        place |= {"gpsLatitude": _decimal(frame.latitude_deg), "gpsLongitude": _decimal(frame.longitude_deg)}
    location = _texts(element("location"), **place)
    if frame.projection is not None:
        x, y, _ = frame.offset_m  # from projected coordinates to those of the file
        transformation = _texts(element("geoTransformation", location), geoReference=xml_text.escaped(frame.projection))
        shift = {"xTranslation": _decimal(-x), "yTranslation": _decimal(-y), "zRotation": "0", "scaling": "1"}
        _texts(element("additionalTransformation", transformation), **shift)
    root.append(location)
    element("scenarioTags", root)
    roads = lanes(scenario)
    number_of = {lane.id: number for number, lane in enumerate(roads, start=1)}
    lights = [{lane.id for lane in signal_lanes(signal, roads)} for signal in scenario.signals]
    marks = MarkFinder(scenario)
    for lane in roads:
        own = [len(roads) + k for k, names in enumerate(lights, start=1) if lane.id in names]
        # A lane with its edges, the lanes before, behind and beside it, and the traffic lights for it
        lanelet = element("lanelet", id=str(number_of[lane.id]))
        sides = ("leftBound", "rightBound"), edges_of(lane), map(marks.mark, (lane.left, lane.right))
        for tag, bound, mark in zip(*sides):
            parent = element(tag, lanelet)
            for point in bound:
                _point(parent, point)
            _texts(parent, lineMarking=LINE_MARKING[mark.kind])
        for tag, others in (("predecessor", lane.predecessors), ("successor", lane.successors)):
            for other in others:
                element(tag, lanelet, ref=str(number_of[other]))
        for tag, beside in (("adjacentLeft", lane.left_lane), ("adjacentRight", lane.right_lane)):
            if beside is not None:
                element(tag, lanelet, ref=str(number_of[beside]), drivingDir="same")
        _texts(lanelet, laneletType="unknown" if lane.junction is None else "intersection")
        for light in own:
            element("trafficLightRef", lanelet, ref=str(light))
        root.append(lanelet)
    root.extend(_traffic_light(signal, len(roads) + k, t_s) for k, signal in enumerate(scenario.signals, start=1))
    first = len(roads) + len(scenario.signals) + 1
    table: list[tuple[object, ...]] = [("commonroad_id", "agent", "category", "role", "confidence", "doubts")]
    obstacles = []
    for number, agent in enumerate((ego, *scenario.others), start=first):
        obstacle = None if agent is ego else _obstacle(agent, number, t_s)
        obstacles += [obstacle] if obstacle is not None else []
        role = "planning problem" if agent is ego else "left out: not alive at any step"
        doubts = ", ".join(doubt.sentence for doubt in agent.doubts)
        role = role if obstacle is None else obstacle.tag
        table.append((number, agent.id, agent.category, role, agent.confidence, doubts))
    root.extend(sorted(obstacles, key=lambda o: o.tag != "staticObstacle"))  # the schema wants these first
    root.append(_planning_problem(ego, first, step_times(t_s[0], ego.waypoints.t_s[-1], STEP_S)))
    xml_text.write(root, folder / f"{name}.xml")
    write_csv_table(folder / "agents.csv", table)


def _decimal(value: float) -> str:
    return xml_text.number(value, DECIMALS)


def _texts(parent: Element, **children: str) -> Element:
    for tag, text in children.items():
        element(tag, parent).text = text
    return parent


def _point(parent: Element, xyz: Array) -> None:
    _texts(element("point", parent), **dict(zip("xyz", map(_decimal, xyz))))


def _traffic_light(signal: Signal, number: int, t_s: Array) -> Element:
    """Return a traffic light whose cycle is what was seen of it from the first step to the last."""
    states = [LIGHT[str(state)] for state in signal.at(t_s)]
    node = element("trafficLight", id=str(number))
    cycle = element("cycle", node)
    starts = [k for k, state in enumerate(states) if k == 0 or state != states[k - 1]]
    for first, last in zip(starts, [*starts[1:], len(states)], strict=True):
        _texts(element("cycleElement", cycle), duration=str(last - first), color=states[first])
    _point(element("position", node), signal.position_m)
    return _texts(node, direction="all", active="true")


def _obstacle(agent: Agent, number: int, t_s: Array) -> Element | None:
    """Return an agent as obstacle; None for one that is gone before the first step."""
    if agent.static and agent.category in STATIC_TYPE:
        obstacle = _texts(element("staticObstacle", id=str(number)), type=STATIC_TYPE[agent.category])
        _shape(obstacle, agent)
        obstacle.append(_state("initialState", sample_motion(agent, agent.waypoints.t_s[:1]), 0))
        return obstacle
    move = sample_steps(agent, t_s, STEP_S, at_least=2)  # an initial state and a trajectory
    steps = np.flatnonzero(move.valid).tolist()
    if len(steps) < 2:
        return None
    obstacle = _texts(element("dynamicObstacle", id=str(number)), type=TYPE_OF_CATEGORY[agent.category])
    _shape(obstacle, agent)
    obstacle.append(_state("initialState", move, steps[0]))
    element("trajectory", obstacle).extend(_state("state", move, k) for k in steps[1:])
    return obstacle


def _shape(obstacle: Element, agent: Agent) -> None:
    length, width, _ = map(_decimal, agent.size_m)
    _texts(element("rectangle", element("shape", obstacle)), length=length, width=width)


def _along(vector: Array, yaw_rad: float) -> float:
    return float(vector[0] * np.cos(yaw_rad) + vector[1] * np.sin(yaw_rad))


def _state(tag: str, move: SampledMotion, k: int) -> Element:
    """Return the state at step k of a motion; speed and acceleration are along the heading."""
    yaw = float(move.yaw_rad[k])
    state = element(tag)
    _point(element("position", state), move.position_m[k, :2])
    speed, acceleration = (_along(v[k], yaw) for v in (move.velocity_mps, move.acceleration_mps2))
    rows = (("orientation", yaw), ("time", k), ("velocity", speed), ("acceleration", acceleration))
    for key, value in rows:
        _texts(element(key, state), exact=str(value) if isinstance(value, int) else _decimal(value))
    return state


def _planning_problem(ego: Agent, number: int, t_s: Array) -> Element:
    """Return the task of the ego: from its first to its last pose, in about the time that it takes."""
    move, last, spare = sample_motion(ego, t_s), len(t_s) - 1, round(GOAL_S / STEP_S)
    problem = element("planningProblem", id=str(number))
    initial = _state("initialState", move, 0)
    for key in ("yawRate", "slipAngle"):
        _texts(element(key, initial), exact="0")
    problem.append(initial)
    yaw = float(move.yaw_rad[last])
    speed = _along(move.velocity_mps[last], yaw)
    goal = element("goalState", problem)
    area = element("rectangle", element("position", goal))
    width = _decimal(ego.size_m[1] + 2 * GOAL_SIDE_M)
    _texts(area, length=_decimal(GOAL_LENGTH_M), width=width, orientation=_decimal(yaw))
    x, y, _ = map(_decimal, move.position_m[last])
    _texts(element("center", area), x=x, y=y)
    for tag, middle, reach in (("orientation", yaw, GOAL_YAW_RAD), ("velocity", speed, GOAL_SPEED_MPS)):
        _texts(element(tag, goal), intervalStart=_decimal(middle - reach), intervalEnd=_decimal(middle + reach))
    _texts(element("time", goal), intervalStart=str(max(0, last - spare)), intervalEnd=str(last + spare))
    return problem
