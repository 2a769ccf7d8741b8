"""Names of agents."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from log2sim.agents.candidate import AgentCandidate


def name_agents(candidates: Sequence[AgentCandidate]) -> list[AgentCandidate]:
    """Sort candidates by their first time and name their agents by category and number, such as "car-1"."""
    ordered = sorted(candidates, key=lambda c: (float(c.agent.waypoints.t_s[0]), float(c.agent.waypoints.x_m[0])))
    count: dict[str, int] = {}
    named = []
    for candidate in ordered:
        category = candidate.agent.category
        count[category] = count.get(category, 0) + 1
        named.append(replace(candidate, agent=replace(candidate.agent, id=f"{category}-{count[category]}")))
    return named
