"""Lanes, markings, borders of roads and traffic lights on the map axes, below the agents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from log2sim.datatypes import MIN_TRUSTED_CONFIDENCE, MapLane, Marking, Scenario, Signal
from log2sim.geometry import Array
from log2sim.visualization.plot.drawing import BACKGROUND, LABEL
from log2sim.visualization.plot.style import BORDER_COLOR, LANE_ARROW, LANE_FACE, MARKING_COLOR, PAPER, SIGNAL_COLOR
from log2sim.visualization.plot.viewport import Viewport

LANES, LINES = BACKGROUND + 0.2, BACKGROUND + 0.4
"""z-order: above a picture of the ground, below what stands."""

MIN_LINE_PT, BORDER_PT = 0.9, 0.8
DASHES = (0, (4.0, 3.0))
ARROW_EVERY_M, ARROW_M = 15.0, (1.6, 0.7)
"""Arrows along lanes: distance from one to the next, length and half width."""


def draw_road(ax: Axes, scenario: Scenario, view: Viewport, *, over_picture: bool) -> None:
    """Draw the map features of a scenario; the faces of lanes not over a picture of the ground, which they would hide."""
    features = scenario.map_features
    if features is None:
        return
    if not over_picture:
        faces = [lane_outline(lane) for lane in features.lanes]
        ax.add_collection(PolyCollection(faces, facecolors=LANE_FACE, edgecolors="none", zorder=LANES), autolim=False)
    arrows = [arrow for lane in features.lanes for arrow in lane_arrows(lane)]
    ax.add_collection(PolyCollection(arrows, facecolors=LANE_ARROW, zorder=LANES + 0.1), autolim=False)
    borders = [border.points_m[:, :2] for border in features.borders]
    ax.add_collection(
        LineCollection(borders, colors=BORDER_COLOR, linewidths=BORDER_PT, zorder=LINES - 0.1), autolim=False
    )
    _draw_markings(ax, features.markings, view)


def _draw_markings(ax: Axes, markings: Sequence[Marking], view: Viewport) -> None:
    """Draw lines along their middle, dashed ones with dashes, and outlines of crosswalks and symbols; doubtful ones are pale."""
    areas = [m for m in markings if m.kind in ("crosswalk", "other")]
    ax.add_collection(
        PolyCollection(
            [m.points_m[:, :2] for m in areas],
            facecolors=[_shade(m, 0.25) for m in areas],
            edgecolors=[_shade(m, 0.9) for m in areas],
            linewidths=0.6,
            hatch="////",
            zorder=LINES,
        ),
        autolim=False,
    )
    for dashed in (False, True):
        lines = [m for m in markings if m not in areas and (m.kind == "dashed") is dashed]
        widths = [max(m.width_m / view.m_per_pt, MIN_LINE_PT) for m in lines]
        style: dict[str, Any] = {"linestyles": [DASHES]} if dashed else {"capstyle": "butt"}
        points, colors = [m.points_m[:, :2] for m in lines], [_shade(m, 1.0) for m in lines]
        ax.add_collection(
            LineCollection(points, colors=colors, linewidths=widths, zorder=LINES, **style), autolim=False
        )


def draw_signals(ax: Axes, signals: Sequence[Signal], t_s: float) -> None:
    """Draw traffic lights in the color of their state at a time, s."""
    for signal in signals:
        color = SIGNAL_COLOR[str(signal.at(t_s)[0])]
        ax.plot(*signal.position_m[:2], "o", ms=5.0, mfc=color, mec=PAPER, mew=0.9, zorder=LABEL - 0.3)


class SignalLights:
    """Traffic lights of an animation, each in the color of its state at the time that is shown."""

    def __init__(self, ax: Axes, signals: Sequence[Signal]) -> None:
        self._ax, self._signals = ax, signals
        style: dict[str, Any] = {"ls": "none", "marker": "o", "ms": 5.0, "mec": PAPER, "mew": 0.9, "animated": True}
        self._marks = [ax.plot(*signal.position_m[:2], zorder=LABEL - 0.3, **style)[0] for signal in signals]

    def show(self, t_s: float) -> None:
        """Draw the states at a time, s."""
        for signal, mark in zip(self._signals, self._marks):
            mark.set_markerfacecolor(SIGNAL_COLOR[str(signal.at(t_s)[0])])
            self._ax.draw_artist(mark)


def road_rows(scenario: Scenario) -> list[tuple[Any, str]]:
    """Return the lines of the legend for what there is."""
    features = scenario.map_features
    rows: list[tuple[Any, str]] = []
    if features is not None:
        if features.lanes:
            inferred = sum(lane.inferred_from == "paths" for lane in features.lanes)
            text = f"{len(features.lanes)} lanes" + (f", {inferred} from paths alone" if inferred else "")
            rows.append((Patch(fc=LANE_FACE, ec="none"), text))
        if features.markings:
            rows.append((Line2D([0, 1], [0, 1], color=MARKING_COLOR["white"], lw=1.3), "marking on the ground"))
        if any(m.color == "yellow" for m in features.markings):
            rows.append((Line2D([0, 1], [0, 1], color=MARKING_COLOR["yellow"], lw=1.3), "yellow marking"))
        if features.borders:
            rows.append((Line2D([0, 1], [0, 1], color=BORDER_COLOR, lw=BORDER_PT), "border of a road"))
    if scenario.signals:
        style: dict[str, Any] = {"marker": "o", "ms": 5.0, "mfc": SIGNAL_COLOR["red"], "mec": PAPER, "ls": "none"}
        rows.append((Line2D([], [], **style), "traffic light"))
    return rows


def lane_outline(lane: MapLane) -> Array:
    """Return the outline (2 N, 2) of a lane, m, map frame."""
    xy = lane.points_m[:, :2]
    along = np.gradient(xy, axis=0)
    along /= np.maximum(np.hypot(*along.T), 1e-9)[:, None]
    aside = np.stack([-along[:, 1], along[:, 0]], axis=1) * lane.width_m[:, None] / 2
    return np.concatenate([xy + aside, (xy - aside)[::-1]])


def lane_arrows(lane: MapLane) -> list[Array]:
    """Return triangles (3, 2), m, along the middle of a lane that show its direction."""
    xy = lane.points_m[:, :2]
    traveled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
    count = max(int(traveled[-1] // ARROW_EVERY_M), 1)
    if traveled[-1] < 2 * ARROW_M[0]:
        return []
    arrows = []
    for s in (np.arange(count) + 0.5) * traveled[-1] / count:
        tip, tail = (
            np.array([np.interp(s + d, traveled, column) for column in xy.T]) for d in (ARROW_M[0] / 2, -ARROW_M[0] / 2)
        )
        ahead = tip - tail
        left = np.array([-ahead[1], ahead[0]]) / max(float(np.hypot(*ahead)), 1e-9) * ARROW_M[1]
        arrows.append(np.array([tip, tail + left, tail - left]))
    return arrows


def _shade(marking: Marking, alpha: float) -> tuple[float, float, float, float]:
    doubtful = marking.confidence < MIN_TRUSTED_CONFIDENCE
    return to_rgba(MARKING_COLOR[marking.color or "white"], alpha * (0.4 if doubtful else 1.0))
