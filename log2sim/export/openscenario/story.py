"""The storyboard: where agents stand at first, the trajectories that they follow, when they come and go.

Written by revision. 1.0 is what CARLA's ScenarioRunner reads: it knows no spawning and deleting and stops at such an
action, so there agents wait `HIDDEN_M` or more below their first pose and go back below after the last one; it also knows
neither `greaterOrEqual` nor `TrajectoryRef`. From 1.1 on agents are added and deleted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from xml.etree.ElementTree import Element

import numpy as np

from log2sim.datatypes import Agent
from log2sim.export.placement import Placement
from log2sim.export.xml_text import element, number
from log2sim.geometry import Array

# Each agent that waits has a level of its own, so that none waits in another.
HIDDEN_M, LEVEL_M = 500.0, 10.0
# A polyline needs two vertices; an agent that was seen once stays this long.
MOMENT_S = 0.001
# "At or after t" where only "after" can be said.
JUST_BEFORE_S = 1e-6
SAME_TIME_S = 1e-6


@dataclass(frozen=True)
class Revision:
    """What differs between OpenSCENARIO 1.0, 1.1 and 1.2; `minor` is the second number."""

    minor: int

    @property
    def spawns(self) -> bool:
        return self.minor >= 1

    @property
    def override(self) -> str:
        return "override" if self.minor >= 2 else "overwrite"

    def at_or_after(self, t_s: float) -> dict[str, str]:
        """Attributes of a `SimulationTimeCondition`."""
        if self.minor >= 1:
            return {"rule": "greaterOrEqual", "value": number(t_s, 9)}
        return {"rule": "greaterThan", "value": number(t_s - JUST_BEFORE_S, 9)}


@dataclass(frozen=True, eq=False)
class Part:
    """What one agent plays: vertices (V, 5) t, x, y, z, heading of its reference point.

    `enters` and `leaves` tell whether it is absent before and after them, `hidden_m` how far below it waits where absent
    agents cannot be taken away.
    """

    name: str
    vertices: Array
    speed_mps: float
    enters: bool
    leaves: bool
    hidden_m: float = HIDDEN_M

    @property
    def first_s(self) -> float:
        return float(self.vertices[0, 0])

    @property
    def last_s(self) -> float:
        return float(self.vertices[-1, 0])

    @property
    def start(self) -> Array:
        """The vertex (5,) where it begins, which is where it is at 0 s if its log began before."""
        t_s = max(self.first_s, 0.0)
        return np.array([np.interp(t_s, self.vertices[:, 0], column) for column in self.vertices.T])


def parts_of(agents: Sequence[Agent], names: Sequence[str], duration_s: float, placement: Placement) -> list[Part]:
    """The parts of all agents, each on a level of its own where it is hidden."""
    parts = [_part(agent, name, duration_s, placement) for agent, name in zip(agents, names)]
    return [replace(part, hidden_m=HIDDEN_M + LEVEL_M * k) for k, part in enumerate(parts)]


def _part(agent: Agent, name: str, duration_s: float, placement: Placement) -> Part:
    """The part of an agent: the middle of its rear axle on the ground, headings that never jump by a turn."""
    w = agent.waypoints
    states = placement.forward(np.column_stack([w.x_m, w.y_m, w.z_m, np.unwrap(w.yaw_rad)]))
    heading, axle_m = states[:, 3], agent.rear_axle_offset_m
    back = np.column_stack([axle_m * np.cos(heading), axle_m * np.sin(heading), np.full(len(w), agent.size_m[2] / 2)])
    vertices = np.column_stack([w.t_s, states[:, :3] - back, heading])
    if len(vertices) == 1:
        vertices = np.repeat(vertices, 2, axis=0) + np.outer([0, MOMENT_S], [1, 0, 0, 0, 0])
    enters, leaves = w.t_s[0] > SAME_TIME_S, vertices[-1, 0] < duration_s - SAME_TIME_S
    # Players refuse a negative speed at the start; a reversing agent gets its own from the trajectory at once.
    return Part(name, vertices, max(float(w.speed_mps[0]), 0.0), bool(enters), bool(leaves))


def starts(parts: Sequence[Part], revision: Revision) -> Array:
    """Where agents stand at the start (A, 4) x, y, z, heading of their reference points; NaN for those added later."""
    rows = np.array([part.start[1:] for part in parts])
    for row, part in zip(rows, parts):
        if part.enters:
            row[2] = np.nan if revision.spawns else row[2] - part.hidden_m
    return rows


def add_storyboard(parent: Element, parts: list[Part], duration_s: float, revision: Revision) -> None:
    """Add the `Storyboard` of all parts."""
    storyboard = element("Storyboard", parent)
    actions = element("Actions", element("Init", storyboard))
    for part in parts:
        if not part.enters or not revision.spawns:
            _add_start(actions, part)
    act = element("Act", element("Story", storyboard, name="log"), name="replay")
    for part in parts:
        _add_group(act, part, revision)
    _add_trigger(act, "StartTrigger", "at the start", 0.0, revision)
    _add_trigger(storyboard, "StopTrigger", "at the end", duration_s, revision)


def _add_start(actions: Element, part: Part) -> None:
    private = element("Private", actions, entityRef=part.name)
    below_m = part.hidden_m if part.enters else 0.0
    _add_position(element("TeleportAction", element("PrivateAction", private)), part.start, below_m)
    _add_speed(private, "PrivateAction", 0.0 if part.enters else part.speed_mps)


def _add_group(act: Element, part: Part, revision: Revision) -> None:
    """One agent's maneuver: it enters, follows its trajectory and leaves, or stops at the last vertex."""
    group = element("ManeuverGroup", act, name=f"{part.name} group", maximumExecutionCount="1")
    element("EntityRef", element("Actors", group, selectTriggeringEntities="false"), entityRef=part.name)
    maneuver = element("Maneuver", group, name=f"{part.name} maneuver")
    if part.enters:
        action, event = _event(maneuver, f"{part.name} enters", "parallel")
        if revision.spawns:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=part.name)
            _add_position(element("AddEntityAction", entity), part.vertices[0])
        else:
            _add_position(element("TeleportAction", element("PrivateAction", action)), part.vertices[0])
        _add_trigger(event, "StartTrigger", f"{part.name} is seen", part.first_s, revision)
    action, event = _event(maneuver, f"{part.name} follows", "parallel")
    _add_trajectory(action, part, revision)
    _add_trigger(event, "StartTrigger", f"{part.name} may move", max(part.first_s, 0.0), revision)
    _add_end(maneuver, part, revision)


