"""Detect road users in the LiDAR sweeps of a log."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

from log2sim.cli import options as opt


def detect(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("FILE", "Boxes file to write.")],
    detector: Annotated[str, opt.option(
        "Detector in LiDAR sweeps: lidar:vehicle, lidar:roadside, lidar:MODEL.onnx, or lidar:labels (boxes of "
        "the log).", "lidar:NAME|lidar:MODEL.onnx",
        completes=opt.complete_plugins("lidar_detector", prefix="lidar:"))] = "lidar:vehicle",
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    start: opt.Start = None,
    stop: opt.Stop = None,
    poses: opt.Poses = None,
    labels: opt.LabelFile = None,
    config: opt.ConfigFile = None,
    settings: opt.Settings = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:  # fmt: skip
    """Detect road users in the LiDAR sweeps of a log.

    Examples
    --------
    log2sim detect samples/crossing -o boxes.json
    log2sim detect kitti_object/ --detector lidar:MODEL.onnx -o boxes.json
    log2sim detect LOG --detector lidar:labels --labels openlabel.json -o boxes.json
    """
    from log2sim.cli.progress import progress
    from log2sim.cli.reconstruct import pose_reasons
    from log2sim.evaluation.detection.detect_log import detect_log
    from log2sim.files.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.perception.detect3d.detectors import describe_weakness

    check_targets(out, overwrite=overwrite)
    chosen = opt.load_config(config, settings, detector=detector, poses=poses, start_s=start, stop_s=stop)
    opened = open_log(log, format=format, sequence=sequence, labels=labels)
    weakness = describe_weakness(detector)
    opt.say_all("note", [*opened.notes, *([weakness] if weakness else [])], quiet=quiet)
    with progress(quiet=quiet) as report_progress:
        result = detect_log(opened, chosen, progress=partial(report_progress, "detect"))
    result.found.save(out)
    opt.say_all("poses", pose_reasons(result.poses.to_dict()), quiet=quiet)
    opt.say_all("note", result.findings, quiet=quiet)
    if result.left_out:
        opt.say(f"note: {opt.counted(result.left_out, 'sweep')} left out, without points or a known pose", quiet=quiet)
    boxes = sum(len(found) for found in result.found.boxes)
    words = f"{boxes} box{'es' * (boxes != 1)} in {opt.counted(len(result.found.t_ns), 'sweep')}"
    opt.say(f"{out}: {words} by {result.found.detector}", quiet=quiet)
