"""Who drives each agent of a scenario, and the groups that this makes."""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.replay.clock import Clock
from log2sim.replay.drivable import LOCK_SHARE, Limits
from log2sim.replay.follower import control_step
from log2sim.replay.path import Path, path_of
from log2sim.replay.reactive.group import Reactive, ReactiveCrowd, ReactiveFleet, ReactiveTape
from log2sim.replay.reactive.traffic import Traffic
from log2sim.replay.reference import (
    MAX_CURVATURE_1PM,
    MAX_TWO_WHEELER_CURVATURE_1PM,
    Reference,
    point_reference,
    tape_reference,
    vehicle_reference,
)
from log2sim.replay.simulator import STEPS, EmbeddedSimulator
from log2sim.replay.vehicles.models import Choice, choose, slipping_reference, understeer
from log2sim.replay.vehicles.parameters import PEDAL_LAG_S, STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset
from log2sim.replay.world import Crowd, Driven, Fleet, Group, Tape
from log2sim.scenario import EGO, Agent

Cast = dict[str, list[Agent]]
"""Agents by what drives them: "policy", "reactive", "pid", "exact" or, with one pose for good, "static"."""


def cast_agents(agents: Sequence[Agent], mode: str, *, drives_ego: bool, reactive: Collection[str] = ()) -> Cast:
    """Who is driven by what; ids in `reactive` are of agents that can be."""
    cast: Cast = {"policy": [], "reactive": [], "pid": [], "exact": [], "static": []}
    for agent in agents:
        if drives_ego and agent.id == EGO:
            cast["policy"].append(agent)
        elif agent.static:
            cast["static"].append(agent)
        elif agent.id in reactive:
            cast["reactive"].append(agent)
        else:
            cast[mode if len(agent.waypoints) > 1 else "exact"].append(agent)
    return cast


def reactive_ids(agents: Sequence[Agent], wanted: str | Collection[str], *, drives_ego: bool) -> frozenset[str]:
    """Ids of the agents that react: all that can for "reactive", none for "log", or those named.

    Raises
    ------
    ConfigError
        When a name is not known, or is that of an agent that cannot react: parked, seen once, or driven by a policy.
    """
    able = [a.id for a in agents if not a.static and len(a.waypoints) > 1 and not (drives_ego and a.id == EGO)]
    if isinstance(wanted, str):
        if wanted not in ("log", "reactive"):
            raise ConfigError(f"agents '{wanted}': expected log or reactive")
        return frozenset(i for i in able if i != EGO) if wanted == "reactive" else frozenset()
    for name in wanted:
        if name in able:
            continue
        if any(a.id == name for a in agents):
            raise ConfigError(f"agent '{name}': cannot react, it is parked, seen only once, or driven by the policy")
        raise ConfigError(f"agent '{name}': there is none of that id{nearest(name, able)}")
    return frozenset(wanted)


def groups_of(
    cast: Mapping[str, Sequence[Agent]], clock: Clock, mode: str = "pid", model: str = "auto"
) -> tuple[list[Group], dict[str, Choice]]:
    """The groups that have agents, and by id the model that moves each vehicle; static agents are in none."""
    groups: list[Group] = []
    choices: dict[str, Choice] = {}
    controlled: list[tuple[str, type[Fleet], type[Crowd]]] = [("policy", Driven, Crowd)]
    if mode == "pid":
        controlled += [("reactive", ReactiveFleet, ReactiveCrowd), ("pid", Fleet, Crowd)]
    for driver, kind, on_foot in controlled:
        wheeled = [a for a in cast[driver] if a.category in WHEELED]
        groups += _fleets(wheeled, kind, clock, model, choices)
        walking = [a for a in cast[driver] if a.category not in WHEELED]
        if walking:
            references = [point_reference(path_of(a, 0.0)) for a in walking]
            groups.append(on_foot(walking, references, *_lives(walking, clock), EmbeddedSimulator(STEPS["kinematic"])))
    for driver, tape in (("exact", Tape), *([("reactive", ReactiveTape)] if mode == "exact" else [])):
        agents = list(cast[driver])
        if agents:
            references = [tape_reference(path_of(a, rear_axle_offset(a))) for a in agents]
            groups.append(tape(agents, references, *_lives(agents, clock)))
    return groups, choices


