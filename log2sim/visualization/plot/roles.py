"""Who is in the picture: movers with a color and a label, and those that stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import GROUP_OF, Agent, Scenario
from log2sim.geometry import Array
from log2sim.visualization.plot.style import CROWD_COLOR, INK, PALETTE

MOVING_M = 1.0
"""An agent whose whole path fits into a box with a shorter diagonal stands."""


@dataclass(frozen=True, eq=False)
class Role:
    """An agent with its color and the label that map and legend share."""

    agent: Agent
    color: str
    label: str
    leading: bool
    """Whether it has a color of its own, a label and a line in the legend."""

    @property
    def is_ego(self) -> bool:
        return self.agent.id == "ego"

    @property
    def group(self) -> str:
        return GROUP_OF[self.agent.category]


@dataclass(frozen=True, eq=False)
class Cast:
    """The ego, if there is one, is the first mover even when it stands."""

    movers: tuple[Role, ...]
    standing: tuple[Agent, ...]


def assign(scenario: Scenario, most_leading: int = len(PALETTE)) -> Cast:
    """Split agents into movers and standing; movers in order of their closest approach to the ego, else of their way."""
    ego = scenario.ego
    moving = [a for a in scenario.others if moves(a)]
    if ego is not None:
        key = {a.id: _closest_m(a, ego) for a in moving}
    else:
        key = {a.id: -float(np.ptp(path(a), axis=0).sum()) for a in moving}
    moving.sort(key=lambda a: (key[a.id], a.id))
    short = all(len(a.id) <= 4 for a in moving)
    roles = [] if ego is None else [Role(ego, INK, "ego", True)]
    for k, agent in enumerate(moving):
        leading = k < most_leading
        label = agent.id if short else str(k + 1)
        roles.append(Role(agent, PALETTE[k % len(PALETTE)] if leading else CROWD_COLOR, label, leading))
    return Cast(tuple(roles), tuple(a for a in scenario.others if not moves(a)))


def moves(agent: Agent) -> bool:
    """Whether the agent goes anywhere."""
    return not agent.static and float(np.hypot(*np.ptp(path(agent), axis=0))) >= MOVING_M


def path(agent: Agent) -> Array:
    """Box centers (T, 2), m, map frame."""
    return np.column_stack([agent.waypoints.x_m, agent.waypoints.y_m])


def _closest_m(agent: Agent, ego: Agent, samples: int = 24) -> float:
    """Shortest distance between two paths, on a few points of each, in m."""
    a, b = (p[np.linspace(0, len(p) - 1, samples).round().astype(int)] for p in (path(agent), path(ego)))
    return float(np.min(np.hypot(*(a[:, None] - b[None]).transpose(2, 0, 1))))
