"""Reconstruct the scenario of a log."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import replace
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
    SequenceName,
    Settings,
    Start,
    Stop,
    Verbose,
    camera_names,
    choose,
    complete_detectors,
    counted,
    report_written,
    say,
    write_to,
)

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.datatypes.findings import Finding
    from log2sim.report import Result


# Stages without which something is missing in a scenario; the others save time.
LOOKED_FOR = (
    "image decoding",
    "detection in LiDAR sweeps",
    "markings and lanes",
    "colors of vehicles",
    "traffic lights",
)


def summarize_run(result: Result, next_line: str, out: Path, *, verbose: bool = False) -> list[str]:
    """Summarize a run for people; with `verbose` everything is listed, also which stages were left out."""
    from log2sim.cli.shared import format_rows
    from log2sim.datatypes import count_agents, count_categories

    scenario, seconds = result.scenario, result.report["seconds"]
    ids = count_agents(agent.id for agent in scenario.agents)
    speed = f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    rows = [
        ("agents", count_categories(scenario.others) or "none"),
        *(("doubtful", line) for line in doubt_lines(scenario, result.findings, verbose=verbose) or ["none"]),
        ("road", ", ".join(described(scenario)) or "no lanes, markings or traffic lights"),
        *(("missing", line) for line in missing_lines(scenario)),
        *(("used", line) for line in (stage_lines(scenario) if verbose else ())),
    ]
    names = [name if k == 0 or rows[k - 1][0] != name else "" for k, (name, _) in enumerate(rows)]
    table = format_rows([(name, text) for name, (_, text) in zip(names, rows)], indent=2)
    made = ", ".join([f"made in {speed}", *known_ticks(result.report)])
    # Never broken into lines: it is there to be copied.
    return [
        f"{out}: {ids} over {scenario.duration_s:.1f} s, {made}",
        *table,
        f"  {'next':<{len('doubtful')}}  {next_line}",
    ]


def known_ticks(report: dict[str, Any]) -> list[str]:
    """Say how many ticks were not looked at, since an earlier run had done it."""
    cache = report["detection_cache"]
    found = 0 if cache is None else cache["found"]
    return [f"{counted(found, 'tick')} known from earlier runs"] if found else []


def described(scenario: Scenario) -> list[str]:
    """Count what was found beside the agents; nothing of what was not found or not looked for."""
    features = scenario.map_features
    counts = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
    counts.append((len(scenario.signals), "traffic light"))
    return [counted(count, name) for count, name in counts if count]


def doubt_lines(scenario: Scenario, findings: Sequence[Finding], *, verbose: bool = False) -> list[str]:
    """Say how many agents are doubtful and why the first ones are, or all, and what of the sensors may be the cause; or nothing."""
    from log2sim.datatypes import explain_doubt, list_doubtful
    from log2sim.datatypes.agent import MAX_LISTED
    from log2sim.datatypes.findings import KINDS

    ego, others = scenario.ego, [agent for agent in scenario.others if agent.is_doubtful]
    lines = [f"the ego: {explain_doubt(ego)}"] if ego is not None and ego.is_doubtful else []
    if not others:
        return lines
    named = list_doubtful(others, None if verbose else MAX_LISTED)
    gone = [agent for agent in others if agent.quarantined]
    quarantined = f"not in replays and exports: {', '.join(a.id for a in gone)} (quarantined)"
    options = {KINDS[f.kind].option for f in findings if f.kind in KINDS and f.treatment != "corrected"} - {""}
    return [
        *lines,
        f"{len(others)} of {counted(len(scenario.others), 'agent')}: {named}",
        *([quarantined] if gone else []),
        *([f"perhaps since sensors are off (see the notes): try {' '.join(sorted(options))}"] if options else []),
    ]


def missing_lines(scenario: Scenario) -> list[str]:
    """Say what a scenario lacks and why: what was not looked for, by reason, and what of the road was not found."""
    left_out: dict[str, list[str]] = {}
    for stage in scenario.stages:
        if stage["stage"] in LOOKED_FOR and not stage["kept"]:
            left_out.setdefault(str(stage["reason"]), []).append(str(stage["stage"]))
    features = scenario.map_features
    notes = () if features is None else features.notes
    return [*(f"{', '.join(stages)}: {reason}" for reason, stages in left_out.items()), *notes]


def stage_lines(scenario: Scenario) -> list[str]:
    """Say of every stage whether it was run, and why."""
    return [f"{'with' if stage['kept'] else 'no'} {stage['stage']}: {stage['reason']}" for stage in scenario.stages]


def view_command(log: Path, sequence: str | None, out: Path) -> str:
    """Return the command that shows the scenario with the pictures and the ground of its log."""
    chosen = [] if sequence is None else ["--sequence", sequence]
    page = str(out.with_suffix(".html"))
    return shlex.join(["log2sim", "view", str(out), "--log", str(log), *chosen, "-o", page])


def pose_lines(poses: dict[str, Any]) -> list[str]:
    """Say which poses were used and why; nothing of the log's own where no others were asked for."""
    own = poses["source"] == "none" or poses["source"] == poses["requested"] == "given"
    return [] if own else [f"poses: {poses['source']} ({poses['reason']})"]


