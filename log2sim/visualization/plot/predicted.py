"""Predictions on the map axes: where an agent was expected to go, and how far off that may be."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D

from log2sim.datatypes import STANDSTILL_MPS, Scenario
from log2sim.geometry import Array
from log2sim.prediction.prediction import DEFAULT_METHOD, predict_scenario
from log2sim.visualization.plot.drawing import MARK, TRACK
from log2sim.visualization.plot.roles import AgentRole, AgentRoles
from log2sim.visualization.plot.style import MUTED

DOTS: dict[str, Any] = {"linestyles": [(0, (1.0, 1.3))], "linewidths": 1.3}
ELLIPSE_ALPHA, ELLIPSE_EDGE_ALPHA = 0.14, 0.6
_CIRCLE = np.exp(2j * np.pi * np.arange(36) / 36)


class Expected(NamedTuple):
    """A prediction to draw.

    Attributes
    ----------
    path_m : (H + 1, 2) float64, m
        From where the agent is to where it is expected to be.
    ellipse_m : (V, 2) float64, m
        One standard deviation about the end.
    """

    path_m: Array
    ellipse_m: Array


class PredictedPaths:
    """Predictions of the agents of a scenario, to be drawn at times."""

    def __init__(self, scenario: Scenario, horizon_s: float) -> None:
        self.horizon_s = horizon_s
        self._found = predict_scenario(scenario, horizon_s, methods=(DEFAULT_METHOD,))
        self._rows = {a.id: self._found.rows_of(a.id) for a in scenario.agents}

    def at(self, agent: str, t_s: float) -> Expected | None:
        """Return what was expected of an agent at the last tick up to a time; None when it is absent or stands."""
        found, rows = self._found, self._rows[agent]
        table, ticks = found.table, found.tick[rows]
        k = int(np.searchsorted(table.t_s[ticks], t_s + 1e-6, side="right")) - 1
        if k < 0 or t_s - table.t_s[ticks[k]] > table.tick_s or self._stands(rows[k]):
            return None
        forecast, row = found.forecasts[DEFAULT_METHOD], rows[k]
        path = np.append(table.position_m[found.row[row], ticks[k]], forecast.position_m[row])
        along, across = forecast.sigma_m[row, -1]
        rim = path[-1] + forecast.course[row, -1] * (along * _CIRCLE.real + 1j * across * _CIRCLE.imag)
        return Expected(*(np.column_stack([z.real, z.imag]) for z in (path, rim)))

    def times_of(self, agent: str) -> Array:
        """Choose the times (K,), s, at which a still picture shows what was expected of an agent.

        Every `horizon_s`, so that they follow each other, and at its last tick, after which nothing else is drawn.
        """
        found, rows = self._found, self._rows[agent]
        t = found.table.t_s[found.tick[rows]]
        if len(t) < 2:
            return t[:0]
        regular = (
            np.arange(np.ceil(t[0] / self.horizon_s + 1e-6), np.floor(t[-1] / self.horizon_s) + 1) * self.horizon_s
        )
        return np.append(regular[regular < t[-1] - self.horizon_s / 3], t[-1])

    def _stands(self, row: int) -> bool:
        found = self._found
        return bool(abs(found.table.velocity_mps[found.row[row], found.tick[row]]) < STANDSTILL_MPS)


def draw_predictions(ax: Axes, roles: AgentRoles, paths: PredictedPaths) -> None:
    """Draw what was expected of the leading movers at several times, as dotted lines with an ellipse at the end."""
    shown = [
        (role, expected)
        for role in roles.movers
        if role.leading
        for t in paths.times_of(role.agent.id)
        if role.agent.waypoints.t_s[0] <= t <= role.agent.waypoints.t_s[-1]
        if (expected := paths.at(role.agent.id, float(t))) is not None
    ]
    for artist in (
        LineCollection([], zorder=MARK + 0.2, **DOTS),
        PolyCollection([], linewidths=0.7, zorder=TRACK - 0.4),
    ):
        show_expected(artist, shown)
        ax.add_collection(artist, autolim=False)


def show_expected(artist: LineCollection | PolyCollection, shown: list[tuple[AgentRole, Expected]]) -> None:
    """Set the paths of a line collection or the ellipses of a polygon collection, in the colors of the agents."""
    colors = [role.color for role, _ in shown]
    if isinstance(artist, LineCollection):
        artist.set_segments([expected.path_m for _, expected in shown])
        artist.set_color([to_rgba(color) for color in colors])
        return
    artist.set_verts([expected.ellipse_m for _, expected in shown])
    artist.set_facecolor([to_rgba(color, ELLIPSE_ALPHA) for color in colors])
    artist.set_edgecolor([to_rgba(color, ELLIPSE_EDGE_ALPHA) for color in colors])


def prediction_row(horizon_s: float) -> tuple[Line2D, str]:
    """Return the line of the legend."""
    handle = Line2D([0, 1], [0, 1], color=MUTED, lw=1.3, ls=(0, (1.0, 1.3)))
    return handle, f"predicted for {horizon_s:g} s, 1 sigma"
