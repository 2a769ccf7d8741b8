"""Describe the content of a log or a scenario, or draw one moment of a log."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli.options import Cameras, Format, Overwrite, Sequence, camera_names, say
from log2sim.errors import ConfigError


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Folder or file of a log, or a scenario.json.")],
    format: Format = "auto",
    sequence: Sequence = None,
    overlay: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE.png",
            help="Instead draw one tick: LiDAR points and labeled boxes on all images, and from above.",
        ),
    ] = None,
    at: Annotated[
        float | None, typer.Option(help="Time to draw, in s after the first tick. [default: in the middle]")
    ] = None,
    cameras: Cameras = None,
    overwrite: Overwrite = False,
) -> None:
    """Describe the content of a log, or of a scenario.json, as JSON, or draw one tick of a log."""
    import json

    from log2sim.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.logs.summary import summarize

    if overlay is None and (at is not None or cameras is not None):
        raise ConfigError("--at and --cameras choose what --overlay FILE.png draws; name the picture too")
    if log.suffix.lower() == ".json":
        if overlay is not None:
            raise ConfigError(f"{log}: is a scenario, which --overlay does not draw; log2sim plot does")
        say(json.dumps(_summary_of_scenario(log), indent=2))
        return
    names = camera_names(cameras)
    check_targets(overlay, overwrite=overwrite)
    opened = open_log(log, format=format, sequence=sequence)
    if overlay is None:
        say(json.dumps(summarize(opened), indent=2))
        return
    from log2sim.visualization.overlay.moment import read_moment
    from log2sim.visualization.overlay.picture import write_overlay

    write_overlay(read_moment(opened, names, at), overlay, overwrite=overwrite)
    say(f"{overlay}: written")


def _summary_of_scenario(path: Path) -> dict[str, Any]:
    from log2sim.datatypes import Scenario
    from log2sim.lanes.scenario_summary import summarize_scenario

    return summarize_scenario(Scenario.load(path))
