"""The command line. Each command imports what it needs, so that `log2sim --help` answers at once."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer

from log2sim import __version__
from log2sim.errors import Log2SimError

if TYPE_CHECKING:
    from log2sim.scenario import Scenario
    from log2sim.types import Log

app = typer.Typer(
    name="log2sim",
    help="Reconstruct driving logs as scenarios that a simulator can run.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)

INTERRUPTED = 130

LogPath = Annotated[Path, typer.Argument(metavar="LOG", help="Folder of a log.")]
ScenarioPath = Annotated[Path, typer.Argument(metavar="SCENARIO", help="A scenario.json.")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="Replace files that exist.")]
Quiet = Annotated[bool, typer.Option("--quiet", help="Print nothing but errors.")]
Format = Annotated[str, typer.Option(help="Log format: auto, log2sim, kitti, kitti-tracking, pandaset.")]
Sequence = Annotated[str | None, typer.Option(help="Which sequence, when the folder holds several.")]
Settings = Annotated[list[str] | None, typer.Option("--set", metavar="SECTION.KEY=VALUE", help="Change a setting.")]
ConfigFile = Annotated[Path | None, typer.Option("--config", metavar="FILE.toml", help="Settings file.")]


def main() -> None:
    """Run the command line; every error of ours becomes one clear message and its exit code."""
    arguments = [a for a in sys.argv[1:] if a != "--debug"]
    debug = len(arguments) != len(sys.argv) - 1
    try:
        code = app(args=arguments, prog_name="log2sim", standalone_mode=False)
    except Log2SimError as error:
        if debug:
            raise
        fail(str(error), error.exit_code)
    except (KeyboardInterrupt, typer.Abort):
        code = INTERRUPTED
    except OSError as error:
        if debug:
            raise
        fail(f"{error.filename or 'a file'}: {error.strerror or error}; check the name and the permissions", 3)
    except Exception as error:
        format_message: Callable[[], str] | None = getattr(error, "format_message", None)  # click's own usage errors
        if format_message is None:
            if debug:
                raise
            fail(f"internal error: {type(error).__name__}: {error}; run again with --debug for the place", 1)
        if not arguments:
            sys.stderr.write(format_message() + "\n")
            sys.exit(2)
        fail(f"{format_message()} (see log2sim --help)", getattr(error, "exit_code", 2))
    if code == INTERRUPTED:  # typer returns it for Ctrl-C within a command
        fail("interrupted; nothing half-written was left", INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def fail(message: str, code: int) -> NoReturn:
    """Print an error and leave."""
    sys.stderr.write(f"log2sim: {message}\n")
    sys.exit(code)


def say(text: str, *, quiet: bool = False) -> None:
    """Print a line for the user."""
    if not quiet:
        sys.stdout.write(text + "\n")
        sys.stdout.flush()


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    """Reconstruct driving logs as scenarios that a simulator can run. Add --debug for tracebacks."""
    if version:
        say(__version__)
        raise typer.Exit


@app.command()
def reconstruct(
    log: LogPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Scenario file to write.")],
    format: Format = "auto",
    sequence: Sequence = None,
    detector: Annotated[
        str | None, typer.Option(metavar="NAME|MODEL.onnx|labels", help="What finds the objects.")
    ] = None,
    cameras: Annotated[str | None, typer.Option(metavar="A,B", help="Use only these cameras.")] = None,
    start: Annotated[float | None, typer.Option(help="First second.")] = None,
    stop: Annotated[float | None, typer.Option(help="Last second.")] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(help="Seed of everything random.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Write the report.")] = None,
    topdown: Annotated[Path | None, typer.Option(metavar="FILE.png", help="Write the fused top-down picture.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the scenario of a log."""
    from log2sim.config import Config
    from log2sim.errors import ConfigError
    from log2sim.files import check_targets, write_json
    from log2sim.logs import open_log
    from log2sim.pipeline import reconstruct as run
    from log2sim.progress import progress

    check_targets(out, report, topdown, overwrite=overwrite)
    if cameras is not None and not cameras.replace(",", "").strip():
        raise ConfigError("--cameras: is empty; name cameras separated by commas, or leave it out to use all")
    changes: dict[str, Any] = {"cameras": cameras, "start_s": start, "stop_s": stop, "seed": seed}
    if detector is not None:
        changes["detect"] = {"name": detector}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence)
    for note in opened.notes:
        say(f"note: {note}", quiet=quiet)
    with progress(quiet=quiet) as tell:
        result = run(opened, chosen, picture=topdown is not None, progress=tell)
    if topdown is not None:
        from log2sim.mosaic import mosaic_of
        from log2sim.topdown.picture import write_picture

        write_picture(mosaic_of(opened, result.scenario), topdown, overwrite=overwrite)
    if report is not None:
        write_json(report, result.report)
    result.scenario.save(out)
    for note in left_out(result.report):
        say(f"note: {note}", quiet=quiet)
    counts = result.report["agents"]
    say(
        f"{out}: {counts['total']} agents ({counts['static']} standing) over {result.scenario.duration_s:.1f} s, "
        f"{result.report['ticks_per_second']:.1f} ticks/s",
        quiet=quiet,
    )


