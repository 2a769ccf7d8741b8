"""The base of pictures and animations: layout, background, legend and charts; axes of one's own."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from log2sim.datatypes import ENDS, Scenario
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.expected_motion import ends_of
from log2sim.visualization.plot import layers, viewport
from log2sim.visualization.plot import layout as layouts
from log2sim.visualization.plot.selection import PlotOptions
from log2sim.visualization.plot.style import END_COLOR, FONT, MUTED, PAPER, SIGNAL_COLOR, style_axes
from log2sim.visualization.plot.time_series import TimelineCharts, charts_height_in, draw_charts, timeline_of

Rows = list[tuple[Any, str]]  # handles and texts of a legend


def draw_base(
    scenario: Scenario, roles: viewport.AgentRoles, overlays: layers.Overlays, *, moving: bool = False
) -> tuple[layouts.FigureLayout, float, TimelineCharts | None, list[layouts.MapLabel]]:
    """Draw what stills and animations share.

    Returns the layout, the seconds between time marks, charts of a replay with a driven agent, and the labels of a still picture,
    which are not drawn yet.
    """
    span = overlays.span_of(scenario)
    view = _view_of(roles, overlays.options)
    step_s = viewport.time_step_s(span.duration_s, len(roles.movers), _typical_speed(roles), view.width_m / 500)
    projected = scenario.map.projection is not None
    timeline = timeline_of(overlays.replay, roles)
    size = overlays.options.size_px

    def lay_out(rows: Rows) -> layouts.FigureLayout:
        return layouts.make_layout(
            view, sum(1 + text.count("\n") for _, text in rows), projected=projected,
            foot_in=charts_height_in(timeline), aspect=None if size is None else size[1] / size[0],
        )  # fmt: skip

    # What finds no room on the map is in the legend, for which the figure grows.
    leading = {role.agent.id for role in roles.movers if role.leading}
    labels: list[layouts.MapLabel] = []
    if moving:
        rows = _legend(scenario, roles, overlays, None, leading if layouts.names_fit(roles) else set())
        layout = lay_out(rows)
    else:
        static, sensors = overlays.options.label_static, scenario.sensors
        told = leading | {agent.id for agent in roles.stationary}
        layout = lay_out(_legend(scenario, roles, overlays, step_s, told))
        labels, said = layouts.place_labels(roles, layout.view, step_s, sensors, static=static)
        if not told <= said | {agent.id for agent in roles.stationary if not agent.is_doubtful}:
            layout = lay_out(_legend(scenario, roles, overlays, step_s, said))
            labels, said = layouts.place_labels(roles, layout.view, step_s, sensors, static=static)
        rows = _legend(scenario, roles, overlays, step_s, said)
    signals_s = None if moving else span.stop_s
    draw_standing(layout.ax, scenario, roles, layout.view, overlays.background, signals_s=signals_s)
    layout.ax.set(xlim=(layout.view.x0, layout.view.x1), ylim=(layout.view.y0, layout.view.y1))
    # In the column beside the map, where the legend covers nothing.
    place = 1 - layouts.SIDE_IN / layout.width_in, 1 - layouts.TOP_IN / layout.figure.get_figheight()
    layouts.fill_legend(layout.figure, rows, place, handlelength=2.0, labelspacing=0.56, handletextpad=0.7)
    layouts.draw_scale_and_north(layout, projected=projected)
    movers = sum(viewport.is_moving(r.agent) for r in roles.movers if not r.is_ego)
    agents = len(scenario.others)
    parts = [f"{span.duration_s:.1f} s" if span.start_s == 0 else f"{span.start_s:.1f} to {span.stop_s:.1f} s"]
    parts.append(f"{agents} agent{'' if agents == 1 else 's'}, {movers} moving")
    if scenario.doubtful:
        parts.append(f"{len(scenario.doubtful)} doubtful")
    if scenario.ego is None:
        parts.append("no ego")
    if scenario.map.latitude_deg is not None and scenario.map.longitude_deg is not None:
        parts.append(f"origin {scenario.map.latitude_deg:.5f}°, {scenario.map.longitude_deg:.5f}°")
    layouts.write_title(layout, scenario.name or "scenario", " · ".join(parts))
    charts = None if timeline is None else draw_charts(layout, timeline, (span.start_s, span.stop_s), moving=moving)
    return layout, step_s, charts, labels


def draw_standing(
    ax: Axes,
    scenario: Scenario,
    roles: viewport.AgentRoles,
    view: viewport.Viewport,
    background: Any,
    *,
    signals_s: float | None,
) -> None:
    """Draw what stands: the ground, the road with its traffic lights at a time, if any, and the agents that never move."""
    if background is not None:  # lightened so that tracks stand out
        pale = 0.62 * background.image_bgr[..., ::-1].astype(np.float32) + 0.38 * 255
        rgba = np.dstack([np.rint(pale).astype(np.uint8), (background.alpha * 0.95).astype(np.uint8)])
        how: dict[str, Any] = {"origin": "upper", "interpolation": "antialiased", "aspect": "auto"}
        ax.imshow(rgba, extent=background.extent_m, zorder=layers.BACKGROUND, **how)
    layers.draw_road(ax, scenario, view, over_picture=background is not None)
    if signals_s is not None:
        for signal in scenario.signals:
            color, z = SIGNAL_COLOR[str(signal.at(signals_s)[0])], layers.LABEL - 0.3
            ax.plot(*signal.position_m[:2], "o", ms=5.0, mfc=color, mec=PAPER, mew=0.9, zorder=z)
    layers.draw_stationary(ax, roles.stationary, view)
    for agent in (agent for agent in roles.stationary if agent.is_doubtful):
        middle, z = len(agent.waypoints) // 2, layers.STATIONARY + 0.1
        layers.hatch(ax, agent, middle, view, stripe=MUTED, edge=MUTED, z=z)


def draw_moving(
    ax: Axes,
    roles: viewport.AgentRoles,
    view: viewport.Viewport,
    step_s: float,
    *,
    truth: Scenario | None,
    replay: Any,
    ghosts: bool = False,
) -> None:
    """Draw the tracks of agents, pale where truth or replay lie over them; with `ghosts` also boxes along those."""
    overlaid = truth is not None or replay is not None
    layers.draw_tracks(ax, roles, view, step_s, alpha=0.45 if overlaid else 1.0)
    crowded = overlaid or not ghosts or len(roles.movers) > viewport.MAX_UNCROWDED_MOVERS
    layers.draw_ends(ax, roles, view, ghosts_step_s=None if crowded else step_s)
    layers.hatch_movers(ax, roles, view, layers.TRACK + 0.5, layers.BOX + 0.6)
    if truth is not None:
        layers.draw_truth(ax, truth)
    if replay is not None:
        layers.draw_replay(ax, replay, roles)
        layers.draw_collisions(ax, layers.new_collisions(replay)[1])


def _view_of(roles: viewport.AgentRoles, options: PlotOptions) -> viewport.Viewport:
    if options.extent_m is None:
        return viewport.choose_viewport(roles)
    x0, y0, x1, y1 = options.extent_m
    return viewport.Viewport(min(x0, x1), max(x0, x1), min(y0, y1), max(y0, y1))


def _legend(
    scenario: Scenario, roles: viewport.AgentRoles, overlays: layers.Overlays, mark_step_s: float | None, told: set[str]
) -> Rows:
    """List the rows of the legend; `told` agents are labeled on the map, and `mark_step_s` is None in animations."""
    view = _view_of(roles, overlays.options)
    agents = [r.agent for r in roles.movers] + list(roles.stationary)
    outside = sum(not view.contains(viewport.centers_xy(a)).any() for a in agents)
    shown = {"truth": overlays.truth is not None, "replay": overlays.replay is not None}
    collisions = len(layers.new_collisions(overlays.replay)[0])
    rows = layouts.legend_rows(roles, mark_step_s, told, collisions=collisions, outside=outside, **shown)
    rows += layers.doubt_rows(roles, told)
    if overlays.predicted is not None and roles.movers:
        dots = Line2D([0, 1], [0, 1], color=MUTED, lw=1.3, ls=(0, (1.0, 1.3)))
        rows.append((dots, f"predicted for {overlays.predicted.horizon_s:g} s, 1 sigma"))
    if len(ends_of(scenario)) > 1 and mark_step_s is not None:
        lines = [Line2D([0, 1], [0, 1], color=END_COLOR[end], lw=layers.WIDTH_PT) for end in ENDS]
        rows += [(line, f"observed by the {end} alone") for line, end in zip(lines, ENDS)]
    if layers.warned_events(overlays.replay) and mark_step_s is not None:
        rows.append((Line2D([0, 1], [0, 1], **layers.LINE), "warning: when, and how far apart"))
    return rows + layers.road_rows(scenario)


def _typical_speed(roles: viewport.AgentRoles) -> float:
    speeds = [float(np.abs(r.agent.waypoints.speed_mps).mean()) for r in roles.movers if viewport.is_moving(r.agent)]
    return float(np.median(speeds)) if speeds else 0.0


SIZE_IN = (9.5, 6.0)


def plot(
    scenario: Scenario,
    ax: Axes | None = None,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: GroundMap | None = None,
    legend: bool | None = None,
) -> Axes:
    """Draw a scenario from above.

    Raises `ScenarioError` when the truth's map has another projection.

    `ax`: drawn into; limits of axes that show something already are kept. Without, a new figure of pyplot. `replay`: drawn over the
    scenario. `truth`: brought to the scenario's start and map. `background`: a picture of the ground in the map frame. `legend`: by
    default only in a new figure.
    """
    aligned = None if truth is None else truth.aligned_to(scenario)
    new = ax is None
    if ax is None:
        import matplotlib.pyplot as plt

        ax = plt.subplots(figsize=SIZE_IN, layout="constrained")[1]
    roles = viewport.assign_view_roles(scenario)
    # The view is that of axes that show something, else the agents'.
    extent, per_pt = ax.get_window_extent(), 72 / ax.figure.dpi
    size_pt = max(extent.width * per_pt, 1.0), max(extent.height * per_pt, 1.0)
    if ax.has_data():
        (x0, x1), (y0, y1) = sorted(ax.get_xlim()), sorted(ax.get_ylim())
        view = viewport.Viewport(x0, x1, y0, y1, max((x1 - x0) / size_pt[0], (y1 - y0) / size_pt[1]))
    else:
        view = viewport.choose_viewport(roles).fitted(*size_pt)
        ax.set_aspect("equal", adjustable="box")
        style_axes(ax, grid=False)
        ax.set_xlabel("x of the map (m)", fontsize=7.5, color=MUTED, family=FONT)
        ax.set_ylabel("y of the map (m)", fontsize=7.5, color=MUTED, family=FONT)
    step_s = viewport.time_step_s(scenario.duration_s, len(roles.movers), _typical_speed(roles), view.m_per_pt)
    draw_standing(ax, scenario, roles, view, background, signals_s=scenario.duration_s)
    draw_moving(ax, roles, view, step_s, truth=aligned, replay=replay)
    labels, told = layouts.place_labels(roles, view, step_s, scenario.sensors)
    layouts.draw_labels(ax, labels)
    ax.set(xlim=(view.x0, view.x1), ylim=(view.y0, view.y1))
    if new if legend is None else legend:
        overlays = {"truth": truth is not None, "replay": replay is not None}
        collisions = len(layers.new_collisions(replay)[0])
        rows = layouts.legend_rows(roles, step_s, told, collisions=collisions, outside=0, **overlays)
        layouts.fill_legend(ax, [*rows, *layers.doubt_rows(roles, told), *layers.road_rows(scenario)], (1.01, 1.0))
    return ax
