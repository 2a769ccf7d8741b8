"""Error against run time over methods and settings."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli.options import ConfigFile, Format, LogPath, Overwrite, Quiet, Sequence, Settings, say

if TYPE_CHECKING:
    pass
from log2sim.cli.truth import truth_at


def bench(
    log: LogPath,
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder for bench.json and bench.png.")],
    truth: Annotated[
        Path | None,
        typer.Option(metavar="TRUTH", help="Scenario file, or a log with labels; LOG itself if it has any."),
    ] = None,
    detector: Annotated[
        list[str] | None, typer.Option(metavar="NAME|MODEL.onnx|labels", help="May be given several times to compare.")
    ] = None,
    format: Format = "auto",
    sequence: Sequence = None,
    cameras: Annotated[str | None, typer.Option(metavar="A,B", help="Use only these cameras.")] = None,
    range: Annotated[
        float | None, typer.Option(metavar="M", help="Compare only within so many meters of the ego.")
    ] = None,
    categories: Annotated[str | None, typer.Option(metavar="A,B", help="Compare only these, e.g. vehicle.")] = None,
    start: Annotated[float | None, typer.Option(help="First second.")] = None,
    stop: Annotated[float | None, typer.Option(help="Last second.")] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Draw error against run time over methods and settings."""
    from log2sim.cli.progress import progress
    from log2sim.config import Config
    from log2sim.documents import check_targets, write_json
    from log2sim.evaluation.bench.benchmark import bench as run
    from log2sim.evaluation.bench.document import document, format_table
    from log2sim.evaluation.bench.figure import write_picture
    from log2sim.evaluation.bench.scores import Scope
    from log2sim.logs.opening import open_log

    check_targets(out / "bench.json", out / "bench.png", overwrite=overwrite)
    changes: dict[str, Any] = {"cameras": cameras, "start_s": start, "stop_s": stop}
    if detector:
        changes["detect"] = {"name": detector[0]}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence)
    labeled = opened.labels is not None or (log / "truth.json").is_file()
    used = chosen.cameras or tuple(opened.cameras)
    known = truth_at(truth or log, used, sequence) if truth is not None or labeled else None
    scope = Scope(range, tuple(c.strip() for c in categories.split(",")) if categories else None)
    with progress(quiet=quiet) as tell:
        result = run(opened, chosen, truth=known, scope=scope, detectors=tuple(detector or ()), progress=tell)
    write_json(out / "bench.json", document(result))
    write_picture(result, out / "bench.png")
    say(format_table(result), quiet=quiet)
