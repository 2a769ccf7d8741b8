"""Top-down pictures of a scenario: stills and animations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

from log2sim.datatypes import Scenario
from log2sim.errors import ConfigError
from log2sim.files.documents import refuse_existing, replaced
from log2sim.road.ground_map import GroundMap
from log2sim.simulation.expected_motion import ends_of
from log2sim.visualization.plot import layers, selection
from log2sim.visualization.plot.encoding import FilmFile, choose_film_file
from log2sim.visualization.plot.layout import FigureLayout, draw_labels
from log2sim.visualization.plot.scene import draw_base, draw_moving
from log2sim.visualization.plot.viewport import AgentRoles, assign_view_roles


def plot_tracks(
    scenario: Scenario,
    out_path: Path | str,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: GroundMap | None = None,
    predict_s: float | None = None,
    title: str | None = None,
    options: selection.PlotOptions = selection.NO_OPTIONS,
    overwrite: bool = False,
    dpi: int = 200,
    progress: Any = lambda stage, done, total: None,
) -> Path:
    """Draw a scenario from above into a file: a still for .png, .svg and .pdf, an animation for .gif, .mp4 and .webm.

    `replay`: drawn over the scenario; charts below the map show commands and errors of the ego, else of the agent
    farthest from its path. `truth`: brought to the scenario's start and map. `background`: a picture of the ground in
    the map frame, drawn below everything. `predict_s`: for how long predictions of the leading movers are drawn.
    `options`: size, range of time, part of the map, agents, and the frames of a film. `dpi`: dots per inch of a .png
    without a size, which is 10 inches wide then. `progress`: `progress(stage, done, total)` is called for every frame
    of an animation. Returns the file that was written: a .webm where an .mp4 was asked for and H.264 is not installed.
    Raises `ConfigError` when the name has another suffix, an option does not fit, `predict_s` is no horizon of
    predictions, the file exists and `overwrite` is False, or it cannot be written. Raises `ScenarioError` when the
    truth's map has another projection.
    """
    film = resolve_picture(Path(out_path))
    suffix = film.path.suffix.lower()
    options.require_fits(suffix, film.path.name)
    refuse_existing(film.path, overwrite=overwrite)
    whole = scenario
    scenario, replay = selection.select_shown(scenario, replay, options)
    span = selection.choose_span(scenario, options)
    shown_truth = None if truth is None else selection.cut_scenario(truth.aligned_to(scenario), span)
    predicted = None if predict_s is None else layers.PredictedPaths(scenario, predict_s)
    shown_replay = selection.cut_replay(replay, span, scenario)
    overlays = layers.Overlays(shown_replay, shown_truth, background, predicted, title, span, options)
    scenario = selection.cut_scenario(scenario, span)
    roles = assign_view_roles(scenario, whole)
    if suffix in selection.MOVING:
        from log2sim.visualization.plot.animation import write_animation

        write_animation(scenario, roles, film, overlays, progress)
    else:
        layout = still(scenario, roles, overlays)
        # The same scenario gives the same bytes: no random element names, no dates.
        left_out: Any = {{".svg": "Date", ".pdf": "CreationDate", ".png": "Software"}[suffix]: None}
        dots = layout.figure.dpi if options.size_px else dpi
        with replaced(film.path) as temporary, matplotlib.rc_context({"svg.hashsalt": "log2sim"}):
            layout.figure.savefig(temporary, format=suffix.removeprefix("."), dpi=dots, metadata=left_out)
    return film.path


def still(scenario: Scenario, roles: AgentRoles, overlays: layers.Overlays = layers.NO_OVERLAYS) -> FigureLayout:
    """Draw a still picture."""
    layout, step_s, _, labels = draw_base(scenario, roles, overlays)
    ax, replay = layout.ax, overlays.replay
    draw_moving(ax, roles, layout.view, step_s, truth=overlays.truth, replay=replay, ghosts=True)
    if len(ends_of(scenario)) > 1:
        layers.draw_observers(ax, roles, layout.view)
    layers.draw_warnings(ax, replay)
    if overlays.predicted is not None:
        layers.draw_predictions(ax, roles, overlays.predicted)
    draw_labels(ax, labels)
    if overlays.options.size_px is not None:
        layout.set_width_px(overlays.options.size_px[0])
    return layout


def resolve_picture(requested: Path) -> FilmFile:
    """Tell which file is written for a name, and for an animation how.

    Raises `ConfigError` when no picture ends in its suffix.
    """
    suffix = requested.suffix.lower()
    if suffix not in selection.STILL + selection.MOVING:
        raise ConfigError(
            f"{requested}: a picture's name must end in {', '.join(selection.STILL)} (still) or {', '.join(selection.MOVING)} (moving), "
            f"not in '{requested.suffix}'"
        )
    return choose_film_file(requested) if suffix in (".mp4", ".webm") else FilmFile(requested)
