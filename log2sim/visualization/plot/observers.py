"""Beside the tracks of a cooperative log: where one end alone observed an agent."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D

from log2sim.datatypes import ENDS, Agent, Scenario, Span
from log2sim.geometry import Array
from log2sim.simulation.warnings.known import ends_of
from log2sim.visualization.plot.drawing import TRACK
from log2sim.visualization.plot.roles import AgentRoles
from log2sim.visualization.plot.style import END_COLOR
from log2sim.visualization.plot.viewport import Viewport

STEP_S = 0.1
"""Between the points of a line: ends observe at the rate of their LiDARs."""

WIDTH_PT, BESIDE_PT = 1.3, 3.4
"""Width of a line, and how far to the right of the track it is."""


def tells_ends(scenario: Scenario) -> bool:
    """Whether both ends of a cooperative log observed somebody, so that there is something to distinguish."""
    return len(ends_of(scenario)) > 1


def draw_observers(ax: Axes, roles: AgentRoles, view: Viewport) -> None:
    """Draw a line beside the tracks of movers where one end alone observed them."""
    aside_m = BESIDE_PT * view.m_per_pt
    for end in ENDS:
        lines = [line for role in roles.movers for line in lines_of(role.agent, end, aside_m)]
        artist = LineCollection(lines, colors=END_COLOR[end], linewidths=WIDTH_PT, capstyle="butt", zorder=TRACK - 0.2)
        ax.add_collection(artist, autolim=False)


def lines_of(agent: Agent, end: str, aside_m: float = 0.0) -> list[Array]:
    """Return lines (K, 2), m, map frame, along which an end alone observed an agent; `aside_m` to its right."""
    w, others = agent.waypoints, [e for e in ENDS if e != end]
    if not agent.observed_by.get(end) or len(w) < 2:
        return []
    t_s = np.arange(w.t_s[0], w.t_s[-1] + STEP_S / 2, STEP_S)
    alone = _within(t_s, agent.observed_by[end])
    for other in others:
        alone &= ~_within(t_s, agent.observed_by.get(other, ()))
    states = agent.trajectory.at(t_s)
    right = states.yaw_rad - np.pi / 2
    points = np.column_stack([states.x_m + aside_m * np.cos(right), states.y_m + aside_m * np.sin(right)])
    runs = np.split(np.arange(len(t_s)), np.flatnonzero(np.diff(alone)) + 1)
    return [points[run] for run in runs if alone[run[0]] and len(run) > 1]


def observer_rows() -> list[tuple[Line2D, str]]:
    """Return the lines of the legend."""
    return [(Line2D([0, 1], [0, 1], color=END_COLOR[e], lw=WIDTH_PT), f"observed by the {e} alone") for e in ENDS]


def _within(t_s: Array, spans: tuple[Span, ...]) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
    return np.asarray(np.any([(t_s >= a - 1e-6) & (t_s <= b + 1e-6) for a, b in spans] or [t_s < -np.inf], axis=0))
