"""Reconstruct the scenario of a log."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli.options import (
    Cameras,
    ConfigFile,
    Format,
    LogPath,
    NoCache,
    Overwrite,
    Poses,
    Quiet,
    Sequence,
    Settings,
    Start,
    Stop,
    Verbose,
    camera_names,
    choose,
    complete_detectors,
    say,
    say_written,
    write_to,
)

if TYPE_CHECKING:
    from log2sim.pipeline import Result


def reconstruct(
    log: LogPath,
    out: Annotated[Path, write_to("FILE", "Scenario file to write.")],
    format: Format = "auto",
    sequence: Sequence = None,
    detector: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|MODEL.onnx|labels|lidar:NAME",
            help="Detector in images: ssd-mobilenet-v2, a path to an ONNX model, or labels (boxes of the log); in LiDAR "
            "sweeps: lidar:vehicle, lidar:roadside, lidar:MODEL.onnx, lidar:labels; both: NAME+lidar:NAME.",
            autocompletion=complete_detectors,
            show_default="ssd-mobilenet-v2+lidar:vehicle, or what of it the log and the installation allow",
        ),
    ] = None,
    cameras: Cameras = None,
    start: Start = None,
    stop: Stop = None,
    poses: Poses = None,
    static_for_all: Annotated[
        bool | None,
        typer.Option(
            "--static-for-all/--as-observed",
            help="Static agents exist all the time unless the log shows their place free, or only while observed.",
            show_default="--static-for-all",
        ),
    ] = None,
    fix_time: Annotated[
        bool, typer.Option("--fix-time", help="Correct stamps of sensors by the offsets that the log shows.")
    ] = False,
    fix_calibration: Annotated[
        bool, typer.Option("--fix-calibration", help="Correct mounts of sensors by the rotations that the log shows.")
    ] = False,
    ends: Annotated[
        str | None,
        choose(
            "--ends",
            "both",
            "vehicle",
            "road",
            default="both",
            help="Use only the sensors on the vehicle, or only those at the road.",
        ),
    ] = None,
    fusion: Annotated[
        str | None,
        choose(
            "--fusion",
            "points",
            "boxes",
            "tracks",
            default="see log2sim config",
            help="What of the vehicle's and the road's LiDARs is joined.",
        ),
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random numbers.", show_default="0")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Report file to write.")] = None,
    topdown: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Bird's-eye image of all cameras to write.")
    ] = None,
    no_cache: NoCache = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
    verbose: Verbose = False,
) -> None:
    """Reconstruct the scenario of a log.

    Examples
    --------
    log2sim reconstruct samples/crossing -o s.json
    log2sim reconstruct drive.mcap -o s.json --poses auto --stop 20
    log2sim reconstruct pandaset/ --sequence 002 --detector lidar:vehicle -o s.json
    """
    from log2sim.cli.progress import progress
    from log2sim.documents import check_targets, write_json
    from log2sim.outputs import together
    from log2sim.visualization.notebook.progress import OPENING

    check_targets(out, report, topdown, overwrite=overwrite)
    changes: dict[str, Any] = {"start_s": start, "stop_s": stop, "seed": seed}
    changes["cameras"] = None if cameras is None else camera_names(cameras)
    if detector is not None:
        changes["detect"] = {"name": detector}
    if static_for_all is not None:
        changes["track"] = {"static_for_all": static_for_all}
    if poses is not None:
        changes["poses"] = {"source": poses}
    changes["cooperation"] = {k: v for k, v in (("ends", ends), ("fusion", fusion)) if v is not None}
    fixes = {"fix_time": fix_time, "fix_mounts": fix_calibration}
    changes["calibration"] = {name: True for name, chosen in fixes.items() if chosen}
    with progress(quiet=quiet) as report_progress:
        report_progress(OPENING, 0, 0)
        from log2sim.cli.run_summary import cache_notes, fault_lines, look_line, pose_notes, summarize, unused_records
        from log2sim.config import Config
        from log2sim.errors import ConfigError, MissingExtra
        from log2sim.logs.opening import open_log
        from log2sim.perception.detect3d.network_detector import describe_weakness
        from log2sim.pipeline import reconstruct as run
        from log2sim.run_detectors import check_detectors
        from log2sim.sensors import IMAGE_DETECTOR, choose_detector

        chosen = Config.load(config, settings or (), **changes)
        check_detectors(chosen)
        opened = open_log(log, format=format, sequence=sequence)
    if topdown is not None and not opened.cameras:
        raise ConfigError(f"--topdown: {opened.name}: the log has no camera, so there is no picture of the ground")
    for note in opened.notes:
        say(f"note: {note}", quiet=quiet)
    chosen = choose_detector(opened, chosen)
    if opened.cameras and not chosen.detect.in_images and detector is None:
        say(f"note: no image is searched: {MissingExtra(IMAGE_DETECTOR, 'coco')}", quiet=quiet)
    if weakness := describe_weakness(chosen.detect.in_sweeps or ""):
        say(f"note: {weakness}", quiet=quiet)
    with progress(quiet=quiet) as report_progress:
        result = run(opened, chosen, progress=report_progress, cache=not no_cache)
    for line in (*pose_notes(result.report["poses"]), *fault_lines(result.report["faults"])):
        say(line, quiet=quiet)
    with together():
        if topdown is not None:
            _write_topdown(result, topdown, overwrite=overwrite)
        if report is not None:
            write_json(report, result.report)
        result.scenario.save(out)
    for note in (*unused_records(result.report), *cache_notes(result.report)):
        say(f"note: {note}", quiet=quiet)
    say_written(report, topdown, quiet=quiet)
    for line in summarize(result, look_line(log, sequence, out), out, verbose=verbose):
        say(line, quiet=quiet)


def _write_topdown(result: Result, path: Path, *, overwrite: bool) -> None:
    """Write the bird's-eye image of a run, and note in its report which records could not be read for it."""
    from log2sim.cli.background import CELL_M
    from log2sim.config_sections import MapConfig
    from log2sim.mapping.builder import map_ground
    from log2sim.mapping.files import write_map
    from log2sim.perception.frames import RecordReader

    reader = RecordReader(result.log)
    ground = map_ground(result.log, result.scenario, MapConfig(cell_m=CELL_M), reader)
    write_map(ground.around(ground.coverage), path, overwrite=overwrite)
    result.report["unreadable"] = {**reader.summary(), **result.report["unreadable"]}
