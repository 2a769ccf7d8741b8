"""Builds a `Replay` from the recorded tracks and evaluates it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario, Trajectory
from log2sim.geometry import Array
from log2sim.simulation.groups import AgentGroup
from log2sim.simulation.metrics.all_metrics import SCENARIO_FOLLOWERS, replay_metrics
from log2sim.simulation.metrics.collisions import RECONSTRUCTION, SCENARIO
from log2sim.simulation.metrics.tracking_error import TrackingErrors, agent_errors
from log2sim.simulation.reactive.path_table import scenario_times_of_distance, scenario_times_of_positions
from log2sim.simulation.recording import RecordedTracks
from log2sim.simulation.result import AgentReplay, Commands, Replay
from log2sim.simulation.step_clock import StepClock
from log2sim.simulation.vehicles.model_choice import ModelChoice

STATE_DIGITS = 6
"""Decimals of stored states: a micrometer."""

COMMAND_DIGITS = 4
"""Decimals of commands and errors: a tenth of a millimeter."""


def replay_result(
    scenario: Scenario,
    groups: Sequence[AgentGroup],
    tracks: RecordedTracks,
    clock: StepClock,
    choices: Mapping[str, ModelChoice],
    mode: str,
    model: str,
) -> Replay:
    """Build the replay of a scenario from the recorded tracks."""
    source = {a.id: (g.driver, r.trajectory, r.flags) for g in groups for a, r in zip(g.agents, g.references)}
    agents: list[AgentReplay] = []
    stored: list[NDArray[np.intp]] = []
    errors: dict[str, TrackingErrors] = {}
    point_drivers = ("pid", "reactive") if mode == "pid" else ()
    for agent in scenario.agents:
        if agent.id not in tracks:
            replayed, steps = _static_agent(agent, clock)
        else:
            driver, trajectory, flags = source[agent.id]
            steps, states = tracks[agent.id]
            t_s: Array = clock.begin_s + steps.astype(np.float64) * clock.dt_s
            choice = choices.get(
                agent.id, ModelChoice("point", "") if driver in point_drivers else ModelChoice("none", "")
            )
            moved = _moving_agent(agent, driver, choice, trajectory, flags, t_s, states)
            errors[agent.id] = agent_errors(trajectory, moved, follows=driver in SCENARIO_FOLLOWERS)
            replayed = _with_errors(moved, errors[agent.id])
        agents.append(replayed)
        stored.append(steps)
    trajectories = {k: trajectory for k, (_, trajectory, _) in source.items() if k in tracks}
    return Replay(
        scenario=scenario.name,
        scenario_digest=scenario.digest,
        mode=mode,
        model=model,
        dt_s=clock.dt_s,
        store_dt_s=round(clock.dt_s * clock.store_every, 9),
        agents=tuple(agents),
        metrics=replay_metrics(
            agents,
            stored,
            trajectories,
            errors,
            clock,
            source_kind=RECONSTRUCTION if scenario.is_reconstruction else SCENARIO,
        ),
    )


def _moving_agent(
    agent: Agent,
    driver: str,
    choice: ModelChoice,
    trajectory: Trajectory,
    flags: tuple[str, ...],
    t_s: Array,
    states: Array,
) -> AgentReplay:
    x, y, yaw, speed, steer, accel, pedal, wheel, gear = states
    if driver == "exact":
        x, y, _, yaw, speed = trajectory.at(t_s)  # the reference tables are only good to half a millimeter
    log_t_s = t_s
    if driver == "reactive":
        log_t_s = scenario_times_of_distance(trajectory, t_s, x, y)
    elif driver == "policy":
        log_t_s = scenario_times_of_positions(trajectory, x, y)
    if np.isnan(accel).any():
        accel = np.gradient(speed, t_s) if len(t_s) > 1 else np.zeros(len(t_s))
    z = trajectory.heights(log_t_s)  # the height of the road at this place
    x, y, z, yaw, speed, steer, accel = (np.round(c, STATE_DIGITS) for c in (x, y, z, yaw, speed, steer, accel))
    t_s = np.round(t_s, 9)
    commands = Commands(
        np.round(pedal, COMMAND_DIGITS), np.round(wheel, COMMAND_DIGITS), np.where(gear < 0, -1, 1).astype(np.int8)
    )
    return AgentReplay(
        agent.id, agent.category, agent.size_m, driver, choice.model, t_s, x, y, z, yaw, speed, steer, accel, flags,
        choice.reason, None if np.isnan(pedal).any() else commands,
    )  # fmt: skip


def _with_errors(agent: AgentReplay, errors: TrackingErrors) -> AgentReplay:
    """Add the tracking errors, unless the agent is placed on its trajectory."""
    if agent.driver == "exact":
        return agent
    across, along = (np.round(c, COMMAND_DIGITS) for c in (errors.across_m, errors.along_m))
    return replace(agent, cross_track_m=across, along_track_m=along)


def _static_agent(agent: Agent, clock: StepClock) -> tuple[AgentReplay, NDArray[np.intp]]:
    """Build a static agent, or one that lived between two steps, and the stored steps at which it is present.

    A permanent agent is present all the time; one that lived between two stored steps has that one moment.
    """
    w = agent.waypoints
    end_s = clock.time(clock.steps - 1)
    begin_s, until_s = (clock.begin_s, end_s) if agent.is_permanent else (float(w.t_s[0]), float(w.t_s[-1]))
    t_s = np.array([begin_s, until_s] if agent.static and until_s > begin_s else [begin_s])
    first, last = clock.first_step(np.array([begin_s]))[0], clock.last_step(np.array([until_s]))[0]
    every = clock.store_every
    steps = np.arange(-(-first // every) * every, last + 1, every) if agent.static else np.zeros(0, dtype=np.intp)
    x, y, z, yaw = (np.full(len(t_s), round(float(c[0]), STATE_DIGITS)) for c in (w.x_m, w.y_m, w.z_m, w.yaw_rad))
    speed = np.full(len(t_s), 0.0 if agent.static else float(w.speed_mps[0]))
    zero = np.zeros(len(t_s))
    driver = "static" if agent.static else "exact"
    replayed = AgentReplay(agent.id, agent.category, agent.size_m, driver, "none", t_s, x, y, z, yaw, speed, zero, zero)
    return replayed, steps
