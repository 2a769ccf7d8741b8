"""Write an interactive HTML page of a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli.options import Overwrite, Quiet, ScenarioPath, Sequence, counted, say


def view(
    scenario: ScenarioPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE.html", help="Page to write.")],
    truth: Annotated[
        Path | None, typer.Option(metavar="TRUTH", help="Ground truth: a scenario file or a log with labels.")
    ] = None,
    replay: Annotated[Path | None, typer.Option(metavar="REPLAY", help="Replay to show as a layer.")] = None,
    predict: Annotated[
        float | None, typer.Option(metavar="S", help="Show where agents were expected to go for this long, in s.")
    ] = None,
    background: Annotated[
        Path | None,
        typer.Option(
            metavar="LOG|MAP.png", help="Log whose map of the ground is shown below, or a map of log2sim map."
        ),
    ] = None,
    sequence: Sequence = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Write an interactive HTML page of a scenario."""
    from log2sim.cli.truth import load_replay, load_truth
    from log2sim.datatypes import Scenario
    from log2sim.documents import check_targets
    from log2sim.visualization.page.writer import write_page

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    replayed = load_replay(replay, loaded, quiet=quiet) if replay is not None else None
    known = load_truth(truth, loaded, sequence) if truth is not None else None
    picture = None
    if background is not None:
        from log2sim.cli.background import load_background
        from log2sim.cli.progress import progress

        with progress(quiet=quiet) as report_progress:
            picture = load_background(background, loaded, sequence, report_progress)
    layers: dict[str, Any] = {"truth": known, "replay": replayed, "background": picture}
    write_page(loaded, out, **layers, predict_s=predict, overwrite=overwrite)
    say(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {counted(len(loaded.agents), 'agent')}", quiet=quiet)
