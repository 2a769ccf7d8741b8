"""The loop of a replay: agents appear when their life begins, are driven step by step, and vanish at its end."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.replay.policy import (
    ROUTE_AHEAD_S,
    ROUTE_STEP_S,
    SIGHT_M,
    EgoState,
    Observation,
    Others,
    Policy,
    Route,
    ask,
)
from log2sim.replay.reference import GRID_S
from log2sim.replay.simulator import Host
from log2sim.replay.world import Driven, Group, Snapshot
from log2sim.scenario import Agent

STORE_S = 0.05
WINDOW_S = 10.0
MARGIN = 1e-6  # of a step: a waypoint at 0.3 s is on step 30 of 10 ms

Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class Clock:
    """Steps at begin_s + n * dt_s for n in [0, steps); every `store_every`-th is stored: about 20 Hz."""

    begin_s: float
    dt_s: float
    steps: int

    @classmethod
    def spanning(cls, begin_s: float, end_s: float, dt_s: float) -> Clock:
        return cls(begin_s, dt_s, math.floor((end_s - begin_s) / dt_s + MARGIN) + 1)

    @property
    def store_every(self) -> int:
        return max(1, round(STORE_S / self.dt_s))

    def time(self, step: int) -> float:
        return self.begin_s + step * self.dt_s

    def first_step(self, t_s: Array) -> NDArray[np.intp]:
        """The first steps at or after times (N,)."""
        return np.ceil((t_s - self.begin_s) / self.dt_s - MARGIN).astype(np.intp)

    def last_step(self, t_s: Array) -> NDArray[np.intp]:
        """The last steps at or before times (N,)."""
        return np.floor((t_s - self.begin_s) / self.dt_s + MARGIN).astype(np.intp)


Tracks = dict[str, tuple[NDArray[np.intp], Array]]
"""By agent id: the stored steps (S,) and the columns (C, S) of a `Snapshot` at them."""


def roll(
    groups: Sequence[Group],
    clock: Clock,
    statics: Sequence[Agent],
    policy: Policy | None,
    progress: Progress | None,
    host: Host | None = None,
) -> Tracks:
    """Drive all groups from the first step to the last and return what was stored; a `host` moves them, if any."""
    tracks: dict[str, list[tuple[NDArray[np.intp], Array]]] = defaultdict(list)
    arrivals = [_arrivals(group, clock) for group in groups]
    driven = next((g for g in groups if isinstance(g, Driven)), None)
    width = max(1, round(WINDOW_S / clock.dt_s))
    for begin in range(0, clock.steps, width):
        end = min(begin + width, clock.steps)
        for group in groups:
            group.open_window(begin, end, clock.time(begin), clock.time(end))
        busy = [(g, a) for g, a in zip(groups, arrivals) if len(g.live)]
        records: list[tuple[list[int], list[Array]]] = [([], []) for _ in busy]
        for step in range(begin, end):
            for group, placed in busy:
                group.look_up(clock.time(step))
                if step in placed:
                    group.place(placed[step], clock.time(step))
            if step % clock.store_every == 0:
                for (group, _), (steps, rows) in zip(busy, records):
                    steps.append(step)
                    rows.append(_stack(group.snapshot()))
            if policy is not None and driven is not None and driven.first[0] <= step <= driven.last[0]:
                driven.controls = ask(policy, _observe(driven, groups, statics, clock, step))
            for group, _ in busy:
                group.advance(clock.dt_s)
            if host is not None:
                host.tick(step)
        for (group, _), (steps, rows) in zip(busy, records):
            if steps:
                _keep(tracks, group, np.array(steps), np.stack(rows))
        if progress is not None:
            progress(end, clock.steps)
    return {
        k: (np.concatenate([p[0] for p in v]), np.concatenate([p[1] for p in v], axis=1)) for k, v in tracks.items()
    }


def _arrivals(group: Group, clock: Clock) -> dict[int, NDArray[np.intp]]:
    """By step, the agents that are put on their references: at the start of their life and after a leap of the log."""
    placed: dict[int, list[int]] = defaultdict(list)
    for i, reference in enumerate(group.references):
        if group.last[i] < group.first[i]:
            continue
        placed[int(group.first[i])].append(i)
        if not isinstance(group, Driven):
            # The table blends the sides of a leap over one row, so the agent is placed again once that is past.
            leaps = reference.path.jump_times()
            for step in clock.first_step(np.concatenate([leaps, leaps + GRID_S])):
                if group.first[i] < step <= group.last[i]:
                    placed[int(step)].append(i)
    return {step: np.unique(index) for step, index in placed.items()}


def _stack(snapshot: Snapshot) -> Array:
    return np.stack([getattr(snapshot, f.name) for f in fields(snapshot)])


def _keep(
    tracks: dict[str, list[tuple[NDArray[np.intp], Array]]], group: Group, steps: NDArray[np.intp], rows: Array
) -> None:
    """Add to the tracks what was recorded in one window, `rows` (S, C, A), cut to the life of each agent."""
    begin = np.searchsorted(steps, group.first[group.live])
    end = np.searchsorted(steps, group.last[group.live], side="right")
    for slot, i in enumerate(group.live):
        alive = slice(begin[slot], end[slot])
        if begin[slot] < end[slot]:
            tracks[group.agents[i].id].append((steps[alive], rows[alive, :, slot].T))


def _observe(ego: Driven, groups: Sequence[Group], statics: Sequence[Agent], clock: Clock, step: int) -> Observation:
    """What the policy sees at a step."""
    t_s, s, p = clock.time(step), ego.snapshot(), ego.living
    agent = ego.agents[0]
    state = EgoState(
        x_m=float(s.x_m[0]),
        y_m=float(s.y_m[0]),
        yaw_rad=float(s.yaw_rad[0]),
        speed_mps=float(s.speed_mps[0]),
        accel_mps2=float(s.accel_mps2[0]),
        steer_rad=float(s.steer_rad[0]),
        length_m=agent.size_m[0],
        width_m=agent.size_m[1],
        wheelbase_m=float(p.wheelbase_m[0]),
        rear_axle_offset_m=float(p.rear_axle_offset_m[0]),
    )
    path = ego.references[0].path
    ahead = np.arange(t_s, min(t_s + ROUTE_AHEAD_S, path.t_s[-1]) + ROUTE_STEP_S / 2, ROUTE_STEP_S)
    route = Route(ahead, *path.centers(ahead))
    return Observation(t_s, clock.dt_s, state, _others(state, ego, groups, statics, step, t_s), route)


def _others(
    ego: EgoState, own: Driven, groups: Sequence[Group], statics: Sequence[Agent], step: int, t_s: float
) -> Others:
    """Agents present at a step within sight, nearest first."""
    agents: list[Agent] = []
    poses: list[Array] = []
    for group in groups:
        if group is own or not len(group.live):
            continue
        present = (group.first[group.live] <= step) & (step <= group.last[group.live])
        agents += [group.agents[i] for i in group.live[present]]
        poses.append(_stack(group.snapshot())[:4, present])
    here = [a for a in statics if a.waypoints.t_s[0] <= t_s <= a.waypoints.t_s[-1] or len(a.waypoints) == 1]
    agents += here
    poses.append(
        np.array([[a.waypoints.x_m[0], a.waypoints.y_m[0], a.waypoints.yaw_rad[0], 0.0] for a in here]).reshape(-1, 4).T
    )
    x, y, yaw, speed = np.concatenate(poses, axis=1)
    distance = np.hypot(x - ego.x_m, y - ego.y_m)
    order = np.argsort(distance, kind="stable")
    near = order[distance[order] <= SIGHT_M]
    size = np.array([a.size_m for a in agents]).reshape(-1, 3)
    return Others(
        id=np.array([a.id for a in agents], dtype=str)[near],
        category=np.array([a.category for a in agents], dtype=str)[near],
        x_m=x[near], y_m=y[near], yaw_rad=yaw[near], speed_mps=speed[near],
        length_m=size[near, 0], width_m=size[near, 1],
    )  # fmt: skip
