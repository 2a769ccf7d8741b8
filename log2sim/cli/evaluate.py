"""Comparisons with the ground truth: of a scenario or boxes, and of methods and settings."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError, LogError, ScenarioError
from log2sim.files.outputs import together

PROTOCOL = "center"


def evaluate(
    path: Annotated[Path, typer.Argument(
        metavar="FILE_OR_DIR", help="A scenario.json, a boxes.json of `detect`, or the folder of a `batch`.")],
    truth: Annotated[Path, opt.option(
        "Ground truth: a log with labels or, for a scenario, a scenario file; of a batch the folder with its logs.",
        "TRUTH")],
    labels: opt.LabelFile = None,
    sequence: opt.SequenceName = None,
    poses: opt.Poses = None,
    range: opt.Range = None,
    categories: opt.Categories = None,
    protocol: Annotated[str | None, opt.option(
        "Of boxes: KITTI's classes, difficulties and IoU; DAIR-V2X's classes and IoU; or distance of centers "
        "(nuScenes).", "kitti|dair|center", completes=opt.complete("kitti", "dair", "center"),
        default=PROTOCOL)] = None,
    score: Annotated[float | None, opt.option(
        "Of boxes: score from which precision and recall count them.", "S", default="0.5")] = None,
    plot: Annotated[Path | None, opt.option(
        "Reliability diagram of confidences or scores to write.", "FILE.png")] = None,
    out: Annotated[Path | None, opt.write_to("FILE", "Metrics file to write.")] = None,
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Compare a scenario, or detected boxes, with the ground truth.

    Examples
    --------
    log2sim evaluate s.json --truth samples/crossing --range 40
    log2sim evaluate s.json --truth drive.bag --labels label_02.txt
    log2sim evaluate boxes.json --truth kitti_tracking/ --sequence 0000 --protocol kitti
    """
    from log2sim.datatypes import Scenario
    from log2sim.evaluation.detection.boxes import is_boxes_document
    from log2sim.evaluation.metrics.evaluator import evaluate as run
    from log2sim.evaluation.metrics.evaluator import select_categories
    from log2sim.evaluation.metrics.table import format_table, format_verdict
    from log2sim.evaluation.metrics.truth import load_truth
    from log2sim.files.documents import check_targets, read_json, write_json

    check_targets(out, plot, overwrite=overwrite)
    wanted = list(opt.split_names(categories)) or None
    only_boxes = {"--protocol": protocol, "--score": score}
    if path.is_dir():
        only_files = {**only_boxes, "--sequence": sequence, "--poses": poses, "--plot": plot, "--labels": labels}
        for name in (name for name, value in only_files.items() if value is not None):
            raise ConfigError(f"{name}: is for single files; {path} is a folder, so leave it out")
        from log2sim.batch.evaluation import evaluate_batch, format_batch_table, format_batch_verdict
        from log2sim.batch.folder import BatchFolder, is_batch

        if not is_batch(path):
            raise LogError(
                f"{path}: is a folder, but of no batch; give a file, or the folder that `log2sim batch` wrote"
            )
        with progress() as report_progress:
            result = evaluate_batch(
                BatchFolder.load(path), truth,
                lambda log, scenario: load_truth(log.path, scenario, sequence=log.sequence, points=True),
                max_range_m=range, categories=wanted, progress=partial(report_progress, "logs"),
            )  # fmt: skip
        table = format_batch_verdict(result)
        table += f"\n\n{format_batch_table(result)}" if verbose else ""
    elif is_boxes_document(document := read_json(path, ScenarioError)):
        from log2sim.evaluation.detection.boxes import DetectedBoxes
        from log2sim.evaluation.detection.evaluation import DEFAULT_SCORE, DetectionOptions, evaluate_boxes
        from log2sim.evaluation.detection.evaluation import format_table as boxes_table
        from log2sim.evaluation.detection.evaluation import format_verdict as boxes_verdict
        from log2sim.localization.choice import localize_like
        from log2sim.logs.opening import is_log_file, open_log

        options = DetectionOptions(protocol or PROTOCOL, DEFAULT_SCORE if score is None else score, range, wanted)
        options.chosen()  # what is wrong with them is said before anything is read
        try:
            detected = DetectedBoxes.from_dict(document)
        except LogError as error:
            raise LogError(f"{path}: {error}") from None
        with progress() as report_progress:
            if truth.is_file() and not is_log_file(truth):
                raise LogError(f"{truth}: is a file and no log; the truth of boxes is a log with labels")
            labeled = open_log(truth, sequence=sequence, labels=labels)
            labeled = localize_like(labeled, _stated(document.get("poses"), poses))
            result = evaluate_boxes(detected, labeled, options, progress=partial(report_progress, "count points"))
        table = boxes_verdict(result) + (f"\n\n{boxes_table(result)}" if verbose else "")
    else:
        select_categories(wanted)  # reports an unknown one before a log is read
        for name in (name for name, value in only_boxes.items() if value is not None):
            raise ConfigError(f"{name}: is for boxes of `log2sim detect`; {path} is no boxes file, so leave it out")
        scenario = Scenario.load(path)
        if poses is not None:
            stated = _stated(scenario.provenance.get("poses"), poses)
            scenario = replace(scenario, provenance={**scenario.provenance, **stated})
        with progress() as report_progress:
            known = load_truth(
                truth, scenario, sequence=sequence, labels=labels, points=True,
                progress=partial(report_progress, "count points"),
            )  # fmt: skip
        opt.say_all("note", known.provenance.get("notes", ()) if labels is not None else ())
        result = run(scenario, known, max_range_m=range, categories=wanted)
        made_with = scenario.provenance.get("poses")
        source = made_with.get("source") if isinstance(made_with, dict) else None
        # A truth in a file of its own cannot be placed by the estimated poses.
        unplaced = truth.suffix == ".json" or (truth / "truth.json").is_file()
        if result["placement"]["method"] == "same_map" and source in ("lidar", "camera") and unplaced:
            differ = "what the two maps differ by counts as error"
            opt.tell(f"note: the scenario's poses are estimated ({source}), {truth} has its own: {differ}")
        table = format_verdict(result) + (f"\n\n{format_table(result)}" if verbose else "")
    with together():
        if out is not None:
            write_json(out, result)
        if plot is not None:
            from log2sim.visualization.plot.reliability import write_reliability

            write_reliability(result, plot)
    opt.tell(table)
    opt.report_written(out, plot)


