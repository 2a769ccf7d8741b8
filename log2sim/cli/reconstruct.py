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
    camera_names,
    counted,
    say,
)

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.pipeline import Result


def reconstruct(
    log: LogPath,
    out: Annotated[Path, typer.Option("--out", metavar="FILE", help="Scenario file to write.")],
    format: Format = "auto",
    sequence: Sequence = None,
    detector: Annotated[
        str | None,
        typer.Option(
            metavar="NAME|MODEL.onnx|labels|lidar:NAME",
            help="Detector in images: ssd-mobilenet-v2, a path to an ONNX model, or labels (boxes of the log); in LiDAR "
            "sweeps: lidar:vehicle, lidar:roadside, lidar:MODEL.onnx, lidar:labels; both: NAME+lidar:NAME.",
        ),
    ] = None,
    cameras: Cameras = None,
    start: Annotated[float | None, typer.Option(help="First time to use, in s from the start of the log.")] = None,
    stop: Annotated[float | None, typer.Option(help="Last time to use, in s from the start of the log.")] = None,
    poses: Poses = None,
    fix_time: Annotated[
        bool, typer.Option("--fix-time", help="Correct stamps of sensors by the offsets that the log shows.")
    ] = False,
    fix_calibration: Annotated[
        bool, typer.Option("--fix-calibration", help="Correct mounts of sensors by the rotations that the log shows.")
    ] = False,
    ends: Annotated[
        str | None,
        typer.Option(
            metavar="both|vehicle|road", help="Use only the sensors on the vehicle, or only those at the road."
        ),
    ] = None,
    fusion: Annotated[
        str | None,
        typer.Option(
            metavar="points|boxes|tracks",
            help="What of the vehicle's and the road's LiDARs is joined, see log2sim config.",
        ),
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(help="Seed of all random numbers.")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Report file to write.")] = None,
    topdown: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Bird's-eye image of all cameras to write.")
    ] = None,
    no_cache: NoCache = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Reconstruct the scenario of a log."""
    from log2sim.cli.progress import progress
    from log2sim.config import Config
    from log2sim.documents import check_targets, write_json
    from log2sim.errors import ConfigError, MissingExtra
    from log2sim.logs.opening import open_log
    from log2sim.outputs import together
    from log2sim.pipeline import reconstruct as run
    from log2sim.sensors import IMAGE_DETECTOR, choose_detector

    check_targets(out, report, topdown, overwrite=overwrite)
    changes: dict[str, Any] = {"start_s": start, "stop_s": stop, "seed": seed}
    changes["cameras"] = None if cameras is None else camera_names(cameras)
    if detector is not None:
        changes["detect"] = {"name": detector}
    if poses is not None:
        changes["poses"] = {"source": poses}
    changes["cooperation"] = {k: v for k, v in (("ends", ends), ("fusion", fusion)) if v is not None}
    fixes = {"fix_time": fix_time, "fix_mounts": fix_calibration}
    changes["calibration"] = {name: True for name, chosen in fixes.items() if chosen}
    chosen = Config.load(config, settings or (), **changes)
    opened = open_log(log, format=format, sequence=sequence)
    if topdown is not None and not opened.cameras:
        raise ConfigError(f"--topdown: {opened.name}: the log has no camera, so there is no picture of the ground")
    for note in opened.notes:
        say(f"note: {note}", quiet=quiet)
    chosen = choose_detector(opened, chosen)
    if opened.cameras and not chosen.detect.in_images and detector is None:
        say(f"note: no image is searched: {MissingExtra(IMAGE_DETECTOR, 'coco')}", quiet=quiet)
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
    told = (*unused_records(result.report), *cache_notes(result.report), *feature_notes(result.scenario))
    notes = [f"note: {note}" for note in told]
    for line in (*notes, *doubt_lines(result.scenario), f"{out}: {_summary(result)}"):
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


def _summary(result: Result) -> str:
    counts, rate = result.report["agents"], result.report["ticks_per_second"]
    static, duration_s = counts["static"], result.scenario.duration_s
    agents = f"{counts['total']} agents ({static} static) over {duration_s:.1f} s"
    return ", ".join([agents, *described(result.scenario), f"{rate:.1f} ticks/s", *known_pictures(result.report)])


def known_pictures(report: dict[str, Any]) -> list[str]:
    """Say how many pictures were not searched, since an earlier run had done it."""
    cache = report["detection_cache"]
    found = 0 if cache is None else cache["found"]
    return [f"{counted(found, 'picture')} known from earlier runs"] if found else []


def cache_notes(report: dict[str, Any]) -> list[str]:
    """Say why detections were not kept, where they should have been."""
    cache = report["detection_cache"]
    return [f"detections are not kept for later runs: {cache['problem']}"] if cache and cache["problem"] else []


def described(scenario: Scenario) -> list[str]:
    """Count what was found beside the agents; nothing of what was not found or not looked for."""
    features = scenario.map_features
    counts = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
    counts.append((len(scenario.signals), "traffic light"))
    return [f"{count} {name}{'s' * (count != 1)}" for count, name in counts if count]


def feature_notes(scenario: Scenario) -> tuple[str, ...]:
    """Return what of the road is not there, and why."""
    return () if scenario.map_features is None else scenario.map_features.notes


def doubt_lines(scenario: Scenario) -> list[str]:
    """Say how many agents are doubtful and why the first ones are; no line without any. The report has all."""
    from log2sim.datatypes import list_doubtful, why_doubtful

    ego, others = scenario.ego, [agent for agent in scenario.others if agent.is_doubtful]
    lines = [f"the ego is doubtful: {why_doubtful(ego)}"] if ego is not None and ego.is_doubtful else []
    verb = "is" if len(others) == 1 else "are"
    count = f"{len(others)} of {len(scenario.others)} agents {verb} doubtful"
    return [*lines, f"{count}: {list_doubtful(others)}"] if others else lines


def pose_notes(poses: dict[str, Any]) -> list[str]:
    """Say which poses were used and why, and what is doubtful about them; nothing of the log's own where no others were asked for."""
    if poses["source"] == poses["requested"] == "given" or poses["source"] == "none":
        return []
    return [f"poses: {poses['source']} ({poses['reason']})", *(f"note: {note}" for note in poses["notes"])]


def fault_lines(faults: list[dict[str, Any]]) -> list[str]:
    """Say what is wrong with the sensors and poses of a log, a line for each fault."""
    return [f"note: {fault['sensor']}: {fault['message']}" for fault in faults]


def unused_records(report: dict[str, Any]) -> list[str]:
    """List what a run could not use of a log, a line for each stream."""
    unreadable = report["unreadable"].items()
    without_pose = report["without_pose"].items()
    return [
        *(f"{name}: {u['count']} records could not be read, first: {u['first']}" for name, u in unreadable),
        *(
            f"{name}: {count} frames skipped, since no ego pose is known at their stamps"
            for name, count in without_pose
        ),
    ]
