"""A scenario from above on the axes of a figure of one's own."""

from __future__ import annotations

from typing import Any

from matplotlib.axes import Axes

from log2sim.datatypes import Scenario
from log2sim.visualization.plot import doubts, drawing
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.labels import draw_labels, place_labels
from log2sim.visualization.plot.layout import legend_rows
from log2sim.visualization.plot.road_features import draw_road, draw_signals, road_rows
from log2sim.visualization.plot.roles import AgentRoles, assign_roles, is_moving
from log2sim.visualization.plot.style import FONT, FRAME, INK, MUTED
from log2sim.visualization.plot.viewport import Viewport, choose_viewport, time_step_s

SIZE_IN = (9.5, 6.0)


def plot(
    scenario: Scenario,
    ax: Axes | None = None,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    legend: bool | None = None,
) -> Axes:
    """Draw a scenario from above.

    Parameters
    ----------
    scenario : Scenario
    ax : matplotlib.axes.Axes, optional
        Drawn into; limits of axes that show something already are kept. Without, a new figure of pyplot.
    replay : Replay, optional
        Drawn over the scenario.
    truth : Scenario, optional
        Brought to the scenario's start and map.
    background : GroundMap, optional
        A picture of the ground in the map frame.
    legend : bool, optional
        By default only in a new figure.

    Returns
    -------
    matplotlib.axes.Axes

    Raises
    ------
    ScenarioError
        When the truth's map has another projection.
    """
    aligned = None if truth is None else truth.aligned_to(scenario)
    new = ax is None
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=SIZE_IN, layout="constrained")[1]
    roles = assign_roles(scenario)
    view = _set_view(ax, roles)
    step_s = time_step_s(scenario.duration_s, len(roles.movers), _usual_speed(roles), view.m_per_pt)
    if background is not None:
        drawing.draw_background(ax, background)
    draw_road(ax, scenario, view, over_picture=background is not None)
    draw_signals(ax, scenario.signals, scenario.duration_s)
    drawing.draw_stationary(ax, roles.stationary, view)
    doubts.hatch_stationary(ax, roles, view, drawing.STATIONARY + 0.1)
    drawing.draw_tracks(ax, roles, view, step_s, alpha=1.0 if replay is None and truth is None else 0.45)
    drawing.draw_ends(ax, roles, view, ghosts_step_s=None)
    doubts.hatch_movers(ax, roles, view, drawing.TRACK + 0.5, drawing.BOX + 0.6)
    if aligned is not None:
        drawing.draw_truth(ax, aligned)
    if replay is not None:
        drawing.draw_replay(ax, replay, roles)
        drawing.draw_collisions(ax, new_collisions(replay)[1])
    placed = place_labels(roles, view, step_s)
    draw_labels(ax, placed.labels)
    ax.set(xlim=(view.x0, view.x1), ylim=(view.y0, view.y1))
    if new if legend is None else legend:
        overlays = {"truth": truth is not None, "replay": replay is not None}
        collisions = len(new_collisions(replay)[0])
        rows = legend_rows(roles, step_s, placed.told, collisions=collisions, outside=0, **overlays)
        _draw_legend(ax, [*rows, *doubts.doubt_rows(roles, placed.told), *road_rows(scenario)])
    return ax


def _set_view(ax: Axes, roles: AgentRoles) -> Viewport:
    """Style axes, and return the part of the map that they show: theirs where they show something, else the agents'."""
    extent, per_pt = ax.get_window_extent(), 72 / ax.figure.dpi
    size_pt = max(extent.width * per_pt, 1.0), max(extent.height * per_pt, 1.0)
    if ax.has_data():
        (x0, x1), (y0, y1) = sorted(ax.get_xlim()), sorted(ax.get_ylim())
        return Viewport(x0, x1, y0, y1, max((x1 - x0) / size_pt[0], (y1 - y0) / size_pt[1]))
    view = choose_viewport(roles).fitted(*size_pt)
    ax.set_aspect("equal", adjustable="box")
    ax.set_axisbelow(True)
    ax.set_xlabel("x of the map (m)", fontsize=7.5, color=MUTED, family=FONT)
    ax.set_ylabel("y of the map (m)", fontsize=7.5, color=MUTED, family=FONT)
    ax.tick_params(labelsize=7, colors=MUTED, length=2.5, width=0.6)
    for spine in ax.spines.values():
        spine.set(color=FRAME, linewidth=0.8)
    return view


def _usual_speed(roles: AgentRoles) -> float:
    speeds = [float(abs(r.agent.waypoints.speed_mps).mean()) for r in roles.movers if is_moving(r.agent)]
    return sum(speeds) / len(speeds) if speeds else 0.0


def _draw_legend(ax: Axes, rows: list[tuple[Any, str]]) -> None:
    """Draw the legend beside the map, where it covers nothing."""
    made = ax.legend(
        [handle for handle, _ in rows], [text for _, text in rows], loc="upper left", bbox_to_anchor=(1.01, 1.0),
        borderaxespad=0, frameon=False, prop={"family": FONT, "size": 7.0}, labelcolor=INK,
    )  # fmt: skip
    for text in made.get_texts():
        text.set_parse_math(False)
