"""Edit a scenario."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from log2sim.cli.options import DropDoubtful, Overwrite, Quiet, ScenarioPath, counted, say

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.edit.edits import Edit

Changes = list[str] | None


def edit(
    scenario: ScenarioPath,
    out: Annotated[Path, typer.Option("--out", "-o", metavar="FILE", help="Scenario file to write.")],
    shift: Annotated[
        Changes, typer.Option(metavar="AGENT=SECONDS", help="Delay an agent; negative: advance it.")
    ] = None,
    speed: Annotated[Changes, typer.Option(metavar="AGENT=FACTOR", help="Multiply the speed of an agent.")] = None,
    lateral: Annotated[
        Changes, typer.Option(metavar="AGENT=METERS", help="Move an agent to its left; negative: to its right.")
    ] = None,
    remove: Annotated[Changes, typer.Option(metavar="A,B", help="Remove agents.")] = None,
    only: Annotated[Changes, typer.Option(metavar="A,B", help="Keep only these agents; the ego is 'ego'.")] = None,
    drop_doubtful: DropDoubtful = False,
    strict: Annotated[bool, typer.Option("--strict", help="Exit 6 when a check fails.")] = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Edit the agents of a scenario: their presence, timing, speed and lateral position.

    Options with values but --out may be given several times. They are applied in this order: only, remove, drop-doubtful,
    speed, lateral, shift.

    Examples
    --------
    log2sim edit s.json --shift car-3=-0.5 --lateral ego=0.3 -o edited.json
    log2sim edit s.json --remove bus-1 --speed car-2=1.2 -o edited.json
    """
    from log2sim.datatypes import Scenario, list_doubtful, say_agents
    from log2sim.documents import check_targets
    from log2sim.edit.apply import edit as run
    from log2sim.edit.edits import DropDoubtful as Drop

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    # A shift comes last: it may cut off waypoints before the start that other edits need.
    edits = [
        *_choices(loaded, only, remove),
        *([Drop()] if drop_doubtful else []),
        *_motions({"speed": speed, "lateral": lateral, "shift": shift}),
    ]
    result = run(loaded, edits)
    edited = result.scenario
    edited.save(out)
    if drop_doubtful:
        kept = {a.id for a in edited.agents}
        gone = [a for a in loaded.doubtful if a.id not in kept]
        say(f"left out as doubtful: {list_doubtful(gone) or 'none'}", quiet=quiet)
    for warning in result.warnings:
        say(f"warning: {warning}", quiet=quiet)
    say(
        f"{out}: {counted(len(edits), 'edit')}, {say_agents(a.id for a in edited.agents)} over {edited.duration_s:.1f} s, "
        f"{counted(len(result.warnings), 'warning')}",
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


def _motions(changes: dict[str, Changes]) -> Iterator[Edit]:
    """Yield the edits of timing, speed and lateral position."""
    from log2sim.edit.edits import Lateral, Shift, Speed
    from log2sim.errors import ConfigError

    kinds = {"speed": Speed, "lateral": Lateral, "shift": Shift}
    for option, entries in changes.items():
        for entry in entries or ():
            agent, _, value = entry.rpartition("=")  # an id may hold an equals sign, a number does not
            try:
                number = float(value)
            except ValueError:
                number = None
            if not agent or number is None:
                raise ConfigError(f"--{option} {entry}: expected an agent, '=' and a number, such as car-1=1.5")
            yield kinds[option](agent, number)
