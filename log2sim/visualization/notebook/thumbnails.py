"""Small pictures of logs, scenarios and replays."""

from __future__ import annotations

import io
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Log, Scenario, Waypoints
from log2sim.errors import RecordError
from log2sim.simulation.result import AgentReplay, Replay
from log2sim.visualization.plot.axes import plot
from log2sim.visualization.plot.collisions import new_collisions
from log2sim.visualization.plot.drawing import draw_collisions
from log2sim.visualization.plot.style import PAPER

WIDTH_IN, HEIGHT_IN, DPI = 5.2, 3.6, 100
MAX_CAMERAS = 6
FRAME_WIDTH_PX, JPEG_QUALITY = 236, 80
ABOVE_PX, ABOVE_REACH_M = 236, 40.0


@dataclass(frozen=True, eq=False)
class Thumbnail:
    """A small picture.

    Attributes
    ----------
    media_type : str
        "image/png" or "image/jpeg".
    data : bytes
    caption : str
    """

    media_type: str
    data: bytes
    caption: str = ""


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
            found.append(_jpeg(_from_above(sweep.xyz_m), f"{name}, from above"))
    return found


def thumbnail_of_scenario(scenario: Scenario) -> list[Thumbnail]:
    """Draw the tracks from above."""
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), facecolor=PAPER)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    plot(scenario, ax)
    ax.set(xlabel="", ylabel="")
    ax.tick_params(length=0, labelbottom=False, labelleft=False)
    return [_png(figure)]


def thumbnail_of_replay(replay: Replay) -> list[Thumbnail]:
    """Draw the paths that were driven from above, with the collisions of the replay."""
    figure = Figure(figsize=(WIDTH_IN, HEIGHT_IN), facecolor=PAPER)
    FigureCanvasAgg(figure)
    ax = figure.add_axes((0.005, 0.005, 0.99, 0.99))
    agents = tuple(_as_agent(a) for a in replay.agents if len(a))
    end_s = max((float(a.waypoints.t_s[-1]) for a in agents), default=0.0)
    plot(Scenario(replay.scenario, 0, end_s, agents), ax)
    draw_collisions(ax, new_collisions(replay)[1])
    ax.set(xlabel="", ylabel="")
    ax.tick_params(length=0, labelbottom=False, labelleft=False)
    return [_png(figure)]


def _as_agent(driven: AgentReplay) -> Agent:
    waypoints = Waypoints(
        driven.t_s, driven.x_m, driven.y_m, driven.z_m, driven.yaw_rad, driven.speed_mps,
        observed=np.ones(len(driven), dtype=bool), sigma_xy_m=np.zeros(len(driven)),
    )  # fmt: skip
    return Agent(driven.id, driven.category, driven.size_m, waypoints, static=driven.driver == "static")


def _middle_record(log: Log, name: str) -> Any:
    stream = log.streams[name]
    try:
        return stream.read(len(stream.t_ns) // 2) if len(stream.t_ns) else None
    except RecordError:
        return None


def _from_above(xyz_m: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Draw points around the sensor as a gray picture, x up as a LiDAR looks ahead."""
    limits = [(-ABOVE_REACH_M, ABOVE_REACH_M)] * 2
    count, _, _ = np.histogram2d(xyz_m[:, 0], xyz_m[:, 1], bins=ABOVE_PX, range=limits)
    shade = 255 * (1 - np.minimum(np.sqrt(count[::-1, ::-1]) / 4, 1))
    return np.ascontiguousarray(shade.astype(np.uint8))


def _jpeg(image: NDArray[np.uint8], caption: str) -> Thumbnail:
    _, data = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    return Thumbnail("image/jpeg", data.tobytes(), caption)


def _png(figure: Figure) -> Thumbnail:
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=DPI, metadata={"Software": None})
    return Thumbnail("image/png", data.getvalue())
