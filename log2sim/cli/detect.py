"""Detect road users in the LiDAR sweeps of a log."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

from log2sim.cli.options import (
    ConfigFile,
    Format,
    LabelFile,
    LogPath,
    Overwrite,
    Poses,
    Quiet,
    SequenceName,
    Settings,
    Start,
    Stop,
    complete_plugins,
    counted,
    option,
    say,
    write_to,
)


def detect(
    log: LogPath,
    out: Annotated[Path, write_to("FILE", "Boxes file to write.")],
    detector: Annotated[
        str,
        option(
            "Detector in LiDAR sweeps: lidar:vehicle, lidar:roadside, lidar:MODEL.onnx, or lidar:labels (boxes of "
            "the log).",
            "lidar:NAME|lidar:MODEL.onnx",
            completes=complete_plugins("lidar_detector", prefix="lidar:"),
        ),
    ] = "lidar:vehicle",
    format: Format = "auto",
    sequence: SequenceName = None,
    start: Start = None,
    stop: Stop = None,
    poses: Poses = None,
    labels: LabelFile = None,
    config: ConfigFile = None,
    settings: Settings = None,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Detect road users in the LiDAR sweeps of a log.

    Examples
    --------
    log2sim detect samples/crossing -o boxes.json
    log2sim detect kitti_object/ --detector lidar:MODEL.onnx -o boxes.json
    log2sim detect LOG --detector lidar:labels --labels openlabel.json -o boxes.json
    """
    from log2sim.cli.progress import progress
    from log2sim.cli.reconstruct import pose_lines
    from log2sim.config import Config
    from log2sim.evaluation.detection.detect_log import detect_log
    from log2sim.files.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.perception.detect3d.detectors import describe_weakness

    check_targets(out, overwrite=overwrite)
    changes: dict[str, Any] = {"start_s": start, "stop_s": stop, "detect": {"name": detector}}
    if poses is not None:
        changes["poses"] = {"source": poses}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence, labels=labels)
    for note in opened.notes:
        say(f"note: {note}", quiet=quiet)
    if weakness := describe_weakness(detector):
        say(f"note: {weakness}", quiet=quiet)
    with progress(quiet=quiet) as report_progress:
        result = detect_log(opened, chosen, progress=partial(report_progress, "detect"))
    result.found.save(out)
    for line in (*pose_lines(result.poses.to_dict()), *(f"note: {finding}" for finding in result.findings)):
        say(line, quiet=quiet)
    if result.left_out:
        say(f"note: {counted(result.left_out, 'sweep')} left out, without points or a known pose", quiet=quiet)
    boxes = sum(len(found) for found in result.found.boxes)
    words = f"{boxes} box{'es' * (boxes != 1)} in {counted(len(result.found.t_ns), 'sweep')}"
    say(f"{out}: {words} by {result.found.detector}", quiet=quiet)
