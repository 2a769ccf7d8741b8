"""Convert a file of another simulator to a scenario."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli import options as opt


def import_(
    file: Annotated[Path, typer.Argument(metavar="FILE.xosc", help="An OpenSCENARIO file with trajectories.")],
    out: Annotated[Path, opt.write_to("SCENARIO", "Scenario file to write.")],
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
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
    opt.report_written(out, quiet=quiet)