def reconstruct(
    log: LogPath,
    out: Annotated[Path, write_to("FILE", "Scenario file to write.")],
    format: Format = "auto",
    sequence: SequenceName = None,
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
    corrections: Annotated[
        Path | None,
        typer.Option(metavar="FILE.json", help="Corrections by hand to apply to the result, see log2sim correct."),
    ] = None,
    config: ConfigFile = None,
    settings: Settings = None,
    seed: Annotated[int | None, typer.Option(metavar="N", help="Seed of all random numbers.", show_default="0")] = None,
    report: Annotated[Path | None, typer.Option(metavar="FILE.json", help="Report file to write.")] = None,
    topdown: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Bird's-eye image of all cameras to write.")
    ] = None,
    jobs: Annotated[
        int | None,
        typer.Option(
            "--jobs",
            metavar="N",
            min=1,
            help="Processes that share the ticks; the result is the same for any number.",
            show_default="the usable cores",
        ),
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
    from log2sim.files.documents import check_targets, write_json
    from log2sim.files.outputs import together
    from log2sim.visualization.progress import OPENING

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
        from log2sim.config import Config
        from log2sim.edit.corrections import correct, load_corrections
        from log2sim.errors import ConfigError, MissingExtra
        from log2sim.logs.opening import open_log
        from log2sim.perception.detect3d.detectors import describe_weakness
        from log2sim.perception.run_detectors import check_detectors
        from log2sim.pipeline import reconstruct as run
        from log2sim.plan import IMAGE_DETECTOR, choose_detector
        from log2sim.report import unused_records

        chosen = Config.load(config, settings or (), **changes)
        by_hand = None if corrections is None else load_corrections(corrections)
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
        result = run(opened, chosen, progress=report_progress, cache=not no_cache, jobs=jobs)
    if by_hand is not None:
        corrected = correct(result.scenario, by_hand)
        result = replace(result, scenario=corrected.scenario)
        for line in corrected.unmatched:
            say(f"warning: {line}", quiet=quiet)
    with together():
        if topdown is not None:
            _write_topdown(result, topdown, overwrite=overwrite)
        if report is not None:
            write_json(report, result.report)
        result.scenario.save(out)
    findings = (*result.findings, *unused_records(result.report))
    for line in (*pose_lines(result.report["poses"]), *(f"note: {finding}" for finding in findings)):
        say(line, quiet=quiet)
    report_written(report, topdown, quiet=quiet)
    for line in summarize_run(result, view_command(log, sequence, out), out, verbose=verbose):
        say(line, quiet=quiet)


def _write_topdown(result: Result, path: Path, *, overwrite: bool) -> None:
    """Write the bird's-eye image of a run, and note in its report which records could not be read for it."""
    from log2sim.cli.layers import CELL_M
    from log2sim.config import MapConfig
    from log2sim.perception.records import RecordSource
    from log2sim.road.builder import map_ground
    from log2sim.road.map_files import write_map

    records = RecordSource(result.log)
    ground = map_ground(result.log, result.scenario, MapConfig(cell_m=CELL_M), records)
    write_map(ground.around(ground.coverage), path, overwrite=overwrite)
    result.report["unreadable"] = {**records.summary(), **result.report["unreadable"]}
