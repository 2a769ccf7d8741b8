"""Logs: described, validated, converted, searched for boxes, and their ground as a map."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.progress import progress
from log2sim.errors import ConfigError, LogError, ScenarioError
from log2sim.files.outputs import together
from log2sim.visualization.progress import OPENING, VALIDATING

if TYPE_CHECKING:
    from log2sim.datatypes import Log, Scenario


Document = Mapping[str, Any]
MAX_NOTES = 5


def describe_log(log: Document, *, verbose: bool = False) -> list[str]:
    """Describe a log: a line for each sensor, then the ego, labels, the map, and notes."""
    lines = [f"{log['name']}: a log in the format {log['format']}, {log['duration_s']:.1f} s", ""]
    rows = [("sensor", "records", "rate", "gaps", "mount", "")]
    for name, sensor in [*log["cameras"].items(), *log["lidars"].items()]:
        rate, gaps = sensor["rate_hz"], sensor["gaps"]
        longest = max((gap["length_s"] for gap in gaps), default=0.0)
        what = "LiDAR"
        if name in log["cameras"]:
            width, height = sensor["size_px"]
            shutter = "" if sensor["rolling_shutter"] is None else ", rolling shutter"
            what = f"{width} x {height} px, {sensor['field_of_view_deg']:.0f} degrees{shutter}"
        told = f"{len(gaps)}, longest {longest:.1f} s" if gaps else "none"
        hertz = "-" if rate is None else f"{rate:.1f} Hz"
        rows.append((name, str(sensor["records"]), hertz, told, sensor["mount"], what))
    lines += [*opt.format_rows(rows), ""]
    driven, boxes, place = "no poses", "none", "local, its place on Earth is not known"
    if (ego := log["ego"]) is not None:
        at = "" if ego["rate_hz"] is None else f" at {ego['rate_hz']:.1f} Hz"
        size = " x ".join(f"{v:g}" for v in ego["size_m"])
        way = f"{ego['distance_m']:.1f} m driven, at most {ego['top_speed_mps']:.1f} m/s"
        driven = f"{opt.counted(ego['records'], 'pose')}{at}, {way}, {size} m"
    if (labels := log["labels"]) is not None:
        tracks = f"{opt.counted(labels['tracks'], 'object')}: {_counts(labels['tracks_by_category'])}"
        boxes = f"{labels['boxes']} boxes of {tracks}"
    latitude, longitude = log["map"]["latitude_deg"], log["map"]["longitude_deg"]
    if latitude is not None and longitude is not None:
        place = f"origin at {latitude:.5f}, {longitude:.5f} degrees (latitude, longitude)"
    facts = [("ego", driven), ("labels", boxes), ("map", place)]
    for name, title in (("image_labels", "boxes in images"), ("ignored_regions", "ignored regions")):
        if log[name]:
            counts = {s: n if isinstance(n, int) else sum(n.values()) for s, n in log[name].items()}
            facts.append((title, ", ".join(f"{sensor} {count}" for sensor, count in counts.items())))
    facts += [(key, str(value)) for key, value in log["details"].items() if isinstance(value, str | int | float)]
    lines += opt.format_rows(facts)
    topics = log["details"].get("topics")
    if isinstance(topics, list) and topics:  # of a ROS recording, with what each was taken for
        taken = [(str(t["topic"]), str(t["messages"]), str(t["role"] or "-"), str(t["reason"])) for t in topics]
        lines += ["", *opt.format_rows([("topic", "messages", "role", ""), *taken])]
    return [*lines, *_notes(log["notes"], verbose=verbose)]


def describe_scenario(scenario: Document, *, verbose: bool = False) -> list[str]:
    """Describe a scenario: its agents, the road, how the ego keeps its lane, and notes."""
    agents, lanes, ego = scenario["agents"], scenario["lanes"], scenario["ego"]
    total = opt.counted(agents["count"], "agent") + (" and the ego" if ego is not None else "")
    inferred = "" if lanes["in_file"] or not lanes["count"] else ", inferred from paths now"
    kept, keeping = "none" if ego is None else "in no lane", scenario["ego_in_lane"]
    if ego is not None and keeping is not None:
        kept = f"in a lane {keeping['in_lane']:.0%} of the time"
        if "aside_m" in keeping:
            aside = keeping["aside_m"]["mean"]
            kept += f", {abs(aside):.2f} m {'left' if aside > 0 else 'right'} of the middle on average"
        else:
            kept += ", none of them between markings"
    facts = [
        ("agents", f"{agents['count']}: {_counts(agents['categories'])}" if agents["count"] else "none"),
        ("moving", str(agents["moving"])),
        ("doubtful", str(agents["doubtful"]) + (" and the ego" if ego is not None and ego["doubtful"] else "")),
        ("colors", _counts(agents["colors"]) or "none"),
        ("markings", _counts(scenario["markings"]) or "none"),
        ("borders", _counts(scenario["borders"]) or "none"),
        ("lanes", f"{lanes['count']}, {opt.counted(lanes['junctions'], 'junction')}{inferred}"),
        ("lights", opt.counted(scenario["signals"], "traffic light")),
        ("ego", kept),
    ]
    lines = [f"{scenario['name']}: a scenario with {total} over {scenario['duration_s']:.1f} s", ""]
    return [*lines, *opt.format_rows(facts), *_notes(scenario["notes"], verbose=verbose)]


def _counts(counts: Mapping[str, int]) -> str:
    """List counts, the largest first."""
    return ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda entry: (-entry[1], entry[0])))


def _notes(notes: Sequence[str], *, verbose: bool) -> list[str]:
    """Return the first notes, or all of them, and how many more there are."""
    shown = notes if verbose else notes[:MAX_NOTES]
    rest = len(notes) - len(shown)
    lines = [line for note in shown for line in opt.wrap(f"note: {note}", indent=6)]
    return [*([""] if lines else []), *lines, *([f"note: and {rest} more; --verbose lists them"] if rest else [])]


def inspect(
    log: Annotated[Path, typer.Argument(metavar="LOG", help="Folder or file of a log, or a scenario.json.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    as_json: opt.AsJson = False,
    overlay: Annotated[Path | None, opt.option(
        "Instead draw one tick: LiDAR points and labeled boxes on all images, and from above.", "FILE.png")] = None,
    at: Annotated[float | None, opt.option(
        "Time to draw, in s after the first tick.", "S", default="in the middle")] = None,
    cameras: opt.Cameras = None,
    overwrite: opt.Overwrite = False,
    verbose: opt.Verbose = False,
) -> None:  # fmt: skip
    """Describe the content of a log, or of a scenario.json, or draw one tick of a log.

    Examples
    --------
    log2sim inspect samples/crossing
    log2sim inspect s.json --json
    log2sim inspect samples/crossing --overlay tick.png --at 2
    """
    import json

    from log2sim.files.documents import check_targets
    from log2sim.logs.excerpt import summarize
    from log2sim.logs.opening import open_log

    if overlay is None and (at is not None or cameras is not None):
        raise ConfigError("--at and --cameras choose what --overlay FILE.png draws; name the picture too")
    describe: Callable[..., list[str]] = describe_log
    if log.suffix.lower() == ".json":
        if overlay is not None:
            raise ConfigError(f"{log}: is a scenario, which --overlay does not draw; log2sim plot does")
        from log2sim.datatypes import Scenario
        from log2sim.road.lane_keeping import summarize_scenario

        describe, document = describe_scenario, summarize_scenario(Scenario.load(log))
    else:
        names = opt.camera_names(cameras)
        check_targets(overlay, overwrite=overwrite)
        with progress() as report_progress:
            report_progress(OPENING, 0, 0)
            opened = open_log(log, format=format, sequence=sequence)
        if overlay is not None:
            from log2sim.visualization.overlay import read_moment, write_overlay

            write_overlay(read_moment(opened, names, at), overlay, overwrite=overwrite)
            opt.report_written(overlay)
            return
        document = summarize(opened)
    opt.tell(json.dumps(document, indent=2) if as_json else "\n".join(describe(document, verbose=verbose)))


SCHEMAS = ("metrics", "batch-metrics", "detection-metrics", "report", "prediction", "bench", "corrections")


def validate(
    path: Annotated[Path, typer.Argument(
        metavar="FILE_OR_LOG",
        help="Scenario, replay, corrections, boxes, report, metrics or bench file, or a log: a folder, or the file of a bag.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
) -> None:  # fmt: skip
    """Validate a file, or every record of a log.

    Exits with 3 and lists the problems, if there are any. Gaps between records are no problem; they are
    noted, and so is what a format lacks or its reader left out.

    Examples
    --------
    log2sim validate s.json
    log2sim validate samples/crossing
    """
    from log2sim.logs.opening import is_log_file, open_log

    if path.is_dir() or is_log_file(path):
        from log2sim.logs.native.reader import READER
        from log2sim.logs.opening import list_gaps, validate_log

        opened = open_log(path, format=format, sequence=sequence)
        with progress() as report_progress:
            problems = validate_log(opened, progress=partial(report_progress, VALIDATING))
        # Those of native logs are among the problems.
        notes = () if opened.format == READER.name else opened.notes
        opt.say_all("note", [*notes, *list_gaps(opened)])
        if problems:
            raise LogError(f"{path}: {opt.counted(len(problems), 'problem')}\n  " + "\n  ".join(problems))
    else:
        from log2sim.datatypes import Scenario
        from log2sim.evaluation.detection.boxes import DetectedBoxes, is_boxes_document
        from log2sim.files.documents import check, kind_of, read_json
        from log2sim.simulation.result import Replay

        document = read_json(path, ScenarioError)
        kind = kind_of(document)
        if kind in SCHEMAS:
            check(document, f"{kind}-1", ScenarioError)
        elif kind == "replay":
            Replay.load(path)
        elif is_boxes_document(document):
            DetectedBoxes.load(path)
        else:
            Scenario.load(path)
    opt.tell(f"{path}: valid")


def convert(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("DIR", "Folder to write.")],
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    start: opt.Start = None,
    stop: opt.Stop = None,
    cameras: opt.Cameras = None,
    labels: opt.LabelFile = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Write any log, or a part of it, as a log folder of log2sim; images are copied as they are.

    Examples
    --------
    log2sim convert samples/crossing --start 1 --stop 3 --cameras front -o part/
    log2sim convert drive.bag --labels openlabel.json -o labeled/
    """
    from log2sim.files.documents import check_folder
    from log2sim.logs.excerpt import cut_log
    from log2sim.logs.native.writer import refuse_target, write_log
    from log2sim.logs.opening import open_log

    names = opt.camera_names(cameras)
    refuse_target(out, overwrite=overwrite)
    check_folder(out, overwrite=overwrite)
    if out.resolve() in (log.resolve(), *log.resolve().parents):
        raise ConfigError(f"{out}: holds the log that is converted; choose another folder")
    opened = open_log(log, format=format, sequence=sequence, labels=labels)
    part = cut_log(opened, cameras=names, start_s=start, stop_s=stop)
    opt.say_all("note", part.notes)
    problems: list[str] = []
    with progress() as report_progress:
        done = partial(report_progress, "convert")
        write_log(part, out, overwrite=overwrite, jpeg_quality=95, progress=done, problems=problems)
    opt.say_all("note: left out", problems)
    records = sum(len(stream.t_ns) for stream in part.streams.values()) - len(problems)
    size_mb = sum(file.stat().st_size for file in out.rglob("*") if file.is_file()) / 1e6
    opt.tell(f"{out}: {opt.counted(records, 'record')} of {opt.counted(len(part.streams), 'sensor')}, {size_mb:.1f} MB")


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
) -> None:  # fmt: skip
    """Detect road users in the LiDAR sweeps of a log.

    Examples
    --------
    log2sim detect samples/crossing -o boxes.json
    log2sim detect kitti_object/ --detector lidar:MODEL.onnx -o boxes.json
    log2sim detect LOG --detector lidar:labels --labels openlabel.json -o boxes.json
    """
    from log2sim.cli.reconstruct import pose_reasons
    from log2sim.evaluation.detection.detect_log import detect_log
    from log2sim.files.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.perception.detect3d.detectors import describe_weakness

    check_targets(out, overwrite=overwrite)
    chosen = opt.load_config(config, settings, detector=detector, poses=poses, start_s=start, stop_s=stop)
    opened = open_log(log, format=format, sequence=sequence, labels=labels)
    weakness = describe_weakness(detector)
    opt.say_all("note", [*opened.notes, *([weakness] if weakness else [])])
    with progress() as report_progress:
        result = detect_log(opened, chosen, progress=partial(report_progress, "detect"))
    result.found.save(out)
    opt.say_all("poses", pose_reasons(result.poses.to_dict()))
    opt.say_all("note", result.findings)
    if result.left_out:
        opt.tell(f"note: {opt.counted(result.left_out, 'sweep')} left out, without points or a known pose")
    boxes = sum(len(found) for found in result.found.boxes)
    words = f"{boxes} box{'es' * (boxes != 1)} in {opt.counted(len(result.found.t_ns), 'sweep')}"
    opt.tell(f"{out}: {words} by {result.found.detector}")


