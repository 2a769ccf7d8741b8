"""Scenarios changed: edited, corrected by hand, on a page too."""

from __future__ import annotations

import webbrowser
from collections.abc import Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError
from log2sim.files.outputs import claim

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario


Changes = list[str] | None


def edit(
    scenario: opt.ScenarioPath,
    out: Annotated[Path, opt.write_to("FILE", "Scenario file to write.")],
    shift: Annotated[Changes, opt.option("Delay an agent; negative: advance it.", "AGENT=SECONDS")] = None,
    speed: Annotated[Changes, opt.option("Multiply the speed of an agent.", "AGENT=FACTOR")] = None,
    lateral: Annotated[Changes, opt.option(
        "Move an agent to its left; negative: to its right.", "AGENT=METERS")] = None,
    begin: Annotated[float | None, opt.option(
        "Change speed and lateral position from this time on, within --over.", "S", "--from")] = None,
    over: Annotated[float | None, opt.option(
        "Seconds that the change takes, with --from; 3 if not given.", "S")] = None,
    cut_in: Annotated[Changes, opt.option(
        "At --from, bring an agent onto the ego's path, GAP meters ahead.", "AGENT[=GAP]")] = None,
    add: Annotated[Changes, opt.option("Add an agent, at the place that --at gives.", "CATEGORY")] = None,
    at: Annotated[Changes, opt.option(
        "Place of --add in the map, its heading and speed; or meters ahead of an agent, at its pace.",
        "X,Y[,DEG[,MPS]]|AGENT+M")] = None,
    replace: Annotated[Changes, opt.option(
        "Replace an agent by one of another category and size.", "AGENT=CATEGORY")] = None,
    remove: Annotated[Changes, opt.option("Remove agents.", "A,B")] = None,
    only: Annotated[Changes, opt.option("Keep only these agents; the ego is 'ego'.", "A,B")] = None,
    drop_doubtful: opt.DropDoubtful = False,
    strict: Annotated[bool, opt.option("Exit 6 when a check fails.", None, "--strict")] = False,
    overwrite: opt.Overwrite = False,
) -> None:  # fmt: skip
    """Edit the agents of a scenario: their presence, category, timing, speed and lateral position.

    Options with values but --out, --from and --over may be given several times. They are applied in this order: only, remove,
    drop-doubtful, replace, add, speed, lateral, cut-in, shift.

    Examples
    --------
    log2sim edit s.json --lateral car-3=3.5 --from 2 --over 2.5 -o lane_change.json
    log2sim edit s.json --cut-in car-3=8 --from 2 -o cut_in.json
    log2sim edit s.json --add car --at ego+20 --replace car-2=truck -o more.json
    log2sim edit s.json --remove bus-1 --speed car-2=1.2 -o edited.json
    """
    from math import radians

    from log2sim.datatypes import Scenario, count_agents, list_doubtful
    from log2sim.edit import edits as kinds
    from log2sim.edit.apply import edit as run
    from log2sim.files.documents import check_targets

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    ids = [a.id for a in loaded.agents]
    if begin is None and over is not None:
        raise ConfigError("--over: says how long a change takes; add --from, when it begins")
    window = None if begin is None else kinds.Window(begin, 3.0 if over is None else over)
    edits: list[kinds.Edit] = [kinds.Only(tuple(ids_of(loaded, only)))] if only else []
    edits += map(kinds.Remove, ids_of(loaded, remove or ()))
    edits += [kinds.DropDoubtful()] if drop_doubtful else []
    for entry in replace or ():
        agent, _, category = entry.rpartition("=")
        if not agent:
            raise ConfigError(f"--replace {entry}: expected an agent, '=' and a category, such as car-1=truck")
        edits.append(kinds.Replace(agent, category))
    if len(add or ()) != len(at or ()):
        raise ConfigError("--add and --at: give one place for each agent that is added, in the same order")
    for category, place in zip(add or (), at or ()):
        leader = next((i for i in ids if place.startswith((f"{i}+", f"{i}-"))), None)
        try:
            if leader is not None:
                edits.append(kinds.Add(category, ahead_of=leader, meters=float(place.removeprefix(leader))))
                continue
            x, y, deg, mps = ([float(v) for v in place.split(",")] + [0.0, 0.0])[:4]
        except ValueError:
            raise ConfigError(
                f"--at {place}: expected x,y[,degrees[,m/s]] or an agent and meters, such as ego+20"
            ) from None
        edits.append(kinds.Add(category, x, y, radians(deg), mps))

    def numbers(option: str, entries: Changes) -> Iterator[tuple[str, float]]:  # agent and number of each, as car-1=1.5
        for entry in entries or ():
            agent, _, value = entry.rpartition("=")  # an id may hold an equals sign, a number does not
            try:
                number = float(value)
            except ValueError:
                agent = ""
            if not agent:
                raise ConfigError(f"{option} {entry}: expected an agent, '=' and a number, such as car-1=1.5")
            yield agent, number

    edits += [kinds.Speed(agent, factor, window) for agent, factor in numbers("--speed", speed)]
    edits += [kinds.Lateral(agent, meters, window) for agent, meters in numbers("--lateral", lateral)]
    for entry in cut_in or ():
        if window is None:
            raise ConfigError("--cut-in: add --from, when it begins")
        agent, _, gap = (entry, "", "") if entry in ids else entry.rpartition("=")
        try:
            edits.append(kinds.CutIn(agent or entry, window, float(gap) if gap else None))
        except ValueError:
            raise ConfigError(f"--cut-in {entry}: expected an agent, and meters if any, such as car-1=8") from None
    # A shift comes last: it may cut off waypoints before the start that other edits need.
    edits += [kinds.Shift(agent, seconds) for agent, seconds in numbers("--shift", shift)]
    result = run(loaded, edits)
    edited = result.scenario
    edited.save(out)
    if drop_doubtful:
        kept = {a.id for a in edited.agents}
        gone = [a for a in loaded.doubtful if a.id not in kept]
        opt.tell(f"left out as doubtful: {list_doubtful(gone) or 'none'}")
    opt.say_all("warning", result.warnings)
    opt.tell(
        f"{out}: {opt.counted(len(edits), 'edit')}, {count_agents(a.id for a in edited.agents)} over {edited.duration_s:.1f} s, "
        f"{opt.counted(len(result.warnings), 'warning')}"
    )
    if strict:
        result.require_clean()


