"""Correct a scenario on a page."""

from __future__ import annotations

import webbrowser
from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli import options as opt


def studio(
    scenario: opt.ScenarioPath,
    log: opt.PageLog = None,
    corrections: Annotated[Path | None, opt.option(
        "File of corrections to write, and to go on with where it is there.", "FILE.json",
        default="beside the scenario")] = None,
    cameras: opt.Cameras = None,
    max_mb: Annotated[float, opt.option("Size of the page, in millions of bytes.", "MB", default="40")] = 40.0,
    port: Annotated[int, typer.Option(
        metavar="N", min=0, max=65535, help="Port of this computer.", show_default="a free one")] = 0,
    browser: Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser.")] = True,
    sequence: opt.SequenceName = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Correct a scenario on a page: the doubtful agents first, merging, moving, turning, sizes, categories; with undo.

    The page is served to this computer alone, until Ctrl-C. Every correction is kept in a file at once, which `log2sim correct` and
    `reconstruct --corrections` apply.

    Examples
    --------
    log2sim studio s.json --log samples/crossing
    log2sim studio s.json --corrections mine.json --no-browser
    """
    from log2sim.cli.layers import map_of, open_recorded, shows_ground
    from log2sim.cli.progress import progress
    from log2sim.datatypes import Scenario
    from log2sim.errors import ConfigError
    from log2sim.files.outputs import claim
    from log2sim.visualization.studio import Studio

    path = corrections or scenario.with_name(f"{scenario.stem}.corrections.json")
    claim(path, overwrite=False)  # two studios on one file would overwrite each other's corrections
    loaded = Scenario.load(scenario)
    layers: dict[str, Any] = {}
    with progress(quiet=quiet) as report_progress:
        if log is not None:
            recorded = open_recorded(
                log, loaded, sequence, round(max_mb * 1e6), opt.camera_names(cameras), report_progress
            )
            layers["recorded"] = recorded
            if shows_ground(recorded.log):
                layers["background"] = map_of(recorded.log, loaded, report_progress)
        try:
            served = Studio(loaded, path, port=port, **layers)
        except OSError as error:
            raise ConfigError(f"--port {port}: {error.strerror}; choose another") from None
        served.page()  # its pictures take long to gather: not while a browser waits
    opt.say_all("warning", served.result.unmatched, quiet=quiet)
    try:
        opt.say(f"{served.address}  (Ctrl-C ends it; corrections go to {path})")
        if browser:
            webbrowser.open(served.address)
        served.serve()
    except KeyboardInterrupt:
        count = len(served.document["corrections"])
        words = f"{path}: {count} correction{'s' * (count != 1)}"
        opt.say(f"{words}; log2sim correct {scenario} {path} --out corrected.json applies them" if count else words)
