"""What a notebook shows of logs, scenarios and replays."""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from html import escape
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from log2sim.datatypes import EGO, Agent, AgentTable, Labels, Log, Scenario, Tick, Waypoints
from log2sim.files.documents import refuse_existing, replaced
from log2sim.geometry import NS_PER_S, Array
from log2sim.perception.records import RecordSource
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.simulation.result import Replay
from log2sim.visualization.overlay import draw_moment, read_moment
from log2sim.visualization.plot.layers import draw_collisions, new_collisions
from log2sim.visualization.plot.scene import plot
from log2sim.visualization.plot.style import new_figure, png_bytes

WIDTH_IN, HEIGHT_IN, DPI = 5.2, 3.6, 100
MAX_CAMERAS = 6
FRAME_WIDTH_PX, JPEG_QUALITY = 236, 80
ABOVE_PX, ABOVE_REACH_M = 236, 40.0
Thumbnail = tuple[str, bytes, str]  # a small picture: "image/png" or "image/jpeg", the bytes, and a caption


def thumbnails_of_log(log: Log) -> list[Thumbnail]:
    """Take the frame in the middle of each camera, without cameras a sweep from above; frames that cannot be read are left out."""
    found = []
    for name in list(log.cameras)[:MAX_CAMERAS]:
        image = _middle_record(log, name)
        if image is not None:
            height = max(1, round(FRAME_WIDTH_PX * image.shape[0] / image.shape[1]))
            small = cv2.resize(image, (FRAME_WIDTH_PX, height), interpolation=cv2.INTER_AREA)
            found.append(_jpeg(small, name))
    if not log.cameras and log.lidars:
        name = next(iter(log.lidars))
        sweep = _middle_record(log, name)
        if sweep is not None:
            limits = [(-ABOVE_REACH_M, ABOVE_REACH_M)] * 2
            count, _, _ = np.histogram2d(sweep.xyz_m[:, 0], sweep.xyz_m[:, 1], bins=ABOVE_PX, range=limits)
            shade = 255 * (1 - np.minimum(np.sqrt(count[::-1, ::-1]) / 4, 1))
            found.append(_jpeg(np.ascontiguousarray(shade.astype(np.uint8)), f"{name}, from above"))
    return found


def thumbnail_of_scenario(scenario: Scenario, collisions_m: Array | None = None) -> list[Thumbnail]:
    """Draw the tracks from above, and collisions at places (K, 2)."""
    figure = new_figure(WIDTH_IN, HEIGHT_IN)
    ax = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    plot(scenario, ax)
    if collisions_m is not None:
        draw_collisions(ax, collisions_m)
    ax.set(xlabel="", ylabel="")
    ax.tick_params(length=0, labelbottom=False, labelleft=False)
    return [("image/png", png_bytes(figure, DPI), "")]


def thumbnail_of_replay(replay: Replay) -> list[Thumbnail]:
    """Draw the paths that were driven from above, with the collisions of the replay."""
    agents = []
    for a in (a for a in replay.agents if len(a)):
        observed, sigma = np.ones(len(a), dtype=bool), np.zeros(len(a))
        waypoints = Waypoints(a.t_s, a.x_m, a.y_m, a.z_m, a.yaw_rad, a.speed_mps, observed, sigma)
        agents.append(Agent(a.id, a.category, a.size_m, waypoints, static=a.driver == "static"))
    end_s = max((float(a.waypoints.t_s[-1]) for a in agents), default=0.0)
    return thumbnail_of_scenario(Scenario(replay.scenario, 0, end_s, tuple(agents)), new_collisions(replay)[1])