def ids_of(scenario: Scenario, entries: Iterable[str]) -> Iterator[str]:
    """Yield the ids in entries such as "A,B"; an id of the scenario may itself contain a comma."""
    known = {a.id for a in scenario.agents}
    for entry in entries:
        yield from [entry] if entry in known else (name.strip() for name in entry.split(","))


def correct(
    scenario: opt.ScenarioPath,
    corrections: Annotated[
        Path, typer.Argument(metavar="CORRECTIONS", help="File of corrections, see schemas/corrections-1.json.")
    ],
    out: Annotated[Path, opt.write_to("FILE", "Scenario file to write.")],
    log: Annotated[
        Path | None, opt.option("Log of the scenario, whose LiDAR points in the corrected boxes are counted.", "LOG")
    ] = None,
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Apply corrections that a person made: merged, split, moved and deleted agents, categories, fronts, sizes, colors, lines.

    A key pose is a further measurement with its own sigma: it moves a trajectory as far as the sigmas of both say. Corrections that
    no longer find their agent are told and left out, and so are collisions and motion that no vehicle can do, where corrections
    lead to them. Tags are found anew; with the log, points of what was corrected are counted anew.

    Examples
    --------
    log2sim correct s.json corrections.json -o corrected.json
    log2sim correct s.json corrections.json --log samples/crossing -o corrected.json
    """
    from log2sim.datatypes import Scenario
    from log2sim.edit.apply import find_problems
    from log2sim.edit.corrections import correct as run
    from log2sim.edit.corrections import load_corrections
    from log2sim.files.documents import check_targets

    check_targets(out, overwrite=overwrite)
    document = load_corrections(corrections)
    source = Scenario.load(scenario)
    result = run(source, document)
    corrected, known = result.scenario, {a.id: a for a in source.agents}
    changed = [a for a in corrected.agents if a is not known.get(a.id)]
    lines = [*result.unmatched, *find_problems(source, corrected, changed)]
    if log is not None:
        corrected, unseen = _with_points(corrected, {a.id for a in changed}, log, sequence)
        lines += unseen
    if source.tags is not None:
        from log2sim.scenarios.tagging import tag

        corrected = tag(corrected)
    corrected.save(out)
    opt.say_all("warning", lines)
    done = len(document["corrections"]) - len(result.unmatched)
    lost = f", {len(result.unmatched)} without its agent" if result.unmatched else ""
    opt.tell(f"{out}: {opt.counted(done, 'correction')} applied{lost}")


def _with_points(scenario: Scenario, changed: set[str], log: Path, sequence: str | None) -> tuple[Scenario, list[str]]:
    """Return the scenario with the LiDAR points of the changed agents, and a line for each of them that has none."""
    import numpy as np

    from log2sim.cli.show import open_recorded
    from log2sim.evaluation.metrics.truth import count_points

    opened = open_recorded(log, scenario, sequence).log
    part = replace(scenario, agents=tuple(a for a in scenario.others if a.id in changed))
    points = {a.id: a.waypoints.lidar_points for a in count_points(part, opened).agents}
    seen = {name: float(np.median(found)) for name, found in points.items() if found is not None}
    agents = tuple(
        replace(a, quality={**a.quality, "points_median": seen[a.id]}) if a.id in seen else a for a in scenario.agents
    )
    none = [name for name, found in points.items() if found is not None and not found.any()]
    return replace(scenario, agents=agents), [f"{name}: the LiDAR has no point in its box" for name in none]


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
) -> None:  # fmt: skip
    """Correct a scenario on a page: the doubtful agents first, merging, moving, turning, sizes, categories; with undo.

    The page is served to this computer alone, until Ctrl-C. Every correction is kept in a file at once, which `log2sim correct` and
    `reconstruct --corrections` apply.

    Examples
    --------
    log2sim studio s.json --log samples/crossing
    log2sim studio s.json --corrections mine.json --no-browser
    """
    from log2sim.cli.show import map_of, open_recorded, shows_ground
    from log2sim.datatypes import Scenario
    from log2sim.visualization.studio import Studio

    path = corrections or scenario.with_name(f"{scenario.stem}.corrections.json")
    claim(path, overwrite=False)  # two studios on one file would overwrite each other's corrections
    loaded = Scenario.load(scenario)
    layers: dict[str, Any] = {}
    with progress() as report_progress:
        if log is not None:
            wanted = opt.camera_names(cameras)
            recorded = open_recorded(log, loaded, sequence, round(max_mb * 1e6), wanted, report_progress)
            layers["recorded"] = recorded
            if shows_ground(recorded.log):
                layers["background"] = map_of(recorded.log, loaded, report_progress)
        try:
            served = Studio(loaded, path, port=port, **layers)
        except OSError as error:
            raise ConfigError(f"--port {port}: {error.strerror}; choose another") from None
        served.page()  # its pictures take long to gather: not while a browser waits
    opt.say_all("warning", served.result.unmatched)
    try:
        opt.say(f"{served.address}  (Ctrl-C ends it; corrections go to {path})")
        if browser:
            webbrowser.open(served.address)
        served.serve()
    except KeyboardInterrupt:
        count = len(served.document["corrections"])
        words = f"{path}: {opt.counted(count, 'correction')}"
        opt.say(f"{words}; log2sim correct {scenario} {path} --out corrected.json applies them" if count else words)
