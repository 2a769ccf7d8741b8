"""The judge: of all candidates together, which are agents, and what speaks against each."""

from __future__ import annotations

from collections.abc import Sequence

from log2sim.agents.candidate import AgentCandidate, confirm
from log2sim.agents.duplicates import suppress_duplicates, trim_ego_overlap
from log2sim.agents.naming import name_agents
from log2sim.agents.plausibility.dimensions import doubt_size
from log2sim.datatypes import Agent


def judge(candidates: Sequence[AgentCandidate], ego: Agent | None) -> list[AgentCandidate]:
    """Keep the candidates that are confirmed and can be true together, each named and with what speaks against it.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        Of all tracks.
    ego : Agent, optional
        Where the ego is, nobody else is.
    """
    apart = trim_ego_overlap(suppress_duplicates(confirm(candidates), ego), ego)
    # A doubt may name another agent.
    named = name_agents(apart)
    return [candidate.doubted(doubt_size(candidate.agent)) for candidate in named]