def _middle_record(log: Log, name: str) -> Any:
    count = len(log.streams[name].t_ns)
    return RecordSource(log).get(name, count // 2) if count else None


def _jpeg(image: NDArray[np.uint8], caption: str) -> Thumbnail:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return "image/jpeg", data.tobytes(), caption


MAX_TEXT = 200  # letters of a name or a note that are shown
MAX_SENSORS = 12


def notebook_html(value: Log | Scenario | Replay) -> str:
    """Return the HTML of a value; its text is escaped, and without a picture where that cannot be drawn."""
    rows: list[tuple[str, str]] = []
    draw: Callable[[], list[Thumbnail]]
    if isinstance(value, Log):
        draw = partial(thumbnails_of_log, value)
        kinds = [*((n, "camera") for n in value.cameras), *((n, "LiDAR") for n in value.lidars)]
        for name, kind in kinds[:MAX_SENSORS]:
            t_ns = value.streams[name].t_ns
            span_s = float(t_ns[-1] - t_ns[0]) / NS_PER_S if len(t_ns) else 0.0
            rate = f" at {(len(t_ns) - 1) / span_s:.1f} Hz" if span_s > 0 else ""
            size = f", {value.cameras[name].width_px} x {value.cameras[name].height_px} px" if kind == "camera" else ""
            rows.append((name, f"{kind}{size}, {_count(len(t_ns), 'record')}{rate}"))
        if len(kinds) > MAX_SENSORS:
            rows.append(("", f"and {_count(len(kinds) - MAX_SENSORS, 'more sensor')}"))
        rows.append(("ego", "no poses" if value.ego is None else _count(len(value.ego.t_ns), "pose")))
    elif isinstance(value, Scenario):
        draw = partial(thumbnail_of_scenario, value)
        rows.append(("agents", _by_category(a.category for a in value.others)))
        if value.doubtful:
            rows.append(("doubtful", ", ".join(a.id for a in value.doubtful)))
        features, place = value.map_features, value.map
        found = [] if features is None else [(len(features.lanes), "lane"), (len(features.markings), "marking")]
        found.append((len(value.signals), "traffic light"))
        if any(count for count, _ in found):
            rows.append(("road", ", ".join(_count(count, noun) for count, noun in found if count)))
        if place.latitude_deg is not None and place.longitude_deg is not None:
            rows.append(("origin", f"{place.latitude_deg:.5f}°, {place.longitude_deg:.5f}°"))
    else:
        draw = partial(thumbnail_of_replay, value)
        events = [e for e in value.metrics.get("collisions", ()) if e["belongs_to"] == REPLAY]
        hits = "; ".join(f"{' and '.join(e['agents'])} at {e['t_s']:.2f} s" for e in events)
        models = Counter(a.model for a in value.agents if a.model != "none").most_common()
        rows.append(("agents", _by_category(a.category for a in value.agents if a.id != EGO)))
        rows.append(("models", ", ".join(f"{name} {count}" for name, count in models) or "none"))
        rows.append(("collisions", hits or "none"))
        if value.metrics.get("cross_track_rms_m") is not None:
            rows.append(("beside the path", f"{value.metrics['cross_track_rms_m']:.3f} m rms"))
    try:
        drawn = draw()
    except Exception:  # a picture that cannot be drawn must not hide the rest
        drawn = []
    cell = 'style="text-align:left;padding:1px 12px 1px 0;vertical-align:top'
    table = "".join(
        f'<tr><td {cell};opacity:0.65">{_text(name)}</td><td {cell}">{_text(told)}</td></tr>' for name, told in rows
    )
    shown = ""
    for media_type, data, caption in drawn:
        label, source = escape(caption or "picture", quote=True), base64.b64encode(data).decode("ascii")
        below = f'<figcaption style="font-size:85%;opacity:0.65">{_text(caption)}</figcaption>' * bool(caption)
        image = f'<img alt="{label}" src="data:{media_type};base64,{source}" style="max-width:100%;height:auto">'
        shown += f'<figure style="margin:0">{image}{below}</figure>'
    return (
        f'<div style="max-width:760px"><div><code>{_text(repr(value))}</code></div>'
        f'<table style="border-collapse:collapse;margin:4px 0">{table}</table>'
        f'<div style="display:flex;flex-wrap:wrap;gap:8px">{shown}</div></div>'
    )


def _text(text: str) -> str:
    return escape(text if len(text) <= MAX_TEXT else f"{text[: MAX_TEXT - 1]}…", quote=True)


def _by_category(categories: Iterable[str]) -> str:
    return ", ".join(f"{name} {count}" for name, count in Counter(categories).most_common()) or "none"


def _count(count: int, noun: str) -> str:
    return f"{count} {noun}{'s' * (count != 1)}"


SHOWN_DPI, SAVED_DPI = 100, 150
# Times around a tick at which agents are looked up: pictures of a tick are not of one time.
AROUND_S = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that a notebook shows."""

    figure: Figure
    title: str

    def __repr__(self) -> str:
        """Return what it shows, and how to keep it."""
        return f"<Picture of {self.title}; save it by .save('FILE.png')>"

    def _repr_png_(self) -> bytes:
        """Return the picture as a notebook shows it."""
        return png_bytes(self.figure, SHOWN_DPI)

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the picture, in the format of the file's name.

        Raises `ConfigError` when the file exists and `overwrite` is False, or it cannot be written.
        """
        refuse_existing(path, overwrite=overwrite)
        with replaced(path) as temporary:
            self.figure.savefig(temporary, dpi=SAVED_DPI)


def show_log(
    log: Log, when: float | Tick | None = None, *, camera: str | Sequence[str] = (), scenario: Scenario | None = None
) -> Picture:
    """Draw one moment of a log, as `Log.show` does; see there."""
    cameras = (camera,) if isinstance(camera, str) else tuple(camera)
    at_s, t_ns = (None, when.t_ns) if isinstance(when, Tick) else (when, None)
    boxes = None if scenario is None else (lambda stamp_ns: notebook_labels(scenario, log, stamp_ns))
    moment = read_moment(log, cameras, at_s, t_ns=t_ns, labels=boxes)
    figure = draw_moment(moment, box_name="3D label" if scenario is None else "agent")
    return Picture(figure, f"{log.name!r:.80} at {moment.at_s:.3f} s")


def notebook_labels(scenario: Scenario, log: Log, t_ns: int) -> Labels:
    """Return the agents but for the ego around a stamp as labels in the map frame of a log."""
    shift = np.array(scenario.map.offset_m) - np.array(log.map.offset_m)
    t_s = (t_ns - scenario.t0_ns) / NS_PER_S + AROUND_S
    stamps = t_ns + np.round(AROUND_S * NS_PER_S).astype(np.int64)
    table = AgentTable.of(scenario.others, t_s, permanent=True)
    k, i = np.nonzero(table.present)
    ids = np.array([agent.id for agent in scenario.others], dtype=np.str_)
    return Labels(
        t_ns=stamps[i], track_id=ids[k], category=table.category[k], center_m=table.center_m[k, i] + shift,
        size_m=table.size_m[k], yaw_rad=table.yaw_rad[k, i],
    )  # fmt: skip
