"""Sizes that no road user has."""

from __future__ import annotations

from log2sim.agents.size import WHOLE_SIDE_SIGMA_M
from log2sim.datatypes import GROUP_OF, Agent, Doubt

# Directive 96/53/EC, Annex I, without mirrors; 2.6 m in North America too (23 CFR 658.15).
MAX_VEHICLE_WIDTH_M = 2.6


def doubt_size(agent: Agent) -> list[Doubt]:
    """Doubt a vehicle that is wider than any on the road, by more than the error of an observed side."""
    width_m = agent.size_m[1]
    if GROUP_OF[agent.category] != "vehicle" or width_m <= MAX_VEHICLE_WIDTH_M + WHOLE_SIDE_SIGMA_M:
        return []
    return [Doubt("unlikely_size", f"is {width_m:.1f} m wide, road vehicles have at most {MAX_VEHICLE_WIDTH_M:.1f} m")]
