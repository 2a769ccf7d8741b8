"""Top-down pictures of a scenario: stills and animations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

from log2sim.datatypes import Scenario
from log2sim.documents import refuse_existing, replaced
from log2sim.errors import ConfigError
from log2sim.visualization.plot import doubts, drawing
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.layout import (
    FigureLayout,
)
from log2sim.visualization.plot.observers import draw_observers, tells_ends
from log2sim.visualization.plot.predicted import PredictedPaths, draw_predictions
from log2sim.visualization.plot.roles import AgentRoles, assign_roles
from log2sim.visualization.plot.scene import draw_base
from log2sim.visualization.plot.warned import draw_warnings, warned_places

STILL, ANIMATED = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def plot_tracks(
    scenario: Scenario,
    out_path: Path | str,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    predict_s: float | None = None,
    title: str | None = None,
    overwrite: bool = False,
    dpi: int = 200,
) -> None:
    """Draw a scenario from above into a file: a still for .png, .svg and .pdf, an animation for .gif and .mp4.

    Parameters
    ----------
    replay : log2sim.simulation.result.Replay or None
        Drawn over the scenario; charts below the map show commands and errors of the ego, else of the agent farthest from
        its path.
    truth : Scenario or None
        Brought to the scenario's start and map.
    background : BirdsEyeView or None
        A picture of the ground in the map frame, drawn below everything.
    predict_s : float, s, or None
        For how long predictions of the leading movers are drawn.
    dpi : int
        Dots per inch of a .png, which is 10 inches wide.

    Raises
    ------
    ConfigError
        When the name has another suffix, `predict_s` is no horizon of predictions, the file exists and `overwrite` is False, or it cannot be written.
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
    roles = assign_roles(scenario)
    overlays: dict[str, Any] = {
        "replay": replay,
        "truth": None if truth is None else truth.aligned_to(scenario),
        "background": background,
        "predicted": None if predict_s is None else PredictedPaths(scenario, predict_s),
        "title": title,
    }
    if suffix in ANIMATED:
        from log2sim.visualization.plot.animation import write_animation

        write_animation(scenario, roles, out_path, **overlays)
        return
    layout = still(scenario, roles, **overlays)
    # The same scenario gives the same bytes: no random element names, no dates.
    metadata: dict[str, dict[str, Any]] = {
        ".svg": {"Date": None},
        ".pdf": {"CreationDate": None},
        ".png": {"Software": None},
    }
    with replaced(out_path) as temporary, matplotlib.rc_context({"svg.hashsalt": "log2sim"}):
        layout.figure.savefig(temporary, format=suffix[1:], dpi=dpi, metadata=metadata[suffix])


def still(
    scenario: Scenario,
    roles: AgentRoles,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    predicted: PredictedPaths | None = None,
    title: str | None = None,
) -> FigureLayout:
    """Draw a still picture."""
    layout, step_s, _ = draw_base(
        scenario, roles, replay=replay, truth=truth, background=background, title=title, predicted=predicted
    )
    overlaid = truth is not None or replay is not None
    drawing.draw_tracks(layout.ax, roles, layout.view, step_s, alpha=0.45 if overlaid else 1.0)
    ghosts = None if overlaid or drawing.view_is_crowded(roles) else step_s
    drawing.draw_ends(layout.ax, roles, layout.view, ghosts_step_s=ghosts)
    doubts.hatch_movers(layout.ax, roles, layout.view, drawing.TRACK + 0.5, drawing.BOX + 0.6)
    if truth is not None:
        drawing.draw_truth(layout.ax, truth)
    if replay is not None:
        drawing.draw_replay(layout.ax, replay, roles)
        drawing.draw_collisions(layout.ax, new_collisions(replay)[1])
    if tells_ends(scenario):
        draw_observers(layout.ax, roles, layout.view)
    draw_warnings(layout.ax, warned_places(replay))
    if predicted is not None:
        draw_predictions(layout.ax, roles, predicted)
    drawing.draw_labels(layout.ax, roles, layout.view, step_s)
    return layout
