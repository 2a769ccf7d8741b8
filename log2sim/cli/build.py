"""Commands that make something: a scenario of a log, a replay of a scenario, a log of a scene."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli.app import ConfigFile, Format, LogPath, Overwrite, Quiet, ScenarioPath, Sequence, Settings, app, say


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
    model: Annotated[str, typer.Option(help="Vehicle model: auto, kinematic, dynamic or single-track.")] = "auto",
    dt: Annotated[float, typer.Option(help="Step in s, from 0.0005 to 1.")] = 0.01,
    ego: Annotated[
        str | None, typer.Option(metavar="MODULE|FILE.py:ATTRIBUTE", help="Policy that drives the ego.")
    ] = None,
    agents: Annotated[str, typer.Option(help="What the others do: log, or reactive (brake for what is new).")] = "log",
    react: Annotated[str | None, typer.Option(metavar="ID,ID", help="Only these react.")] = None,
    simulator: Annotated[str, typer.Option(help="own, or carla: a CARLA server moves the agents.")] = "own",
    host: Annotated[str | None, typer.Option(help="With carla: where its server runs, else 127.0.0.1.")] = None,
    port: Annotated[int | None, typer.Option(help="With carla: its port, else 2000.", min=1, max=65535)] = None,
    map: Annotated[str | None, typer.Option(metavar="TOWN|FILE.xodr", help="With carla: world to load first.")] = None,
    strict: Annotated[
        bool,
        typer.Option("--strict", help="Exit 6 when a limit is broken: of --limit, new collisions, far off the path."),
    ] = False,
    limit: Annotated[
        list[str] | None,
        typer.Option(metavar="METRIC=VALUE", help="Tell who breaks it, e.g. min_ttc_s=1; see --strict."),
    ] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Let vehicles drive a scenario."""
    from log2sim.cli.change import ids_of
    from log2sim.errors import ConfigError
    from log2sim.files import check_targets
    from log2sim.progress import progress
    from log2sim.replay import check_limits, host_named, load_policy, parse_limits, require_strict
    from log2sim.replay import replay as run
    from log2sim.replay.assess.summary import summarize
    from log2sim.scenario import Scenario

    check_targets(out, overwrite=overwrite)
    if out is not None and out.resolve() == scenario.resolve():
        raise ConfigError(f"{out}: is the scenario itself, which a replay must not replace; choose another name")
    if react is not None and agents != "log":
        raise ConfigError("--react names the agents that react, --agents reactive means all: give one of them")
    limits = parse_limits(limit or ())
    loaded = Scenario.load(scenario)
    chosen = agents if react is None else list(ids_of(loaded, [react]))
    policy = load_policy(ego) if ego is not None else None
    moved_by = host_named(simulator, host, port, map)
    with progress(quiet=quiet) as tell:
        result = run(
            loaded, mode=mode, model=model, dt_s=dt, ego=policy, agents=chosen, host=moved_by,
            progress=lambda done, total: tell("replay", done, total),
        )  # fmt: skip
    if out is not None:
        result.save(out)
    say(summarize(result), quiet=quiet)
    if strict:
        require_strict(result, limits)
    for broken in check_limits(result, limits):
        say(f"limit broken: {broken}", quiet=quiet)


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
