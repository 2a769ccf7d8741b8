"""Describe the content of a log or a scenario, or draw one moment of a log."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from log2sim.cli import options as opt
from log2sim.cli.shared import format_rows, wrap
from log2sim.errors import ConfigError

Document = Mapping[str, Any]
MAX_NOTES = 5


def describe_log(log: Document, *, verbose: bool = False) -> list[str]:
    """Describe a log: a line for each sensor, then the ego, labels, the map, and notes."""
    seconds = f"{log['duration_s']:.1f} s"
    lines = [f"{log['name']}: a log in the format {log['format']}, {seconds}", ""]
    header = ("sensor", "records", "rate", "gaps", "mount", "")
    rows = [(name, *_stream(entry), _lens(entry)) for name, entry in log["cameras"].items()]
    rows += [(name, *_stream(entry), "LiDAR") for name, entry in log["lidars"].items()]
    lines += [*format_rows([header, *rows]), ""]
    facts = [("ego", _ego(log["ego"])), ("labels", _labels(log["labels"])), ("map", _map(log["map"]))]
    for name, title in (("image_labels", "boxes in images"), ("ignored_regions", "ignored regions")):
        if log[name]:
            counts = {s: n if isinstance(n, int) else sum(n.values()) for s, n in log[name].items()}
            facts.append((title, ", ".join(f"{sensor} {count}" for sensor, count in counts.items())))
    facts += [(key, str(value)) for key, value in log["details"].items() if isinstance(value, str | int | float)]
    return [*lines, *format_rows(facts), *_topics(log["details"]), *_notes(log["notes"], verbose=verbose)]


def describe_scenario(scenario: Document, *, verbose: bool = False) -> list[str]:
    """Describe a scenario: its agents, the road, how the ego keeps its lane, and notes."""
    agents, lanes, ego = scenario["agents"], scenario["lanes"], scenario["ego"]
    total = opt.counted(agents["count"], "agent") + (" and the ego" if ego is not None else "")
    inferred = "" if lanes["in_file"] or not lanes["count"] else ", inferred from paths now"
    facts = [
        ("agents", f"{agents['count']}: {_counts(agents['categories'])}" if agents["count"] else "none"),
        ("moving", str(agents["moving"])),
        ("doubtful", str(agents["doubtful"]) + (" and the ego" if ego is not None and ego["doubtful"] else "")),
        ("colors", _counts(agents["colors"]) or "none"),
        ("markings", _counts(scenario["markings"]) or "none"),
        ("borders", _counts(scenario["borders"]) or "none"),
        ("lanes", f"{lanes['count']}, {opt.counted(lanes['junctions'], 'junction')}{inferred}"),
        ("lights", opt.counted(scenario["signals"], "traffic light")),
        ("ego", _lane_keeping(ego, scenario["ego_in_lane"])),
    ]
    lines = [f"{scenario['name']}: a scenario with {total} over {scenario['duration_s']:.1f} s", ""]
    return [*lines, *format_rows(facts), *_notes(scenario["notes"], verbose=verbose)]


def _stream(sensor: Document) -> tuple[str, str, str, str]:
    """Return records, rate, gaps and mount of a sensor."""
    rate, gaps = sensor["rate_hz"], sensor["gaps"]
    longest = max((gap["length_s"] for gap in gaps), default=0.0)
    told = f"{len(gaps)}, longest {longest:.1f} s" if gaps else "none"
    return str(sensor["records"]), "-" if rate is None else f"{rate:.1f} Hz", told, sensor["mount"]


def _lens(camera: Document) -> str:
    width, height = camera["size_px"]
    shutter = "" if camera["rolling_shutter"] is None else ", rolling shutter"
    return f"{width} x {height} px, {camera['field_of_view_deg']:.0f} degrees{shutter}"


def _ego(ego: Document | None) -> str:
    if ego is None:
        return "no poses"
    rate = "" if ego["rate_hz"] is None else f" at {ego['rate_hz']:.1f} Hz"
    length, width, height = ego["size_m"]
    way = f"{ego['distance_m']:.1f} m driven, at most {ego['top_speed_mps']:.1f} m/s"
    return f"{opt.counted(ego['records'], 'pose')}{rate}, {way}, {length:g} x {width:g} x {height:g} m"


def _labels(labels: Document | None) -> str:
    if labels is None:
        return "none"
    tracks = f"{opt.counted(labels['tracks'], 'object')}: {_counts(labels['tracks_by_category'])}"
    return f"{labels['boxes']} boxes of {tracks}"


def _map(frame: Document) -> str:
    if frame["latitude_deg"] is None or frame["longitude_deg"] is None:
        return "local, its place on Earth is not known"
    return f"origin at {frame['latitude_deg']:.5f}, {frame['longitude_deg']:.5f} degrees (latitude, longitude)"


def _topics(details: Document) -> list[str]:
    """Return a table of the topics of a ROS recording, with what each was taken for."""
    topics = details.get("topics")
    if not isinstance(topics, list) or not topics:
        return []
    rows = [(str(t["topic"]), str(t["messages"]), str(t["role"] or "-"), str(t["reason"])) for t in topics]
    return ["", *format_rows([("topic", "messages", "role", ""), *rows])]


def _lane_keeping(ego: Document | None, keeping: Document | None) -> str:
    if ego is None:
        return "none"
    if keeping is None:
        return "in no lane"
    text = f"in a lane {keeping['in_lane']:.0%} of the time"
    if "aside_m" not in keeping:
        return f"{text}, none of them between markings"
    aside = keeping["aside_m"]["mean"]
    return f"{text}, {abs(aside):.2f} m {'left' if aside > 0 else 'right'} of the middle on average"


def _counts(counts: Mapping[str, int]) -> str:
    """List counts, the largest first."""
    return ", ".join(f"{n} {name}" for name, n in sorted(counts.items(), key=lambda entry: (-entry[1], entry[0])))


def _notes(notes: Sequence[str], *, verbose: bool) -> list[str]:
    """Return the first notes, or all of them, and how many more there are."""
    shown = notes if verbose else notes[:MAX_NOTES]
    rest = len(notes) - len(shown)
    lines = [line for note in shown for line in wrap(f"note: {note}", indent=6)]
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
    quiet: opt.Quiet = False,
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

    from log2sim.cli.progress import progress
    from log2sim.files.documents import check_targets
    from log2sim.logs.excerpt import summarize
    from log2sim.logs.opening import open_log
    from log2sim.visualization.progress import OPENING

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
        with progress(quiet=quiet) as report_progress:
            report_progress(OPENING, 0, 0)
            opened = open_log(log, format=format, sequence=sequence)
        if overlay is not None:
            from log2sim.visualization.overlay import read_moment, write_overlay

            write_overlay(read_moment(opened, names, at), overlay, overwrite=overwrite)
            opt.report_written(overlay, quiet=quiet)
            return
        document = summarize(opened)
    opt.say(json.dumps(document, indent=2) if as_json else "\n".join(describe(document, verbose=verbose)), quiet=quiet)
