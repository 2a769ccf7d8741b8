"""The judge: of all candidates together, which are agents, how far each can be trusted, and what speaks against it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Timeline, name_agents
from log2sim.agents.conflicts import conflict_doubts, resolve_conflicts
from log2sim.agents.evidence import Recording, Table, gather
from log2sim.agents.size import MAX_ROAD_WIDTH_M, WHOLE_SIDE_SIGMA_M
from log2sim.agents.weights import RIGHT, THERE, VARIANCES
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, Agent, AgentTable, Finding
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array, overlap_of_smaller

# What was detected well enough is dropped where it is rather not there. Without a LiDAR, what is not there is mostly placed wrong,
# which is for doubts.
MIN_THERE = {True: 0.5, False: 0.25}
# A reason that makes an agent e times less likely is told.
DOUBT_NATS = 1.0
# Never 0 or 1: an agent may be right or wrong for a reason that no evidence shows.
MIN_CONFIDENCE, MAX_CONFIDENCE = 0.01, 0.99
SAME_M = 0.005  # rounding


def judge(
    candidates: Sequence[AgentCandidate], ego: Agent | None, recording: Recording, *, jobs: int = 1
) -> list[AgentCandidate]:
    """Keep the candidates that are there and can be true together, each named, with its confidence and what speaks against it.

    At the place of the `ego` there is no other agent. `jobs`: processes that share the candidates; the result is the same for any
    number.
    """
    t_s, lidar = recording.t_s, bool(recording.log.lidars)
    table = gather(candidates, recording, jobs)
    there, right = probabilities(table, lidar=lidar)
    kept = [
        _rated(c.doubted(doubts), float(right[k]), recording.timeline)
        for k, c in enumerate(candidates)
        if (doubts := decide(c.agent, {name: float(column[k]) for name, column in table.items()}, there[k], lidar=lidar)) is not None
    ]  # fmt: skip
    apart = resolve_conflicts(suppress_duplicates(kept, ego), ego, t_s)
    # A doubt may name another agent.
    named = name_agents(apart)
    return [c.doubted(found) for c, found in zip(named, conflict_doubts(named, ego, t_s))]


def probabilities(table: Table, *, lidar: bool) -> tuple[Array, Array]:
    """Return the probabilities (C,) that something is where each candidate is, and that the candidate is right.

    Right is what `evaluate` finds right: at no more than a fifth of its ticks invented, a duplicate, in the ego, or with a wrong
    speed, motion, direction or size. It is the product of two logistic regressions on the same table: that it is there, and that it
    is right where it is. Each weight has the sign of its reason (`evidence.SIGNS`). Where there is a LiDAR, an agent without points
    is rather wrong; without one, nothing has points, and what images say of the distance counts instead: each case has its weights.
    """
    there, state = (
        probability_of(np.sum([weight * table[name] for name, weight in weights[lidar].items()], axis=0))
        for weights in (THERE, RIGHT)
    )
    return there, np.clip(there * state, MIN_CONFIDENCE, MAX_CONFIDENCE)


def decide(agent: Agent, evidence: Mapping[str, float], there: float, *, lidar: bool) -> list[Finding] | None:
    """Return what is doubtful about a candidate, None if it is dropped: nothing is there, or something else.

    `evidence`: its row of the table. `there`: probability that something is there, from `probabilities`.
    """
    if not evidence["confirmed"] or there < MIN_THERE[lidar]:
        return None
    counts = {"detected_ticks": evidence["image_ticks"], "shown_ticks": evidence["shown_ticks"]}
    weights = THERE[lidar]
    reasons = {
        "through": Finding("empty", values={"through_share": 1 - float(np.exp(-evidence["through"]))}),
        "missing": Finding("hardly_observed", case="images", values=counts),
    }
    told = [found for name, found in reasons.items() if -weights.get(name, 0.0) * evidence[name] > DOUBT_NATS]
    told += [Finding("hardly_observed", case="no_points")] if evidence["pointless"] else []
    (length_m, width_m, _), longest_m = agent.size_m, MAX_SIZE_M[agent.category][0]
    # Wider than any on the road, by more than the error of an observed side. Or as long as sizes go: they are limited to those of
    # the category, so a vehicle at the greatest length was observed to be longer.
    if GROUP_OF[agent.category] == "vehicle" and width_m > MAX_ROAD_WIDTH_M + WHOLE_SIDE_SIGMA_M:
        wide = {"width_m": width_m, "limit_m": MAX_ROAD_WIDTH_M}
        told.append(Finding("unlikely_size", case="width", values=wide))
    elif GROUP_OF[agent.category] == "vehicle" and length_m >= longest_m - SAME_M:
        told.append(Finding("unlikely_size", case="length", values={"limit_m": longest_m}, other=agent.category))
    return told


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
