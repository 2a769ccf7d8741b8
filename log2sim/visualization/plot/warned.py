"""Warnings of a replay on the map: where the warned vehicle and the other agent are at the first warning."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D

from log2sim.geometry import Array
from log2sim.visualization.plot.drawing import LABEL
from log2sim.visualization.plot.style import FONT, WARNING, halo

LINE: dict[str, Any] = {"color": WARNING, "lw": 1.2, "ls": (0, (4.0, 2.5)), "marker": "o", "ms": 3.5, "mfc": "none"}

TEXT_PT = -9.0
"""How far above the middle of the line its text is."""


class WarnedPlace(NamedTuple):
    """A warning to draw.

    Attributes
    ----------
    ends_m : (2, 2) float64, m
        Centers of the warned vehicle and of the agent.
    text : str
    """

    ends_m: Array
    text: str


def warned_places(replay: Any) -> list[WarnedPlace]:
    """Find where the warned vehicle and the others are in a replay when they are first warned of."""
    if replay is None or replay.warnings is None:
        return []
    places = []
    for w in replay.warnings.events:
        if w.warned is not None:
            pair = [replay.agent(id) for id in (w.driver, w.agent)]
            ends = [[float(np.interp(w.warned.t_s, a.t_s, c)) for c in (a.x_m, a.y_m)] for a in pair]
            places.append(WarnedPlace(np.array(ends), f"{w.warned.t_s:.1f} s: {w.warned.distance_m:.1f} m"))
    return places


def draw_warnings(ax: Axes, places: list[WarnedPlace]) -> None:
    """Draw a line from the warned vehicle to the agent for each warning, with the time and the distance."""
    for place in places:
        ax.plot(*place.ends_m.T, zorder=LABEL - 0.2, **LINE)
        ax.annotate(
            place.text, place.ends_m.mean(axis=0), (0.0, TEXT_PT), textcoords="offset points", color=WARNING, fontsize=6.5,
            fontweight="bold", family=FONT, ha="center", va="center", path_effects=halo(), zorder=LABEL, parse_math=False,
            annotation_clip=True,
        )  # fmt: skip


def warning_row() -> tuple[Line2D, str]:
    """Return the line of the legend."""
    return Line2D([0, 1], [0, 1], **LINE), "warning: when, and how far apart"
