"""What a notebook shows of a log, a scenario or a replay: a line, a short table and a small picture, as HTML."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable
from functools import partial
from html import escape

from log2sim.datatypes import EGO, Log, Scenario
from log2sim.geometry import NS_PER_S
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.result import Replay
from log2sim.visualization.notebook.thumbnails import (
    Thumbnail,
    thumbnail_of_replay,
    thumbnail_of_scenario,
    thumbnails_of_log,
)

MAX_TEXT = 200
"""Letters of a name or a note that are shown."""

MAX_SENSORS = 12
Row = tuple[str, str]


def html_of(value: Log | Scenario | Replay) -> str:
    """Return the HTML of a value; its text is escaped, and without a picture where that cannot be drawn."""
    rows: list[Row]
    draw: Callable[[], list[Thumbnail]]
    if isinstance(value, Log):
        rows, draw = _rows_of_log(value), partial(thumbnails_of_log, value)
    elif isinstance(value, Scenario):
        rows, draw = _rows_of_scenario(value), partial(thumbnail_of_scenario, value)
    else:
        rows, draw = _rows_of_replay(value), partial(thumbnail_of_replay, value)
    try:
        drawn = draw()
    except Exception:  # a picture that cannot be drawn must not hide the rest
        drawn = []
    return _page(repr(value), rows, drawn)


def _rows_of_log(log: Log) -> list[Row]:
    kinds = [*((n, "camera") for n in log.cameras), *((n, "LiDAR") for n in log.lidars)]
    rows = []
    for name, kind in kinds[:MAX_SENSORS]:
        t_ns = log.streams[name].t_ns
        span_s = float(t_ns[-1] - t_ns[0]) / NS_PER_S if len(t_ns) else 0.0
        rate = f" at {(len(t_ns) - 1) / span_s:.1f} Hz" if span_s > 0 else ""
        size = f", {log.cameras[name].width_px} x {log.cameras[name].height_px} px" if kind == "camera" else ""
        rows.append((name, f"{kind}{size}, {_count(len(t_ns), 'record')}{rate}"))
    if len(kinds) > MAX_SENSORS:
        rows.append(("", f"and {_count(len(kinds) - MAX_SENSORS, 'more sensor')}"))
    poses = "no poses" if log.ego is None else _count(len(log.ego.t_ns), "pose")
    return [*rows, ("ego", poses)]


def _rows_of_scenario(scenario: Scenario) -> list[Row]:
    rows = [("agents", _by_category(a.category for a in scenario.others))]
    if scenario.doubtful:
        rows.append(("doubtful", ", ".join(a.id for a in scenario.doubtful)))
    features = scenario.map_features
    found = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
    found.append((len(scenario.signals), "traffic light"))
    if any(count for count, _ in found):
        rows.append(("road", ", ".join(_count(count, noun) for count, noun in found if count)))
    if scenario.map.latitude_deg is not None and scenario.map.longitude_deg is not None:
        rows.append(("origin", f"{scenario.map.latitude_deg:.5f}°, {scenario.map.longitude_deg:.5f}°"))
    return rows


def _rows_of_replay(replay: Replay) -> list[Row]:
    events = [e for e in replay.metrics.get("collisions", ()) if e["belongs_to"] == REPLAY]
    models = Counter(a.model for a in replay.agents if a.model != "none")
    rows = [
        ("agents", _by_category(a.category for a in replay.agents if a.id != EGO)),
        ("models", ", ".join(f"{name} {count}" for name, count in models.most_common()) or "none"),
        ("collisions", "; ".join(f"{' and '.join(e['agents'])} at {e['t_s']:.2f} s" for e in events) or "none"),
    ]
    if replay.metrics.get("cross_track_rms_m") is not None:
        rows.append(("beside the path", f"{replay.metrics['cross_track_rms_m']:.3f} m rms"))
    return rows


def _page(title: str, rows: Iterable[Row], pictures: Iterable[Thumbnail]) -> str:
    cell = 'style="text-align:left;padding:1px 12px 1px 0;vertical-align:top'
    table = "".join(
        f'<tr><td {cell};opacity:0.65">{_text(name)}</td><td {cell}">{_text(value)}</td></tr>' for name, value in rows
    )
    shown = "".join(_figure(picture) for picture in pictures)
    return (
        f'<div style="max-width:760px"><div><code>{_text(title)}</code></div>'
        f'<table style="border-collapse:collapse;margin:4px 0">{table}</table>'
        f'<div style="display:flex;flex-wrap:wrap;gap:8px">{shown}</div></div>'
    )


def _figure(picture: Thumbnail) -> str:
    data = base64.b64encode(picture.data).decode("ascii")
    caption = f'<figcaption style="font-size:85%;opacity:0.65">{_text(picture.caption)}</figcaption>'
    name = escape(picture.caption or "picture", quote=True)
    image = f'<img alt="{name}" src="data:{picture.media_type};base64,{data}" style="max-width:100%;height:auto">'
    return f'<figure style="margin:0">{image}{caption * bool(picture.caption)}</figure>'


def _text(text: str) -> str:
    return escape(text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 1]}…", quote=True)


def _by_category(categories: Iterable[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(categories).most_common()) or "none"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"
