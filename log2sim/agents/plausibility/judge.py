"""The judge: of all candidates together, which are agents, and what speaks against each."""

from __future__ import annotations

from collections.abc import Sequence

from log2sim.agents.candidate import AgentCandidate, Timeline, confirm
from log2sim.agents.duplicates import suppress_duplicates
from log2sim.agents.naming import name_agents
from log2sim.agents.plausibility.conflicts import conflict_doubts, resolve_conflicts
from log2sim.agents.plausibility.dimensions import doubt_size
from log2sim.agents.plausibility.evidence import weigh
from log2sim.agents.plausibility.points import contradict, is_refuted
from log2sim.datatypes import Agent, Obstacles


def judge(
    candidates: Sequence[AgentCandidate],
    ego: Agent | None,
    clouds: Sequence[Obstacles | None],
    timeline: Timeline,
) -> list[AgentCandidate]:
    """Keep the candidates that are confirmed and can be true together, each named and with what speaks against it.

    Parameters
    ----------
    candidates : sequence of AgentCandidate
        Of all tracks.
    ego : Agent, optional
        Where the ego is, nobody else is.
    clouds : T clouds, None at ticks without LiDAR
    timeline : Timeline
    """
    t_s = timeline.seconds(timeline.t_ns)
    weighed = [c for c in weigh(confirm(candidates), clouds, timeline) if not is_refuted(c)]
    apart = resolve_conflicts(suppress_duplicates(weighed, ego), ego, t_s)
    # A doubt may name another agent.
    named = name_agents(apart)
    conflicts = conflict_doubts(named, ego, t_s)
    return [c.doubted([*contradict(c), *doubt_size(c.agent), *found]) for c, found in zip(named, conflicts)]