def _stated(made_with: Any, requested: str | None) -> dict[str, Any]:
    """Return the provenance of poses: as stated by what is evaluated, or as requested."""
    from log2sim.config import PosesConfig

    if requested is None or requested == "auto":
        return {} if made_with is None else {"poses": made_with}
    if requested not in PosesConfig.choices("source"):
        raise ConfigError(f"--poses {requested}: expected {', '.join(PosesConfig.choices('source'))}")
    return {"poses": {**(made_with if isinstance(made_with, dict) else {}), "source": requested}}


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
) -> None:  # fmt: skip
    """Compare methods and settings by error and run time.

    Examples
    --------
    log2sim bench samples/crossing -o bench/
    log2sim bench samples/crossing --detector labels --detector lidar:vehicle -o bench/
    """
    from log2sim.evaluation.bench.benchmark import bench as run
    from log2sim.evaluation.bench.benchmark import bench_document, format_benchmark, write_picture
    from log2sim.evaluation.bench.scores import ScoreScope
    from log2sim.evaluation.metrics.truth import truth_at
    from log2sim.files.documents import check_targets, write_json
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
    with progress() as report_progress:
        others = tuple(detector or ())
        result = run(opened, chosen, truth=known, scope=scope, detectors=others, progress=report_progress)
    with together():
        write_json(out / "bench.json", bench_document(result))
        write_picture(result, out / "bench.png")
    opt.tell(format_benchmark(result))
    opt.report_written(out / "bench.json", out / "bench.png")
