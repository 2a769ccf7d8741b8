"""Write a scenario in the format of another simulator or viewer."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt

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
    quiet: opt.Quiet = False,
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
    opened = open_log(log) if log is not None else None
    options = Options(revision, map, mode, opened, driver)
    files = run(chosen, to, out, options, quarantined=doubtful == "all", overwrite=overwrite)
    for file in files:
        opt.say(f"{file}: written", quiet=quiet)
    notes = export_notes(chosen)
    if loaded.doubtful:
        opt.say(f"note: {doubtful_note(loaded, chosen)}", quiet=quiet)
    opt.say_all("note", notes if verbose else notes[:MAX_NOTES], quiet=quiet)
    if len(notes) > MAX_NOTES and not verbose:
        opt.say(f"note: and {len(notes) - MAX_NOTES} more", quiet=quiet)
