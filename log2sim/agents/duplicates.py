"""Duplicate agents are removed: those in one place most of the time."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.agents.candidate import AgentCandidate
from log2sim.datatypes import GROUP_OF, Agent
from log2sim.geometry import Array, overlap_of_smaller

# Two agents whose overlap exceeds this share of the smaller box for most of the time are duplicates. Pedestrians are compared
# by distance, since the boxes of two people who stand close together overlap.
SHARED_AREA = 0.25
# A person whose center is outside a vehicle's box is beside it, so that less than half of the person is inside.
SHARED_AREA_OF_PERSON = 0.5
SAME_PERSON_M = 0.35
SAMPLES = 12


def suppress_duplicates(built: Sequence[AgentCandidate], ego: Agent | None = None) -> list[AgentCandidate]:
    """Keep, of the candidates that overlap, the one with the most evidence, and none that overlaps the ego."""
    taken = [ego] if ego is not None else []
    kept: list[AgentCandidate] = []
    for candidate in sorted(built, key=lambda b: -b.evidence):
        if not any(_are_duplicates(candidate.agent, other) for other in (*taken, *(k.agent for k in kept))):
            kept.append(candidate)
    return kept


def _are_duplicates(a: Agent, b: Agent) -> bool:
    """Return whether two agents overlap for most of the time that they have in common."""
    first, last = max(a.waypoints.t_s[0], b.waypoints.t_s[0]), min(a.waypoints.t_s[-1], b.waypoints.t_s[-1])
    if last < first or not _extents_meet(a, b):
        return False
    t = np.linspace(first, last, SAMPLES)
    groups = {GROUP_OF[a.category], GROUP_OF[b.category]}
    if groups == {"pedestrian"}:
        p, q = a.at(t), b.at(t)
        return bool(np.median(np.hypot(p.x_m - q.x_m, p.y_m - q.y_m)) < SAME_PERSON_M)
    least = SHARED_AREA_OF_PERSON if groups == {"pedestrian", "vehicle"} else SHARED_AREA
    return bool(np.median(_shared_areas(a, b, t)) > least)


def _extents_meet(a: Agent, b: Agent) -> bool:
    """Return whether the axis-aligned extents of two trajectories are near enough for the boxes to touch, a cheap test."""
    reach = (np.hypot(*a.size_m[:2]) + np.hypot(*b.size_m[:2])) / 2
    return all(
        p.min() - q.max() <= reach and q.min() - p.max() <= reach
        for p, q in ((a.waypoints.x_m, b.waypoints.x_m), (a.waypoints.y_m, b.waypoints.y_m))
    )


def _shared_areas(a: Agent, b: Agent, t_s: Array) -> Array:
    """Return the overlap (T,) of two agents' boxes at times (T,) as a share of the smaller box; 0 where one is absent."""
    rectangles = []
    for agent in (a, b):
        s = agent.at(t_s)
        length, width = (np.full(len(t_s), v) for v in agent.size_m[:2])
        rectangles.append(np.column_stack([s.x_m, s.y_m, length, width, s.yaw_rad]))
    return overlap_of_smaller(*rectangles)
