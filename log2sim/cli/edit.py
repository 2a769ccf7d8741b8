"""Edit a scenario."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.edit.edits import Edit, Window

Changes = list[str] | None


def edit(
    scenario: opt.ScenarioPath,
    out: Annotated[Path, opt.write_to("FILE", "Scenario file to write.")],
    shift: Annotated[Changes, opt.option("Delay an agent; negative: advance it.", "AGENT=SECONDS")] = None,
    speed: Annotated[Changes, opt.option("Multiply the speed of an agent.", "AGENT=FACTOR")] = None,
    lateral: Annotated[
        Changes, opt.option("Move an agent to its left; negative: to its right.", "AGENT=METERS")
    ] = None,
    begin: Annotated[
        float | None, opt.option("Change speed and lateral position from this time on, within --over.", "S", "--from")
    ] = None,
    over: Annotated[
        float | None, opt.option("Seconds that the change takes, with --from; 3 if not given.", "S")
    ] = None,
    cut_in: Annotated[
        Changes, opt.option("At --from, bring an agent onto the ego's path, GAP meters ahead.", "AGENT[=GAP]")
    ] = None,
    add: Annotated[Changes, opt.option("Add an agent, at the place that --at gives.", "CATEGORY")] = None,
    at: Annotated[
        Changes,
        opt.option(
            "Place of --add in the map, its heading and speed; or meters ahead of an agent, at its pace.",
            "X,Y[,DEG[,MPS]]|AGENT+M",
        ),
    ] = None,
    replace: Annotated[
        Changes, opt.option("Replace an agent by one of another category and size.", "AGENT=CATEGORY")
    ] = None,
    remove: Annotated[Changes, opt.option("Remove agents.", "A,B")] = None,
    only: Annotated[Changes, opt.option("Keep only these agents; the ego is 'ego'.", "A,B")] = None,
    drop_doubtful: opt.DropDoubtful = False,
    strict: Annotated[bool, opt.option("Exit 6 when a check fails.", None, "--strict")] = False,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
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
    from log2sim.datatypes import Scenario, count_agents, list_doubtful
    from log2sim.edit.apply import edit as run
    from log2sim.edit.edits import DropDoubtful as Drop
    from log2sim.files.documents import check_targets

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    # A shift comes last: it may cut off waypoints before the start that other edits need.
    edits = [
        *_choices(loaded, only, remove),
        *([Drop()] if drop_doubtful else []),
        *_new_agents(loaded, replace, add, at),
        *_motions({"speed": speed, "lateral": lateral}, _window(begin, over)),
        *_cut_ins(loaded, cut_in, _window(begin, over)),
        *_motions({"shift": shift}, None),
    ]
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


def _choices(scenario: Scenario, only: Changes, remove: Changes) -> Iterator[Edit]:
    """Yield the edits that keep or remove agents."""
    from log2sim.edit.edits import Only, Remove

    if only:
        yield Only(tuple(ids_of(scenario, only)))
    yield from map(Remove, ids_of(scenario, remove or ()))


def ids_of(scenario: Scenario, entries: Iterable[str]) -> Iterator[str]:
    """Yield the ids in entries such as "A,B"; an id of the scenario may itself contain a comma."""
    known = {a.id for a in scenario.agents}
    for entry in entries:
        yield from [entry] if entry in known else (name.strip() for name in entry.split(","))


def _window(begin_s: float | None, over_s: float | None) -> Window | None:
    """Return the window of --from and --over."""
    from log2sim.edit.edits import Window
    from log2sim.errors import ConfigError

    if begin_s is None:
        if over_s is not None:
            raise ConfigError("--over: says how long a change takes; add --from, when it begins")
        return None
    return Window(begin_s, 3.0 if over_s is None else over_s)


def _new_agents(scenario: Scenario, replaced: Changes, added: Changes, places: Changes) -> Iterator[Edit]:
    """Yield the edits that replace and add agents."""
    from math import radians

    from log2sim.edit.edits import Add, Replace
    from log2sim.errors import ConfigError

    for entry in replaced or ():
        agent, _, category = entry.rpartition("=")
        if not agent:
            raise ConfigError(f"--replace {entry}: expected an agent, '=' and a category, such as car-1=truck")
        yield Replace(agent, category)
    if len(added or ()) != len(places or ()):
        raise ConfigError("--add and --at: give one place for each agent that is added, in the same order")
    ids = [a.id for a in scenario.agents]
    for category, place in zip(added or (), places or ()):
        leader = next((i for i in ids if place.startswith((f"{i}+", f"{i}-"))), None)
        try:
            if leader is not None:
                yield Add(category, ahead_of=leader, meters=float(place.removeprefix(leader)))
                continue
            x, y, deg, mps = ([float(v) for v in place.split(",")] + [0.0, 0.0])[:4]
        except ValueError:
            raise ConfigError(
                f"--at {place}: expected x,y[,degrees[,m/s]] or an agent and meters, such as ego+20"
            ) from None
        yield Add(category, x, y, radians(deg), mps)


def _cut_ins(scenario: Scenario, entries: Changes, window: Window | None) -> Iterator[Edit]:
    """Yield the edits that bring agents onto the path of the ego."""
    from log2sim.edit.edits import CutIn
    from log2sim.errors import ConfigError

    if entries and window is None:
        raise ConfigError("--cut-in: add --from, when it begins")
    for entry in entries or ():
        agent, _, gap = (entry, "", "") if any(a.id == entry for a in scenario.agents) else entry.rpartition("=")
        try:
            gap_m = float(gap) if gap else None
        except ValueError:
            raise ConfigError(f"--cut-in {entry}: expected an agent, and meters if any, such as car-1=8") from None
        if window is not None:
            yield CutIn(agent or entry, window, gap_m)


def _motions(changes: dict[str, Changes], window: Window | None) -> Iterator[Edit]:
    """Yield the edits of timing, speed and lateral position."""
    from log2sim.edit.edits import Lateral, Shift, Speed
    from log2sim.errors import ConfigError

    for name, entries in changes.items():
        for entry in entries or ():
            agent, _, value = entry.rpartition("=")  # an id may hold an equals sign, a number does not
            try:
                number = float(value)
            except ValueError:
                number = None
            if not agent or number is None:
                raise ConfigError(f"--{name} {entry}: expected an agent, '=' and a number, such as car-1=1.5")
            if name == "shift":
                yield Shift(agent, number)
            else:
                yield (Speed if name == "speed" else Lateral)(agent, number, window)
