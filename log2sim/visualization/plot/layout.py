"""Layout of a figure: title, map axes, and beside the map the legend, the scale and the north arrow."""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch, Polygon
from matplotlib.ticker import FuncFormatter, MultipleLocator

from log2sim.visualization.plot.labels import speed_text
from log2sim.visualization.plot.roles import AgentRole, AgentRoles
from log2sim.visualization.plot.style import (
    COLLISION_MARK,
    CROWD_COLOR,
    FONT,
    FRAME,
    GRID,
    INK,
    MARKERS,
    MUTED,
    PAPER,
    PARKED_EDGE,
    PARKED_FACE,
    printable,
)
from log2sim.visualization.plot.viewport import Viewport, nice_step

WIDTH_IN = 10.0
LEFT_IN, SIDE_IN, TOP_IN, BOTTOM_IN, GAP_IN = 0.72, 2.3, 0.74, 0.52, 0.2
MIN_MAP_IN, MAX_MAP_IN = 3.4, 8.4
ROW_IN = 0.178
CHART_IN, CHART_GAP_IN, TIME_IN, HEAD_IN = 0.56, 0.12, 0.36, 0.26
"""Below the map: a chart, the gap below it, the time axis, and the heading of the charts."""


@dataclass(frozen=True, eq=False)
class FigureLayout:
    """A figure and its parts.

    Attributes
    ----------
    figure : Figure
    canvas : FigureCanvasAgg
    ax : Axes
        Of the map.
    view : Viewport
        What the map shows.
    foot_in : float, inch
        Height below the map for charts.
    """

    figure: Figure
    canvas: FigureCanvasAgg
    ax: Axes
    view: Viewport
    foot_in: float = 0.0

    @property
    def width_in(self) -> float:
        """Return the width of the figure, inch."""
        return float(self.figure.get_figwidth())

    def set_width_px(self, width_px: int) -> None:
        """Choose the dots per inch that make the figure so wide, and its sides whole pixels."""
        height_px = round(width_px * self.figure.get_figheight() / self.width_in)
        self.figure.set_dpi(width_px / self.width_in)
        # A hair more, since the canvas cuts off parts of pixels.
        self.figure.set_size_inches((width_px + 0.01) / self.figure.dpi, (height_px + 0.01) / self.figure.dpi)


def make_layout(
    view: Viewport, legend_rows: int, *, projected: bool, foot_in: float = 0.0, aspect: float | None = None
) -> FigureLayout:
    """Lay out a figure whose map has the proportions of the view within limits, above `foot_in` inches for charts.

    With an `aspect`, height over width, the figure has that, and is so large that all has room.
    """
    width, map_width = WIDTH_IN, WIDTH_IN - LEFT_IN - SIDE_IN - GAP_IN
    needed = legend_rows * ROW_IN + 1.0
    around = TOP_IN + BOTTOM_IN + foot_in
    if aspect is None:
        wanted = max(map_width * view.height_m / view.width_m, needed)
        map_height = float(np.clip(wanted, MIN_MAP_IN, MAX_MAP_IN))
    else:
        width = max(WIDTH_IN, (max(needed, MIN_MAP_IN) + around) / aspect)
        map_width, map_height = width - LEFT_IN - SIDE_IN - GAP_IN, width * aspect - around
    height = map_height + around
    figure = Figure(figsize=(width, height), facecolor=PAPER)
    canvas = FigureCanvasAgg(figure)
    bottom = foot_in + BOTTOM_IN
    ax = figure.add_axes((LEFT_IN / width, bottom / height, map_width / width, map_height / height))
    fitted = view.fitted(map_width * 72, map_height * 72)
    ax.set(xlim=(fitted.x0, fitted.x1), ylim=(fitted.y0, fitted.y1), facecolor="#FBFCFD")
    ax.set_aspect("equal", adjustable="box")
    _axes_style(ax, fitted, projected)
    return FigureLayout(figure, canvas, ax, fitted, foot_in)


def write_title(layout: FigureLayout, title: str, subtitle: str) -> None:
    """Write the title and a smaller line below it, flush with the map's left edge."""
    height = layout.figure.get_figheight()
    style: dict[str, Any] = {"family": FONT, "ha": "left", "va": "baseline", "parse_math": False}
    x = LEFT_IN / layout.width_in
    layout.figure.text(x, 1 - 0.36 / height, printable(title, 70), fontsize=13, fontweight="bold", color=INK, **style)
    layout.figure.text(x, 1 - 0.59 / height, printable(subtitle, 130), fontsize=8, color=MUTED, **style)


def draw_legend(layout: FigureLayout, rows: list[tuple[Any, str]]) -> None:
    """Draw the legend in the column beside the map, where it covers nothing."""
    height = layout.figure.get_figheight()
    x = 1 - SIDE_IN / layout.width_in
    legend = layout.figure.legend(
        [handle for handle, _ in rows], [text for _, text in rows], loc="upper left", bbox_to_anchor=(x, 1 - TOP_IN / height),
        borderaxespad=0, frameon=False, prop={"family": FONT, "size": 7.0}, handlelength=2.0, labelspacing=0.56,
        handletextpad=0.7, labelcolor=INK,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)


