"""Validate files and logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli.options import Format, Quiet, SequenceName, say


def validate(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="FILE_OR_LOG",
            help="Scenario, replay, boxes, report, metrics or bench file, or a log: a folder, or the file of a bag.",
        ),
    ],
    format: Format = "auto",
    sequence: SequenceName = None,
    quiet: Quiet = False,
) -> None:
    """Validate a file, or every record of a log.

    Exits with 3 and lists the problems, if there are any. Gaps between records are no problem; they are
    noted, and so is what a format lacks or its reader left out.

    Examples
    --------
    log2sim validate s.json
    log2sim validate samples/crossing
    """
    from log2sim.errors import LogError
    from log2sim.logs.opening import is_log_file, open_log

    if path.is_dir() or is_log_file(path):
        from log2sim.cli.progress import progress
        from log2sim.logs.native.reader import READER
        from log2sim.logs.validation import list_gaps, validate_log
        from log2sim.visualization.progress import VALIDATING

        opened = open_log(path, format=format, sequence=sequence)
        with progress(quiet=quiet) as report_progress:
            problems = validate_log(opened, progress=partial(report_progress, VALIDATING))
        # Those of native logs are among the problems.
        for note in () if opened.format == READER.name else opened.notes:
            say(f"note: {note}", quiet=quiet)
        for gap in list_gaps(opened):
            say(f"note: {gap}", quiet=quiet)
        if problems:
            raise LogError(f"{path}: {len(problems)} problem{'s' * (len(problems) > 1)}\n  " + "\n  ".join(problems))
    else:
        from log2sim.datatypes import Scenario
        from log2sim.errors import ScenarioError
        from log2sim.evaluation.detection.boxes import DetectedBoxes, is_boxes_document
        from log2sim.files.documents import check, read_json
        from log2sim.simulation.result import Replay

        document = read_json(path, ScenarioError)
        keys = document if isinstance(document, dict) else {}
        if "replay_version" in keys:
            Replay.load(path)
        elif "metrics_version" in keys:
            check(document, "metrics-1", ScenarioError)
        elif "detection_metrics_version" in keys:
            check(document, "detection-metrics-1", ScenarioError)
        elif is_boxes_document(document):
            DetectedBoxes.load(path)
        elif "report_version" in keys:
            check(document, "report-1", ScenarioError)
        elif "prediction_version" in keys:
            check(document, "prediction-1", ScenarioError)
        elif "bench_version" in keys:
            check(document, "bench-1", ScenarioError)
        else:
            Scenario.load(path)
    say(f"{path}: valid", quiet=quiet)
