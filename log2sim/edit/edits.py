"""The edits: values that describe a change, and apply it to the agents of a scenario."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np

from log2sim.datatypes import EGO, Agent, Doubt, Span, Waypoints, retime_spans
from log2sim.edit.motion import (
    chords,
    doubts_shifted,
    doubts_sped_up,
    parallel_fails,
    shifted_in_time,
    shifted_left,
    sped_up,
)
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
        """Return the agents after the edit; `agents` must include the named ones."""
        raise NotImplementedError

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the edit in a scenario's provenance."""
        return {"kind": self.kind, **asdict(self)}  # type: ignore[call-overload]


@dataclass(frozen=True)
class Only(Edit):
    """Keep only the named agents; the ego is removed too unless it is named."""

    agents: tuple[str, ...]
    kind: ClassVar[str] = "only"

    @property
    def names(self) -> tuple[str, ...]:
        """Ids of the agents that are kept."""
        return self.agents

    def applied(self, agents: Agents) -> Agents:
        """Keep the named agents."""
        return {k: a for k, a in agents.items() if k in self.agents}

    def to_dict(self) -> dict[str, Any]:
        """Return the entry of the edit in a scenario's provenance."""
        return {"kind": self.kind, "agents": list(self.agents)}


@dataclass(frozen=True)
class _AgentEdit(Edit):
    """A change to one agent."""

    agent: str

    @property
    def names(self) -> tuple[str, ...]:
        """Id of the agent, as a tuple of one."""
        return (self.agent,)


@dataclass(frozen=True)
class Remove(_AgentEdit):
    """Remove an agent."""

    kind: ClassVar[str] = "remove"

    def applied(self, agents: Agents) -> Agents:
        """Return all other agents."""
        return {k: a for k, a in agents.items() if k != self.agent}


@dataclass(frozen=True)
class DropDoubtful(Edit):
    """Remove the agents that the scenario itself doubts, see `Agent.is_doubtful`; the ego stays."""

    kind: ClassVar[str] = "drop_doubtful"

    @property
    def names(self) -> tuple[str, ...]:
        """No ids: which agents it removes is decided by their doubts and confidence."""
        return ()

    def applied(self, agents: Agents) -> Agents:
        """Return the agents that are not doubtful, and the ego."""
        return {k: a for k, a in agents.items() if k == EGO or not a.is_doubtful}


@dataclass(frozen=True)
class _WaypointEdit(_AgentEdit):
    """A change to the waypoints of one agent; what sensors saw of it is dropped, since it is unknown at the new positions."""

    def applied(self, agents: Agents) -> Agents:
        """Replace the waypoints of the agent."""
        agent = agents[self.agent]
        waypoints = replace(self.moved(agent), visible=None, lidar_points=None)
        moved = replace(agent, waypoints=waypoints, doubts=self.doubts(agent), observed_by=self.observed_by(agent))
        return {**agents, self.agent: moved}

    def doubts(self, agent: Agent) -> tuple[Doubt, ...]:
        """Return the doubts of the agent after the edit: the same ones, unless it moves in time."""
        return agent.doubts

    def observed_by(self, agent: Agent) -> Mapping[str, tuple[Span, ...]]:
        """Return when each end measured the agent after the edit: at the same times, unless it moves in time."""
        return agent.observed_by

    def moved(self, agent: Agent) -> Waypoints:
        """Return the waypoints of the agent after the edit."""
        raise NotImplementedError


@dataclass(frozen=True)
class Speed(_WaypointEdit):
    """Scale the speed of an agent on its path, from its first waypoint on."""

    factor: float
    kind: ClassVar[str] = "speed"

    def __post_init__(self) -> None:
        """Check the factor."""
        _require(self, self.factor, 0.01, 100.0, "")

    def moved(self, agent: Agent) -> Waypoints:
        """Return the waypoints at scaled times."""
        if agent.static:
            raise ConfigError(f"speed: agent '{agent.id}' is static and has no speed to change; leave it out")
        return sped_up(agent.waypoints, self.factor)

    def doubts(self, agent: Agent) -> tuple[Doubt, ...]:
        """Return the doubts at scaled times."""
        return doubts_sped_up(agent, self.factor)

    def observed_by(self, agent: Agent) -> Mapping[str, tuple[Span, ...]]:
        """Return the spans at scaled times."""
        begin_s = float(agent.waypoints.t_s[0])
        return retime_spans(agent.observed_by, lambda t_s: begin_s + (t_s - begin_s) / self.factor)


@dataclass(frozen=True)
class Lateral(_WaypointEdit):
    """Shift an agent's path to its left in meters, to its right where negative."""

    meters: float
    kind: ClassVar[str] = "lateral"

    def __post_init__(self) -> None:
        """Check the distance."""
        _require(self, self.meters, -100.0, 100.0, " m")

    def moved(self, agent: Agent) -> Waypoints:
        """Return the waypoints of the parallel path."""
        w = agent.waypoints
        fails = parallel_fails(w, self.meters)
        if fails.any():
            chord, turn = chords(w)
            radius_m = np.where(fails, np.abs(chord / np.where(fails, turn, 1.0)), np.inf)
            k = int(np.argmin(radius_m))
            raise ConfigError(
                f"lateral: agent '{agent.id}' turns with a radius of {radius_m[k]:.2f} m at {w.t_s[k]:.2f} s, so its path "
                f"cannot be shifted to that side by {abs(self.meters):g} m; choose less than {radius_m[k]:.2f} m"
            )
        return shifted_left(w, self.meters)


@dataclass(frozen=True)
class Shift(_WaypointEdit):
    """Delay an agent by seconds, or advance it where negative; waypoints before t = 0 are cut off."""

    seconds: float
    kind: ClassVar[str] = "shift"

    def __post_init__(self) -> None:
        """Check the time."""
        _require(self, self.seconds, -1e5, 1e5, " s")

    def moved(self, agent: Agent) -> Waypoints:
        """Return the waypoints at shifted times."""
        w = shifted_in_time(agent, self.seconds)
        if len(w) == 0:
            end_s = float(agent.waypoints.t_s[-1])
            raise ConfigError(
                f"shift: nothing is left of agent '{agent.id}', which is there until {end_s:g} s, when it comes "
                f"{-self.seconds:g} s earlier; choose less, or remove the agent"
            )
        return w

    def doubts(self, agent: Agent) -> tuple[Doubt, ...]:
        """Return the doubts at shifted times."""
        return doubts_shifted(agent, self.seconds)

    def observed_by(self, agent: Agent) -> Mapping[str, tuple[Span, ...]]:
        """Return the spans at shifted times, cut at the scenario's start."""
        return retime_spans(agent.observed_by, lambda t_s: t_s + self.seconds, begin_s=0.0)


def _require(edit: _WaypointEdit, value: float, low: float, high: float, unit: str) -> None:
    if not (math.isfinite(value) and low <= value <= high):
        raise ConfigError(
            f"{edit.kind}: {value:g}{unit} for agent '{edit.agent}', expected a number from {low:g} to {high:g}{unit}"
        )
