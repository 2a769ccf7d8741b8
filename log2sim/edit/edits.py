"""The edits: small values that say what to change, and apply it to the agents of a scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from log2sim.datatypes import Agent, Waypoints
from log2sim.edit.motion import chords, faster, folds, later, to_the_left
from log2sim.errors import ConfigError

Agents = Mapping[str, Agent]
"""Agents by id, in the order of the scenario."""


class Edit:
    """One change to a scenario."""

    kind: ClassVar[str]

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the agents that the edit names."""
        raise NotImplementedError

    def applied(self, agents: Agents) -> Agents:
        """The agents after the edit; those given must include the ones that it names."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """The edit as an entry of a scenario's provenance."""
        return {"kind": self.kind, **asdict(self)}  # type: ignore[call-overload]


@dataclass(frozen=True)
class Only(Edit):
    """Leaves out everyone but the named agents; the ego too goes unless it is named."""

    agents: tuple[str, ...]
    kind: ClassVar[str] = "only"

    @property
    def names(self) -> tuple[str, ...]:
        return self.agents

    def applied(self, agents: Agents) -> Agents:
        return {k: a for k, a in agents.items() if k in self.agents}

    def to_dict(self) -> dict[str, Any]:
        return {"kind": self.kind, "agents": list(self.agents)}


@dataclass(frozen=True)
class _Single(Edit):
    """A change to one agent."""

    agent: str

    @property
    def names(self) -> tuple[str, ...]:
        return (self.agent,)


@dataclass(frozen=True)
class Remove(_Single):
    """Leaves out an agent."""

    kind: ClassVar[str] = "remove"

    def applied(self, agents: Agents) -> Agents:
        return {k: a for k, a in agents.items() if k != self.agent}


@dataclass(frozen=True)
class _Motion(_Single):
    """A change to the waypoints of one agent. What was visible where they were, nobody knows where they are."""

    def applied(self, agents: Agents) -> Agents:
        agent = agents[self.agent]
        return {**agents, self.agent: replace(agent, waypoints=replace(self.moved(agent), visible=None))}

    def moved(self, agent: Agent) -> Waypoints:
        """The waypoints of the agent after the edit."""
        raise NotImplementedError


@dataclass(frozen=True)
class Speed(_Motion):
    """Lets an agent go its way so many times as fast from its first moment on."""

    factor: float
    kind: ClassVar[str] = "speed"

    def __post_init__(self) -> None:
        _require(self, self.factor, 0.01, 100.0, "")

    def moved(self, agent: Agent) -> Waypoints:
        if agent.static:
            raise ConfigError(f"speed: agent '{agent.id}' stands all the time and has no speed to change; leave it out")
        return faster(agent.waypoints, self.factor)


@dataclass(frozen=True)
class Lateral(_Motion):
    """Moves an agent's way to its left by so many meters, to its right where negative."""

    meters: float
    kind: ClassVar[str] = "lateral"

    def __post_init__(self) -> None:
        _require(self, self.meters, -100.0, 100.0, " m")

    def moved(self, agent: Agent) -> Waypoints:
        w = agent.waypoints
        broken = folds(w, self.meters)
        if broken.any():
            chord, turn = chords(w)
            room = np.where(broken, np.abs(chord / np.where(broken, turn, 1.0)), np.inf)
            k = int(np.argmin(room))
            raise ConfigError(
                f"lateral: agent '{agent.id}' turns about a point {room[k]:.2f} m off at {w.t_s[k]:.2f} s, "
                f"so its way cannot be moved to that side by {abs(self.meters):g} m; choose less than {room[k]:.2f} m"
            )
        return to_the_left(w, self.meters)


@dataclass(frozen=True)
class Shift(_Motion):
    """Lets an agent do everything so many seconds later, earlier where negative; before t = 0 there is nothing."""

    seconds: float
    kind: ClassVar[str] = "shift"

    def __post_init__(self) -> None:
        _require(self, self.seconds, -1e5, 1e5, " s")

    def moved(self, agent: Agent) -> Waypoints:
        w = later(agent, self.seconds)
        if len(w) == 0:
            end_s = float(agent.waypoints.t_s[-1])
            raise ConfigError(
                f"shift: nothing is left of agent '{agent.id}', which is there until {end_s:g} s, when it comes "
                f"{-self.seconds:g} s earlier; choose less, or remove the agent"
            )
        return w


def _require(edit: _Motion, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(
            f"{edit.kind}: {value:g}{unit} for agent '{edit.agent}', expected a number from {low:g} to {high:g}{unit}"
        )