def _fleets(
    agents: Sequence[Agent], kind: type[Fleet], clock: Clock, model: str, choices: dict[str, Choice]
) -> list[Group]:
    """Groups of vehicles, one for each model that moves some of them; what moves each is added to `choices`."""
    groups: list[Group] = []
    references = {a.id: _vehicle_reference(a, clock.dt_s) for a in agents}
    for a in agents:
        choices[a.id] = choose(a, references[a.id], parameters_for([a]), model, free=kind is Driven)
    for name in STEPS:
        moved = [a for a in agents if choices[a.id].model == name]
        if moved:
            p = parameters_for(moved, published=name == "single-track")
            followed = [references[a.id] for a in moved]
            if name != "kinematic":
                p = replace(p, understeer_s2pm2=understeer(p))
                ahead_s = STEER_LAG_S + control_step(clock.dt_s) / 2
                ones = [p.take(slice(i, i + 1)) for i in range(len(moved))]
                followed = [slipping_reference(r, one, name, ahead_s) for r, one in zip(followed, ones)]
            groups.append(kind(moved, followed, *_lives(moved, clock), p, EmbeddedSimulator(STEPS[name])))
    return groups


def traffic_of(agents: Sequence[Agent], groups: Sequence[Group], clock: Clock) -> Traffic | None:
    """What the reactive groups decide by, with which they are connected; None where nobody reacts."""
    reacting = [g for g in groups if isinstance(g, Reactive)]
    if not reacting:
        return None
    paths = {a.id: r.path for g in groups for a, r in zip(g.agents, g.references)}
    driven = next((g.agents[0].id for g in groups if isinstance(g, Driven)), None)
    reactive = {a.id for g in reacting for a in g.agents}
    traffic = Traffic(agents, [paths.get(a.id) or _pose(a) for a in agents], reactive, driven)
    for group in reacting:
        group.join(traffic, clock)
    return traffic


def _pose(agent: Agent) -> Path:
    """The path of a static agent: it stands, as long as it lives."""
    w = agent.waypoints
    first = {k: np.full(len(w), getattr(w, k)[0]) for k in ("x_m", "y_m", "z_m", "yaw_rad")}
    return path_of(replace(agent, waypoints=replace(w, **first, speed_mps=np.zeros(len(w)))), 0.0)


def vehicle_limits(agent: Agent) -> Limits:
    """What a wheeled agent can drive, from its category and length."""
    p = parameters_for([agent])
    wheelbase_m = float(p.wheelbase_m[0])
    return Limits(
        offset_m=float(p.rear_axle_offset_m[0]),
        max_curvature_1pm=LOCK_SHARE * math.tan(p.max_steer_rad[0]) / wheelbase_m,
        max_curvature_rate_1pmps=float(p.max_steer_rate_radps[0]) / wheelbase_m,
        max_accel_mps2=float(p.max_brake_mps2[0]),
    )


def _vehicle_reference(agent: Agent, dt_s: float) -> Reference:
    """A vehicle's table: feed-forward is ahead by the actuator's lag and by half the step for which it is held."""
    limits = vehicle_limits(agent)
    return vehicle_reference(
        path_of(agent, limits.offset_m),
        limits,
        accel_ahead_s=PEDAL_LAG_S + control_step(dt_s) / 2,
        curvature_ahead_s=STEER_LAG_S + control_step(dt_s) / 2,
        max_curvature_1pm=MAX_CURVATURE_1PM
        if agent.category in ("car", "truck", "bus")
        else MAX_TWO_WHEELER_CURVATURE_1PM,
    )


def _lives(agents: Sequence[Agent], clock: Clock) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First and last step (A,), (A,) of each agent; the last before the first where a life lies between two steps."""
    begin = np.array([a.waypoints.t_s[0] for a in agents])
    end = np.array([a.waypoints.t_s[-1] for a in agents])
    return clock.first_step(begin), clock.last_step(end)
