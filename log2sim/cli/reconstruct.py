"""Scenarios of logs: of one, or of all below a folder."""

from __future__ import annotations

import shlex
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError, LogsFailed, MissingExtra
from log2sim.files.outputs import together
from log2sim.visualization.progress import OPENING

if TYPE_CHECKING:
    from log2sim.datatypes import Scenario
    from log2sim.datatypes.findings import Finding
    from log2sim.report import Result


# Stages without which something is missing in a scenario; the others save time.
LOOKED_FOR = (
    "image decoding", "detection in LiDAR sweeps", "markings and lanes", "colors of vehicles", "traffic lights",
)  # fmt: skip


def summarize_run(result: Result, next_line: str, out: Path, *, verbose: bool = False) -> list[str]:
    """Summarize a run for people; with `verbose` everything is listed, also which stages were left out."""
    from log2sim.datatypes import count_agents, count_categories

    scenario, seconds = result.scenario, result.report["seconds"]
    ids = count_agents(agent.id for agent in scenario.agents)
    speed = f"{seconds:.1f} s" if seconds < 10 else f"{seconds:.0f} s"
    # What was found beside the agents; nothing of what was not found or not looked for.
    features = scenario.map_features
    counts = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
    counts.append((len(scenario.signals), "traffic light"))
    road = ", ".join(opt.counted(count, name) for count, name in counts if count)
    # What was not looked for, by reason, and what of the road was not found.
    left_out: dict[str, list[str]] = {}
    for stage in scenario.stages:
        if stage["stage"] in LOOKED_FOR and not stage["kept"]:
            left_out.setdefault(str(stage["reason"]), []).append(str(stage["stage"]))
    missing = [f"{', '.join(stages)}: {reason}" for reason, stages in left_out.items()]
    rows = [
        ("agents", count_categories(scenario.others) or "none"),
        *(("doubtful", line) for line in doubt_lines(scenario, result.findings, verbose=verbose) or ["none"]),
        ("road", road or "no lanes, markings or traffic lights"),
        *(("missing", line) for line in (*missing, *(() if features is None else features.notes))),
    ]
    if verbose:
        stages = [f"{'with' if s['kept'] else 'no'} {s['stage']}: {s['reason']}" for s in scenario.stages]
        rows += [("used", line) for line in stages]
    names = [name if k == 0 or rows[k - 1][0] != name else "" for k, (name, _) in enumerate(rows)]
    table = opt.format_rows([(name, text) for name, (_, text) in zip(names, rows)], indent=2)
    known = (result.report["detection_cache"] or {"found": 0})["found"]
    made = f"made in {speed}" + (f", {opt.counted(known, 'tick')} known from earlier runs" if known else "")
    # Never broken into lines: it is there to be copied.
    return [
        f"{out}: {ids} over {scenario.duration_s:.1f} s, {made}",
        *table,
        f"  {'next':<{len('doubtful')}}  {next_line}",
    ]


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
        f"{len(others)} of {opt.counted(len(scenario.others), 'agent')}: {named}",
        *([quarantined] if gone else []),
        *([f"perhaps since sensors are off (see the notes): try {' '.join(sorted(options))}"] if options else []),
    ]


def pose_reasons(poses: dict[str, Any]) -> list[str]:
    """Say which poses were used and why; nothing of the log's own where no others were asked for."""
    own = poses["source"] == "none" or poses["source"] == poses["requested"] == "given"
    return [] if own else [f"{poses['source']} ({poses['reason']})"]


