"""The part of a scenario and its replay that a picture shows: a range of time, and some of the agents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario
from log2sim.errors import ConfigError
from log2sim.registry import nearest
from log2sim.visualization.plot.options import PlotOptions

SAME_TIME_S = 1e-6


@dataclass(frozen=True)
class Span:
    """A range of a scenario's time.

    Attributes
    ----------
    start_s, stop_s : float, s
    """

    start_s: float
    stop_s: float

    @property
    def duration_s(self) -> float:
        """Return how long it is."""
        return self.stop_s - self.start_s

    def holds(self, t_s: Any) -> NDArray[np.bool_]:
        """Mark the times within."""
        t = np.asarray(t_s, dtype=np.float64)
        return (t >= self.start_s - SAME_TIME_S) & (t <= self.stop_s + SAME_TIME_S)


def choose_span(scenario: Scenario, options: PlotOptions) -> Span:
    """Return the range of time that the options ask for.

    Raises
    ------
    ConfigError
        When it is empty or none of it is in the scenario.
    """
    start = 0.0 if options.start_s is None else options.start_s
    stop = scenario.duration_s if options.stop_s is None else min(options.stop_s, scenario.duration_s)
    if not (0.0 <= start < stop or (options.start_s is None and options.stop_s is None)):
        asked = "end" if options.stop_s is None else f"{options.stop_s:g}"
        raise ConfigError(
            f"start, stop: {start:g} to {asked} s, expected a range within the scenario, 0 to {scenario.duration_s:g} s"
        )
    return Span(start, stop)


def select_shown(scenario: Scenario, replay: Any, options: PlotOptions) -> tuple[Scenario, Any]:
    """Return the scenario and its replay with the agents that the options name alone.

    Raises
    ------
    ConfigError
        For an id that no agent has.
    """
    if options.agents is None:
        return scenario, replay
    known = [agent.id for agent in scenario.agents]
    for id in options.agents:
        if id not in known:
            raise ConfigError(f"agents: '{id}' is no agent of {scenario.name or 'the scenario'}{nearest(id, known)}")
    scenario = replace(scenario, agents=tuple(a for a in scenario.agents if a.id in options.agents))
    if replay is None:
        return scenario, None
    collisions = [e for e in replay.metrics.get("collisions", ()) if set(e["agents"]) <= set(options.agents)]
    warnings = replay.warnings
    if warnings is not None:
        events = tuple(e for e in warnings.events if {e.driver, e.agent} <= set(options.agents))
        warnings = replace(warnings, events=events)
    agents = tuple(a for a in replay.agents if a.id in options.agents)
    metrics: Mapping[str, Any] = {**replay.metrics, "collisions": collisions}
    return scenario, replace(replay, agents=agents, metrics=metrics, warnings=warnings)


def cut_scenario(scenario: Scenario, span: Span) -> Scenario:
    """Return a scenario with what is within a range of its time; times stay, and agents that are not there go."""
    if span.start_s <= 0.0 and span.stop_s >= scenario.duration_s:
        return scenario
    agents = [cut for agent in scenario.agents if (cut := _cut_agent(agent, span)) is not None]
    return replace(scenario, agents=tuple(agents), duration_s=span.stop_s)


def cut_replay(replay: Any, span: Span, scenario: Scenario) -> Any:
    """Return a replay with what is within a range of the scenario's time."""
    if replay is None or (span.start_s <= 0.0 and span.stop_s >= scenario.duration_s):
        return replay
    cut = [_cut_states(agent, span) for agent in replay.agents]
    agents = tuple(agent for agent in cut if agent is not None)
    there = {agent.id for agent in agents}
    events = [e for e in replay.metrics.get("collisions", ()) if span.holds(e["t_s"]) and set(e["agents"]) <= there]
    warnings = replay.warnings
    if warnings is not None:
        kept = tuple(
            w
            for w in warnings.events
            if w.warned is not None and span.holds(w.warned.t_s) and {w.driver, w.agent} <= there
        )
        warnings = replace(warnings, events=kept)
    return replace(replay, agents=agents, metrics={**replay.metrics, "collisions": events}, warnings=warnings)


def _cut_agent(agent: Agent, span: Span) -> Agent | None:
    """Return an agent with the waypoints within a range and interpolated ones at its ends; None when it is not there."""
    w = agent.waypoints
    if agent.is_permanent:
        return agent
    first, last = max(span.start_s, float(w.t_s[0])), min(span.stop_s, float(w.t_s[-1]))
    if first > last:
        return None
    inside = w.t_s[(w.t_s > first + SAME_TIME_S) & (w.t_s < last - SAME_TIME_S)]
    t_s = np.concatenate([[first], inside, [last] if last > first else []])
    taken = w.take(np.searchsorted((w.t_s[1:] + w.t_s[:-1]) / 2, t_s))  # the nearest ones
    states = agent.at(t_s)
    exact = {name: getattr(states, name) for name in ("x_m", "y_m", "z_m", "yaw_rad", "speed_mps")}
    return replace(agent, waypoints=replace(taken, t_s=t_s, **exact))


def _cut_states(agent: Any, span: Span) -> Any:
    """Return the states of a replayed agent within a range; None when it is not there."""
    keep = span.holds(agent.t_s)
    if not keep.any():  # what stands has a state at the start and one at the end
        return agent if len(agent.t_s) and agent.t_s[0] < span.start_s and agent.t_s[-1] > span.stop_s else None
    commands = agent.commands
    if commands is not None:
        commands = replace(commands, **{name: getattr(commands, name)[keep] for name in commands.COLUMNS})
    columns = {name: getattr(agent, name) for name in (*agent.COLUMNS, *agent.ERRORS)}
    kept = {name: None if column is None else column[keep] for name, column in columns.items()}
    return replace(agent, commands=commands, **kept)
