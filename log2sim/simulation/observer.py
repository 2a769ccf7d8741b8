"""Builds the observations of the ego's policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Trajectory
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation.groups import AgentGroup, PolicyVehicle
from log2sim.simulation.policy import (
    PATH_AHEAD_M,
    ROUTE_AHEAD_S,
    ROUTE_STEP_S,
    EgoState,
    Observation,
    Others,
    PathAhead,
    Route,
)
from log2sim.simulation.reactive.path_table import SPACING_M, PathTable

ONE = np.zeros(1, dtype=np.intp)


class PolicyObserver:
    """Observations for the one vehicle that a policy drives, among all groups and static agents."""

    def __init__(
        self, ego: PolicyVehicle, groups: Sequence[AgentGroup], statics: Sequence[Agent], sight_m: float
    ) -> None:
        self.ego, self.sight_m = ego, sight_m
        self._trajectory = ego.references[0].trajectory
        self._path_table = PathTable([self._trajectory])
        self._groups = [g for g in groups if g is not ego]
        self._statics = _static_poses(statics)
        lives = [(-np.inf, np.inf) if a.is_permanent else (a.waypoints.t_s[0], a.waypoints.t_s[-1]) for a in statics]
        self._static_lives_s = np.array(lives, dtype=np.float64).reshape(-1, 2)
        self._agents = [_identities(g.agents, [r.trajectory for r in g.references]) for g in self._groups]
        self._static_agents = _identities(statics, [Trajectory.through(a.waypoints, 0.0) for a in statics])
        self.restart()

    def restart(self) -> None:
        """Start again at the beginning of the path."""
        self.progress_m = 0.0

    def __call__(self, step: int, t_s: float, dt_s: float) -> Observation:
        """Build the observation at a step; steps must be in order."""
        ahead = self._ahead()
        ego = self._state()
        return Observation(t_s, dt_s, ego, self._others(ego, step, t_s), self._route(t_s), ahead)

    def _state(self) -> EgoState:
        """Build the ego's state, at the height of its path in the scenario at `progress_m`."""
        agent, s, p = self.ego.agents[0], self.ego.snapshot(), self.ego.living
        log_t_s = self._path_table.times(ONE, np.array([self.progress_m]))
        return EgoState(
            x_m=float(s.x_m[0]),
            y_m=float(s.y_m[0]),
            z_m=float(self._trajectory.heights(log_t_s)[0]),
            yaw_rad=float(s.yaw_rad[0]),
            speed_mps=float(s.speed_mps[0]),
            accel_mps2=float(s.accel_mps2[0]),
            steer_rad=float(s.steer_rad[0]),
            length_m=agent.size_m[0],
            width_m=agent.size_m[1],
            height_m=agent.size_m[2],
            wheelbase_m=float(p.wheelbase_m[0]),
            rear_axle_offset_m=float(p.rear_axle_offset_m[0]),
            understeer_s2pm2=float(p.understeer_s2pm2[0]),
        )

    def _route(self, t_s: float) -> Route:
        ahead = np.arange(t_s, min(t_s + ROUTE_AHEAD_S, self._trajectory.t_s[-1]) + ROUTE_STEP_S / 2, ROUTE_STEP_S)
        x, y, _, yaw, speed = self._trajectory.at(ahead)
        return Route(*(_read_only(c) for c in (ahead, x, y, yaw, speed)))

    def _ahead(self) -> PathAhead:
        table, now = self._path_table, self.ego.snapshot()
        self.progress_m = table.progress_near(0, self.progress_m, float(now.x_m[0]), float(now.y_m[0]))
        ahead = np.arange(0.0, PATH_AHEAD_M + SPACING_M / 2, SPACING_M)
        x, y, cos, sin, at_s = table.along(ONE, self.progress_m + ahead)
        pace = np.abs(table.at(ONE, np.where(np.isnan(at_s), self._trajectory.t_s[-1], at_s)).speed_mps)
        columns = (ahead, x + table.origin_m[0], y + table.origin_m[1], wrap_angle(np.arctan2(sin, cos)), pace, at_s)
        return PathAhead(self.progress_m, *(_read_only(c) for c in columns))

    def _others(self, ego: EgoState, step: int, t_s: float) -> Others:
        begin_s, end_s = self._static_lives_s.T
        here = (begin_s <= t_s) & (t_s <= end_s)
        poses, who, log_s = [self._statics[:, here]], [self._static_agents[here]], [np.full(here.sum(), t_s)]
        for group, agents in zip(self._groups, self._agents):
            if len(group.live):
                present = (group.first[group.live] <= step) & (step <= group.last[group.live])
                s = group.snapshot()
                poses.append(np.stack([s.x_m, s.y_m, s.yaw_rad, s.speed_mps])[:, present])
                who.append(agents[group.live[present]])
                log_s.append(group.log_times(t_s)[present])
        x, y, yaw, speed = np.concatenate(poses, axis=1)
        distance = np.hypot(x - ego.x_m, y - ego.y_m)
        near = np.argsort(distance, kind="stable")
        near = near[distance[near] <= self.sight_m]
        x, y, yaw, speed, seen = x[near], y[near], yaw[near], speed[near], np.concatenate(who)[near]
        z = np.array(
            [trajectory.heights(t) for trajectory, t in zip(seen["trajectory"], np.concatenate(log_s)[near])],
            dtype=np.float64,
        )
        size = (seen[k] for k in ("length_m", "width_m", "height_m"))
        columns = (x, y, z, yaw, speed, speed * np.cos(yaw), speed * np.sin(yaw), *size)
        return Others(_read_only(seen["id"]), _read_only(seen["category"]), *(_read_only(c) for c in columns))


def _identities(agents: Sequence[Agent], trajectories: Sequence[Trajectory]) -> NDArray[Any]:
    """Return id, category, size and trajectory in the scenario of agents as records (A,)."""
    rows = [(a.id, a.category, *a.size_m, trajectory) for a, trajectory in zip(agents, trajectories)]
    sizes = [(k, np.float64) for k in ("length_m", "width_m", "height_m")]
    return np.array(rows, dtype=[("id", object), ("category", object), *sizes, ("trajectory", object)])


def _static_poses(agents: Sequence[Agent]) -> Array:
    """Return x, y, yaw and speed (4, A) of static agents."""
    first = [(a.waypoints.x_m[0], a.waypoints.y_m[0], a.waypoints.yaw_rad[0], 0.0) for a in agents]
    return np.array(first, dtype=np.float64).reshape(-1, 4).T


def _read_only(values: NDArray[Any]) -> NDArray[Any]:
    """Return the array protected against writing, strings as such and not as objects."""
    out = values.astype(str) if values.dtype == object else np.ascontiguousarray(values)
    out.setflags(write=False)
    return out
