"""The base of still pictures and animations: layout, background, stationary agents, legend and charts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.visualization.plot import doubts, drawing
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.labels import MapLabel, place_labels
from log2sim.visualization.plot.layout import (
    FigureLayout,
    draw_legend,
    draw_scale_and_north,
    legend_rows,
    make_layout,
    write_title,
)
from log2sim.visualization.plot.moving_labels import names_fit
from log2sim.visualization.plot.observers import observer_rows, tells_ends
from log2sim.visualization.plot.options import PlotOptions
from log2sim.visualization.plot.overlays import Overlays
from log2sim.visualization.plot.predicted import prediction_row
from log2sim.visualization.plot.road_features import draw_road, draw_signals, road_rows
from log2sim.visualization.plot.roles import AgentRoles, centers_xy, is_moving
from log2sim.visualization.plot.selection import Span
from log2sim.visualization.plot.time_series import TimelineCharts, charts_height_in, draw_charts, timeline_of
from log2sim.visualization.plot.viewport import Viewport, choose_viewport, time_step_s
from log2sim.visualization.plot.warned import warned_places, warning_row

Rows = list[tuple[Any, str]]
"""Handles and texts of a legend."""


@dataclass(frozen=True, eq=False)
class PictureBase:
    """What stills and animations share.

    Attributes
    ----------
    layout : FigureLayout
    step_s : float, s
        Between time marks.
    charts : TimelineCharts or None
        Of the replay; None without a driven agent.
    labels : tuple of MapLabel
        Of a still picture, not drawn yet.
    """

    layout: FigureLayout
    step_s: float
    charts: TimelineCharts | None
    labels: tuple[MapLabel, ...] = ()


def draw_base(scenario: Scenario, roles: AgentRoles, overlays: Overlays, *, moving: bool = False) -> PictureBase:
    """Draw what stills and animations share."""
    span = overlays.span_of(scenario)
    view = _view_of(roles, overlays.options)
    step_s = time_step_s(span.duration_s, len(roles.movers), _typical_speed(roles), view.width_m / 500)
    projected = scenario.map.projection is not None
    timeline = timeline_of(overlays.replay, scenario, roles)
    size = overlays.options.size_px

    def lay_out(rows: Rows) -> FigureLayout:
        return make_layout(
            view, sum(1 + text.count("\n") for _, text in rows), projected=projected,
            foot_in=charts_height_in(timeline), aspect=None if size is None else size[1] / size[0],
        )  # fmt: skip

    layout, rows, labels = _fit_labels(scenario, roles, overlays, lay_out, None if moving else step_s)
    if overlays.background is not None:
        drawing.draw_background(layout.ax, overlays.background)
    draw_road(layout.ax, scenario, layout.view, over_picture=overlays.background is not None)
    if not moving:
        draw_signals(layout.ax, scenario.signals, span.stop_s)
    layout.ax.set(xlim=(layout.view.x0, layout.view.x1), ylim=(layout.view.y0, layout.view.y1))
    drawing.draw_stationary(layout.ax, roles.stationary, layout.view)
    doubts.hatch_stationary(layout.ax, roles, layout.view, drawing.STATIONARY + 0.1)
    draw_legend(layout, rows)
    draw_scale_and_north(layout, projected=projected)
    write_title(layout, overlays.title or scenario.name or "scenario", _subtitle(scenario, roles, span))
    charts = None
    if timeline is not None:
        charts = draw_charts(layout, timeline, (span.start_s, span.stop_s), moving=moving)
    return PictureBase(layout, step_s, charts, labels)


def _view_of(roles: AgentRoles, options: PlotOptions) -> Viewport:
    if options.extent_m is None:
        return choose_viewport(roles)
    x0, y0, x1, y1 = options.extent_m
    return Viewport(min(x0, x1), max(x0, x1), min(y0, y1), max(y0, y1))


def _fit_labels(
    scenario: Scenario,
    roles: AgentRoles,
    overlays: Overlays,
    lay_out: Callable[[Rows], FigureLayout],
    mark_step_s: float | None,
) -> tuple[FigureLayout, Rows, tuple[MapLabel, ...]]:
    """Lay out a figure and place the labels on its map; what found no room there is in the legend, for which the figure grows."""
    leading = {role.agent.id for role in roles.movers if role.leading}
    if mark_step_s is None:
        rows = _legend(scenario, roles, overlays, None, leading if names_fit(roles) else set())
        return lay_out(rows), rows, ()
    told = leading | {agent.id for agent in roles.stationary}
    layout = lay_out(_legend(scenario, roles, overlays, mark_step_s, told))
    placed = place_labels(roles, layout.view, mark_step_s, label_static=overlays.options.label_static)
    if not told <= placed.told | {agent.id for agent in roles.stationary if not agent.is_doubtful}:
        layout = lay_out(_legend(scenario, roles, overlays, mark_step_s, placed.told))
        placed = place_labels(roles, layout.view, mark_step_s, label_static=overlays.options.label_static)
    return layout, _legend(scenario, roles, overlays, mark_step_s, placed.told), tuple(placed.labels)


def _legend(
    scenario: Scenario, roles: AgentRoles, overlays: Overlays, mark_step_s: float | None, told: set[str]
) -> Rows:
    """List the rows of the legend; `told` agents are labeled on the map, and `mark_step_s` is None in animations."""
    outside = _outside(roles, _view_of(roles, overlays.options))
    shown = {"truth": overlays.truth is not None, "replay": overlays.replay is not None}
    collisions = len(new_collisions(overlays.replay)[0])
    rows = legend_rows(roles, mark_step_s, told, collisions=collisions, outside=outside, **shown)
    rows += doubts.doubt_rows(roles, told)
    if overlays.predicted is not None and roles.movers:
        rows.append(prediction_row(overlays.predicted.horizon_s))
    if tells_ends(scenario) and mark_step_s is not None:
        rows += observer_rows()
    if warned_places(overlays.replay) and mark_step_s is not None:
        rows.append(warning_row())
    return rows + road_rows(scenario)


def _subtitle(scenario: Scenario, roles: AgentRoles, span: Span) -> str:
    moving = sum(is_moving(r.agent) for r in roles.movers if not r.is_ego)
    agents = len(scenario.others)
    parts = [f"{span.duration_s:.1f} s" if span.start_s == 0 else f"{span.start_s:.1f} to {span.stop_s:.1f} s"]
    parts.append(f"{agents} agent{'' if agents == 1 else 's'}, {moving} moving")
    if scenario.doubtful:
        parts.append(f"{len(scenario.doubtful)} doubtful")
    if scenario.ego is None:
        parts.append("no ego")
    if scenario.map.latitude_deg is not None and scenario.map.longitude_deg is not None:
        parts.append(f"origin {scenario.map.latitude_deg:.5f}°, {scenario.map.longitude_deg:.5f}°")
    return " · ".join(parts)


def _outside(roles: AgentRoles, view: Viewport) -> int:
    """Count the agents whose trajectories lie outside the view."""
    agents = [r.agent for r in roles.movers] + list(roles.stationary)
    return sum(not view.contains(centers_xy(a)).any() for a in agents)


def _typical_speed(roles: AgentRoles) -> float:
    speeds = [float(np.abs(r.agent.waypoints.speed_mps).mean()) for r in roles.movers if is_moving(r.agent)]
    return float(np.median(speeds)) if speeds else 0.0
