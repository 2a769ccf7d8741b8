"""Assigns a driver to each agent of a scenario, and builds the groups of agents that are driven alike."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim import registry
from log2sim.datatypes import EGO, Agent, Trajectory
from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.simulation.follower import control_step
from log2sim.simulation.groups import AgentGroup, LogReplayGroup, PedestrianGroup, PolicyVehicle, VehicleGroup
from log2sim.simulation.reactive.groups import (
    ReactiveGroup,
    ReactiveLogReplayGroup,
    ReactivePedestrianGroup,
    ReactiveVehicleGroup,
)
from log2sim.simulation.reactive.traffic import Traffic
from log2sim.simulation.reference import (
    log_reference,
    point_reference,
    vehicle_reference_of,
)
from log2sim.simulation.simulators import EmbeddedSimulator, load_step
from log2sim.simulation.step_clock import StepClock
from log2sim.simulation.vehicles.model_choice import ModelChoice, choose_model, slipping_reference, understeer
from log2sim.simulation.vehicles.parameters import STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset

DriverAssignment = dict[str, list[Agent]]
"""Agents by driver: "policy", "reactive", "pid", "exact", or "static" for those that never move."""


def assign_drivers(
    agents: Sequence[Agent], mode: str, *, drives_ego: bool, reactive: Collection[str] = ()
) -> DriverAssignment:
    """Assign a driver to each agent; `reactive` holds the ids of agents that react, see `reactive_ids`."""
    assignment: DriverAssignment = {"policy": [], "reactive": [], "pid": [], "exact": [], "static": []}
    for agent in agents:
        if drives_ego and agent.id == EGO:
            assignment["policy"].append(agent)
        elif agent.static:
            assignment["static"].append(agent)
        elif agent.id in reactive:
            assignment["reactive"].append(agent)
        else:
            assignment[mode if len(agent.waypoints) > 1 else "exact"].append(agent)
    return assignment


def reactive_ids(agents: Sequence[Agent], wanted: str | Collection[str], *, drives_ego: bool) -> frozenset[str]:
    """Return the ids of the agents that react: all that can for "reactive", none for "scenario", or those named.

    Raises
    ------
    ConfigError
        When a name is not known, or is that of an agent that cannot react: static, seen once, or driven by a policy.
    """
    able = [a.id for a in agents if not a.static and len(a.waypoints) > 1 and not (drives_ego and a.id == EGO)]
    if isinstance(wanted, str):
        if wanted not in ("scenario", "log", "reactive"):  # log: the name of scenario in older programs
            raise ConfigError(f"agents '{wanted}': expected scenario or reactive")
        return frozenset(i for i in able if i != EGO) if wanted == "reactive" else frozenset()
    for name in wanted:
        if name in able:
            continue
        if any(a.id == name for a in agents):
            raise ConfigError(f"agent '{name}': cannot react, it is static, seen only once, or driven by the policy")
        raise ConfigError(f"agent '{name}': there is none of that id{nearest(name, able)}")
    return frozenset(wanted)


def agent_groups(
    assignment: Mapping[str, Sequence[Agent]], clock: StepClock, mode: str = "pid", model: str = "auto"
) -> tuple[list[AgentGroup], dict[str, ModelChoice]]:
    """Build the groups that have agents, and choose by id the model that moves each vehicle; static agents are in no group."""
    groups: list[AgentGroup] = []
    choices: dict[str, ModelChoice] = {}
    controlled: list[tuple[str, type[VehicleGroup], type[PedestrianGroup]]] = [
        ("policy", PolicyVehicle, PedestrianGroup)
    ]
    if mode == "pid":
        controlled += [
            ("reactive", ReactiveVehicleGroup, ReactivePedestrianGroup),
            ("pid", VehicleGroup, PedestrianGroup),
        ]
    for driver, kind, on_foot in controlled:
        wheeled = [a for a in assignment[driver] if a.category in WHEELED]
        groups += _vehicle_groups(wheeled, kind, clock, model, choices)
        walking = [a for a in assignment[driver] if a.category not in WHEELED]
        if walking:
            references = [point_reference(Trajectory.through(a.waypoints)) for a in walking]
            groups.append(
                on_foot(walking, references, *_lifespans(walking, clock), EmbeddedSimulator(load_step("kinematic")))
            )
    for driver, tape in (
        ("exact", LogReplayGroup),
        *([("reactive", ReactiveLogReplayGroup)] if mode == "exact" else []),
    ):
        agents = list(assignment[driver])
        if agents:
            references = [log_reference(Trajectory.through(a.waypoints, rear_axle_offset(a))) for a in agents]
            groups.append(tape(agents, references, *_lifespans(agents, clock)))
    return groups, choices


def _vehicle_groups(
    agents: Sequence[Agent], kind: type[VehicleGroup], clock: StepClock, model: str, choices: dict[str, ModelChoice]
) -> list[AgentGroup]:
    """Build one group of vehicles for each model in use; the choice for each vehicle is added to `choices`."""
    groups: list[AgentGroup] = []
    references = {a.id: vehicle_reference_of(a, clock.dt_s) for a in agents}
    for a in agents:
        choices[a.id] = choose_model(a, references[a.id], parameters_for([a]), model, free=kind is PolicyVehicle)
    chosen = {choices[a.id].model for a in agents}
    for name in sorted(chosen, key=[*registry.BUILT_IN["vehicle_model"], *sorted(chosen)].index):
        moved = [a for a in agents if choices[a.id].model == name]
        p = parameters_for(moved, published=name == "single-track")
        followed = [references[a.id] for a in moved]
        if name != "kinematic":
            p = replace(p, understeer_s2pm2=understeer(p))
            ahead_s = STEER_LAG_S + control_step(clock.dt_s) / 2
            ones = [p.take(slice(i, i + 1)) for i in range(len(moved))]
            followed = [slipping_reference(r, one, name, ahead_s) for r, one in zip(followed, ones)]
        groups.append(kind(moved, followed, *_lifespans(moved, clock), p, EmbeddedSimulator(load_step(name))))
    return groups


def reactive_traffic(
    agents: Sequence[Agent], groups: Sequence[AgentGroup], clock: StepClock, foresight: str
) -> Traffic | None:
    """Build the traffic model of the reactive groups and connect them with it; None when no agent reacts."""
    reacting = [g for g in groups if isinstance(g, ReactiveGroup)]
    if not reacting:
        return None
    trajectories = {a.id: r.trajectory for g in groups for a, r in zip(g.agents, g.references)}
    driven = next((g.agents[0].id for g in groups if isinstance(g, PolicyVehicle)), None)
    reactive = {a.id for g in reacting for a in g.agents}
    followed = [trajectories.get(a.id) or _static_trajectory(a) for a in agents]
    traffic = Traffic(agents, followed, reactive, driven, foresight)
    for group in reacting:
        group.join(traffic, clock)
    return traffic


def _static_trajectory(agent: Agent) -> Trajectory:
    """Return the trajectory of a static agent: its first pose throughout its lifetime."""
    w = agent.waypoints
    first = {k: np.full(len(w), getattr(w, k)[0]) for k in ("x_m", "y_m", "z_m", "yaw_rad")}
    return Trajectory.through(replace(w, **first, speed_mps=np.zeros(len(w))))


def _lifespans(agents: Sequence[Agent], clock: StepClock) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the first and last step (A,), (A,) of each agent; last < first when an agent lives between two steps only."""
    begin = np.array([a.waypoints.t_s[0] for a in agents])
    end = np.array([a.waypoints.t_s[-1] for a in agents])
    return clock.first_step(begin), clock.last_step(end)
