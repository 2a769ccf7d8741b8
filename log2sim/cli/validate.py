"""Validate files and logs."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from log2sim.cli import options as opt

SCHEMAS = {
    f"{name.replace('-', '_')}_version": f"{name}-1"
    for name in ("metrics", "detection-metrics", "report", "prediction", "bench")
}


def validate(
    path: Annotated[Path, typer.Argument(
        metavar="FILE_OR_LOG",
        help="Scenario, replay, boxes, report, metrics or bench file, or a log: a folder, or the file of a bag.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
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
        notes = () if opened.format == READER.name else opened.notes
        opt.say_all("note", [*notes, *list_gaps(opened)], quiet=quiet)
        if problems:
            raise LogError(f"{path}: {opt.counted(len(problems), 'problem')}\n  " + "\n  ".join(problems))
    else:
        from log2sim.datatypes import Scenario
        from log2sim.errors import ScenarioError
        from log2sim.evaluation.detection.boxes import DetectedBoxes, is_boxes_document
        from log2sim.files.documents import check, read_json
        from log2sim.simulation.result import Replay

        document = read_json(path, ScenarioError)
        keys = document if isinstance(document, dict) else {}
        schema = next((name for key, name in SCHEMAS.items() if key in keys), None)
        if schema is not None:
            check(document, schema, ScenarioError)
        elif "replay_version" in keys:
            Replay.load(path)
        elif is_boxes_document(document):
            DetectedBoxes.load(path)
        else:
            Scenario.load(path)
    opt.say(f"{path}: valid", quiet=quiet)
