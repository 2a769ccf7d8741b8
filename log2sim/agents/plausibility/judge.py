"""The judge: of all candidates together, which are agents, and what speaks against each."""

from __future__ import annotations

from collections.abc import Sequence

from log2sim.agents.candidate import AgentCandidate, confirm
from log2sim.agents.duplicates import suppress_duplicates
from log2sim.agents.naming import name_agents
from log2sim.agents.plausibility.conflicts import conflict_doubts, resolve_conflicts
from log2sim.agents.plausibility.dimensions import doubt_size
from log2sim.agents.plausibility.evidence import weigh
from log2sim.agents.plausibility.points import contradict, is_refuted, usual_detection_rate
from log2sim.agents.plausibility.recording import Recording
from log2sim.datatypes import Agent


def judge(candidates: Sequence[AgentCandidate], ego: Agent | None, recording: Recording) -> list[AgentCandidate]:
    """Keep the candidates that are confirmed and can be true together, each named and with what speaks against it.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        Of all tracks.
    ego : Agent, optional
        At its place there is no other agent.
    recording : Recording
    """
    t_s = recording.t_s
    weighed = weigh(confirm(candidates), recording)
    usual_rate = usual_detection_rate(weighed)
    apart = suppress_duplicates([c for c in weighed if not is_refuted(c, usual_rate)], ego)
    apart = resolve_conflicts(apart, ego, t_s)
    # A doubt may name another agent.
    named = name_agents(apart)
    conflicts = conflict_doubts(named, ego, t_s)
    return [c.doubted([*contradict(c, usual_rate), *doubt_size(c.agent), *found]) for c, found in zip(named, conflicts)]
