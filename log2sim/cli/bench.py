"""Compare methods and settings by error and run time."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt


def bench(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("DIR", "Folder for bench.json and bench.png.")],
    truth: Annotated[Path | None, opt.option(
        "Ground truth: a scenario file or a log with labels; default: LOG, if it has labels.", "TRUTH")] = None,
    detector: Annotated[list[str] | None, opt.option(
        "Detector, see reconstruct; repeat the option to compare several.", "NAME|MODEL.onnx|labels",
        completes=opt.complete_detectors)] = None,
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    cameras: opt.Cameras = None,
    range: opt.Range = None,
    categories: opt.Categories = None,
    start: opt.Start = None,
    stop: opt.Stop = None,
    config: opt.ConfigFile = None,
    settings: opt.Settings = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Compare methods and settings by error and run time.

    Examples
    --------
    log2sim bench samples/crossing -o bench/
    log2sim bench samples/crossing --detector labels --detector lidar:vehicle -o bench/
    """
    from log2sim.cli.progress import progress
    from log2sim.evaluation.bench.benchmark import bench as run
    from log2sim.evaluation.bench.benchmark import bench_document, format_benchmark, write_picture
    from log2sim.evaluation.bench.scores import ScoreScope
    from log2sim.evaluation.metrics.truth import truth_at
    from log2sim.files.documents import check_targets, write_json
    from log2sim.files.outputs import together
    from log2sim.localization.choice import localize
    from log2sim.logs.opening import open_log

    check_targets(out / "bench.json", out / "bench.png", overwrite=overwrite)
    names = None if cameras is None else opt.camera_names(cameras)
    first = detector[0] if detector else None
    chosen = opt.load_config(config, settings, detector=first, cameras=names, start_s=start, stop_s=stop)
    opened = open_log(log, format=format, sequence=sequence)
    opened, choice = localize(opened, chosen)
    labeled = opened.labels is not None or (log / "truth.json").is_file()
    made = {"poses": choice.to_provenance()}
    used = chosen.cameras or tuple(opened.cameras)
    known = truth_at(truth or log, used, sequence, provenance=made) if truth is not None or labeled else None
    scope = ScoreScope(range, opt.split_names(categories) or None)
    with progress(quiet=quiet) as report_progress:
        result = run(
            opened, chosen, truth=known, scope=scope, detectors=tuple(detector or ()), progress=report_progress
        )
    with together():
        write_json(out / "bench.json", bench_document(result))
        write_picture(result, out / "bench.png")
    opt.say(format_benchmark(result), quiet=quiet)
    opt.report_written(out / "bench.json", out / "bench.png", quiet=quiet)
