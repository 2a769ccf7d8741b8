"""How long static agents exist: for the whole scenario, but for times at which the log shows their place free."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import Timeline
from log2sim.agents.plausibility.box_table import BoxTable
from log2sim.agents.plausibility.conflicts import TOUCHING
from log2sim.agents.plausibility.evidence import MIN_TICK_RAYS
from log2sim.agents.plausibility.free_space import count_at
from log2sim.datatypes import Agent, Obstacles, Waypoints
from log2sim.geometry import Array, overlap_of_smaller

# Rays tell whether a place is free up to this distance: a car holds about ten of them there by a LiDAR of 64 lines.
MAX_FREE_RANGE_M = 60.0
# A place is free at a tick at which more than this share of the rays toward it goes on behind it.
FREE_SHARE = 0.5


def extend_static(
    agents: Sequence[Agent], ego: Agent | None, clouds: Sequence[Obstacles | None], timeline: Timeline
) -> list[Agent]:
    """Let static agents exist for the whole scenario, up to the last time before and the first time after at which their place is free.

    It is free where LiDAR rays pass through it, and where something else is. Waypoints outside of the time in which the agent was
    observed say so (`observed` false).
    """
    t_s = timeline.seconds(timeline.t_ns)
    rows = [k for k, agent in enumerate(agents) if agent.static]
    free = _free_places([agents[k] for k in rows], clouds, t_s)
    out = list(agents)
    # The surest first: what it takes, the others cannot have.
    for n in sorted(range(len(rows)), key=lambda n: -agents[rows[n]].confidence):
        agent, w = agents[rows[n]], agents[rows[n]].waypoints
        others = [a for k, a in enumerate(out) if k != rows[n]] + ([] if ego is None else [ego])
        taken = free[n] | _occupied(agent, others, t_s)
        before, after = np.flatnonzero(t_s < w.t_s[0]), np.flatnonzero(t_s > w.t_s[-1])
        before = before[before > max(before[taken[before]], default=-1)]
        after = after[after < min(after[taken[after]], default=len(t_s))]
        if len(before) or len(after):
            out[rows[n]] = replace(agent, waypoints=_held(w, t_s[before], t_s[after]))
    return out


def _held(w: Waypoints, before_s: Array, after_s: Array) -> Waypoints:
    """Return waypoints that stay at their ends at earlier and later times, at which nothing was observed."""
    index = np.concatenate([np.zeros(len(before_s)), np.arange(len(w)), np.full(len(after_s), len(w) - 1)]).astype(
        np.intp
    )
    observed = np.concatenate([np.zeros(len(before_s), bool), w.observed, np.zeros(len(after_s), bool)])
    return replace(w.take(index), t_s=np.concatenate([before_s, w.t_s, after_s]), observed=observed)


def _free_places(agents: Sequence[Agent], clouds: Sequence[Obstacles | None], t_s: Array) -> NDArray[np.bool_]:
    """Return at which ticks (A, T) outside of their lives rays pass through the places of static agents."""
    free = np.zeros((len(agents), len(t_s)), dtype=bool)
    if not agents:
        return free
    first = [a.waypoints.take(slice(0, 1)) for a in agents]
    center = np.array([(w.x_m[0], w.y_m[0], w.z_m[0]) for w in first])
    yaw, size = np.array([w.yaw_rad[0] for w in first]), np.array([a.size_m for a in agents])
    life = np.array([(a.waypoints.t_s[0], a.waypoints.t_s[-1]) for a in agents])
    for tick, cloud in enumerate(clouds):
        if cloud is None or cloud.free is None or not len(cloud.free):
            continue
        outside = (t_s[tick] < life[:, 0]) | (t_s[tick] > life[:, 1])
        near = np.hypot(*(center[:, :2] - cloud.origin[:2]).T) < MAX_FREE_RANGE_M
        rows = np.flatnonzero(outside & near)
        if len(rows):
            boxes = BoxTable(
                np.ones((len(rows), 1), dtype=bool),
                center[rows, None],
                np.zeros((len(rows), 1, 2)),
                yaw[rows, None],
                size[rows],
            )
            inside, through, _ = count_at(boxes, 0, cloud.origin, cloud.free)[0]
            free[rows, tick] = (inside + through >= MIN_TICK_RAYS) & (through > FREE_SHARE * (inside + through))
    return free


def _occupied(agent: Agent, others: Sequence[Agent], t_s: Array) -> NDArray[np.bool_]:
    """Return at which times (T,) another agent is in the place of a static one."""
    w, (length, width) = agent.waypoints, agent.size_m[:2]
    place = np.array([w.x_m[0], w.y_m[0], length, width, w.yaw_rad[0]])
    occupied = np.zeros(len(t_s), dtype=bool)
    for other in others:
        reach_m = (np.hypot(length, width) + np.hypot(*other.size_m[:2])) / 2
        v = other.waypoints
        if np.hypot(v.x_m - place[0], v.y_m - place[1]).min() > reach_m + np.hypot(np.ptp(v.x_m), np.ptp(v.y_m)):
            continue
        s = other.at(t_s)
        rows = np.flatnonzero(s.valid & ~(np.hypot(s.x_m - place[0], s.y_m - place[1]) > reach_m))
        if len(rows):
            sides = (np.full(len(rows), side) for side in other.size_m[:2])
            boxes = np.column_stack([s.x_m[rows], s.y_m[rows], *sides, s.yaw_rad[rows]])
            occupied[rows] |= overlap_of_smaller(np.tile(place, (len(rows), 1)), boxes) > TOUCHING
    return occupied
