"""Commands that compare with the truth: pictures, errors, and errors against run time."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli.app import ConfigFile, Format, LogPath, Overwrite, Quiet, ScenarioPath, Sequence, Settings, app, say

if TYPE_CHECKING:
    from log2sim.replay import Replay
    from log2sim.scenario import Scenario
    from log2sim.types import Log


@app.command()
def plot(
    scenario: ScenarioPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help=".png .svg .pdf, or .gif .mp4.")],
    replay: Annotated[Path | None, typer.Option(metavar="REPLAY", help="Replay to lay over.")] = None,
    truth: Annotated[Path | None, typer.Option(metavar="TRUTH", help="Scenario file, or a log with labels.")] = None,
    background: Annotated[Path | None, typer.Option(metavar="LOG", help="Log whose cameras paint the ground.")] = None,
    sequence: Sequence = None,
    overwrite: Overwrite = False,
) -> None:
    """Draw a scenario from above."""
    from log2sim.files import check_targets
    from log2sim.plot import plot_tracks
    from log2sim.scenario import Scenario

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    replayed = load_replay(replay, loaded) if replay is not None else None
    picture = None
    if background is not None:
        from log2sim.logs import open_log
        from log2sim.mosaic import mosaic_of

        picture = mosaic_of(open_log(background, sequence=sequence), loaded)
    known = load_truth(truth, loaded, sequence) if truth is not None else None
    plot_tracks(loaded, out, replay=replayed, truth=known, background=picture, overwrite=overwrite)


@app.command()
def evaluate(
    scenario: ScenarioPath,
    truth: Annotated[Path, typer.Option(metavar="TRUTH", help="Scenario file, or a log with labels.")],
    sequence: Sequence = None,
    range: Annotated[float | None, typer.Option(metavar="M", help="Only within so many meters of the ego.")] = None,
    categories: Annotated[str | None, typer.Option(metavar="A,B", help="Categories or groups, e.g. vehicle.")] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Metrics file to write.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scenario with the truth."""
    from log2sim.files import check_targets, write_json
    from log2sim.metrics.evaluate import evaluate as run
    from log2sim.metrics.table import format_table
    from log2sim.scenario import Scenario

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    wanted = [c.strip() for c in categories.split(",")] if categories else None
    result = run(loaded, load_truth(truth, loaded, sequence), max_range_m=range, categories=wanted)
    if out is not None:
        write_json(out, result)
    say(format_table(result), quiet=quiet)


@app.command()
def bench(
    log: LogPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for bench.json and bench.png.")],
    truth: Annotated[
        Path | None,
        typer.Option(metavar="TRUTH", help="Scenario file, or a log with labels; LOG itself if it has any."),
    ] = None,
    detector: Annotated[
        list[str] | None, typer.Option(metavar="NAME|MODEL.onnx|labels", help="May be given several times to compare.")
    ] = None,
    format: Format = "auto",
    sequence: Sequence = None,
    cameras: Annotated[str | None, typer.Option(metavar="A,B", help="Use only these cameras.")] = None,
    range: Annotated[
        float | None, typer.Option(metavar="M", help="Compare only within so many meters of the ego.")
    ] = None,
    categories: Annotated[str | None, typer.Option(metavar="A,B", help="Compare only these, e.g. vehicle.")] = None,
    start: Annotated[float | None, typer.Option(help="First second.")] = None,
    stop: Annotated[float | None, typer.Option(help="Last second.")] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Draw error against run time over methods and settings."""
    from log2sim.bench import Scope
    from log2sim.bench import bench as run
    from log2sim.bench.document import document, format_table
    from log2sim.bench.picture import write_picture
    from log2sim.config import Config
    from log2sim.files import check_targets, write_json
    from log2sim.logs import open_log
    from log2sim.progress import progress

    check_targets(out / "bench.json", out / "bench.png", overwrite=overwrite)
    changes: dict[str, Any] = {"cameras": cameras, "start_s": start, "stop_s": stop}
    if detector:
        changes["detect"] = {"name": detector[0]}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence)
    labeled = opened.labels is not None or (log / "truth.json").is_file()
    used = chosen.cameras or tuple(opened.cameras)
    known = truth_at(truth or log, used, sequence) if truth is not None or labeled else None
    scope = Scope(range, tuple(c.strip() for c in categories.split(",")) if categories else None)
    with progress(quiet=quiet) as tell:
        result = run(opened, chosen, truth=known, scope=scope, detectors=tuple(detector or ()), progress=tell)
    write_json(out / "bench.json", document(result))
    write_picture(result, out / "bench.png")
    say(format_table(result), quiet=quiet)


def load_replay(path: Path, scenario: Scenario, *, quiet: bool = False) -> Replay:
    """A replay to show with a scenario; says so when it is one of another."""
    from log2sim.replay import Replay as Replayed

    loaded = Replayed.load(path)
    known = {a.id for a in scenario.agents}
    strangers = [a.id for a in loaded.agents if a.id not in known]
    if loaded.scenario != scenario.name:
        say(f"warning: {path} replays '{loaded.scenario}', not '{scenario.name}'; nothing need fit", quiet=quiet)
    elif strangers:
        count = f"{len(strangers)} of its {len(loaded.agents)} agents"
        say(f"warning: {path} replays another version of '{scenario.name}': {count} are not in it", quiet=quiet)
    return loaded


def load_truth(path: Path, scenario: Scenario, sequence: str | None) -> Scenario:
    """Truth for a scenario, of what the cameras saw that were used for it; see `truth_at`."""
    return truth_at(path, [str(c["name"]) for c in scenario.cameras if c.get("used")], sequence)


def truth_at(path: Path, used: Iterable[str], sequence: str | None) -> Scenario:
    """Truth from a scenario file, or from a log: its own `truth.json`, else its labels seen by the cameras that were used."""
    from log2sim.scenario import Scenario as Truth

    if not path.is_dir():
        return Truth.load(path)
    if (path / "truth.json").is_file():
        return Truth.load(path / "truth.json")
    from log2sim.logs import open_log
    from log2sim.metrics.truth import truth_from_log

    log: Log = open_log(path, sequence=sequence)
    return truth_from_log(log, cameras=[name for name in used if name in log.cameras] or None)
