"""Describe the content of a log or a scenario, or draw one moment of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli.options import (
    AsJson,
    Cameras,
    Format,
    Overwrite,
    Quiet,
    Sequence,
    Verbose,
    camera_names,
    say,
    say_written,
)
from log2sim.errors import ConfigError


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Folder or file of a log, or a scenario.json.")],
    format: Format = "auto",
    sequence: Sequence = None,
    as_json: AsJson = False,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            help="Instead draw one tick: LiDAR points and labeled boxes on all images, and from above.",
        ),
    ] = None,
    at: Annotated[
        float | None,
        typer.Option(metavar="S", help="Time to draw, in s after the first tick.", show_default="in the middle"),
    ] = None,
    cameras: Cameras = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Describe the content of a log, or of a scenario.json, or draw one tick of a log.

    Examples
    --------
    log2sim inspect samples/crossing
    log2sim inspect s.json --json
    log2sim inspect samples/crossing --overlay tick.png --at 2
    """
    import json

    from log2sim.cli.inspect_tables import describe_log, describe_scenario
    from log2sim.cli.progress import progress
    from log2sim.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.logs.summary import summarize
    from log2sim.visualization.notebook.progress import OPENING

    if overlay is None and (at is not None or cameras is not None):
        raise ConfigError("--at and --cameras choose what --overlay FILE.png draws; name the picture too")
    if log.suffix.lower() == ".json":
        if overlay is not None:
            raise ConfigError(f"{log}: is a scenario, which --overlay does not draw; log2sim plot does")
        document = _summary_of_scenario(log)
        lines = [json.dumps(document, indent=2)] if as_json else describe_scenario(document, verbose=verbose)
        say("\n".join(lines), quiet=quiet)
        return
    names = camera_names(cameras)
    check_targets(overlay, overwrite=overwrite)
    with progress(quiet=quiet) as report_progress:
        report_progress(OPENING, 0, 0)
        opened = open_log(log, format=format, sequence=sequence)
    if overlay is None:
        document = summarize(opened)
        lines = [json.dumps(document, indent=2)] if as_json else describe_log(document, verbose=verbose)
        say("\n".join(lines), quiet=quiet)
        return
    from log2sim.visualization.overlay.moment import read_moment
    from log2sim.visualization.overlay.picture import write_overlay

    write_overlay(read_moment(opened, names, at), overlay, overwrite=overwrite)
    say_written(overlay, quiet=quiet)


def _summary_of_scenario(path: Path) -> dict[str, Any]:
    from log2sim.datatypes import Scenario
    from log2sim.lanes.scenario_summary import summarize_scenario

    return summarize_scenario(Scenario.load(path))