def left_out(report: dict[str, Any]) -> list[str]:
    """What of a log a run could not use, a line each."""
    unread = report["unreadable"].items()
    lost = report["without_pose"].items()
    return [
        *(f"{name}: {u['count']} records could not be read, first: {u['first']}" for name, u in unread),
        *(f"{name}: {count} frames left out, since no ego pose is known at their stamps" for name, count in lost),
    ]


@app.command()
def replay(
    scenario: ScenarioPath,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Replay file to write.")] = None,
    mode: Annotated[str, typer.Option(help="pid or exact.")] = "pid",
    model: Annotated[str, typer.Option(help="Vehicle model: kinematic.")] = "kinematic",
    dt: Annotated[float, typer.Option(help="Step in s.")] = 0.01,
    ego: Annotated[str | None, typer.Option(metavar="MODULE:ATTRIBUTE", help="Policy that drives the ego.")] = None,
    strict: Annotated[bool, typer.Option("--strict", help="Exit 6 when a limit is broken.")] = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Let vehicles drive a scenario."""
    from log2sim.files import check_targets
    from log2sim.replay import load_policy, require_strict
    from log2sim.replay import replay as run
    from log2sim.scenario import Scenario

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    policy = load_policy(ego) if ego is not None else None
    result = run(loaded, mode=mode, model=model, dt_s=dt, ego=policy)
    if out is not None:
        result.save(out)
    m = result.metrics
    new = sum(not c["in_log"] for c in m["collisions"])
    say(
        f"cross-track {_figure(m['cross_track_rms_m'])} m rms, {_figure(m['cross_track_max_m'])} m max · "
        f"along-track {_figure(m['along_track_rms_m'])} m rms · speed {_figure(m['speed_rms_mps'])} m/s rms · "
        f"{len(m['collisions'])} collisions, {new} that the log does not have",
        quiet=quiet,
    )
    if strict:
        require_strict(result)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}"


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
    replayed = None
    if replay is not None:
        from log2sim.replay import Replay

        replayed = Replay.load(replay)
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


@app.command()
def synth(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.toml", help="Scene description.")],
    out: Annotated[Path, typer.Option("--out", metavar="LOG", help="Log folder to write.")],
    seed: Annotated[int, typer.Option(help="Seed of all noise.")] = 0,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Make a synthetic log with exact truth."""
    from log2sim.progress import progress
    from log2sim.synth import load_scene, write_synthetic

    loaded = load_scene(scene)
    with progress(quiet=quiet) as tell:
        write_synthetic(
            loaded, out, seed=seed, overwrite=overwrite, progress=lambda done, total: tell("synthesize", done, total)
        )
    say(f"{out}: written", quiet=quiet)


@app.command()
def inspect(log: LogPath, format: Format = "auto", sequence: Sequence = None) -> None:
    """Say what a log holds, as JSON."""
    import json

    from log2sim.logs import open_log
    from log2sim.logs.summary import summarize

    say(json.dumps(summarize(open_log(log, format=format, sequence=sequence)), indent=2))


@app.command()
def validate(
    path: Annotated[Path, typer.Argument(metavar="FILE_OR_LOG", help="A scenario, a replay, or a log folder.")],
    format: Format = "auto",
    sequence: Sequence = None,
) -> None:
    """Check a file or every record of a log; exits 3 with the problems."""
    from log2sim.errors import LogError

    if path.is_dir():
        from log2sim.logs.validate import validate_log

        problems = validate_log(path, format=format, sequence=sequence)
        if problems:
            raise LogError(f"{path}: {len(problems)} problem{'s' * (len(problems) > 1)}\n  " + "\n  ".join(problems))
    else:
        _validate_file(path)
    say(f"{path}: valid")


def _validate_file(path: Path) -> None:
    from log2sim.errors import ScenarioError
    from log2sim.files import read_json
    from log2sim.replay import Replay
    from log2sim.scenario import Scenario
    from log2sim.schema import check

    document = read_json(path, ScenarioError)
    keys = document if isinstance(document, dict) else {}
    if "replay_version" in keys:
        Replay.load(path)
    elif "metrics_version" in keys:
        check(document, "metrics-1", ScenarioError)
    elif "report_version" in keys:
        check(document, "report-1", ScenarioError)
    elif "bench_version" in keys:
        check(document, "bench-1", ScenarioError)
    else:
        Scenario.load(path)


@app.command()
def config(
    file: ConfigFile = None,
    settings: Settings = None,
) -> None:
    """Print all settings as TOML: the defaults, or what a file and --set make of them."""
    from log2sim.config import Config

    say(Config.load(file, settings or ()).to_toml().rstrip())


if __name__ == "__main__":
    main()
