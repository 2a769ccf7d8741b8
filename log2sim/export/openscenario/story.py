"""The storyboard: initial poses, trajectories, and when agents appear and disappear.

It depends on the revision. 1.0 is for CARLA's ScenarioRunner, which does not spawn or delete entities and stops at such
an action, so agents wait `HIDDEN_DEPTH_M` or more below their first pose and return below after the last one; it also
lacks `greaterOrEqual` and `TrajectoryRef`. From 1.1 on agents are added and deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import Agent
from log2sim.export.placement import ExportPlacement
from log2sim.export.xml_text import element, number
from log2sim.geometry import Array

# Each waiting agent has a depth of its own, so that none overlaps another.
HIDDEN_DEPTH_M, HIDDEN_SPACING_M = 500.0, 10.0
# A polyline needs two vertices; an agent with one waypoint stays this long.
MIN_DURATION_S = 0.001
# "At or after t" in revisions with only "after".
JUST_BEFORE_S = 1e-6
SAME_TIME_S = 1e-6


@dataclass(frozen=True)
class Revision:
    """Differences between OpenSCENARIO 1.0, 1.1 and 1.2; `minor` is the second number."""

    minor: int

    @property
    def spawns(self) -> bool:
        """Whether agents are added and deleted."""
        return self.minor >= 1

    @property
    def override(self) -> str:
        """The priority of an event that ends others."""
        return "override" if self.minor >= 2 else "overwrite"

    def at_or_after(self, t_s: float) -> dict[str, str]:
        """Return the attributes of a `SimulationTimeCondition`."""
        if self.minor >= 1:
            return {"rule": "greaterOrEqual", "value": number(t_s, 9)}
        return {"rule": "greaterThan", "value": number(t_s - JUST_BEFORE_S, 9)}


@dataclass(frozen=True, eq=False)
class AgentStory:
    """What one agent does.

    Attributes
    ----------
    name : str
    vertices : (V, 5) float64
        t, x, y, z, heading of the reference point.
    speed_mps : float
        At the start.
    enters, leaves : bool
        Whether it is absent before and after the vertices.
    hidden_m : float
        How far below it waits in revisions without spawning.
    external : bool
        Whether it is driven from outside: it gets a place and a speed at the start, and nothing else.
    """

    name: str
    vertices: Array
    speed_mps: float
    enters: bool
    leaves: bool
    hidden_m: float = HIDDEN_DEPTH_M
    external: bool = False

    @property
    def first_s(self) -> float:
        """Time of the first vertex."""
        return float(self.vertices[0, 0])

    @property
    def last_s(self) -> float:
        """Time of the last vertex."""
        return float(self.vertices[-1, 0])

    @property
    def start(self) -> Array:
        """The first pose as a vertex (5,), or the pose at 0 s if its waypoints begin before."""
        t_s = max(self.first_s, 0.0)
        return np.array([np.interp(t_s, self.vertices[:, 0], column) for column in self.vertices.T])


def agent_stories(
    agents: Sequence[Agent], names: Sequence[str], duration_s: float, placement: ExportPlacement
) -> list[AgentStory]:
    """Return the stories of all agents, each with a depth of its own where it is hidden."""
    stories = [_agent_story(agent, name, duration_s, placement) for agent, name in zip(agents, names)]
    return [replace(story, hidden_m=HIDDEN_DEPTH_M + HIDDEN_SPACING_M * k) for k, story in enumerate(stories)]


def _agent_story(agent: Agent, name: str, duration_s: float, placement: ExportPlacement) -> AgentStory:
    """Return the story of an agent: the center of its rear axle on the ground, with unwrapped headings."""
    w = agent.waypoints
    states = placement.forward(np.column_stack([w.x_m, w.y_m, w.z_m, np.unwrap(w.yaw_rad)]))
    heading, axle_m = states[:, 3], agent.rear_axle_offset_m
    back = np.column_stack([axle_m * np.cos(heading), axle_m * np.sin(heading), np.full(len(w), agent.size_m[2] / 2)])
    vertices = np.column_stack([w.t_s, states[:, :3] - back, heading])
    if len(vertices) == 1:
        vertices = np.repeat(vertices, 2, axis=0) + np.outer([0, MIN_DURATION_S], [1, 0, 0, 0, 0])
    enters, leaves = w.t_s[0] > SAME_TIME_S, vertices[-1, 0] < duration_s - SAME_TIME_S
    # Players refuse a negative initial speed; a reversing agent takes its speed from the trajectory at once.
    return AgentStory(name, vertices, max(float(w.speed_mps[0]), 0.0), bool(enters), bool(leaves))


def start_poses(stories: Sequence[AgentStory], revision: Revision) -> Array:
    """Return poses at the start (A, 4) x, y, z, heading of the reference points; NaN for agents added later."""
    rows = np.array([story.start[1:] for story in stories])
    for row, story in zip(rows, stories):
        if story.enters:
            row[2] = np.nan if revision.spawns else row[2] - story.hidden_m
    return rows


def add_storyboard(parent: Element, stories: list[AgentStory], duration_s: float, revision: Revision) -> None:
    """Add the `Storyboard` of all agents."""
    storyboard = element("Storyboard", parent)
    actions = element("Actions", element("Init", storyboard))
    for story in stories:
        if not story.enters or not revision.spawns:
            _add_start(actions, story)
        if story.external:
            _add_external_control(actions[-1], revision)
    act = element("Act", element("Story", storyboard, name="scenario"), name="replay")
    for story in stories:
        if not story.external:
            _add_group(act, story, revision)
    _add_trigger(act, "StartTrigger", "at the start", 0.0, revision)
    _add_trigger(storyboard, "StopTrigger", "at the end", duration_s, revision)


def _add_start(actions: Element, story: AgentStory) -> None:
    private = element("Private", actions, entityRef=story.name)
    below_m = story.hidden_m if story.enters else 0.0
    _add_position(element("TeleportAction", element("PrivateAction", private)), story.start, below_m)
    _add_speed(private, "PrivateAction", 0.0 if story.enters else story.speed_mps)


def _add_external_control(private: Element, revision: Revision) -> None:
    """Hand the control over: to who reports states to esmini from 1.1 on, to who drives the vehicle in CARLA in 1.0."""
    control = element("ControllerAction", element("PrivateAction", private))
    if revision.minor > 0:
        element("ActivateControllerAction", control, longitudinal="true", lateral="true")
        return
    controller = element("Controller", element("AssignControllerAction", control), name="external control")
    element("Property", element("Properties", controller), name="module", value="external_control")
    overridden = element("OverrideControllerValueAction", control)
    for pedal in ("Throttle", "Brake", "Clutch", "ParkingBrake", "SteeringWheel"):
        element(pedal, overridden, value="0", active="false")
    element("Gear", overridden, number="0", active="false")


def _add_group(act: Element, story: AgentStory, revision: Revision) -> None:
    """Add one agent's maneuver: it enters, follows its trajectory and leaves, or stops at the last vertex."""
    group = element("ManeuverGroup", act, name=f"{story.name} group", maximumExecutionCount="1")
    element("EntityRef", element("Actors", group, selectTriggeringEntities="false"), entityRef=story.name)
    maneuver = element("Maneuver", group, name=f"{story.name} maneuver")
    if story.enters:
        action, event = _event(maneuver, f"{story.name} enters", "parallel")
        if revision.spawns:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=story.name)
            _add_position(element("AddEntityAction", entity), story.vertices[0])
        else:
            _add_position(element("TeleportAction", element("PrivateAction", action)), story.vertices[0])
        _add_trigger(event, "StartTrigger", f"{story.name} is seen", story.first_s, revision)
    action, event = _event(maneuver, f"{story.name} follows", "parallel")
    _add_trajectory(action, story, revision)
    _add_trigger(event, "StartTrigger", f"{story.name} may move", max(story.first_s, 0.0), revision)
    _add_end(maneuver, story, revision)


