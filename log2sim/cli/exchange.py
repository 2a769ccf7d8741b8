"""Scenarios in other formats, and synthetic logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError

MAX_NOTES = 5
FORMATS = "openscenario, carla, csv, scenarionet, commonroad, lanelet2, openlabel, osi, mcap, rerun"  # written out: --help imports nothing


def export(
    scenario: opt.ScenarioPath,
    to: Annotated[str, opt.option(f"One of {FORMATS}.", "FORMAT", "--to", completes=opt.complete_plugins("export"))],
    out: Annotated[Path, opt.write_to("DIR", "Folder to write into.")],
    revision: Annotated[str | None, opt.choose(
        "--revision", "1.0|1.1|1.2", "openscenario: its version.", default="the newest")] = None,
    map: Annotated[Path | None, opt.option(
        "openscenario, carla: OpenDRIVE file to use instead of a generated one.", "FILE")] = None,
    mode: Annotated[str | None, opt.choose("--mode", "exact|pid", "carla: how agents move.", default="exact")] = None,
    log: Annotated[Path | None, opt.option(
        "mcap, rerun: log whose images and points are included; openlabel: whose pictures have boxes.", "LOG")] = None,
    ego: Annotated[str | None, opt.option(
        "Agent to take as the ego, where the scenario has none; openscenario: external, another program drives the ego.",
        "AGENT|external")] = None,
    doubtful: Annotated[str, opt.choose(
        "--doubtful", "keep|drop|all",
        "Agents that the scenario itself doubts: keep all but the quarantined, drop them, or keep all.")] = "keep",
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Write a scenario in the format of a simulator or viewer.

    Examples
    --------
    log2sim export s.json --to openscenario -o xosc/
    log2sim export s.json --to openscenario --ego external -o closed_loop/
    log2sim export s.json --to rerun --log samples/crossing -o rerun/
    """
    from log2sim.datatypes import Scenario
    from log2sim.export.checks import doubtful_note, export_notes
    from log2sim.export.exporters import EXTERNAL, Options, filter_doubtful, make_ego
    from log2sim.export.exporters import export as run
    from log2sim.files.documents import check_folder
    from log2sim.logs.opening import open_log

    check_folder(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    driver = EXTERNAL if ego == EXTERNAL and all(a.id != EXTERNAL for a in loaded.agents) else None
    if ego is not None and driver is None:
        loaded = make_ego(loaded, ego)
    chosen = filter_doubtful(loaded, doubtful)
    options = Options(revision, map, mode, None if log is None else open_log(log), driver)
    files = run(chosen, to, out, options, quarantined=doubtful == "all", overwrite=overwrite)
    for file in files:
        opt.tell(f"{file}: written")
    notes = export_notes(chosen)
    if loaded.doubtful:
        opt.tell(f"note: {doubtful_note(loaded, chosen)}")
    opt.say_all("note", notes if verbose else notes[:MAX_NOTES])
    if len(notes) > MAX_NOTES and not verbose:
        opt.tell(f"note: and {len(notes) - MAX_NOTES} more")


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE.xosc", help="An OpenSCENARIO file with trajectories.")],
    out: Annotated[Path, opt.write_to("SCENARIO", "Scenario file to write.")],
    overwrite: opt.Overwrite = False,
) -> None:
    """Convert an OpenSCENARIO file to a scenario.

    Examples
    --------
    log2sim import scenario.xosc -o s.json
    """
    from log2sim.export.openscenario.read import load
    from log2sim.files.documents import check_targets

    check_targets(out, overwrite=overwrite)
    load(file).save(out)
    opt.report_written(out)


def synth(
    out: Annotated[Path, opt.write_to("DIR", "Folder to write.")],
    scene: Annotated[Path | None, typer.Argument(metavar="[SCENE.toml]", help="Scene file.")] = None,
    traffic: Annotated[Literal["vehicle", "roadside"] | None, opt.option(
        "Instead of a scene file: random traffic around a LiDAR on a vehicle or at the roadside.")] = None,
    scenes: Annotated[int | None, opt.option("Number of random scenes. [default: 10]", min=1, max=1_000_000)] = None,
    sensor: Annotated[str | None, opt.option(
        "LiDAR of random scenes: a name, a TOML file, or random. [default: hdl64e, rslidar16-roadside]",
        "NAME")] = None,
    layout: Annotated[Literal["kitti", "log2sim"] | None, opt.option(
        "Layout of random scenes: KITTI's object layout or a log folder each. [default: kitti, log2sim without "
        "pictures]")] = None,
    duration: Annotated[float | None, opt.option(
        "Length of each log of random traffic in s. [default: 5]", min=0.5, max=60.0)] = None,
    light: Annotated[Literal["noon", "overcast", "dusk", "night"] | None, opt.option(
        "Light; random scenes draw it otherwise.")] = None,
    weather: Annotated[Literal["clear", "rain", "fog"] | None, opt.option(
        "Weather; random scenes draw it otherwise.")] = None,
    no_pictures: Annotated[bool, opt.option(
        "Write no cameras: LiDAR sweeps, poses and labels alone.", None, "--no-pictures")] = False,
    seed: Annotated[int, opt.option("Seed of all random numbers.", min=0)] = 0,
    jobs: Annotated[int | None, opt.option(
        "Processes that write random scenes.", "N", min=1, default="one for each core")] = None,
    overwrite: opt.Overwrite = False,
) -> None:  # fmt: skip
    """Generate a synthetic log with exact ground truth, or random traffic for training and tests.

    Examples
    --------
    log2sim synth samples/crossing.toml -o log/
    log2sim synth --traffic vehicle --scenes 100 -o scenes/
    log2sim synth --traffic roadside --no-pictures --duration 2 -o clouds/
    """
    from log2sim.synth.scene import load_scene
    from log2sim.synth.synthesis import write_synthetic

    if (scene is None) == (traffic is None):
        raise ConfigError("give either a scene file or --traffic vehicle or --traffic roadside")
    random = {"--scenes": scenes, "--sensor": sensor, "--layout": layout, "--duration": duration, "--jobs": jobs}
    given = [name for name, value in random.items() if value is not None]
    if scene is not None and given:
        raise ConfigError(f"{', '.join(given)}: for random scenes of --traffic; the file of a scene says what is in it")
    with progress() as report_progress:
        if scene is not None:
            loaded = load_scene(scene)
            changes = {k: v for k, v in (("light", light), ("weather", weather)) if v is not None}
            if no_pictures and not loaded.lidar:
                raise ConfigError(f"{scene}: has no LiDAR, so that nothing is left without pictures")
            cameras = () if no_pictures else loaded.camera
            environment = loaded.environment.model_copy(update=changes)
            lit = loaded.model_copy(update={"environment": environment, "camera": cameras})
            report = partial(report_progress, "synthesize")
            write_synthetic(lit, out, seed=seed, overwrite=overwrite, progress=report)
        elif traffic is not None:
            from log2sim.files.processes import default_jobs
            from log2sim.synth.traffic_data import TrafficSettings, write_traffic

            chosen = layout or ("log2sim" if no_pictures else "kitti")
            settings = TrafficSettings(
                traffic, scenes or 10, seed, sensor, chosen, duration or 5.0, light, weather, pictures=not no_pictures
            )  # fmt: skip
            report = partial(report_progress, "scenes")
            write_traffic(settings, out, overwrite=overwrite, progress=report, jobs=jobs or default_jobs())
    opt.report_written(out)
