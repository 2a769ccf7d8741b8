"""How many agents there are, in words: agents are the other road users, and the ego is told apart from them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from log2sim.datatypes.agent import Agent
from log2sim.datatypes.scenario import EGO

PLURALS = {"bus": "buses", "other": "others"}


def say_agents(ids: Iterable[str]) -> str:
    """Count agents by their ids, as all commands do: "12 agents and the ego", "1 agent", "no agent but the ego"."""
    listed = list(ids)
    others = sum(id != EGO for id in listed)
    if EGO not in listed:
        return f"{others} agent{'s' * (others != 1)}"
    return f"{others} agent{'s' * (others != 1)} and the ego" if others else "no agent but the ego"


def say_categories(agents: Sequence[Agent]) -> str:
    """Count agents by category, most frequent first, with how many of each are static: "8 cars (3 static), 1 bus"."""
    counts: dict[str, list[int]] = {}
    for agent in agents:
        count = counts.setdefault(agent.category, [0, 0])
        count[0] += 1
        count[1] += agent.static
    ordered = sorted(counts.items(), key=lambda entry: (-entry[1][0], entry[0]))
    return ", ".join(_say_category(category, total, static) for category, (total, static) in ordered)


def _say_category(category: str, total: int, static: int) -> str:
    noun = category if total == 1 else PLURALS.get(category, f"{category}s")
    return f"{total} {noun}" + (f" ({static} static)" if static else "")
