"""All metrics of a replay: tracking errors, collisions, conflicts, comfort."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Trajectory
from log2sim.simulation.metrics.box_tracks import BoxTracks
from log2sim.simulation.metrics.collisions import REPLAY, SCENARIO, collisions
from log2sim.simulation.metrics.comfort import comfort
from log2sim.simulation.metrics.conflicts import conflicts, most_critical
from log2sim.simulation.metrics.ego_figures import ego_figures
from log2sim.simulation.metrics.tracking_error import TrackingErrors, agent_metrics, scenario_metrics
from log2sim.simulation.result import AgentReplay
from log2sim.simulation.step_clock import StepClock
from log2sim.simulation.vehicles.parameters import WHEELED

SCENARIO_FOLLOWERS = ("pid", "exact")
"""Drivers that follow the scenario in place and time."""


def replay_metrics(
    agents: Sequence[AgentReplay],
    stored: Sequence[NDArray[np.intp]],
    trajectories: Mapping[str, Trajectory],
    errors: Mapping[str, TrackingErrors],
    clock: StepClock,
    *,
    source_kind: str = SCENARIO,
) -> dict[str, Any]:
    """Compute the metrics of `schemas/replay-1.json`, by agent and overall.

    Parameters
    ----------
    agents : sequence of AgentReplay
    stored : sequence of (S,) int
        The steps of each agent's rows; of a static agent all stored steps at which it is present.
    trajectories, errors : by id
        Trajectories of the agents that move in the scenario, and how far they are from them.
    source_kind : {"reconstruction", "scenario"}
        Whose the collisions are that the boxes of the scenario have themselves.
    """
    ids = [a.id for a in agents]
    replayed, source = (_box_tracks(agents, stored, paths, clock) for paths in ({}, trajectories))
    moves = np.array([a.driver != "static" for a in agents], dtype=bool)
    rows = np.arange(len(replayed.x_m), dtype=np.float64)
    t_s = clock.begin_s + rows * (clock.store_every * clock.dt_s)
    events = collisions(replayed, source, moves, t_s, ids, source_kind=source_kind)
    near = conflicts(replayed, moves, t_s, ids, events)
    events_of, near_of = _by_agent(events), _by_agent(near)
    by_agent = {
        a.id: {
            **agent_metrics(errors[a.id]),
            "min_ttc_s": (most_critical(near_of[a.id], "min_ttc") or {}).get("s"),
            "min_pet_s": (most_critical(near_of[a.id], "pet") or {}).get("s"),
            "comfort": _comfort(a, trajectories[a.id]),
            "collisions": events_of[a.id],
        }
        for a in agents
        if a.id in errors
    }
    on_time = {a.id: len(a) for a in agents if a.driver == "pid"}
    on_way = on_time | {a.id: len(a) for a in agents if a.driver == "reactive"}
    driven = next((k for k, agent in enumerate(agents) if agent.driver == "policy"), None)
    ego = {}
    if driven is not None:
        path = trajectories[ids[driven]]
        ego["ego"] = _with_id(ego_figures(agents[driven], driven, replayed, t_s, path), ids)
    return {
        **scenario_metrics(by_agent, on_time, on_way),
        **ego,
        "collisions": events,
        "new_collisions": sum(e["belongs_to"] == REPLAY for e in events),
        "min_ttc": most_critical(near, "min_ttc"),
        "min_pet": most_critical(near, "pet"),
        "conflicts": near,
        "by_agent": by_agent,
    }


def _with_id(figures: dict[str, Any], ids: Sequence[str]) -> dict[str, Any]:
    """Return figures of the ego with the id of the agent to which the gap was smallest, instead of its column."""
    gap = figures["min_gap"]
    return {**figures, "min_gap": None if gap is None else {**gap, "agent": ids[gap["agent"]]}}


def _by_agent(records: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Group records by the id of each of their agents."""
    found: dict[str, list[Any]] = defaultdict(list)
    for record in records:
        for id in record["agents"]:
            found[id].append(record)
    return found


def _comfort(agent: AgentReplay, trajectory: Trajectory) -> dict[str, float | bool] | None:
    """Return the comfort of a vehicle; None for pedestrians, and where the scenario has a discontinuity."""
    if agent.category not in WHEELED or len(trajectory.discontinuity_times()):
        return None
    return comfort(agent.t_s, agent.x_m, agent.y_m, agent.yaw_rad)


def _box_tracks(
    agents: Sequence[AgentReplay],
    stored: Sequence[NDArray[np.intp]],
    trajectories: Mapping[str, Trajectory],
    clock: StepClock,
) -> BoxTracks:
    """Return boxes at all stored steps, of the replay or, for agents with a trajectory given, of the scenario."""
    shape = ((clock.steps - 1) // clock.store_every + 1, len(agents))
    columns = np.full((5, *shape), np.nan)
    for k, (agent, steps) in enumerate(zip(agents, stored)):
        rows = steps // clock.store_every
        if agent.id in trajectories:
            columns[:, rows, k] = np.stack(trajectories[agent.id].at(agent.t_s))
        elif len(rows) == len(agent):
            columns[:, rows, k] = agent.x_m, agent.y_m, agent.z_m, agent.yaw_rad, agent.speed_mps
        elif len(rows):  # one pose for all rows
            pose = [agent.x_m[0], agent.y_m[0], agent.z_m[0], agent.yaw_rad[0], agent.speed_mps[0]]
            columns[:, rows, k] = np.array(pose)[:, None]
    size = np.array([a.size_m for a in agents], dtype=np.float64).reshape(-1, 3)
    x, y, z, yaw, speed = columns
    return BoxTracks(x, y, z, yaw, speed, size)
