"""Correct a scenario by hand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from log2sim.cli import options as opt

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario


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
    quiet: opt.Quiet = False,
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
        from log2sim.scenarios import tag

        corrected = tag(corrected)
    corrected.save(out)
    opt.say_all("warning", lines, quiet=quiet)
    done = len(document["corrections"]) - len(result.unmatched)
    lost = f", {len(result.unmatched)} without its agent" if result.unmatched else ""
    opt.say(f"{out}: {opt.counted(done, 'correction')} applied{lost}", quiet=quiet)


def _with_points(scenario: Scenario, changed: set[str], log: Path, sequence: str | None) -> tuple[Scenario, list[str]]:
    """Return the scenario with the LiDAR points of the changed agents, and a line for each of them that has none."""
    import numpy as np

    from log2sim.evaluation.metrics.truth import count_points
    from log2sim.localization.choice import localize_like
    from log2sim.logs.opening import open_log
    from log2sim.visualization.recording import require_overlap

    opened = localize_like(open_log(log, sequence=sequence), scenario.provenance)
    require_overlap(opened, scenario)
    part = replace(scenario, agents=tuple(a for a in scenario.others if a.id in changed))
    points = {a.id: a.waypoints.lidar_points for a in count_points(part, opened).agents}
    seen = {name: float(np.median(found)) for name, found in points.items() if found is not None}
    agents = tuple(
        replace(a, quality={**a.quality, "points_median": seen[a.id]}) if a.id in seen else a for a in scenario.agents
    )
    none = [name for name, found in points.items() if found is not None and not found.any()]
    return replace(scenario, agents=agents), [f"{name}: the LiDAR has no point in its box" for name in none]