def reconstruct(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("FILE", "Scenario file to write.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    detector: Annotated[str | None, opt.option(
        "Detector in images: ssd-mobilenet-v2, a path to an ONNX model, or labels (boxes of the log); in LiDAR sweeps: "
        "lidar:vehicle, lidar:roadside, lidar:MODEL.onnx, lidar:labels; both: NAME+lidar:NAME.",
        "NAME|MODEL.onnx|labels|lidar:NAME", completes=opt.complete_detectors,
        default="ssd-mobilenet-v2+lidar:vehicle, or what of it the log and the installation allow")] = None,
    cameras: opt.Cameras = None,
    start: opt.Start = None,
    stop: opt.Stop = None,
    poses: opt.Poses = None,
    static_for_all: Annotated[bool | None, opt.option(
        "Static agents exist all the time unless the log shows their place free, or only while observed.", None,
        "--static-for-all/--as-observed", default="--static-for-all")] = None,
    fix_time: Annotated[bool, opt.option(
        "Correct stamps of sensors by the offsets that the log shows.", None, "--fix-time")] = False,
    fix_calibration: Annotated[bool, opt.option(
        "Correct mounts of sensors by the rotations that the log shows.", None, "--fix-calibration")] = False,
    ends: Annotated[str | None, opt.choose(
        "--ends", "both|vehicle|road", "Use only the sensors on the vehicle, or only those at the road.",
        default="both")] = None,
    fusion: Annotated[str | None, opt.choose(
        "--fusion", "points|boxes", "What of the vehicle's and the road's LiDARs is joined.",
        default="see log2sim config")] = None,
    corrections: Annotated[Path | None, opt.option(
        "Corrections by hand to apply to the result, see log2sim correct.", "FILE.json")] = None,
    config: opt.ConfigFile = None,
    settings: opt.Settings = None,
    seed: Annotated[int | None, opt.option("Seed of all random numbers.", "N", default="0")] = None,
    report: Annotated[Path | None, opt.option("Report file to write.", "FILE.json")] = None,
    topdown: Annotated[Path | None, opt.option("Bird's-eye image of all cameras to write.", "FILE.png")] = None,
    jobs: Annotated[int | None, opt.option(
        "Processes that share the work; the result is the same for any number.", "N", min=1,
        default="the usable cores")] = None,
    scheduler: Annotated[str | None, opt.option(
        "Detect and measure on the workers of this Dask scheduler, which see the same folders.", "tcp://HOST:PORT")] = None,
    no_cache: opt.NoCache = False,
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Reconstruct the scenario of a log.

    Examples
    --------
    log2sim reconstruct samples/crossing -o s.json
    log2sim reconstruct drive.mcap -o s.json --poses auto --stop 20
    log2sim reconstruct pandaset/ --sequence 002 --detector lidar:vehicle -o s.json
    """
    from log2sim.files.documents import check_targets, write_json

    check_targets(out, report, topdown, overwrite=overwrite)
    fixes = {"fix_time": fix_time, "fix_mounts": fix_calibration}
    changes: dict[str, Any] = {
        "cameras": None if cameras is None else opt.camera_names(cameras), "start_s": start, "stop_s": stop,
        "seed": seed, "track": None if static_for_all is None else {"static_for_all": static_for_all},
        "cooperation": {k: v for k, v in (("ends", ends), ("fusion", fusion)) if v is not None},
        "calibration": {name: True for name, chosen in fixes.items() if chosen},
    }  # fmt: skip
    with progress() as report_progress:
        report_progress(OPENING, 0, 0)
        from log2sim.edit.corrections import correct, load_corrections
        from log2sim.logs.opening import open_log
        from log2sim.perception.detect3d.detectors import describe_weakness
        from log2sim.perception.run_detectors import check_detectors
        from log2sim.pipeline import reconstruct as run
        from log2sim.plan import IMAGE_DETECTOR, choose_detector
        from log2sim.report import unused_records

        chosen = opt.load_config(config, settings, detector=detector, poses=poses, **changes)
        by_hand = None if corrections is None else load_corrections(corrections)
        check_detectors(chosen)
        opened = open_log(log, format=format, sequence=sequence)
    if topdown is not None and not opened.cameras:
        raise ConfigError(f"--topdown: {opened.name}: the log has no camera, so there is no picture of the ground")
    chosen, notes = choose_detector(opened, chosen), list(opened.notes)
    if opened.cameras and not chosen.detect.in_images and detector is None:
        notes.append(f"no image is searched: {MissingExtra(IMAGE_DETECTOR, 'coco')}")
    if weakness := describe_weakness(chosen.detect.in_sweeps or ""):
        notes.append(weakness)
    opt.say_all("note", notes)
    with progress() as report_progress:
        result = run(opened, chosen, progress=report_progress, cache=not no_cache, jobs=jobs, scheduler=scheduler)
    if by_hand is not None:
        corrected = correct(result.scenario, by_hand)
        result = replace(result, scenario=corrected.scenario)
        opt.say_all("warning", corrected.unmatched)
    with together():
        if topdown is not None:
            from log2sim.cli.show import CELL_M
            from log2sim.config import MapConfig
            from log2sim.perception.records import RecordSource
            from log2sim.road.builder import map_ground
            from log2sim.road.map_files import write_map

            records = RecordSource(result.log)
            ground = map_ground(result.log, result.scenario, MapConfig(cell_m=CELL_M), records)
            write_map(ground.around(ground.coverage), topdown, overwrite=overwrite)
            result.report["unreadable"] = {**records.summary(), **result.report["unreadable"]}
        if report is not None:
            write_json(report, result.report)
        result.scenario.save(out)
    findings = (*result.findings, *unused_records(result.report))
    opt.say_all("poses", pose_reasons(result.report["poses"]))
    opt.say_all("note", findings)
    opt.report_written(report, topdown)
    # The next command shows the scenario with the pictures and the ground of its log.
    sequences = [] if sequence is None else ["--sequence", sequence]
    page = str(out.with_suffix(".html"))
    view = shlex.join(["log2sim", "view", str(out), "--log", str(log), *sequences, "-o", page])
    opt.tell("\n".join(summarize_run(result, view, out, verbose=verbose)))


MAX_NAMED = 5


def batch(
    root: Annotated[Path, typer.Argument(metavar="ROOT", help="Folder with logs of any formats below it, or with scenarios.")],
    out: Annotated[Path, opt.write_to("DIR", "Folder for the results; the same command goes on there.")],
    jobs: Annotated[int | None, opt.option(
        "Worker processes on this machine.", "N", min=1, default="one for each core")] = None,
    scheduler: Annotated[str | None, opt.option(
        "Use the workers of this Dask scheduler, which see the same folders.", "tcp://HOST:PORT")] = None,
    format: Annotated[str, opt.option(
        f"Log format: auto, {', '.join(opt.BUILT_IN['log'])}; or scenario: replay scenario files.", "FORMAT",
        completes=lambda incomplete: [*opt.complete("auto", "scenario")(incomplete), *opt.complete_plugins("log")(incomplete)])] = "auto",
    detector: Annotated[str | None, opt.option(
        "Detector, see reconstruct.", "NAME|MODEL.onnx|labels|lidar:NAME")] = None,
    poses: opt.Poses = None,
    config: opt.ConfigFile = None,
    settings: opt.Settings = None,
    seed: Annotated[int | None, opt.option("Seed of all random numbers.")] = None,
    replay: Annotated[bool, opt.option(
        "Replay each scenario, too: replay.json, and its figures in the tables.", None, "--replay")] = False,
    no_cache: opt.NoCache = False,
    overwrite: Annotated[bool, opt.option(
        "Start over: first remove the results that DIR holds.", None, "--overwrite", "-f")] = False,
) -> None:  # fmt: skip
    """Reconstruct all logs below a folder, or replay all scenarios there, several at once.

    Each log gets a folder in DIR/logs with scenario.json and report.json, with --replay also replay.json, or error.txt where it failed; table.html and
    table.parquet list them all. A log that fails by something else than its data is run once more at the end. A second call
    runs what is missing or failed. Exits with 7 when logs failed.

    Examples
    --------
    log2sim batch drives/ -o results/
    log2sim batch drives/ -o results/ --replay
    log2sim batch results/ -o replays/ --format scenario
    log2sim batch drives/ -o results/ --scheduler tcp://10.0.0.5:8786
    """
    from log2sim.batch import plan_batch, run_batch
    from log2sim.batch.discovery import SCENARIO
    from log2sim.batch.folder import sum_up
    from log2sim.batch.run import connect

    opt.require_own_workers(jobs, scheduler)
    chosen = opt.load_config(config, settings, detector=detector, poses=poses, seed=seed)
    planned = plan_batch(root, out, chosen, format=format, overwrite=overwrite, cache=not no_cache, replay=replay)
    kind = "scenario" if format == SCENARIO else "log"
    found = f"{opt.counted(len(planned.jobs), kind)} below {root}"
    opt.tell(f"{found}, {len(planned.done)} of them done before" if planned.done else found)

    begun = time.perf_counter()
    with progress() as report_progress:
        rows = run_batch(planned, lambda: connect(jobs, scheduler), progress=partial(report_progress, f"{kind}s"))
    failed = [row for row in rows if not row.is_done]
    for row in failed[:MAX_NAMED]:
        reason = row.error.splitlines()[0] if row.error else row.error_kind
        opt.tell(f"failed: {row.log}: {reason}")
    if len(failed) > MAX_NAMED:
        opt.tell(f"and {len(failed) - MAX_NAMED} more")
    now = sum(row.is_done and row.name not in planned.done for row in rows)
    rate = f"; {now / (time.perf_counter() - begun) * 3600:,.0f} {kind}s an hour" if now else ""
    sums, off_m = sum_up(rows), [row.cross_track_max_m for row in rows if row.cross_track_max_m is not None]
    collisions = opt.counted(sum(row.new_collisions or 0 for row in rows), "new collision")
    replayed = f"; replayed at most {max(off_m):.3f} m off the paths, {collisions}" if off_m else ""
    opt.tell(
        f"{out / 'table.html'}: {sums['done']:.0f} of {opt.counted(len(rows), kind)} done, {sums['agents']:.0f} agents "
        f"({sums['static']:.0f} static, {sums['doubtful']:.0f} doubtful) over {sums['duration_s']:.0f} s{replayed}{rate}"
    )
    if failed:
        raise LogsFailed(f"{len(failed)} of {opt.counted(len(rows), kind)} failed; {out / 'table.html'} says why")
