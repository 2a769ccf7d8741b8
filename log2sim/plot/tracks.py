"""The picture of a scenario from above: who drove where, still or moving."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

from log2sim.errors import ConfigError
from log2sim.files import refuse_existing, replaced
from log2sim.plot import draw
from log2sim.plot.cast import Cast, assign, moves, path
from log2sim.plot.hits import hits_of
from log2sim.plot.sheet import Sheet, draw_legend, draw_scale_and_north, legend_rows, make_sheet, write_title
from log2sim.plot.strips import DrawnStrips, draw_strips, foot_in, story_of
from log2sim.plot.view import View, choose_view, time_step_s
from log2sim.scenario import Scenario

STILL, ANIMATED = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def plot_tracks(
    scenario: Scenario,
    out_path: Path | str,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: draw.Background | None = None,
    title: str | None = None,
    overwrite: bool = False,
    dpi: int = 200,
) -> None:
    """Draw a scenario from above into a file: a still for .png, .svg and .pdf, moving for .gif and .mp4.

    Parameters
    ----------
    replay : log2sim.replay.Replay or None
        Laid over; what the ego did and was told, or the one farthest from its path, goes into strips below the map.
    truth : Scenario or None
        Brought to the scenario's start and map.
    background : TopdownPicture or None
        A picture of the ground in the map frame, laid under everything.
    dpi : dots per inch of a .png; the sheet is 10 inches wide.

    Raises
    ------
    ConfigError
        When the name ends in something else, the file exists and `overwrite` is False, or it cannot be written.
    ScenarioError
        When the truth's map has another projection.
    """
    out_path = Path(out_path)
    suffix = out_path.suffix.lower()
    if suffix not in STILL + ANIMATED:
        raise ConfigError(
            f"{out_path}: a picture's name must end in {', '.join(STILL)} (still) or {', '.join(ANIMATED)} (moving), "
            f"not in '{out_path.suffix}'"
        )
    refuse_existing(out_path, overwrite=overwrite)
    cast = assign(scenario)
    truth = None if truth is None else truth.beside(scenario)
    if suffix in ANIMATED:
        from log2sim.plot.animate import write_animation

        write_animation(scenario, cast, out_path, replay=replay, truth=truth, background=background, title=title)
        return
    sheet = still(scenario, cast, replay=replay, truth=truth, background=background, title=title)
    # Element names in an SVG are random unless salted, and both formats carry the date unless told not to.
    metadata: dict[str, dict[str, Any]] = {
        ".svg": {"Date": None},
        ".pdf": {"CreationDate": None},
        ".png": {"Software": None},
    }
    with replaced(out_path) as temporary, matplotlib.rc_context({"svg.hashsalt": "log2sim"}):
        sheet.figure.savefig(temporary, format=suffix[1:], dpi=dpi, metadata=metadata[suffix])


def still(
    scenario: Scenario,
    cast: Cast,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: draw.Background | None = None,
    title: str | None = None,
) -> Sheet:
    """The sheet of a still picture."""
    sheet, step_s, _ = base(scenario, cast, replay=replay, truth=truth, background=background, title=title)
    overlaid = truth is not None or replay is not None
    draw.draw_tracks(sheet.ax, cast, sheet.view, step_s, alpha=0.45 if overlaid else 1.0)
    ghosts = None if overlaid or draw.view_is_crowded(cast) else step_s
    draw.draw_ends(sheet.ax, cast, sheet.view, ghosts_step_s=ghosts)
    if truth is not None:
        draw.draw_truth(sheet.ax, truth)
    if replay is not None:
        draw.draw_replay(sheet.ax, replay, cast)
        draw.draw_hits(sheet.ax, hits_of(replay)[1])
    draw.draw_labels(sheet.ax, cast, sheet.view, step_s)
    return sheet


def base(
    scenario: Scenario,
    cast: Cast,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: draw.Background | None = None,
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
        draw.draw_background(sheet.ax, background)
    sheet.ax.set(xlim=(sheet.view.x0, sheet.view.x1), ylim=(sheet.view.y0, sheet.view.y1))
    draw.draw_standing(sheet.ax, cast.standing, sheet.view)
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
