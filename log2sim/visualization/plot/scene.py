"""The base of still pictures and animations: layout, background, stationary agents, legend and charts."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.visualization.plot import doubts, drawing
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.layout import (
    FigureLayout,
    draw_legend,
    draw_scale_and_north,
    legend_rows,
    make_layout,
    write_title,
)
from log2sim.visualization.plot.observers import observer_rows, tells_ends
from log2sim.visualization.plot.predicted import PredictedPaths, prediction_row
from log2sim.visualization.plot.road_features import draw_road, draw_signals, road_rows
from log2sim.visualization.plot.roles import AgentRoles, centers_xy, is_moving
from log2sim.visualization.plot.time_series import TimelineCharts, charts_height_in, draw_charts, timeline_of
from log2sim.visualization.plot.viewport import Viewport, choose_viewport, time_step_s
from log2sim.visualization.plot.warned import warned_places, warning_row


def draw_base(
    scenario: Scenario,
    roles: AgentRoles,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    title: str | None = None,
    moving: bool = False,
    predicted: PredictedPaths | None = None,
) -> tuple[FigureLayout, float, TimelineCharts | None]:
    """Draw what stills and animations share.

    Returns
    -------
    layout : Layout
    step_s : float, s
        Between time marks.
    charts : TimelineCharts or None
        Of the replay; None without a driven agent.
    """
    chosen = choose_viewport(roles)
    projected = scenario.map.projection is not None
    step_s = time_step_s(scenario.duration_s, len(roles.movers), _typical_speed(roles), chosen.width_m / 500)
    outside = _outside(roles, chosen)
    overlays = {"truth": truth is not None, "replay": replay is not None}
    collisions = len(new_collisions(replay)[0])
    rows = legend_rows(roles, None if moving else step_s, collisions=collisions, outside=outside, **overlays)
    rows += doubts.doubt_rows(roles)
    if predicted is not None and roles.movers:
        rows.append(prediction_row(predicted.horizon_s))
    if tells_ends(scenario) and not moving:
        rows += observer_rows()
    if warned_places(replay) and not moving:
        rows.append(warning_row())
    rows += road_rows(scenario)
    timeline = timeline_of(replay, scenario, roles)
    lines = sum(1 + text.count("\n") for _, text in rows)
    layout = make_layout(chosen, lines, projected=projected, foot_in=charts_height_in(timeline))
    if background is not None:
        drawing.draw_background(layout.ax, background)
    draw_road(layout.ax, scenario, layout.view, over_picture=background is not None)
    if not moving:
        draw_signals(layout.ax, scenario.signals, scenario.duration_s)
    layout.ax.set(xlim=(layout.view.x0, layout.view.x1), ylim=(layout.view.y0, layout.view.y1))
    drawing.draw_stationary(layout.ax, roles.stationary, layout.view)
    doubts.hatch_stationary(layout.ax, roles, layout.view, drawing.STATIONARY + 0.1)
    draw_legend(layout, rows)
    draw_scale_and_north(layout, projected=projected)
    write_title(layout, title or scenario.name or "scenario", _subtitle(scenario, roles))
    charts = None
    if timeline is not None:
        charts = draw_charts(layout, timeline, (0.0, scenario.duration_s), moving=moving)
    return layout, step_s, charts


def _subtitle(scenario: Scenario, roles: AgentRoles) -> str:
    moving = sum(is_moving(r.agent) for r in roles.movers if not r.is_ego)
    agents = len(scenario.others)
    parts = [f"{scenario.duration_s:.1f} s", f"{agents} agent{'' if agents == 1 else 's'}, {moving} moving"]
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