def map(
    log: opt.LogPath,
    out: Annotated[Path, opt.write_to("FILE", "Map to write: .tif (GeoTIFF), .png or .jpg (with a world file).")],
    scenario: Annotated[
        Path | None, opt.option("Scenario of the log; its agents are left out of the map.", "SCENARIO")
    ] = None,
    layer: Annotated[
        str, opt.choose("--layer", "color|intensity|height", "What is written; intensity is that of the LiDAR.")
    ] = "color",
    cell: Annotated[float, opt.option("Edge of a cell, in m.", "M")] = 0.05,
    format: opt.Format = "auto",
    sequence: opt.SequenceName = None,
    overwrite: opt.Overwrite = False,
) -> None:
    """Make a map of the ground of a log: its color, its height, or how strongly it reflects the LiDAR.

    Examples
    --------
    log2sim map samples/crossing --scenario s.json -o ground.tif
    log2sim map samples/crossing --layer intensity -o ground.png
    """
    from typing import cast

    from log2sim.config import Config
    from log2sim.files.documents import check_targets
    from log2sim.logs.opening import open_log
    from log2sim.perception.records import RecordSource
    from log2sim.road import map_files
    from log2sim.road.builder import map_ground

    map_files.check_name(out)
    world = map_files.world_file_of(out)
    check_targets(out, world, overwrite=overwrite)
    if layer not in map_files.LAYERS:
        raise ConfigError(f"--layer: '{layer}' is none of {', '.join(map_files.LAYERS)}")
    chosen, settings = cast(map_files.Layer, layer), Config.load(map={"cell_m": cell}).map
    opened = open_log(log, format=format, sequence=sequence)
    if chosen == "color" and not opened.cameras:
        raise ConfigError(f"{opened.name}: the log has no camera; take --layer intensity or --layer height")
    if chosen != "color" and not opened.lidars:
        raise ConfigError(f"{opened.name}: the log has no LiDAR; take --layer color")
    opened, loaded, note = _agents_of(opened, scenario)
    opt.say_all("note", (*opened.notes, *((note,) if note else ())))
    records = RecordSource(opened)
    with progress() as report_progress:
        whole = map_ground(opened, loaded, settings, records, report_progress)
    ground = whole.around(map_files.known_cells(whole, chosen))
    with together():
        map_files.write_map(ground, out, chosen, opened.map, overwrite=overwrite)
        if world is not None:
            map_files.write_world_file(ground, world, opened.map, overwrite=overwrite)
    unread = [f"{name}: {u['count']} records could not be read" for name, u in records.summary().items()]
    notes = [*ground.notes, *unread]
    problem = map_files.geokeys_of(opened.map).problem
    notes += [f"no place on Earth: {problem}"] if problem else []
    if chosen == "height" and out.suffix.lower() == ".png":
        notes.append(
            f"heights in {out.name}: value 1 is {map_files.lowest_m(ground):.2f} m, {map_files.HEIGHT_STEP_M:g} m a step, 0 is unknown"
        )
    opt.say_all("note", notes)
    rows, columns = ground.alpha.shape
    d = ground.resolution_m
    opt.report_written(world)
    opt.tell(f"{out}: {columns * d:.0f} x {rows * d:.0f} m in cells of {d:g} m")


def _agents_of(log: Log, scenario: Path | None) -> tuple[Log, Scenario, str | None]:
    """Return the log as the scenario places it, the agents to leave out, and what is to be said of them."""
    from log2sim.datatypes import Scenario
    from log2sim.localization.choice import localize_like

    if scenario is not None:
        loaded = Scenario.load(scenario)
        return localize_like(log, loaded.provenance), loaded, None
    if log.labels is not None:
        from log2sim.evaluation.metrics.truth import truth_from_log

        return log, truth_from_log(log), "without --scenario only agents with labels are left out of the map"
    from log2sim.geometry import NS_PER_S

    stamps = [stream.t_ns for stream in log.streams.values() if len(stream.t_ns)]
    first = min((int(t[0]) for t in stamps), default=0)
    last = max((int(t[-1]) for t in stamps), default=0)
    whole = Scenario(log.name, first, (last - first) / NS_PER_S, (), log.map)
    return log, whole, "no agent is left out of the map: the log has no labels; pass --scenario to leave out its agents"
