"""Who drives each agent of a scenario, and the groups that this makes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.replay.drivable import LOCK_SHARE, Limits
from log2sim.replay.follower import control_step
from log2sim.replay.models import Choice, choose, slipping_reference, understeer
from log2sim.replay.parameters import PEDAL_LAG_S, STEER_LAG_S, WHEELED, parameters_for, rear_axle_offset
from log2sim.replay.path import path_of
from log2sim.replay.reference import MAX_CURVATURE_1PM, Reference, point_reference, tape_reference, vehicle_reference
from log2sim.replay.rollout import Clock
from log2sim.replay.simulator import STEPS, simulator_named
from log2sim.replay.vehicle import VehicleParameters
from log2sim.replay.world import Crowd, Driven, Fleet, Group, Tape
from log2sim.scenario import Agent

EGO = "ego"
MAX_TWO_WHEELER_CURVATURE_1PM = 1.0


def cast_agents(agents: Sequence[Agent], mode: str, *, drives_ego: bool) -> dict[str, list[Agent]]:
    """Who is driven by what: "policy", "pid", "exact" or, with one pose for good, "static"."""
    cast: dict[str, list[Agent]] = {"policy": [], "pid": [], "exact": [], "static": []}
    for agent in agents:
        if drives_ego and agent.id == EGO:
            cast["policy"].append(agent)
        elif agent.static:
            cast["static"].append(agent)
        else:
            cast[mode if len(agent.waypoints) > 1 else "exact"].append(agent)
    return cast


def groups_of(
    cast: Mapping[str, Sequence[Agent]], clock: Clock, model: str = "auto"
) -> tuple[list[Group], dict[str, Choice]]:
    """The groups that have agents, and by id the model that moves each vehicle; static agents are in none."""
    groups: list[Group] = []
    choices: dict[str, Choice] = {}
    for driver, kind in (("policy", Driven), ("pid", Fleet)):
        agents = [a for a in cast[driver] if a.category in WHEELED]
        references = {a.id: _vehicle_reference(a, clock.dt_s) for a in agents}
        for a in agents:
            choices[a.id] = choose(a, references[a.id], parameters_for([a]), model, free=driver == "policy")
        for name in STEPS:
            moved = [a for a in agents if choices[a.id].model == name]
            if moved:
                p, followed = _prepared(moved, [references[a.id] for a in moved], name, clock)
                groups.append(kind(moved, followed, *_lives(moved, clock), p, simulator_named(name)))
    agents = [a for a in cast["pid"] if a.category not in WHEELED]
    if agents:
        followed = [point_reference(path_of(a, 0.0)) for a in agents]
        groups.append(Crowd(agents, followed, *_lives(agents, clock), simulator_named("kinematic")))
    agents = list(cast["exact"])
    if agents:
        followed = [tape_reference(path_of(a, rear_axle_offset(a))) for a in agents]
        groups.append(Tape(agents, followed, *_lives(agents, clock)))
    return groups, choices


def _prepared(
    agents: Sequence[Agent], references: Sequence[Reference], model: str, clock: Clock
) -> tuple[VehicleParameters, Sequence[Reference]]:
    """Parameters of vehicles that a model moves, and their references with what its slip asks for."""
    p = parameters_for(agents, published=model == "single-track")
    if model == "kinematic":
        return p, references
    p = replace(p, understeer_s2pm2=understeer(p))
    ahead_s = STEER_LAG_S + control_step(clock.dt_s) / 2
    each = [p.take(slice(i, i + 1)) for i in range(len(agents))]
    return p, [slipping_reference(r, one, model, ahead_s) for r, one in zip(references, each)]


def _vehicle_reference(agent: Agent, dt_s: float) -> Reference:
    """A vehicle's table: feed-forward is ahead by the actuator's lag and by half the step for which it is held."""
    p = parameters_for([agent])
    wheelbase_m = float(p.wheelbase_m[0])
    limits = Limits(
        offset_m=float(p.rear_axle_offset_m[0]),
        max_curvature_1pm=LOCK_SHARE * math.tan(p.max_steer_rad[0]) / wheelbase_m,
        max_curvature_rate_1pmps=float(p.max_steer_rate_radps[0]) / wheelbase_m,
        max_accel_mps2=float(p.max_brake_mps2[0]),
    )
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
