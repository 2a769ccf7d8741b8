"""Compare methods and settings by error and run time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from log2sim.cli.options import (
    ConfigFile,
    Format,
    LogPath,
    Overwrite,
    Quiet,
    SequenceName,
    Settings,
    Start,
    Stop,
    complete_detectors,
    option,
    report_written,
    say,
    write_to,
)


def bench(
    log: LogPath,
    out: Annotated[Path, write_to("DIR", "Folder for bench.json and bench.png.")],
    truth: Annotated[
        Path | None,
        option("Ground truth: a scenario file or a log with labels; default: LOG, if it has labels.", "TRUTH"),
    ] = None,
    detector: Annotated[
        list[str] | None,
        option(
            "Detector, see reconstruct; repeat the option to compare several.",
            "NAME|MODEL.onnx|labels",
            completes=complete_detectors,
        ),
    ] = None,
    format: Format = "auto",
    sequence: SequenceName = None,
    cameras: Annotated[str | None, option("Use only these cameras.", "A,B")] = None,
    range: Annotated[float | None, option("Compare agents up to this distance from the ego, in m.", "M")] = None,
    categories: Annotated[str | None, option("Compare only these categories or groups, e.g. vehicle.", "A,B")] = None,
    start: Start = None,
    stop: Stop = None,
    config: ConfigFile = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Compare methods and settings by error and run time.

    Examples
    --------
    log2sim bench samples/crossing -o bench/
    log2sim bench samples/crossing --detector labels --detector lidar:vehicle -o bench/
    """
    from log2sim.cli.progress import progress
    from log2sim.config import Config
    from log2sim.evaluation.bench.benchmark import bench as run
    from log2sim.evaluation.bench.benchmark import bench_document, format_benchmark, write_picture
    from log2sim.evaluation.bench.scores import ScoreScope
    from log2sim.evaluation.metrics.truth import truth_at
    from log2sim.files.documents import check_targets, write_json
    from log2sim.files.outputs import together
    from log2sim.localization.choice import localize
    from log2sim.logs.opening import open_log

    check_targets(out / "bench.json", out / "bench.png", overwrite=overwrite)
    changes: dict[str, Any] = {"cameras": cameras, "start_s": start, "stop_s": stop}
    if detector:
        changes["detect"] = {"name": detector[0]}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence)
    opened, choice = localize(opened, chosen)
    labeled = opened.labels is not None or (log / "truth.json").is_file()
    made = {"poses": choice.to_provenance()}
    used = chosen.cameras or tuple(opened.cameras)
    known = truth_at(truth or log, used, sequence, provenance=made) if truth is not None or labeled else None
    scope = ScoreScope(range, tuple(c.strip() for c in categories.split(",")) if categories else None)
    with progress(quiet=quiet) as report_progress:
        result = run(
            opened, chosen, truth=known, scope=scope, detectors=tuple(detector or ()), progress=report_progress
        )
    with together():
        write_json(out / "bench.json", bench_document(result))
        write_picture(result, out / "bench.png")
    say(format_benchmark(result), quiet=quiet)
    report_written(out / "bench.json", out / "bench.png", quiet=quiet)
