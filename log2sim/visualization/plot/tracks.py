"""The picture of a scenario from above: who drove where, still or moving."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib

from log2sim.datatypes import Scenario
from log2sim.documents import refuse_existing, replaced
from log2sim.errors import ConfigError
from log2sim.visualization.plot import drawing
from log2sim.visualization.plot.collisions import hits_of
from log2sim.visualization.plot.layout import (
    Sheet,
)
from log2sim.visualization.plot.roles import Cast, assign
from log2sim.visualization.plot.scene import base

STILL, ANIMATED = (".png", ".svg", ".pdf"), (".gif", ".mp4")


def plot_tracks(
    scenario: Scenario,
    out_path: Path | str,
    *,
    replay: Any = None,
    truth: Scenario | None = None,
    background: drawing.Background | None = None,
    title: str | None = None,
    overwrite: bool = False,
    dpi: int = 200,
) -> None:
    """Draw a scenario from above into a file: a still for .png, .svg and .pdf, moving for .gif and .mp4.

    Parameters
    ----------
    replay : log2sim.simulation.result.Replay or None
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
    truth = None if truth is None else truth.aligned_to(scenario)
    if suffix in ANIMATED:
        from log2sim.visualization.plot.animation import write_animation

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
    background: drawing.Background | None = None,
    title: str | None = None,
) -> Sheet:
    """The sheet of a still picture."""
    sheet, step_s, _ = base(scenario, cast, replay=replay, truth=truth, background=background, title=title)
    overlaid = truth is not None or replay is not None
    drawing.draw_tracks(sheet.ax, cast, sheet.view, step_s, alpha=0.45 if overlaid else 1.0)
    ghosts = None if overlaid or drawing.view_is_crowded(cast) else step_s
    drawing.draw_ends(sheet.ax, cast, sheet.view, ghosts_step_s=ghosts)
    if truth is not None:
        drawing.draw_truth(sheet.ax, truth)
    if replay is not None:
        drawing.draw_replay(sheet.ax, replay, cast)
        drawing.draw_hits(sheet.ax, hits_of(replay)[1])
    drawing.draw_labels(sheet.ax, cast, sheet.view, step_s)
    return sheet