def _add_end(maneuver: Element, story: AgentStory, revision: Revision) -> None:
    if not story.leaves:
        action, event = _event(maneuver, f"{story.name} stops", revision.override)
        _add_speed(action, "PrivateAction", 0.0)
    else:
        action, event = _event(maneuver, f"{story.name} leaves", revision.override)
        if revision.spawns:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=story.name)
            element("DeleteEntityAction", entity)
        else:
            private = element("PrivateAction", action)
            _add_position(element("TeleportAction", private), story.vertices[-1], story.hidden_m)
    _add_trigger(event, "StartTrigger", f"{story.name} was seen", story.last_s, revision)


def _event(maneuver: Element, name: str, priority: str) -> tuple[Element, Element]:
    event = element("Event", maneuver, name=name, priority=priority, maximumExecutionCount="1")
    return element("Action", event, name=f"{name} action"), event


def _add_trajectory(action: Element, story: AgentStory, revision: Revision) -> None:
    follow = element("FollowTrajectoryAction", element("RoutingAction", element("PrivateAction", action)))
    holder = element("TrajectoryRef", follow) if revision.minor >= 1 else follow
    trajectory = element("Trajectory", holder, name=f"{story.name} trajectory", closed="false")
    polyline = element("Polyline", element("Shape", trajectory))
    for row in story.vertices:
        _add_position(element("Vertex", polyline, time=number(row[0], 9)), row)
    timing = element("TimeReference", follow)
    element("Timing", timing, domainAbsoluteRelative="absolute", scale="1", offset="0")
    element("TrajectoryFollowingMode", follow, followingMode="position")


def _add_position(parent: Element, vertex: Array, below_m: float = 0.0) -> None:
    """Add a position with all six numbers: for a missing one players use the road's, or none."""
    _, x, y, z, heading = (float(v) for v in vertex)
    element(
        "WorldPosition", element("Position", parent),
        x=number(x), y=number(y), z=number(z - below_m), h=number(heading, 9), p="0", r="0",
    )  # fmt: skip


def _add_speed(parent: Element, tag: str, speed_mps: float) -> None:
    action = element("SpeedAction", element("LongitudinalAction", element(tag, parent)))
    element("SpeedActionDynamics", action, dynamicsShape="step", value="0", dynamicsDimension="time")
    element("AbsoluteTargetSpeed", element("SpeedActionTarget", action), value=number(speed_mps, 4))


def _add_trigger(parent: Element, tag: str, name: str, t_s: float, revision: Revision) -> None:
    """Add a trigger by time; its edge is "none", since "rising" never occurs for a condition that holds from the start."""
    group = element("ConditionGroup", element(tag, parent))
    condition = element("Condition", group, name=name, delay="0", conditionEdge="none")
    element("SimulationTimeCondition", element("ByValueCondition", condition), **revision.at_or_after(t_s))
