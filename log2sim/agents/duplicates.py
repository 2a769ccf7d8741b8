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
    extents = _Extents(taken)
    kept: list[AgentCandidate] = []
    for candidate in sorted(built, key=lambda b: -b.evidence):
        if not any(_are_duplicates(candidate.agent, taken[k]) for k in extents.near(candidate.agent)):
            kept.append(candidate)
            taken.append(candidate.agent)
            extents.add(candidate.agent)
    return kept


class _Extents:
    """Extents in time and space of agents, by which most pairs are told apart at once."""

    def __init__(self, agents: Sequence[Agent]) -> None:
        self._rows: Array = np.zeros((max(len(agents), 64), 7))
        self._count = 0
        for agent in agents:
            self.add(agent)

    def add(self, agent: Agent) -> None:
        """Add an agent."""
        if self._count == len(self._rows):
            self._rows = np.concatenate([self._rows, np.zeros_like(self._rows)])
        self._rows[self._count] = self._row(agent)
        self._count += 1

    def near(self, agent: Agent) -> list[int]:
        """Return the numbers of the agents that are there at the same time, and near enough for the boxes to touch."""
        t0, t1, x0, x1, y0, y1, radius = self._row(agent)
        rows = self._rows[: self._count].T
        reach = rows[6] + radius
        apart = (rows[0] > t1) | (rows[1] < t0)
        apart |= (rows[2] - x1 > reach) | (x0 - rows[3] > reach) | (rows[4] - y1 > reach) | (y0 - rows[5] > reach)
        return [int(k) for k in np.flatnonzero(~apart)]

    @staticmethod
    def _row(agent: Agent) -> tuple[float, ...]:
        w = agent.waypoints
        ends = (w.t_s[0], w.t_s[-1], w.x_m.min(), w.x_m.max(), w.y_m.min(), w.y_m.max())
        return *map(float, ends), float(np.hypot(*agent.size_m[:2])) / 2


def _are_duplicates(a: Agent, b: Agent) -> bool:
    """Return whether two agents overlap for most of the time that they have in common."""
    first, last = max(a.waypoints.t_s[0], b.waypoints.t_s[0]), min(a.waypoints.t_s[-1], b.waypoints.t_s[-1])
    t = np.linspace(first, last, SAMPLES)
    groups = {GROUP_OF[a.category], GROUP_OF[b.category]}
    if groups == {"pedestrian"}:
        p, q = a.at(t), b.at(t)
        return bool(np.median(np.hypot(p.x_m - q.x_m, p.y_m - q.y_m)) < SAME_PERSON_M)
    if not _touch_long_enough(a, b, t):
        return False
    least = SHARED_AREA_OF_PERSON if groups == {"pedestrian", "vehicle"} else SHARED_AREA
    return bool(np.median(_shared_areas(a, b, t)) > least)


def _touch_long_enough(a: Agent, b: Agent, t_s: Array) -> bool:
    """Return whether two agents are near enough for their boxes to touch at half of the times (T,); else they share 0 on the median."""
    p, q = a.at(t_s), b.at(t_s)
    reach_m = (np.hypot(*a.size_m[:2]) + np.hypot(*b.size_m[:2])) / 2
    return bool(np.sum(np.hypot(p.x_m - q.x_m, p.y_m - q.y_m) <= reach_m) >= len(t_s) // 2)


def _shared_areas(a: Agent, b: Agent, t_s: Array) -> Array:
    """Return the overlap (T,) of two agents' boxes at times (T,) as a share of the smaller box; 0 where one is absent."""
    rectangles = []
    for agent in (a, b):
        s = agent.at(t_s)
        length, width = (np.full(len(t_s), v) for v in agent.size_m[:2])
        rectangles.append(np.column_stack([s.x_m, s.y_m, length, width, s.yaw_rad]))
    return overlap_of_smaller(*rectangles)
