"""Simulate the sensors of a log in what happens now."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt


def resimulate(
    scenario: opt.ScenarioPath,
    log: Annotated[Path, opt.option("Log that the scenario was reconstructed from.", "LOG")],
    out: Annotated[Path, opt.write_to("DIR", "Log folder to write.")],
    replay: Annotated[Path | None, opt.option(
        "What happens now: a replay or an edit of the scenario. [default: the scenario]", "FILE")] = None,
    sensors: Annotated[str | None, opt.option(
        "LiDARs and cameras that are simulated.", "A,B", default="all LiDARs")] = None,
    cameras: Annotated[bool, opt.option("All cameras, too.", None, "--cameras")] = False,
    sequence: Annotated[str | None, opt.option("Sequence of a log with several.", "NAME")] = None,
    film: Annotated[Path | None, opt.option(
        "Film of a LiDAR, and a camera where they are simulated: recorded, simulated, now.", "FILE.webm")] = None,
    seed: Annotated[int, opt.option("Seed of noise and lost returns.", min=0)] = 0,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Write what the LiDARs and cameras of a log would have recorded from where the ego drives now, among its agents.

    Examples
    --------
    log2sim resimulate s.json --log samples/crossing -o simulated/
    log2sim edit s.json --lateral ego=2 -o left.json
    log2sim resimulate s.json --log samples/crossing --replay left.json -o from_the_left/ --cameras --film left.webm
    """
    from log2sim.cli.progress import progress
    from log2sim.datatypes import Scenario
    from log2sim.errors import ConfigError, ScenarioError
    from log2sim.files.documents import check_targets, read_json
    from log2sim.localization.choice import localize_like
    from log2sim.logs.native.writer import refuse_target
    from log2sim.logs.opening import open_log
    from log2sim.resim.simulate import resimulate as run
    from log2sim.simulation.result import Replay, to_scenario
    from log2sim.visualization.plot.encoding import choose_film_file
    from log2sim.visualization.sensor_film import write_film

    refuse_target(out, overwrite=overwrite)
    filmed = None
    if film is not None:  # before the long work
        if film.suffix.lower() not in (".mp4", ".webm"):
            raise ConfigError(f"--film {film}: a film's name must end in .mp4 or .webm")
        filmed = choose_film_file(film)
        check_targets(filmed.path, overwrite=overwrite)
    now = source = Scenario.load(scenario)
    if replay is not None:
        document = read_json(replay, ScenarioError)
        if isinstance(document, dict) and "replay_version" in document:
            now = to_scenario(Replay.load(replay), source)
        else:
            now = Scenario.load(replay).aligned_to(source)
    with progress(quiet=quiet) as report:
        recorded = localize_like(open_log(log, sequence=sequence), source.provenance)
        notes = run(
            recorded, source, now, out, sensors=opt.split_names(sensors), cameras=cameras, seed=seed, overwrite=overwrite, progress=report,
            then=lambda simulation: None if filmed is None else write_film(simulation, source, filmed),
        )  # fmt: skip
    opt.say_all("note", (*notes, *([filmed.note] if filmed is not None and filmed.note else [])), quiet=quiet)
    opt.report_written(out, None if filmed is None else filmed.path, quiet=quiet)
