"""Pictures, films and pages of scenarios."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError, LogError

if TYPE_CHECKING:
    from collections.abc import Callable

    from log2sim.datatypes import Log, Scenario
    from log2sim.road.ground_map import GroundMap
    from log2sim.simulation.result import Replay
    from log2sim.visualization.recording import Recorded


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
) -> None:  # fmt: skip
    """Draw a scenario from above: a picture or a film.

    An .mp4 is H.264 (extra video); without that it becomes a .webm.

    Examples
    --------
    log2sim plot scenario.json -o tracks.png
    log2sim plot scenario.json -o film.mp4 --size 1280x720 --start 2 --stop 8
    """
    from log2sim.datatypes import Scenario
    from log2sim.files.documents import check_targets
    from log2sim.visualization.plot.selection import PlotOptions, parse_extent, parse_ids, parse_size
    from log2sim.visualization.plot.tracks import plot_tracks, resolve_picture

    shown = parse_extent(extent), parse_ids(agents), label_static
    options = PlotOptions(parse_size(size), fps, speed, start, stop, *shown)
    picture = resolve_picture(out)
    options.require_fits(picture.path.suffix.lower(), picture.path.name)
    check_targets(picture.path, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    replayed = load_replay(replay, loaded) if replay is not None else None
    known = None if truth is None else load_placed_truth(truth, loaded, sequence)
    if picture.note is not None:
        opt.tell(f"note: {picture.note}")
    with progress() as report_progress:
        ground = None if background is None else load_background(background, loaded, sequence, report_progress)
        plot_tracks(
            loaded, out, replay=replayed, truth=known, background=ground, predict_s=predict, options=options,
            overwrite=overwrite, progress=report_progress,
        )  # fmt: skip
    opt.report_written(picture.path)


def view(
    scenario: opt.ScenarioPath,
    out: Annotated[Path, opt.write_to("FILE.html", "Page to write.")],
    log: opt.PageLog = None,
    max_mb: Annotated[float | None, opt.option(
        "Size of a page with --log, in millions of bytes; pictures and points are chosen to fit.", "MB",
        default="40")] = None,
    cameras: opt.Cameras = None,
    truth: opt.Truth = None,
    replay: Annotated[Path | None, opt.option("Replay to show as a layer.", "REPLAY")] = None,
    metrics: Annotated[Path | None, opt.option(
        "Metrics file of log2sim evaluate, to show beside the map.", "METRICS")] = None,
    predict: Annotated[float | None, opt.option(
        "Show where agents were expected to go for this long, in s.", "S")] = None,
    background: Annotated[Path | None, opt.option(
        "Log whose map of the ground is shown below, or a map of log2sim map.", "LOG|MAP.png",
        default="that of --log")] = None,
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
) -> None:  # fmt: skip
    """Write an interactive HTML page of a scenario.

    Examples
    --------
    log2sim view s.json --log samples/crossing -o s.html
    log2sim view s.json --replay replay.json --truth samples/crossing -o s.html
    """
    from log2sim.datatypes import Scenario, count_agents
    from log2sim.files.documents import check_targets
    from log2sim.visualization.page.writer import check_name, write_page

    check_targets(out, overwrite=overwrite)
    check_name(out)
    for name, value in (("--max-mb", max_mb), ("--cameras", cameras)):
        if log is None and value is not None:
            raise ConfigError(f"{name}: is for the pictures of a log; add --log")
    if max_mb is not None and not 0 < max_mb <= 1000:
        raise ConfigError(f"--max-mb {max_mb:g}: expected a number above 0 and up to 1000")
    loaded = Scenario.load(scenario)
    layers: dict[str, Any] = {
        "replay": load_replay(replay, loaded) if replay is not None else None,
        "truth": load_placed_truth(truth, loaded, sequence) if truth is not None else None,
        "metrics": [],
    }
    if metrics is not None:
        from log2sim.evaluation.metrics.table import format_table, format_verdict
        from log2sim.files.documents import read_json

        measured = read_json(metrics, LogError)
        try:
            table = f"{format_verdict(measured)}\n\n{format_table(measured)}"
            layers["metrics"] = [(f"Metrics against {measured['truth']}", table)]
        except (KeyError, TypeError, AttributeError, ValueError):
            raise LogError(
                f"{metrics}: expected metrics of a scenario, as `log2sim evaluate SCENARIO --truth TRUTH --out FILE` writes them"
            ) from None
    with progress() as report_progress:
        if log is not None:
            report_progress("open", 0, 0)
            from log2sim.visualization.recording import DEFAULT_MAX_BYTES

            max_bytes = DEFAULT_MAX_BYTES if max_mb is None else round(max_mb * 1e6)
            wanted = opt.camera_names(cameras)
            layers["recorded"] = open_recorded(log, loaded, sequence, max_bytes, wanted, report_progress)
        if background is not None:
            layers["background"] = load_background(background, loaded, sequence, report_progress)
        elif log is not None and shows_ground(opened := layers["recorded"].log):
            layers["background"] = map_of(opened, loaded, report_progress)
        notes = write_page(loaded, out, **layers, predict_s=predict, overwrite=overwrite)
    for note in notes:
        opt.tell(note)
    opt.tell(f"{out}: {out.stat().st_size / 1e6:.1f} MB, {count_agents(a.id for a in loaded.agents)}")


CELL_M = 0.06  # edge of a cell, m: pictures on paper and screens show no more of a hundred meters


def load_background(
    path: Path, scenario: Scenario, sequence: str | None, progress: Callable[[str, int, int], None]
) -> GroundMap:
    """Return the map of the ground in a PNG that `log2sim map` wrote, or that of a log, without the agents of the scenario.

    Raises `LogError` when the file is no such map, or the log has neither camera nor LiDAR.
    """
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.road.map_files import read_png_map

    if path.suffix.lower() == ".png":
        return read_png_map(path, scenario.map)
    log = localize_like(open_log(path, sequence=sequence), scenario.provenance)
    if not log.cameras and not log.lidars:
        raise LogError(f"{log.name}: the log has neither a camera nor a LiDAR, so there is no picture of the ground")
    return map_of(log, scenario, progress)


def map_of(log: Log, scenario: Scenario, progress: Callable[[str, int, int], None]) -> GroundMap:
    """Return the map of the ground of an opened log, as fine as screens and paper show it; in LiDAR intensities without a camera."""
    from log2sim.config import MapConfig
    from log2sim.road.builder import map_ground

    return map_ground(log, scenario, MapConfig(cell_m=CELL_M), progress=progress).as_picture()


def open_recorded(path: Path, scenario: Scenario, sequence: str | None, *options: Any) -> Recorded:
    """Open the log whose pictures and points are shown, with the poses that the scenario was made with; `options` of `Recorded`."""
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.visualization.recording import Recorded, require_overlap

    log = localize_like(open_log(path, sequence=sequence), scenario.provenance)
    require_overlap(log, scenario)
    return Recorded(log, *options)


def shows_ground(log: Log) -> bool:
    """Whether a log has a camera whose place is known, so that its ground can be mapped."""
    return any(camera.mount == "map" or log.ego is not None for camera in log.cameras.values())


def load_placed_truth(path: Path, scenario: Scenario, sequence: str | None) -> Scenario:
    """Return the truth of a scenario, in its map."""
    from log2sim.evaluation.metrics.evaluator import place_truth
    from log2sim.evaluation.metrics.truth import load_truth

    return place_truth(load_truth(path, scenario, sequence=sequence), scenario)[0]


def load_replay(path: Path, scenario: Scenario) -> Replay:
    """Load a replay to show with a scenario; warn when it belongs to another scenario."""
    from log2sim.datatypes import EGO
    from log2sim.simulation.result import Replay as Replayed

    loaded = Replayed.load(path)
    known = {a.id for a in scenario.agents}
    others = [a.id for a in loaded.agents if a.id != EGO]
    unknown = [id for id in others if id not in known]
    if loaded.scenario != scenario.name:
        opt.tell(f"warning: {path} replays '{loaded.scenario}', not '{scenario.name}'; the two may not match")
    elif unknown:
        count = f"{len(unknown)} of its {opt.counted(len(others), 'agent')} {'is' if len(unknown) == 1 else 'are'}"
        opt.tell(f"warning: {path} replays another version of '{scenario.name}': {count} not in it")
    return loaded