def _add_end(maneuver: Element, part: Part, revision: Revision) -> None:
    if not part.leaves:
        action, event = _event(maneuver, f"{part.name} stops", revision.override)
        _add_speed(action, "PrivateAction", 0.0)
    else:
        action, event = _event(maneuver, f"{part.name} leaves", revision.override)
        if revision.spawns:
            entity = element("EntityAction", element("GlobalAction", action), entityRef=part.name)
            element("DeleteEntityAction", entity)
        else:
            private = element("PrivateAction", action)
            _add_position(element("TeleportAction", private), part.vertices[-1], part.hidden_m)
    _add_trigger(event, "StartTrigger", f"{part.name} was seen", part.last_s, revision)


def _event(maneuver: Element, name: str, priority: str) -> tuple[Element, Element]:
    event = element("Event", maneuver, name=name, priority=priority, maximumExecutionCount="1")
    return element("Action", event, name=f"{name} action"), event


def _add_trajectory(action: Element, part: Part, revision: Revision) -> None:
    follow = element("FollowTrajectoryAction", element("RoutingAction", element("PrivateAction", action)))
    holder = element("TrajectoryRef", follow) if revision.minor >= 1 else follow
    trajectory = element("Trajectory", holder, name=f"{part.name} trajectory", closed="false")
    polyline = element("Polyline", element("Shape", trajectory))
    for row in part.vertices:
        _add_position(element("Vertex", polyline, time=number(row[0], 9)), row)
    timing = element("TimeReference", follow)
    element("Timing", timing, domainAbsoluteRelative="absolute", scale="1", offset="0")
    element("TrajectoryFollowingMode", follow, followingMode="position")


def _add_position(parent: Element, vertex: Array, below_m: float = 0.0) -> None:
    """A position with all six numbers: a player that misses one takes the road's, or none."""
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
    """A trigger by time; its edge is "none", since "rising" never comes for what holds from the start."""
    group = element("ConditionGroup", element(tag, parent))
    condition = element("Condition", group, name=name, delay="0", conditionEdge="none")
    element("SimulationTimeCondition", element("ByValueCondition", condition), **revision.at_or_after(t_s))