def legend_rows(
    roles: AgentRoles,
    mark_step_s: float | None,
    told: Set[str],
    *,
    truth: bool,
    replay: bool,
    collisions: int,
    outside: int,
) -> list[tuple[Any, str]]:
    """List handles and texts: leading movers but the `told` ones, counts of the others, then the meaning of marks that occur."""
    rows: list[tuple[Any, str]] = []
    listed = any(role.leading and role.agent.id not in told for role in roles.movers)
    if roles.movers:
        present = mark_step_s is None and not listed  # an animation whose labels tell the speed
        rows.append((_line("none"), "km/h: speed at this time" if present else "km/h: highest speed of each"))
    for role in roles.movers:
        if role.leading and role.agent.id not in told:
            marker = "s" if role.is_ego else MARKERS[role.group]
            rows.append((_line(role.color, lw=2.4 if role.is_ego else 1.7, marker=marker, ms=4.6), _name(role)))
    rest = sum(not r.leading for r in roles.movers)
    if rest:
        rows.append((_line(CROWD_COLOR, lw=1.0), f"{rest} more moving, farther away"))
    if roles.stationary:
        rows.append((Patch(fc=PARKED_FACE, ec=PARKED_EDGE, lw=0.6), f"{len(roles.stationary)} static"))
    if roles.movers and mark_step_s is not None:
        rows.append((Patch(fc=PAPER, ec=MUTED, lw=0.9), "start (hollow), end (filled)"))
        rows.append((_line("none", marker="o", ms=3.2, mfc=PAPER, mec=MUTED, mew=0.9), f"every {mark_step_s:g} s"))
    if mark_step_s is not None and any(not r.agent.waypoints.observed.all() for r in roles.movers):
        rows.append((_line(MUTED, lw=1.3, ls=(0, (2.2, 1.8))), "not observed, interpolated"))
    if any(a.color is not None for a in (*(r.agent for r in roles.movers), *roles.stationary)):
        rows.append(
            (_line("none", marker="^", ms=4.6, mfc="#C0392B", mec=MUTED, mew=0.4), "heading, in the vehicle's color")
        )
    if truth:
        rows.append((_line(INK, lw=0.8, ls=(0, (3, 2))), "truth"))
    if replay:
        rows.append((_line(MUTED, lw=1.9, ls=(0, (0.1, 1.6)), dash_capstyle="round"), "replay"))
    if collisions:
        rows.append((Line2D([], [], ls="none", **{**COLLISION_MARK, "ms": 6.0}), "collision of the replay"))
    if outside:
        rows.append((_line("none"), f"{outside} outside this view"))
    return rows


def draw_scale_and_north(layout: FigureLayout, *, projected: bool) -> None:
    """Draw a scale bar of a round length at the foot of the column, and a north arrow on a projected map."""
    height = layout.figure.get_figheight()
    m_per_in = layout.view.m_per_pt * 72
    length_m = nice_step(1.35 * m_per_in)
    x, y, w = layout.width_in - SIDE_IN + 0.06, layout.foot_in + BOTTOM_IN + 0.08, length_m / m_per_in
    column = layout.figure.add_axes((0, 0, 1, 1), frameon=False)
    column.set(xlim=(0, layout.width_in), ylim=(0, height), xticks=[], yticks=[])
    column.set_zorder(-1)
    for k, face in enumerate((INK, PAPER)):
        column.add_patch(Polygon(_rectangle(x + k * w / 2, y, w / 2, 0.06), fc=face, ec=INK, lw=0.8, closed=True))
    style: dict[str, Any] = {"family": FONT, "fontsize": 7, "color": INK, "va": "bottom"}
    column.text(x, y + 0.1, "0", ha="center", **style)
    column.text(x + w, y + 0.1, f"{length_m:g} m", ha="center", **style)
    if projected:
        nx, ny = layout.width_in - 0.42, y
        column.add_patch(Polygon([(nx, ny + 0.4), (nx - 0.1, ny), (nx, ny + 0.09)], fc=INK, ec=INK, lw=0.8))
        column.add_patch(Polygon([(nx, ny + 0.4), (nx + 0.1, ny), (nx, ny + 0.09)], fc=PAPER, ec=INK, lw=0.8))
        column.text(nx, ny + 0.44, "N", ha="center", **{**style, "fontsize": 8.5, "fontweight": "bold"})


def _axes_style(ax: Axes, view: Viewport, projected: bool) -> None:
    names = ("east", "north") if projected else ("map x", "map y")
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, lw=0.7)
    step_m = nice_step(max(view.width_m, view.height_m) / 5)
    for axis, name, low in zip((ax.xaxis, ax.yaxis), names, (view.x0, view.y0)):
        # Seven-digit tick labels are unreadable; their common part goes into the axis label.
        base_m = float(np.floor(low / 1000) * 1000) if abs(low) >= 1e5 else 0.0
        axis.set_major_locator(MultipleLocator(step_m))
        axis.set_major_formatter(FuncFormatter(lambda v, _, base_m=base_m: f"{v - base_m:.6g}".replace("-", "−")))
        since = f" − {base_m:.0f}" if base_m > 0 else f" + {-base_m:.0f}" if base_m < 0 else ""
        axis.set_label_text(f"{name}{since} (m)", fontsize=7.5, color=MUTED, family=FONT)
    ax.tick_params(labelsize=7, colors=MUTED, length=2.5, width=0.6, labelfontfamily=FONT)
    for spine in ax.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def _name(role: AgentRole) -> str:
    moving = speed_text(role.agent)
    if role.is_ego:
        return f"ego · {moving}"
    kind = "" if role.agent.id.startswith(role.agent.category) else f" · {role.agent.category}"
    room = 34 - len(f"{kind} · {moving}")  # 34 letters fit into the column
    return f"{printable(role.agent.id, max(room, 4))}{kind} · {moving}"


def _line(color: str, **style: Any) -> Line2D:
    edge = {"mec": PAPER, "mew": 0.5} if "mec" not in style else {}
    return Line2D([0, 1], [0, 1], color=color, **{"lw": 0, "mfc": color, **edge, **style})


def _rectangle(x: float, y: float, w: float, h: float) -> list[tuple[float, float]]:
    return [(x, y), (x + w, y), (x + w, y + h), (x, y + h)]
