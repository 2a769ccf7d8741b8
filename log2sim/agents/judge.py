"""The judge: of all candidates together, which are agents, and what speaks against each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from log2sim.agents.candidate import AgentCandidate, Support, name_agents
from log2sim.agents.conflicts import conflict_doubts, resolve_conflicts
from log2sim.agents.evidence import MIN_LOOKING_RAYS, Recording, doubt_size, weigh
from log2sim.agents.size import independent
from log2sim.datatypes import GROUP_OF, Agent, AgentTable, Finding
from log2sim.geometry import overlap_of_smaller

# Two agents whose overlap exceeds this share of the smaller box for most of the time are duplicates. Pedestrians are compared
# by distance, since the boxes of two people who stand close together overlap.
SHARED_AREA = 0.25
# A person whose center is outside a vehicle's box is beside it, so that less than half of the person is inside.
SHARED_AREA_OF_PERSON = 0.5
SAME_PERSON_M = 0.35
SAMPLES = 12


def suppress_duplicates(built: Sequence[AgentCandidate], ego: Agent | None = None) -> list[AgentCandidate]:
    """Keep, of the candidates that overlap, the one with the most evidence, and none that overlaps the ego."""
    ordered = sorted(built, key=lambda b: -b.evidence)
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


# Nats against a candidate, of which each reason has some: odds of 20 to 1 drop it. What is certain outweighs any detections.
REFUTED_NATS, CERTAIN_NATS = 3.0, 10.0
# One labeled vehicle in ten stands so close to something that most of its points are on a surface that goes on beyond it.
BESIDE_STRUCTURE_NATS = 2.3
# Through labeled vehicles in real logs, and exact ones in synthetic ones, pass less than 0.2 of the rays toward their solid part;
# people and bicycles have gaps. Above the lower share something may be there that is smaller than the box or beside it, above the
# higher one nothing is.
DOUBTED_SHARE, EMPTY_SHARE = 0.35, 0.8
# Rays of fewer ticks may all have gone through a window or past a corner.
MIN_EMPTY_TICKS = 3
# A surface counts that is there at more than this share of the searched ticks.
MOSTLY = 0.5
# Share of the images of a place without an object in which a detector finds one, and the highest rate at which it is taken
# to find one that is there: no detector finds all.
FALSE_RATE = 0.05
MAX_USUAL_RATE = 0.9
# Fewer ticks tell no rate.
MIN_SHOWN_TICKS = 8
# The height of an image box errs by 10 %, that of points by 20 %: a ratio of 0.5 is three standard deviations low. Then the
# points are not those of what the image shows, but of something nearer that hides it.
MIN_IMAGE_HEIGHT_SHARE = 0.5


def usual_detection_rate(candidates: Sequence[AgentCandidate]) -> float:
    """Return the share of the ticks at which a searched image shows a candidate well and it is detected, over all of them."""
    supports = [c.support for c in candidates if c.support is not None]
    shown = sum(s.shown_ticks for s in supports)
    return sum(s.detected_ticks for s in supports) / shown if shown else 0.0


def decide(candidate: AgentCandidate, usual_rate: float) -> list[Finding] | None:
    """Return what is doubtful about a weighed candidate, None if it is dropped: nothing is there, or something else.

    Parameters
    ----------
    usual_rate : float
        Of `usual_detection_rate`.
    """
    s = candidate.support
    if s is None:
        return doubt_size(candidate.agent)
    known = s.inside + s.through >= MIN_LOOKING_RAYS and s.seen_ticks >= MIN_EMPTY_TICKS
    through = (s.through_share or 0.0) if known else 0.0
    undetected = missing_nats(s, usual_rate)
    height_share = 1.0 if s.image_height_share is None else s.image_height_share
    against = {
        "points of something nearer": CERTAIN_NATS * (height_share < MIN_IMAGE_HEIGHT_SHARE),
        "rays do not end in it": CERTAIN_NATS * s.unreached,
        "rays pass through": CERTAIN_NATS * (through > EMPTY_SHARE),
        "part of something longer": CERTAIN_NATS * (s.in_structure > MOSTLY),
        "beside something longer": BESIDE_STRUCTURE_NATS * (s.beside_structure > MOSTLY),
        "not detected": undetected,
    }
    if sum(against.values()) > REFUTED_NATS:
        return None
    doubts = []
    if through > DOUBTED_SHARE and GROUP_OF[candidate.agent.category] == "vehicle":
        doubts.append(Finding("empty", values={"through_share": through}))
    if s.pointless:
        doubts.append(Finding("hardly_observed", case="no_points"))
    # Where sweeps alone show it, images next to them should, too.
    only_sweeps = missing_nats(replace(s, detected_ticks=s.image_ticks), usual_rate) > REFUTED_NATS
    if undetected > 0 or only_sweeps:
        case, ticks = ("any", s.detected_ticks) if undetected > 0 else ("images", s.image_ticks)
        counts = {"detected_ticks": float(ticks), "shown_ticks": float(s.shown_ticks)}
        doubts.append(Finding("hardly_observed", case=case, values=counts))
    return [*doubts, *doubt_size(candidate.agent)]


def missing_nats(s: Support, usual_rate: float) -> float:
    """Return the evidence against an agent, in nats, by the share of the ticks that show it well at which it is detected.

    Notes
    -----
    The logarithm of the ratio of two Bernoulli likelihoods: an object is detected at the usual rate, nothing at `FALSE_RATE`.
    Successive images err alike, which is why they count as few independent ones.
    """
    usual = min(usual_rate, MAX_USUAL_RATE)
    if s.shown_ticks < MIN_SHOWN_TICKS or usual <= FALSE_RATE:
        return 0.0
    rate = s.detected_ticks / s.shown_ticks
    mean = rate * np.log(FALSE_RATE / usual) + (1 - rate) * np.log((1 - FALSE_RATE) / (1 - usual))
    return float(mean) * independent(s.shown_ticks)


def judge(candidates: Sequence[AgentCandidate], ego: Agent | None, recording: Recording) -> list[AgentCandidate]:
    """Keep the candidates that are confirmed and can be true together, each named and with what speaks against it.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        Of all tracks.
    ego : Agent, optional
        At its place there is no other agent.
    """
    t_s = recording.t_s
    weighed = weigh([c for c in candidates if c.confirmed], recording)
    usual_rate = usual_detection_rate(weighed)
    decided = [(c, decide(c, usual_rate)) for c in weighed]
    apart = suppress_duplicates([c.doubted(doubts) for c, doubts in decided if doubts is not None], ego)
    apart = resolve_conflicts(apart, ego, t_s)
    # A doubt may name another agent.
    named = name_agents(apart)
    return [c.doubted(found) for c, found in zip(named, conflict_doubts(named, ego, t_s))]
