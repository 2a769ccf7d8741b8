"""Edit a scenario."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from log2sim.cli import options as opt

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
    quiet: opt.Quiet = False,
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
    from log2sim.errors import ConfigError
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
    edits += [kinds.Speed(agent, factor, window) for agent, factor in _numbers("--speed", speed)]
    edits += [kinds.Lateral(agent, meters, window) for agent, meters in _numbers("--lateral", lateral)]
    for entry in cut_in or ():
        if window is None:
            raise ConfigError("--cut-in: add --from, when it begins")
        agent, _, gap = (entry, "", "") if entry in ids else entry.rpartition("=")
        try:
            edits.append(kinds.CutIn(agent or entry, window, float(gap) if gap else None))
        except ValueError:
            raise ConfigError(f"--cut-in {entry}: expected an agent, and meters if any, such as car-1=8") from None
    # A shift comes last: it may cut off waypoints before the start that other edits need.
    edits += [kinds.Shift(agent, seconds) for agent, seconds in _numbers("--shift", shift)]
    result = run(loaded, edits)
    edited = result.scenario
    edited.save(out)
    if drop_doubtful:
        kept = {a.id for a in edited.agents}
        gone = [a for a in loaded.doubtful if a.id not in kept]
        opt.say(f"left out as doubtful: {list_doubtful(gone) or 'none'}", quiet=quiet)
    opt.say_all("warning", result.warnings, quiet=quiet)
    opt.say(
        f"{out}: {opt.counted(len(edits), 'edit')}, {count_agents(a.id for a in edited.agents)} over {edited.duration_s:.1f} s, "
        f"{opt.counted(len(result.warnings), 'warning')}",
        quiet=quiet,
    )
    if strict:
        result.require_clean()


def ids_of(scenario: Scenario, entries: Iterable[str]) -> Iterator[str]:
    """Yield the ids in entries such as "A,B"; an id of the scenario may itself contain a comma."""
    known = {a.id for a in scenario.agents}
    for entry in entries:
        yield from [entry] if entry in known else (name.strip() for name in entry.split(","))


def _numbers(option: str, entries: Changes) -> Iterator[tuple[str, float]]:
    """Yield agent and number of each entry such as "car-1=1.5"."""
    from log2sim.errors import ConfigError

    for entry in entries or ():
        agent, _, value = entry.rpartition("=")  # an id may hold an equals sign, a number does not
        try:
            number = float(value)
        except ValueError:
            agent = ""
        if not agent:
            raise ConfigError(f"{option} {entry}: expected an agent, '=' and a number, such as car-1=1.5")
        yield agent, number
