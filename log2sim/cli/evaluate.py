"""Compare a scenario, or detected boxes, with the ground truth."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli.options import Overwrite, Quiet, Sequence, say
from log2sim.cli.truth import load_truth

PROTOCOL = "center"


def evaluate(
    path: Annotated[Path, typer.Argument(metavar="FILE", help="A scenario.json, or a boxes.json of `detect`.")],
    truth: Annotated[
        Path,
        typer.Option(metavar="TRUTH", help="Ground truth: a log with labels or, for a scenario, a scenario file."),
    ],
    sequence: Sequence = None,
    range: Annotated[
        float | None, typer.Option(metavar="M", help="Compare agents or boxes up to this distance from the ego, in m.")
    ] = None,
    categories: Annotated[
        str | None, typer.Option(metavar="A,B", help="Compare only these categories or groups, e.g. vehicle.")
    ] = None,
    protocol: Annotated[
        str | None,
        typer.Option(
            metavar="kitti|dair|center",
            help="Of boxes: KITTI's classes, difficulties and IoU; DAIR-V2X's classes and IoU; or distance of centers "
            f"(nuScenes). Default: {PROTOCOL}.",
        ),
    ] = None,
    score: Annotated[
        float | None,
        typer.Option(metavar="S", help="Of boxes: score from which precision and recall count them. Default: 0.5."),
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Of boxes: reliability diagram of the scores to write.")
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", metavar="FILE", help="Metrics file to write.")] = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Compare a scenario, or detected boxes, with the ground truth."""
    from log2sim.documents import check_targets, read_json
    from log2sim.errors import ConfigError, ScenarioError
    from log2sim.evaluation.detection.boxes_file import is_boxes_document

    check_targets(out, plot, overwrite=overwrite)
    document = read_json(path, ScenarioError)
    wanted = [c.strip() for c in categories.split(",")] if categories else None
    if is_boxes_document(document):
        options = {"protocol": protocol or PROTOCOL, "max_range_m": range, "classes": wanted}
        if score is not None:
            options["min_score"] = score
        _evaluate_boxes(document, path, truth, sequence, options, out, plot, quiet=quiet)
        return
    given = [
        name for name, value in (("--protocol", protocol), ("--score", score), ("--plot", plot)) if value is not None
    ]
    if given:
        raise ConfigError(f"{given[0]}: is for boxes of `log2sim detect`; {path} is no boxes file, so leave it out")
    _evaluate_scenario(document, path, truth, sequence, range, wanted, out, quiet=quiet)


def _evaluate_scenario(
    document: Any,
    path: Path,
    truth: Path,
    sequence: str | None,
    max_range_m: float | None,
    categories: list[str] | None,
    out: Path | None,
    *,
    quiet: bool,
) -> None:
    from log2sim.datatypes import Scenario
    from log2sim.documents import write_json
    from log2sim.errors import ScenarioError
    from log2sim.evaluation.metrics.evaluator import evaluate as run
    from log2sim.evaluation.metrics.table import format_table

    try:
        loaded = Scenario.from_dict(document)
    except ScenarioError as error:
        raise ScenarioError(f"{path}: {error}") from None
    result = run(loaded, load_truth(truth, loaded, sequence), max_range_m=max_range_m, categories=categories)
    if out is not None:
        write_json(out, result)
    say(format_table(result), quiet=quiet)


def _evaluate_boxes(
    document: Any,
    path: Path,
    truth: Path,
    sequence: str | None,
    options: dict[str, Any],
    out: Path | None,
    plot: Path | None,
    *,
    quiet: bool,
) -> None:
    from log2sim.cli.progress import progress
    from log2sim.documents import write_json
    from log2sim.errors import LogError
    from log2sim.evaluation.detection.boxes_file import DetectedBoxes
    from log2sim.evaluation.detection.evaluation import Options, evaluate_boxes
    from log2sim.evaluation.detection.table import format_table
    from log2sim.logs.opening import open_log

    chosen = Options(**options)
    chosen.chosen()
    try:
        detected = DetectedBoxes.from_dict(document)
    except LogError as error:
        raise LogError(f"{path}: {error}") from None
    if not truth.is_dir():
        raise LogError(f"{truth}: is no folder; the truth of boxes is a log with labels")
    opened = open_log(truth, sequence=sequence)
    with progress(quiet=quiet) as report_progress:
        result = evaluate_boxes(
            detected, opened, chosen, progress=lambda done, total: report_progress("count points", done, total)
        )
    if out is not None:
        write_json(out, result)
    if plot is not None:
        from log2sim.visualization.plot.reliability import write_reliability

        write_reliability({name: figures["calibration"] for name, figures in result["classes"].items()}, plot)
    say(format_table(result), quiet=quiet)
