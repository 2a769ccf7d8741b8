"""One moment of a log as a picture: boxes and LiDAR points on the frames of its cameras."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from log2sim.datatypes import EGO, Labels, Log, Scenario, Tick
from log2sim.documents import refuse_existing, replaced
from log2sim.geometry import NS_PER_S
from log2sim.visualization.overlay.moment import read_moment
from log2sim.visualization.overlay.picture import draw_moment

SHOWN_DPI, SAVED_DPI = 100, 150
AROUND_S = np.array([-0.1, -0.05, 0.0, 0.05, 0.1])
"""Times around a tick at which agents are looked up: pictures of a tick are not of one time."""


@dataclass(frozen=True, eq=False)
class Picture:
    """A picture that a notebook shows.

    Attributes
    ----------
    figure : matplotlib.figure.Figure
    title : str
    """

    figure: Figure
    title: str

    def __repr__(self) -> str:
        """Return what it shows, and how to keep it."""
        return f"<Picture of {self.title}; save it by .save('FILE.png')>"

    def _repr_png_(self) -> bytes:
        """Return the picture as a notebook shows it."""
        data = io.BytesIO()
        self.figure.savefig(data, format="png", dpi=SHOWN_DPI)
        return data.getvalue()

    def save(self, path: Path | str, *, overwrite: bool = False) -> None:
        """Write the picture, in the format of the file's name.

        Raises
        ------
        ConfigError
            When the file exists and `overwrite` is False, or it cannot be written.
        """
        refuse_existing(path, overwrite=overwrite)
        with replaced(path) as temporary:
            self.figure.savefig(temporary, dpi=SAVED_DPI)


def show_log(
    log: Log,
    when: float | Tick | None = None,
    *,
    camera: str | Sequence[str] = (),
    scenario: Scenario | None = None,
) -> Picture:
    """Draw one moment of a log, as `Log.show` does; see there."""
    cameras = (camera,) if isinstance(camera, str) else tuple(camera)
    at_s, t_ns = (None, when.t_ns) if isinstance(when, Tick) else (when, None)
    boxes = None if scenario is None else (lambda stamp_ns: labels_of(scenario, log, stamp_ns))
    moment = read_moment(log, cameras, at_s, t_ns=t_ns, labels=boxes)
    figure = draw_moment(moment, box_name="3D label" if scenario is None else "agent")
    return Picture(figure, f"{log.name!r:.80} at {moment.at_s:.3f} s")


def labels_of(scenario: Scenario, log: Log, t_ns: int) -> Labels:
    """Return the agents but for the ego around a stamp as labels in the map frame of a log."""
    shift = np.array(scenario.map.offset_m) - np.array(log.map.offset_m)
    t_s = (t_ns - scenario.t0_ns) / NS_PER_S + AROUND_S
    stamps = t_ns + np.round(AROUND_S * NS_PER_S).astype(np.int64)
    rows: list[tuple[np.ndarray, str, str, np.ndarray, np.ndarray, np.ndarray]] = []
    for agent in scenario.agents:
        if agent.id == EGO:
            continue
        if agent.is_permanent:
            states = agent.at(np.full(len(t_s), agent.waypoints.t_s[0]))
        else:
            states = agent.at(t_s)
        there = states.valid
        center = np.column_stack([states.x_m, states.y_m, states.z_m])[there] + shift
        size = np.tile(np.array(agent.size_m, dtype=np.float64), (len(center), 1))
        rows.append((stamps[there], agent.id, agent.category, center, size, states.yaw_rad[there]))
    count = [len(row[0]) for row in rows]
    return Labels(
        t_ns=np.concatenate([np.zeros(0, np.int64), *(row[0] for row in rows)]),
        track_id=np.repeat(np.array([row[1] for row in rows], dtype=np.str_), count),
        category=np.repeat(np.array([row[2] for row in rows], dtype=np.str_), count),
        center_m=np.concatenate([np.zeros((0, 3)), *(row[3] for row in rows)]),
        size_m=np.concatenate([np.zeros((0, 3)), *(row[4] for row in rows)]),
        yaw_rad=np.concatenate([np.zeros(0), *(row[5] for row in rows)]),
    )
