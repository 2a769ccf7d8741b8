"""Conflicts: agents that are in one place at one time, and how long static agents exist."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline, spans_of
from log2sim.agents.evidence import MIN_TICK_RAYS
from log2sim.agents.rays import count_at
from log2sim.datatypes import MARGIN_S, Agent, AgentTable, Finding, Obstacles
from log2sim.geometry import Array, overlap_of_smaller, separating_axes

# Of a long log, so that the memory does not grow with agents times ticks.
TICKS_AT_A_TIME = 256
# Boxes that share less than this of the smaller one only touch: their errors.
TOUCHING = 0.05
# Less is rounding: 4 mm of the length of a car.
ROUNDING = 1e-3
# Boxes are not so deep in each other by their errors alone: two standard deviations of the distance of two positions that are
# known to 0.2 m each.
IN_ONE_PLACE_M = 0.5
# What is left of a life without its conflicts is kept alone if it is at least this share.
MIN_KEPT_SHARE = 0.5
# Fewer ticks are no trajectory.
MIN_KEPT_TICKS = 2


@dataclass(frozen=True, eq=False)
class Conflict:
    """Two agents in one place."""

    first: int  # `first`, `second`: indices of the agents
    second: int
    tick: NDArray[np.intp]  # (n,): when
    share: Array  # (n,): of the smaller box that they share
    depth_m: Array  # (n,): by which one of them would have to move to be apart


def find_conflicts(
    agents: Sequence[Agent], t_s: Array, touching: float = TOUCHING
) -> tuple[list[Conflict], NDArray[np.bool_]]:
    """Find the pairs of A agents whose boxes share more than `touching` of the smaller one at ticks (T,), rising.

    Marks (A, T), too, when each agent is there.
    """
    present = np.zeros((len(agents), len(t_s)), dtype=bool)
    parts: dict[tuple[int, int], list[tuple[Array, ...]]] = {}
    life = np.array([agent.waypoints.t_s[[0, -1]] for agent in agents]).reshape(-1, 2)
    for begin in range(0, len(t_s), TICKS_AT_A_TIME):
        some = t_s[begin : begin + TICKS_AT_A_TIME]
        rows = np.flatnonzero((life[:, 0] <= some[-1] + MARGIN_S) & (life[:, 1] >= some[0] - MARGIN_S))
        boxes = AgentTable.of([agents[k] for k in rows.tolist()], some)
        there = np.flatnonzero(boxes.present.any(axis=1))
        rows, boxes = rows[there], boxes.take(there)
        present[rows, begin : begin + len(some)] = boxes.present
        first, second, tick, share, depth = _overlaps(boxes, touching)
        for i, j in np.unique(np.column_stack([first, second]), axis=0).tolist():
            pair = (first == i) & (second == j)
            parts.setdefault((int(rows[i]), int(rows[j])), []).append((tick[pair] + begin, share[pair], depth[pair]))
    return [Conflict(*pair, *map(np.concatenate, zip(*parts[pair]))) for pair in sorted(parts)], present


def _overlaps(boxes: AgentTable, touching: float) -> tuple[NDArray[Any], ...]:
    """Return agents, agents, ticks, shares and depths (n,) of boxes that share more than `touching` of the smaller one."""
    first, second = np.triu_indices(len(boxes.present), 1)
    radius = np.hypot(boxes.size_m[:, 0], boxes.size_m[:, 1]) / 2
    low, high = (f(boxes.xy_m, axis=1) for f in (np.nanmin, np.nanmax))
    reach = radius[first] + radius[second]
    meet = ((low[first] - high[second] <= reach[:, None]) & (low[second] - high[first] <= reach[:, None])).all(axis=1)
    first, second, reach = first[meet], second[meet], reach[meet]
    apart = np.hypot(*np.moveaxis(boxes.xy_m[first] - boxes.xy_m[second], -1, 0))
    pair, tick = np.nonzero(apart < reach[:, None])
    first, second = first[pair], second[pair]
    share = overlap_of_smaller(boxes.rectangles(first, tick), boxes.rectangles(second, tick))
    over = share > touching
    first, second, tick = first[over], second[over], tick[over]
    a, b = boxes.rectangles(first, tick), boxes.rectangles(second, tick)
    dx, dy = (b[:, :2] - a[:, :2]).T
    axes = separating_axes(a[:, 4], b[:, 4], a[:, 2:4], b[:, 2:4])
    depth = np.min([reach - np.abs(dx * nx + dy * ny) for nx, ny, reach, _ in axes], axis=0)
    return first, second, tick, share[over], depth


def resolve_conflicts(candidates: Sequence[AgentCandidate], ego: Agent | None, t_s: Array) -> list[AgentCandidate]:
    """Trim the less likely one of two candidates that are in one place, and drop those that are in the ego all the time.

    The confidence of the candidates says which is more likely; the ego is where it is. `t_s`: (T,): ticks.

    A life is cut to its longest part without a conflict if that is at least `MIN_KEPT_SHARE` of it; otherwise it stays, to be
    doubted. Nothing of it stays in the ego, at whose place nothing else can be.
    """
    agents = [c.agent for c in candidates]
    evidence = [a.confidence for a in agents]
    if ego is not None:
        agents, evidence = [*agents, ego], [*evidence, np.inf]
    conflicts, present = find_conflicts(agents, t_s)
    alive = present.copy()
    for conflict in sorted(conflicts, key=lambda c: -max(evidence[c.first], evidence[c.second])):
        of_ego = ego is not None and conflict.second == len(candidates)
        stronger, weaker = conflict.first, conflict.second
        if evidence[weaker] > evidence[stronger]:
            stronger, weaker = weaker, stronger
        over = conflict.tick[conflict.share > TOUCHING if of_ego else conflict.depth_m > IN_ONE_PLACE_M]
        over = over[alive[stronger, over]]
        left = alive[weaker].copy()
        left[over] = False
        longest = max(spans_of(left), key=len, default=np.zeros(0, dtype=np.intp))  # the first of several
        left = np.zeros_like(left)
        left[longest] = True
        if of_ego or left.sum() >= MIN_KEPT_SHARE * alive[weaker].sum():
            alive[weaker] = left
    kept = []
    for k, candidate in enumerate(candidates):
        if alive[k].sum() < min(MIN_KEPT_TICKS, present[k].sum()):
            continue
        if (alive[k] != present[k]).any():
            first_s, last_s = t_s[alive[k]][[0, -1]].tolist()
            w = candidate.agent.waypoints
            if candidate.agent.static:  # its waypoints stand at its ends
                w = w.take(np.array([0, len(w) - 1])[: 1 + (last_s > first_s)])
                w = replace(w, t_s=np.array([first_s, last_s])[: len(w)])
            else:
                w = w.take((w.t_s >= first_s - MARGIN_S) & (w.t_s <= last_s + MARGIN_S))
            candidate = replace(candidate, agent=replace(candidate.agent, waypoints=w))
        kept.append(candidate)
    return kept


def conflict_doubts(candidates: Sequence[AgentCandidate], ego: Agent | None, t_s: Array) -> list[list[Finding]]:
    """Doubt the less likely one of two named candidates that are in one place, and who touches the ego, while they do so.

    Returns a list for each candidate.
    """
    agents = [c.agent for c in candidates] + ([ego] if ego is not None else [])
    doubts: list[list[Finding]] = [[] for _ in agents]
    for conflict in find_conflicts(agents, t_s, touching=ROUNDING)[0]:
        a, b = conflict.first, conflict.second
        if b == len(candidates):
            doubts[a].append(_doubt(Finding("in_ego"), conflict, t_s, agents[a]))
        elif conflict.depth_m.max() > IN_ONE_PLACE_M:
            weaker, other = (a, b) if agents[a].confidence <= agents[b].confidence else (b, a)
            case = "static" if agents[a].static and agents[b].static else ""
            found = Finding("passes_through", other=agents[other].id, case=case)
            doubts[weaker].append(_doubt(found, conflict, t_s, agents[weaker]))
    return doubts[: len(candidates)]


def _doubt(found: Finding, conflict: Conflict, t_s: Array, agent: Agent) -> Finding:
    """Return a finding that holds during a conflict, for the whole life of an agent where it always holds."""
    worst_s, first_s, last_s = t_s[conflict.tick[[int(conflict.share.argmax()), 0, -1]]].tolist()
    if first_s <= agent.waypoints.t_s[0] + MARGIN_S and last_s >= agent.waypoints.t_s[-1] - MARGIN_S:
        return found
    return replace(found, start_s=first_s, end_s=last_s, values={"at_s": worst_s})


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
    if not rows:
        return list(agents)
    # The ticks outside of their lives at which rays pass through their places.
    free = np.zeros((len(rows), len(t_s)), dtype=bool)
    boxes = AgentTable.of([agents[k] for k in rows], t_s[:1], margin_s=np.inf)
    life = np.array([agents[k].waypoints.t_s[[0, -1]] for k in rows])
    for tick, cloud in enumerate(clouds):
        if cloud is None or cloud.free is None or not len(cloud.free):
            continue
        outside = (t_s[tick] < life[:, 0]) | (t_s[tick] > life[:, 1])
        near = np.flatnonzero(outside & (np.hypot(*(boxes.xy_m[:, 0] - cloud.origin[:2]).T) < MAX_FREE_RANGE_M))
        if len(near):
            inside, through, _ = count_at(boxes.take(near), 0, cloud.origin, cloud.free)
            free[near, tick] = (inside + through >= MIN_TICK_RAYS) & (through > FREE_SHARE * (inside + through))
    out = [*agents, *([] if ego is None else [ego])]
    low, high = (
        np.array([[f(a.waypoints.x_m), f(a.waypoints.y_m)] for a in out], dtype=np.float64) for f in (np.min, np.max)
    )
    half_m = np.array([np.hypot(*a.size_m[:2]) for a in out]) / 2
    # The surest first: what it takes, the others cannot have.
    for n in sorted(range(len(rows)), key=lambda n: -agents[rows[n]].confidence):
        agent, w = agents[rows[n]], agents[rows[n]].waypoints
        taken, reach_m = free[n].copy(), half_m[rows[n]] + half_m
        place = np.array([w.x_m[0], w.y_m[0], *agent.size_m[:2], w.yaw_rad[0]])
        away_m = np.hypot(*np.maximum(np.maximum(low - place[:2], place[:2] - high), 0.0).T)
        may_meet = away_m <= reach_m + np.hypot(*(high - low).T)
        may_meet[rows[n]] = False
        for k in np.flatnonzero(may_meet).tolist():  # in its place
            there = AgentTable.of([out[k]], t_s)
            near = np.flatnonzero(np.hypot(*(there.xy_m[0] - place[:2]).T) <= reach_m[k])
            shared = overlap_of_smaller(np.tile(place, (len(near), 1)), there.rectangles(0, near))
            taken[near] |= shared > TOUCHING
        before, after = np.flatnonzero(t_s < w.t_s[0]), np.flatnonzero(t_s > w.t_s[-1])
        before = before[before > max(before[taken[before]], default=-1)]
        after = after[after < min(after[taken[after]], default=len(t_s))]
        if len(before) or len(after):
            index = np.concatenate([0 * before, np.arange(len(w)), 0 * after + len(w) - 1])
            seen = np.concatenate([np.zeros(len(before), bool), w.observed, np.zeros(len(after), bool)])
            life_s = np.concatenate([t_s[before], w.t_s, t_s[after]])
            out[rows[n]] = replace(agent, waypoints=replace(w.take(index), t_s=life_s, observed=seen))
    return out[: len(agents)]
