"""Draw a scenario from above."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.options import Overwrite, ScenarioPath, Sequence
from log2sim.cli.truth import load_replay, load_truth


def plot(
    scenario: ScenarioPath,
    out: Annotated[
        Path, typer.Option("--out", metavar="FILE", help="Image (.png .svg .pdf) or animation (.gif .mp4) to write.")
    ],
    replay: Annotated[Path | None, typer.Option(metavar="REPLAY", help="Replay to draw over the scenario.")] = None,
    truth: Annotated[
        Path | None, typer.Option(metavar="TRUTH", help="Ground truth: a scenario file or a log with labels.")
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG|MAP.png", help="Log whose map of the ground is the background, or a map of log2sim map."
        ),
    ] = None,
    predict: Annotated[
        float | None, typer.Option(metavar="S", help="Draw where movers were expected to go for this long, in s.")
    ] = None,
    sequence: Sequence = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw a scenario from above."""
    from log2sim.datatypes import Scenario
    from log2sim.documents import check_targets
    from log2sim.visualization.plot.tracks import plot_tracks

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    replayed = load_replay(replay, loaded) if replay is not None else None
    picture = None
    if background is not None:
        from log2sim.cli.background import load_background

        picture = load_background(background, loaded, sequence)
    known = load_truth(truth, loaded, sequence) if truth is not None else None
    plot_tracks(loaded, out, replay=replayed, truth=known, background=picture, predict_s=predict, overwrite=overwrite)
