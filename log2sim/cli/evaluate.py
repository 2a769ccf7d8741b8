"""Compare a scenario with the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.options import Overwrite, Quiet, ScenarioPath, Sequence, say
from log2sim.cli.truth import load_truth


def evaluate(
    scenario: ScenarioPath,
    truth: Annotated[Path, typer.Option(metavar="TRUTH", help="Ground truth: a scenario file or a log with labels.")],
    sequence: Sequence = None,
    range: Annotated[
        float | None, typer.Option(metavar="M", help="Compare agents up to this distance from the ego, in m.")
    ] = None,
    categories: Annotated[
        str | None, typer.Option(metavar="A,B", help="Compare only these categories or groups, e.g. vehicle.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Metrics file to write.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scenario with the ground truth."""
    from log2sim.datatypes import Scenario
    from log2sim.documents import check_targets, write_json
    from log2sim.evaluation.metrics.evaluator import evaluate as run
    from log2sim.evaluation.metrics.table import format_table

    check_targets(out, overwrite=overwrite)
    loaded = Scenario.load(scenario)
    wanted = [c.strip() for c in categories.split(",")] if categories else None
    result = run(loaded, load_truth(truth, loaded, sequence), max_range_m=range, categories=wanted)
    if out is not None:
        write_json(out, result)
    say(format_table(result), quiet=quiet)
