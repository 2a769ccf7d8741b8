"""The picture of a scenario from above: who drove where, still or moving."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import Scenario
from log2sim.visualization.plot import drawing
from log2sim.visualization.plot.collisions import hits_of
from log2sim.visualization.plot.layout import (
    Sheet,
    draw_legend,
    draw_scale_and_north,
    legend_rows,
    make_sheet,
    write_title,
)
from log2sim.visualization.plot.roles import Cast, moves, path
from log2sim.visualization.plot.time_series import DrawnStrips, draw_strips, foot_in, story_of
from log2sim.visualization.plot.viewport import View, choose_view, time_step_s


def base(
    scenario: Scenario,
    cast: Cast,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    title: str | None = None,
    moving: bool = False,
) -> tuple[Sheet, float, DrawnStrips | None]:
    """What still and moving pictures share: sheet, background, standing agents, legend; the time step of marks; strips."""
    chosen = choose_view(cast)
    projected = scenario.map.projection is not None
    step_s = time_step_s(scenario.duration_s, len(cast.movers), _typical_speed(cast), chosen.width_m / 500)
    outside = _outside(cast, chosen)
    overlays = {"truth": truth is not None, "replay": replay is not None}
    hits = len(hits_of(replay)[0])
    rows = legend_rows(cast, None if moving else step_s, hits=hits, outside=outside, **overlays)
    story = story_of(replay, scenario, cast)
    sheet = make_sheet(chosen, len(rows), projected=projected, foot_in=foot_in(story))
    if background is not None:
        drawing.draw_background(sheet.ax, background)
    sheet.ax.set(xlim=(sheet.view.x0, sheet.view.x1), ylim=(sheet.view.y0, sheet.view.y1))
    drawing.draw_standing(sheet.ax, cast.standing, sheet.view)
    draw_legend(sheet, rows)
    draw_scale_and_north(sheet, projected=projected)
    write_title(sheet, title or scenario.name or "scenario", _subtitle(scenario, cast))
    strips = None
    if story is not None:
        strips = draw_strips(sheet, story, (0.0, scenario.duration_s), moving=moving)
    return sheet, step_s, strips


def _subtitle(scenario: Scenario, cast: Cast) -> str:
    moving = sum(moves(r.agent) for r in cast.movers if not r.is_ego)
    agents = len(scenario.others)
    parts = [f"{scenario.duration_s:.1f} s", f"{agents} agent{'' if agents == 1 else 's'}, {moving} moving"]
    if scenario.ego is None:
        parts.append("no ego")
    if scenario.map.latitude_deg is not None and scenario.map.longitude_deg is not None:
        parts.append(f"origin {scenario.map.latitude_deg:.5f}°, {scenario.map.longitude_deg:.5f}°")
    return " · ".join(parts)


def _outside(cast: Cast, view: View) -> int:
    """How many agents are nowhere in the view as it will be shown, or nearly."""
    agents = [r.agent for r in cast.movers] + list(cast.standing)
    return sum(not view.holds(path(a)).any() for a in agents)


def _typical_speed(cast: Cast) -> float:
    speeds = [float(np.abs(r.agent.waypoints.speed_mps).mean()) for r in cast.movers if moves(r.agent)]
    return float(np.median(speeds)) if speeds else 0.0
