"""What the points of the LiDAR say against a candidate."""

from __future__ import annotations

from log2sim.agents.candidate import AgentCandidate
from log2sim.agents.support import Support
from log2sim.datatypes import GROUP_OF, Doubt

# Share of the rays that pass through the solid part of labeled boxes in real logs and of exact ones in synthetic ones: below
# 0.2 for vehicles; people and bicycles have gaps, below 0.6.
MAX_THROUGH_SHARE = {"vehicle": 0.35}
MAX_THROUGH_SHARE_WITH_GAPS = 0.8
MIN_RAYS = 20
# A place is empty when most rays go through at most ticks at which that can be told.
EMPTY_LIFE_SHARE = 0.5
MIN_EMPTY_TICKS = 3
# Points at most of the searched ticks.
MOSTLY = 0.5


def is_refuted(candidate: AgentCandidate) -> bool:
    """Return whether the points of the LiDAR show that a candidate is not there, or show something else in its place."""
    support = candidate.support
    return support is not None and (
        support.hidden or support.in_structure > MOSTLY or (_is_empty(candidate, support) and _mostly_empty(support))
    )


def contradict(candidate: AgentCandidate) -> list[Doubt]:
    """Doubt a candidate through whose place rays pass."""
    support = candidate.support
    if support is None or not _is_empty(candidate, support):
        return []
    share = support.through_share
    return [Doubt("empty", f"{share:.0%} of the LiDAR's rays pass through its place")]


def _is_empty(candidate: AgentCandidate, support: Support) -> bool:
    limit = MAX_THROUGH_SHARE.get(GROUP_OF[candidate.agent.category], MAX_THROUGH_SHARE_WITH_GAPS)
    share = support.through_share
    return share is not None and support.inside + support.through >= MIN_RAYS and share > limit


def _mostly_empty(support: Support) -> bool:
    return support.empty_ticks >= MIN_EMPTY_TICKS and support.empty_ticks > EMPTY_LIFE_SHARE * support.decided_ticks
