"""Doubtful agents in words for people."""

from __future__ import annotations

import math
from collections.abc import Sequence

from log2sim.datatypes.agent import Agent
from log2sim.datatypes.doubts import MIN_TRUSTED_CONFIDENCE

MAX_LISTED = 5


def why_doubtful(agent: Agent) -> str:
    """Say why an agent is doubtful: the reasons of its doubts, else its low confidence; empty when it is not doubtful."""
    if agent.doubts:
        return ", ".join(doubt.reason for doubt in agent.doubts)
    return say_confidence(agent) if agent.confidence < MIN_TRUSTED_CONFIDENCE else ""


def say_confidence(agent: Agent) -> str:
    """Say the confidence of an agent, rounded down, so that 0.499 is not shown as the limit that it misses."""
    return f"confidence {math.floor(agent.confidence * 100 + 1e-9) / 100:.2f}"


def list_doubtful(agents: Sequence[Agent], limit: int | None = MAX_LISTED) -> str:
    """List agents on one line, each with why it is doubtful, else with its confidence; `limit` of many, or all without one.

    Those with a doubt come first, since low confidence alone says less.
    """
    first = sorted(agents, key=lambda agent: not agent.doubts)[:limit]
    named = [f"{agent.id} ({why_doubtful(agent) or say_confidence(agent)})" for agent in first]
    rest = len(agents) - len(first)
    return ", ".join(named) + (f" and {rest} more" if rest > 0 else "")
