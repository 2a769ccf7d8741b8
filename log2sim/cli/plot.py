"""Draw a scenario from above."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt


def plot(
    scenario: opt.ScenarioPath,
    out: Annotated[Path, opt.write_to("FILE", "Picture (.png .svg .pdf) or film (.mp4 .webm .gif) to write.")],
    replay: Annotated[Path | None, opt.option("Replay to draw over the scenario.", "REPLAY")] = None,
    truth: opt.Truth = None,
    background: Annotated[Path | None, opt.option(
        "Log whose map of the ground is the background, or a map of log2sim map.", "LOG|MAP.png")] = None,
    predict: Annotated[float | None, opt.option(
        "Draw where movers were expected to go for this long, in s.", "S")] = None,
    start: Annotated[float | None, opt.option(
        "First time of the scenario to show, in s.", "S", default="the start")] = None,
    stop: Annotated[float | None, opt.option(
        "Last time of the scenario to show, in s.", "S", default="the end")] = None,
    extent: Annotated[str | None, opt.option(
        "Two corners of the part of the map to show, in m.", "X0,Y0,X1,Y1", default="what moves")] = None,
    agents: Annotated[str | None, opt.option("Show these agents alone.", "ID,ID", default="all")] = None,
    label_static: Annotated[bool, opt.option("Write the ids of static agents too.", None, "--label-static")] = False,
    size: Annotated[str | None, opt.option(
        "Size in pixels, such as 1280x720; not of .svg and .pdf.", "WxH", default="what fits")] = None,
    fps: Annotated[float | None, opt.option("Frames of a film a second.", "N", default="25, of a .gif 10")] = None,
    speed: Annotated[float | None, opt.option(
        "Times faster than real time that a film plays.", "X",
        default="1, or what fits into a minute, half a minute for a .gif")] = None,
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Draw a scenario from above: a picture or a film.

    An .mp4 is H.264 (extra video); without that it becomes a .webm.

    Examples
    --------
    log2sim plot scenario.json -o tracks.png
    log2sim plot scenario.json -o film.mp4 --size 1280x720 --start 2 --stop 8
    """
    from log2sim.cli.layers import load_background, load_placed_truth, load_replay
    from log2sim.cli.progress import progress
    from log2sim.datatypes import Scenario
    from log2sim.files.documents import check_targets
    from log2sim.visualization.plot.selection import PlotOptions, parse_extent, parse_ids, parse_size
    from log2sim.visualization.plot.tracks import plot_tracks, resolve_picture

    options = PlotOptions(
        parse_size(size), fps, speed, start, stop, parse_extent(extent), parse_ids(agents), label_static
    )
    picture = resolve_picture(out)
    options.require_fits(picture.path.suffix.lower(), picture.path.name)
    check_targets(picture.path, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    replayed = load_replay(replay, loaded, quiet=quiet) if replay is not None else None
    known = None if truth is None else load_placed_truth(truth, loaded, sequence)
    if picture.note is not None:
        opt.say(f"note: {picture.note}", quiet=quiet)
    with progress(quiet=quiet) as report_progress:
        ground = None if background is None else load_background(background, loaded, sequence, report_progress)
        plot_tracks(
            loaded, out, replay=replayed, truth=known, background=ground, predict_s=predict, options=options,
            overwrite=overwrite, progress=report_progress,
        )  # fmt: skip
    opt.report_written(picture.path, quiet=quiet)
