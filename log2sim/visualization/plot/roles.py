"""Roles of agents in a picture: movers with a color and a label, and stationary agents."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.geometry import Array
from log2sim.visualization.plot.style import CROWD_COLOR, INK, PALETTE

MIN_MOVING_M = 1.0
"""An agent is stationary when the bounding box of its trajectory has a shorter diagonal."""


@dataclass(frozen=True, eq=False)
class AgentRole:
    """A moving agent as the pictures show it.

    Attributes
    ----------
    agent : Agent
    color : str
    leading : bool
        Whether it has its own color, a label and a line in the legend.
    """

    agent: Agent
    color: str
    leading: bool

    @property
    def is_ego(self) -> bool:
        """Whether it is the ego."""
        return self.agent.id == "ego"

    @property
    def group(self) -> str:
        """Return the group of its category."""
        return GROUP_OF[self.agent.category]


@dataclass(frozen=True, eq=False)
class AgentRoles:
    """All agents of a scenario; the ego, if there is one, is the first mover even when it is stationary."""

    movers: tuple[AgentRole, ...]
    stationary: tuple[Agent, ...]


def agent_colors(scenario: Scenario) -> dict[str, str]:
    """Return the colors of a scenario's movers by id: the one table of picture, film and page, of all that is in the file."""
    return {role.agent.id: role.color for role in assign_roles(scenario).movers}


def assign_roles(scenario: Scenario, colors: Mapping[str, str] | None = None) -> AgentRoles:
    """Split agents into movers and stationary ones; movers by closest approach to the ego, without one by distance driven.

    A part of a scenario takes the `colors` of the whole, see `agent_colors`.
    """
    ego = scenario.ego
    moving = [a for a in scenario.others if is_moving(a)]
    if ego is not None:
        key = {a.id: _closest_m(a, ego) for a in moving}
    else:
        key = {a.id: -float(np.ptp(centers_xy(a), axis=0).sum()) for a in moving}
    moving.sort(key=lambda a: (key[a.id], a.id))
    roles = [] if ego is None else [AgentRole(ego, INK, True)]
    for k, agent in enumerate(moving):
        color = PALETTE[k] if k < len(PALETTE) else CROWD_COLOR
        color = color if colors is None else colors.get(agent.id, CROWD_COLOR)
        roles.append(AgentRole(agent, color, k < len(PALETTE)))
    return AgentRoles(tuple(roles), tuple(a for a in scenario.others if not is_moving(a)))


def is_moving(agent: Agent) -> bool:
    """Tell whether an agent moves by at least `MIN_MOVING_M`."""
    return not agent.static and float(np.hypot(*np.ptp(centers_xy(agent), axis=0))) >= MIN_MOVING_M


def centers_xy(agent: Agent) -> Array:
    """Return the box centers (T, 2), m, map frame."""
    return np.column_stack([agent.waypoints.x_m, agent.waypoints.y_m])


def _closest_m(agent: Agent, ego: Agent, samples: int = 24) -> float:
    """Compute the shortest distance, m, between a few points of two trajectories."""
    a, b = (p[np.linspace(0, len(p) - 1, samples).round().astype(int)] for p in (centers_xy(agent), centers_xy(ego)))
    return float(np.min(np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))))


def paint_of(agent: Agent, otherwise: Any) -> Any:
    """Return the color that an agent itself has, which its heading mark is drawn in; `otherwise` where it is not known."""
    return otherwise if agent.color is None else tuple(v / 255 for v in agent.color["rgb"])
