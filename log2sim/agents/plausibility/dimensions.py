"""Sizes that no road user has."""

from __future__ import annotations

from log2sim.agents.size import MAX_ROAD_WIDTH_M, WHOLE_SIDE_SIGMA_M
from log2sim.datatypes import GROUP_OF, MAX_SIZE_M, Agent, Doubt

# Rounding.
SAME_M = 0.005


def doubt_size(agent: Agent) -> list[Doubt]:
    """Doubt a vehicle that is wider than any on the road, by more than the error of an observed side, or as long as sizes go.

    Sizes are limited to those of the category: a vehicle at the greatest length was observed to be longer.
    """
    length_m, width_m, _ = agent.size_m
    if GROUP_OF[agent.category] != "vehicle":
        return []
    if width_m > MAX_ROAD_WIDTH_M + WHOLE_SIDE_SIGMA_M:
        return [Doubt("unlikely_size", f"is {width_m:.1f} m wide, road vehicles have at most {MAX_ROAD_WIDTH_M:.1f} m")]
    longest_m = MAX_SIZE_M[agent.category][0]
    if length_m >= longest_m - SAME_M:
        return [Doubt("unlikely_size", f"is longer than the {longest_m:.1f} m of the longest {agent.category}")]
    return []
