"""Correct a scenario by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli import options as opt


def correct(
    scenario: opt.ScenarioPath,
    corrections: Annotated[
        Path, typer.Argument(metavar="CORRECTIONS", help="File of corrections, see schemas/corrections-1.json.")
    ],
    out: Annotated[Path, opt.write_to("FILE", "Scenario file to write.")],
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """Apply corrections that a person made: merged, split, moved and deleted agents, categories, fronts, sizes, colors, lines.

    A key pose is a further measurement with its own sigma: it moves a trajectory as far as the sigmas of both say. Corrections that
    no longer find their agent are told and left out.

    Examples
    --------
    log2sim correct s.json corrections.json -o corrected.json
    """
    from log2sim.datatypes import Scenario
    from log2sim.edit.corrections import correct as run
    from log2sim.edit.corrections import load_corrections
    from log2sim.files.documents import check_targets

    check_targets(out, overwrite=overwrite)
    document = load_corrections(corrections)
    result = run(Scenario.load(scenario), document)
    result.scenario.save(out)
    opt.say_all("warning", result.unmatched, quiet=quiet)
    done = len(document["corrections"]) - len(result.unmatched)
    lost = f", {len(result.unmatched)} without its agent" if result.unmatched else ""
    opt.say(f"{out}: {opt.counted(done, 'correction')} applied{lost}", quiet=quiet)
