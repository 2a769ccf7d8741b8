"""The judge: of all candidates together, which are agents, how far each can be trusted, and what speaks against it.

Before it, conflicts: agents that are in one place at one time; after it, how long static agents exist.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.candidate import AgentCandidate, Timeline, name_agents, spans_of
from log2sim.agents.evidence import MIN_TENTATIVE_THERE, MIN_THERE, MIN_TICK_RAYS, Recording, Table, gather
from log2sim.agents.rays import count_at
from log2sim.agents.weights import CONFIDENCE, RIGHT, THERE, VARIANCES
from log2sim.datatypes import (
    GROUP_OF,
    MARGIN_S,
    MAX_SIZE_M,
    MIN_TRUSTED_CONFIDENCE,
    Agent,
    AgentTable,
    Finding,
    Obstacles,
)
from log2sim.datatypes.log_odds import MAX_PROBABILITY, MIN_PROBABILITY, log_odds_of, probability_of
from log2sim.geometry import Array, overlap_of_smaller, separating_axes

# Of a long log, so that the memory does not grow with agents times ticks.
TICKS_AT_A_TIME = 256
# Boxes that share less than this of the smaller one only touch: their errors.
TOUCHING = 0.05
# Less is rounding: 4 mm of the length of a car.
ROUNDING = 1e-3
# Boxes are not so deep in each other by their errors alone: two standard deviations of the distance of two positions that are
# known to 0.2 m each.
IN_ONE_PLACE_M = 2 * np.hypot(0.2, 0.2)
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
            free[near, tick] = (inside + through >= MIN_TICK_RAYS) & (through > inside)
    out, places = list(agents), boxes.rectangles(np.arange(len(rows)), np.zeros(len(rows), dtype=np.intp))
    moving = [*(a for a in agents if not a.static), *([] if ego is None else [ego])]
    low, high = (
        np.array([[f(a.waypoints.x_m), f(a.waypoints.y_m)] for a in moving], dtype=np.float64).reshape(-1, 2)
        for f in (np.min, np.max)
    )
    static_half_m, half_m = (np.array([np.hypot(*a.size_m[:2]) for a in some]) / 2 for some in (boxes.agents, moving))
    tables: dict[int, tuple[NDArray[np.intp], AgentTable]] = {}  # of moving agents, at the ticks of their lives
    # The surest first: what it takes, the others cannot have.
    for n in sorted(range(len(rows)), key=lambda n: -agents[rows[n]].confidence):
        place, taken, w = places[n], free[n].copy(), agents[rows[n]].waypoints
        near = np.flatnonzero(np.hypot(*(places[:, :2] - place[:2]).T) <= static_half_m + static_half_m[n])
        near = near[near != n]
        shared = overlap_of_smaller(np.tile(place, (len(near), 1)), places[near])
        for k in near[shared > TOUCHING].tolist():
            taken[_ticks_of(out[rows[k]], t_s)] = True
        reach_m = static_half_m[n] + half_m
        away_m = np.hypot(*np.maximum(np.maximum(low - place[:2], place[:2] - high), 0.0).T)
        ticks, there = [], []
        for k in np.flatnonzero(away_m <= reach_m + np.hypot(*(high - low).T)).tolist():
            if k not in tables:
                alive = _ticks_of(moving[k], t_s)
                tables[k] = alive, AgentTable.of([moving[k]], t_s[alive])
            alive, table = tables[k]
            at = np.flatnonzero(np.hypot(*(table.xy_m[0] - place[:2]).T) <= reach_m[k])
            ticks.append(alive[at])
            there.append(table.rectangles(0, at))
        if ticks:  # at which another is in its place
            others = np.concatenate(there)
            shared = overlap_of_smaller(np.tile(place, (len(others), 1)), others)
            taken[np.concatenate(ticks)[shared > TOUCHING]] = True
        before, after = np.flatnonzero(t_s < w.t_s[0]), np.flatnonzero(t_s > w.t_s[-1])
        before = before[before > max(before[taken[before]], default=-1)]
        after = after[after < min(after[taken[after]], default=len(t_s))]
        if len(before) or len(after):
            index = np.concatenate([0 * before, np.arange(len(w)), 0 * after + len(w) - 1])
            seen = np.concatenate([np.zeros(len(before), bool), w.observed, np.zeros(len(after), bool)])
            life_s = np.concatenate([t_s[before], w.t_s, t_s[after]])
            out[rows[n]] = replace(agents[rows[n]], waypoints=replace(w.take(index), t_s=life_s, observed=seen))
    return out


def _ticks_of(agent: Agent, t_s: Array) -> NDArray[np.intp]:
    """Return the ticks at which an agent is there."""
    first_s, last_s = agent.waypoints.t_s[[0, -1]].tolist()
    return np.flatnonzero((t_s >= first_s - MARGIN_S) & (t_s <= last_s + MARGIN_S))


# A reason that makes an agent e times less likely becomes a doubt.
DOUBT_NATS = 1.0
SAME_M = 0.005  # rounding


def judge(
    candidates: Sequence[AgentCandidate],
    ego: Agent | None,
    recording: Recording,
    *,
    clutter: float = 0.0,
) -> list[AgentCandidate]:
    """Keep the candidates that are there and can be true together, each named, with its confidence and what speaks against it.

    At the place of the `ego` there is no other agent. `clutter`: from `evidence.clutter_nats`.
    """
    t_s, lidar = recording.t_s, recording.lidar
    table = gather(candidates, recording)
    there, right = probabilities(table, lidar=lidar, clutter=clutter)
    kept = []
    for k, candidate in enumerate(candidates):
        row = {name: float(column[k]) for name, column in table.items()}
        if not suffices(there[k], confirmed=bool(row["confirmed"]), lidar=lidar):
            continue
        # Reasons explain a low confidence: given for all agents, they were against right ones at six of seven ticks (80 simulated logs).
        doubts = doubts_by_evidence(candidate.agent, row, lidar=lidar) if right[k] < MIN_TRUSTED_CONFIDENCE else []
        kept.append(_rated(candidate.doubted(doubts), float(right[k]), recording.timeline))
    apart = resolve_conflicts(suppress_duplicates(kept, ego), ego, t_s)
    # A doubt may name another agent.
    named = name_agents(apart)
    return [c.doubted(found) for c, found in zip(named, conflict_doubts(named, ego, t_s))]


def probabilities(table: Table, *, lidar: bool, clutter: float = 0.0) -> tuple[Array, Array]:
    """Return the probabilities (C,) that something is where each candidate is, and that the candidate is right.

    `clutter`: nats by which tentative candidates are less likely in this log than in others.

    Right is what `evaluate` finds right: at no more than a fifth of its ticks invented, a duplicate, in the ego, or with a wrong
    speed, motion, direction or size. It is the product of two logistic regressions on the same table: that it is there, and that it
    is right where it is; with a LiDAR its log-odds are scaled by group (Platt, "Probabilistic Outputs for Support Vector Machines",
    1999). Each weight has the sign of its reason (`evidence.SIGNS`). Where there is a LiDAR, an agent without points is rather wrong;
    without one, nothing has points, and what images say of the distance counts instead: each case has its weights.
    """
    there, state = (
        np.sum([weight * table[name] for name, weight in weights[lidar].items()], axis=0) for weights in (THERE, RIGHT)
    )
    there, state = probability_of(there - clutter * (table["confirmed"] == 0)), probability_of(state)
    odds = log_odds_of(np.clip(there * state, MIN_PROBABILITY, MAX_PROBABILITY))
    if lidar:
        group = np.where(table["pedestrian"] > 0, 2, np.where(table["two_wheeler"] > 0, 1, 0))
        offset, slope = np.array(list(CONFIDENCE.values()))[group].T
        odds = offset + slope * odds
    return there, np.clip(probability_of(odds), MIN_PROBABILITY, MAX_PROBABILITY)


def suffices(there: float, *, confirmed: bool, lidar: bool) -> bool:
    """Return whether the probability that something is there suffices; `confirmed`: whether its detections alone make it likely."""
    if confirmed:
        return there >= MIN_THERE[lidar]
    return lidar and there >= MIN_TENTATIVE_THERE


def doubts_by_evidence(agent: Agent, evidence: Mapping[str, float], *, lidar: bool) -> list[Finding]:
    """Return what of the evidence of an agent, its row of the table, speaks against it."""
    doubts = []
    if -THERE[lidar].get("through", 0.0) * evidence["through"] > DOUBT_NATS:
        doubts.append(Finding("empty", values={"through_share": 1 - float(np.exp(-evidence["through"]))}))
    if evidence["pointless"]:
        doubts.append(Finding("hardly_observed"))
    # As long as sizes go: they are limited to those of the category, so a vehicle at the greatest length was observed to be longer.
    length_m, longest_m = agent.size_m[0], MAX_SIZE_M[agent.category][0]
    if GROUP_OF[agent.category] == "vehicle" and length_m >= longest_m - SAME_M:
        doubts.append(Finding("unlikely_size", values={"limit_m": longest_m}, other=agent.category))
    return doubts


# Two agents whose overlap exceeds this share of the smaller box for most of the time are duplicates. Pedestrians are compared
# by distance, since the boxes of two people who stand close together overlap.
SHARED_AREA = 0.25
# A person whose center is outside a vehicle's box is beside it, so that less than half of the person is inside.
SHARED_AREA_OF_PERSON = 0.5
SAME_PERSON_M = 0.35
SAMPLES = 12


def suppress_duplicates(built: Sequence[AgentCandidate], ego: Agent | None = None) -> list[AgentCandidate]:
    """Keep, of the candidates that overlap, the one with most ticks that are right by its confidence, and none that overlaps the ego."""
    ordered = sorted(built, key=lambda b: -b.agent.confidence * len(b.track))
    agents = [*([] if ego is None else [ego]), *(c.agent for c in ordered)]
    ways = [a.waypoints for a in agents]
    # First and last time and place: agents that are not there at the same time and near enough are no duplicates.
    low = np.array([(w.t_s[0], w.x_m.min(), w.y_m.min()) for w in ways]).reshape(-1, 3)
    high = np.array([(w.t_s[-1], w.x_m.max(), w.y_m.max()) for w in ways]).reshape(-1, 3)
    reach = np.array([np.hypot(*a.size_m[:2]) / 2 for a in agents])[:, None] * [0.0, 1.0, 1.0]
    taken: list[int] = [] if ego is None else [0]
    for k in range(len(taken), len(agents)):
        apart = np.maximum(low[taken] - high[k], low[k] - high[taken]) > reach[taken] + reach[k]
        near = np.array(taken, dtype=np.intp)[~apart.any(axis=1)]
        if not any(_are_duplicates(agents[k], agents[other]) for other in near):
            taken.append(k)
    first = len(agents) - len(ordered)
    return [ordered[k - first] for k in taken if k >= first]


def _are_duplicates(a: Agent, b: Agent) -> bool:
    """Return whether two agents overlap for most of the time that they have in common."""
    first, last = max(a.waypoints.t_s[0], b.waypoints.t_s[0]), min(a.waypoints.t_s[-1], b.waypoints.t_s[-1])
    t = np.linspace(first, last, SAMPLES)
    groups = {GROUP_OF[a.category], GROUP_OF[b.category]}
    boxes = AgentTable.of((a, b), t)
    apart_m = np.hypot(*(boxes.xy_m[0] - boxes.xy_m[1]).T)
    if groups == {"pedestrian"}:
        return bool(np.median(apart_m) < SAME_PERSON_M)
    if np.sum(apart_m <= np.hypot(*boxes.size_m[:, :2].T).sum() / 2) < SAMPLES // 2:
        return False  # too far for their boxes to touch at half of the times
    least = SHARED_AREA_OF_PERSON if groups == {"pedestrian", "vehicle"} else SHARED_AREA
    return bool(np.median(overlap_of_smaller(*(boxes.rectangles(k, slice(None)) for k in range(2)))) > least)


# Of the extents seen at all ticks, this quantile counts as seen at some time: stray points lengthen a few.
SEEN_QUANTILE = 0.85


def _rated(candidate: AgentCandidate, confidence: float, timeline: Timeline) -> AgentCandidate:
    """Return a candidate with its confidence and larger standard deviations.

    A variance is a sum of terms, each a reason for an error, times weights that fit simulated logs (`tools/fit.py confidence`).
    Smoothing and fits take the errors of ticks as independent; but a box that is laid against the wrong end, or has a wrong length,
    is off by as much at every tick.
    """
    w = candidate.agent.waypoints
    sigmas = {
        name: np.sqrt(sum(weight * terms[reason] for reason, weight in VARIANCES[name].items()))
        for name, terms in variance_terms(candidate, confidence, timeline).items()
    }
    return replace(candidate, agent=replace(candidate.agent, confidence=confidence, waypoints=replace(w, **sigmas)))


def variance_terms(candidate: AgentCandidate, confidence: float, timeline: Timeline) -> dict[str, dict[str, Array]]:
    """Return the reasons for errors at the waypoints (T,) by what is wrong, the names of `Waypoints`: variances but for their weights.

    - given: what smoothing or the fit says;
    - given_moving: errors of neighboring ticks are alike, and smoothing averages them;
    - hidden: a box is laid against one end, and the part of its length that was never seen is on either side of the points;
    - range: the spacing of rays and errors of the pose grow with the distance;
    - wrong: the more probably an agent is wrong, the larger its errors are too: of a position mostly by up to half its length,
      of a yaw by any angle;
    - standing, moving: a standing agent that is probably wrong may move, and a moving one stand, or move at another speed.
    """
    agent, m = candidate.agent, candidate.track.measurements
    w, length_m = agent.waypoints, agent.size_m[0]
    ones, wrong, moving = np.ones(len(w)), (1 - confidence) ** 2, float(not agent.static)
    range_m = float(np.median(np.hypot(*(m.center_m - m.sensor_m)[:, :2].T)))
    # Of the length that points spanned at one time at most, but for a few that stray points lengthen.
    extent = m.high_m - m.low_m
    rows = np.isfinite(extent).all(axis=1) & np.isfinite(m.yaw_rad)
    seen_m = 0.0
    if rows.any():
        yaw = np.interp(timeline.seconds(m.t_ns), w.t_s, np.unwrap(w.yaw_rad))
        across = np.abs(np.cos(m.yaw_rad - yaw)) < np.sqrt(0.5)
        seen_m = float(np.quantile(np.where(across, extent[:, 1], extent[:, 0])[rows], SEEN_QUANTILE))
    hidden_m = (1 - float(np.clip(seen_m / length_m, 0.0, 1.0))) * length_m
    terms: dict[str, dict[str, Array]] = {
        "sigma_xy_m": {
            "given": w.sigma_xy_m**2,
            "given_moving": moving * w.sigma_xy_m**2,
            "hidden": hidden_m**2 * ones,
            "range": (range_m / 10.0) ** 2 * ones,
            "wrong": wrong * length_m**2 * ones,
        }
    }
    if w.sigma_yaw_rad is not None:
        terms["sigma_yaw_rad"] = {"given": w.sigma_yaw_rad**2, "wrong": wrong * ones}
    if w.sigma_speed_mps is not None:
        speed = {"standing": (1 - moving) * wrong * ones, "moving": moving * wrong * (1.0 + np.abs(w.speed_mps)) ** 2}
        terms["sigma_speed_mps"] = {"given": w.sigma_speed_mps**2, **speed}
    return terms
