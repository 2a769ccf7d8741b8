"""Charts below the map: commands, response and tracking errors of one replayed agent over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.ticker import FuncFormatter, MaxNLocator

from log2sim.geometry import Array
from log2sim.simulation.metrics.collisions import REPLAY
from log2sim.visualization.plot.layout import (
    CHART_GAP_IN,
    CHART_IN,
    GAP_IN,
    HEAD_IN,
    LEFT_IN,
    SIDE_IN,
    TIME_IN,
    FigureLayout,
)
from log2sim.visualization.plot.style import ALARM, FONT, FRAME, INK, MUTED, PAPER, halo, printable_label, style_axes
from log2sim.visualization.plot.viewport import AgentRole, AgentRoles

KMH = 3.6
# A curve of a chart: label, times and values (T,), and "thin", "muted" where it is secondary, or "ribbon" where it is the reference
# of the thin line over it.
Curve = tuple[str, Array, Array, str]


class Chart(NamedTuple):
    """Curves that share axes."""

    name: str
    unit: str
    min_span: float  # smallest range of the value axis, in `unit`
    lines: tuple[Curve, ...]  # an animation shows the present value of the last one


@dataclass(frozen=True, eq=False)
class AgentTimeline:
    """What the charts show of one agent."""

    role: AgentRole
    driver: str
    charts: tuple[Chart, ...]
    collisions_s: tuple[float, ...]  # start of its collisions that belong to the replay


def timeline_of(replay: Any, roles: AgentRoles) -> AgentTimeline | None:
    """Choose the ego, else the driven agent farthest from its path; None when all agents are where the scenario has them."""
    if replay is None:
        return None
    role_of = {r.agent.id: r for r in roles.movers}
    driven = [a for a in replay.agents if a.id in role_of and a.cross_track_m is not None]
    if not driven:
        return None
    agent = max(driven, key=lambda a: (a.id == "ego", float(np.max(np.abs(a.cross_track_m)))))
    role = role_of[agent.id]
    events = [e for e in replay.metrics.get("collisions", ()) if agent.id in e["agents"] and e["belongs_to"] == REPLAY]
    t, w, commands = agent.t_s, role.agent.waypoints, agent.commands
    speeds: tuple[Curve, ...] = (
        ("scenario", w.t_s, w.speed_mps * KMH, "ribbon"), ("replay", t, agent.speed_mps * KMH, "thin"),
    )  # fmt: skip
    charts = [Chart("speed", "km/h", 4.0, speeds)]
    if commands is not None:
        # The pedal acts along the gear's direction, which in reverse is against the heading.
        response, steer = agent.accel_mps2 * commands.gear, np.degrees(commands.steer_rad)
        wheel = ("command", t, steer, "ribbon"), ("response", t, np.degrees(agent.steer_rad), "thin")
        pedal = ("command", t, commands.pedal_mps2, "ribbon"), ("response", t, response, "thin")
        charts += [Chart("pedal", "m/s²", 1.0, pedal), Chart("steering", "°", 2.0, wheel)]
    along, across = agent.along_track_m, agent.cross_track_m
    errors = ("along (+ ahead)", t, along, "muted"), ("across (+ left)", t, across, "thin")
    charts.append(Chart("tracking error", "m", 0.1, errors))
    return AgentTimeline(role, agent.driver, tuple(charts), tuple(e["t_s"] for e in events))


@dataclass(frozen=True, eq=False)
class TimelineCharts:
    """Charts that were drawn."""

    timeline: AgentTimeline
    axes: tuple[Axes, ...]  # from the top, one for each chart
    moving: list[Any] = field(default_factory=list)  # artists of an animation

    def start(self) -> None:
        """Create the artists that move."""
        hidden: dict[str, Any] = {"animated": True}
        for ax, chart in zip(self.axes, self.timeline.charts):
            cursor = ax.axvline(0.0, color=INK, lw=0.9, **hidden)
            (dot,) = ax.plot([], [], "o", ms=4, mfc=self.timeline.role.color, mec=PAPER, mew=0.7, zorder=9, **hidden)
            # At the right edge of the figure, level with the name of the chart.
            value = ax.text(
                _beside(ax, SIDE_IN + GAP_IN - 0.12), 1.06, "", transform=ax.transAxes, ha="right", va="top", fontsize=7.0,
                family=FONT, color=INK, parse_math=False, path_effects=halo(), clip_on=False, **hidden,
            )  # fmt: skip
            self.moving.append((ax, chart, cursor, dot, value))

    def show(self, t_s: float) -> None:
        """Draw the cursor and the values at `t_s` over the static artists."""
        for ax, chart, cursor, dot, value in self.moving:
            _, times_s, values, _ = chart.lines[-1]
            there = times_s[0] - 1e-6 <= t_s <= times_s[-1] + 1e-6
            now = float(np.interp(t_s, times_s, values))
            cursor.set_xdata([t_s, t_s])
            dot.set_data([t_s] if there else [], [now] if there else [])
            value.set_text(_number(now, chart) if there else "")
            for artist in (cursor, dot):
                ax.draw_artist(artist)
            ax.figure.draw_artist(value)


def draw_charts(
    layout: FigureLayout, timeline: AgentTimeline, span_s: tuple[float, float], *, moving: bool
) -> TimelineCharts:
    """Draw the charts below the map; a still shows the largest values, an animation the present ones."""
    height = layout.figure.get_figheight()
    count = len(timeline.charts)
    top = TIME_IN + count * (CHART_IN + CHART_GAP_IN)
    width = layout.width_in - LEFT_IN - SIDE_IN - GAP_IN
    axes: list[Axes] = []
    for k, chart in enumerate(timeline.charts):
        bottom = top - (k + 1) * (CHART_IN + CHART_GAP_IN) + CHART_GAP_IN
        place = LEFT_IN / layout.width_in, bottom / height, width / layout.width_in, CHART_IN / height
        ax = layout.figure.add_axes(place)
        last = k == count - 1
        color = timeline.role.color
        styles: dict[str, dict[str, Any]] = {
            "ribbon": {"color": to_rgba(color, 0.28), "lw": 3.4, "solid_capstyle": "round"},
            "muted": {"color": MUTED, "lw": 1.0, "ls": (0, (3, 1.6))},
            "thin": {"color": color, "lw": 1.2},
        }
        ax.set(xlim=span_s, facecolor="#FBFCFD")
        everything = np.concatenate([values for _, _, values, _ in chart.lines])
        low, high = min(float(everything.min()), 0.0), max(float(everything.max()), 0.0)
        missing = max(chart.min_span - (high - low), 0.0)
        # A value that is never negative keeps zero at the bottom.
        below = 0.0 if low == 0.0 and high >= chart.min_span else missing / 2
        pad = 0.08 * max(high - low, chart.min_span)
        ax.set_ylim(low - below - pad, high + missing - below + pad)
        ax.axhline(0.0, color=FRAME, lw=0.8, zorder=1)
        for t in timeline.collisions_s:
            ax.axvline(t, color=ALARM, lw=1.0, zorder=2)
        handles = [ax.plot(t_s, values, zorder=3, **styles[style])[0] for _, t_s, values, style in chart.lines]
        style_axes(ax, size_pt=6.5, length_pt=2.0)
        ax.yaxis.set_major_locator(MaxNLocator(nbins=3, steps=[1, 2, 5, 10]))
        for axis in (ax.xaxis, ax.yaxis):
            axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.6g}".replace("-", "−")))
        ax.tick_params(labelbottom=last)
        if last:
            ax.set_xlabel("time (s)", fontsize=7.5, color=MUTED, family=FONT)
        labels = [label for label, *_ in chart.lines]
        if not moving:
            largest = [float(values[np.argmax(np.abs(values))]) for _, _, values, _ in chart.lines]
            labels = [f"{label} · max {_number(value, chart)}" for label, value in zip(labels, largest)]
        legend = ax.legend(
            handles[::-1], labels[::-1], title=f"{chart.name} ({chart.unit})", alignment="left",
            loc="upper left", bbox_to_anchor=(_beside(ax, GAP_IN), 1.06), borderaxespad=0, borderpad=0, frameon=False,
            prop={"family": FONT, "size": 6.5}, title_fontproperties={"family": FONT, "size": 7, "weight": "bold"},
            handlelength=2.0, labelspacing=0.35, handletextpad=0.7, labelcolor=INK,
        )  # fmt: skip
        legend.get_title().set_color(INK)
        axes.append(ax)
    role, spoken = timeline.role, {"pid": "PID", "policy": "a policy", "reactive": "what is ahead"}
    driver = spoken.get(timeline.driver, timeline.driver)
    layout.figure.text(
        LEFT_IN / layout.width_in, (top + HEAD_IN - 0.16) / height, f"{printable_label(role.agent.id, 40)} in the replay, driven by {driver}",
        family=FONT, fontsize=8.5, fontweight="bold", color=role.color, parse_math=False, va="baseline",
    )  # fmt: skip
    return TimelineCharts(timeline, tuple(axes))


def charts_height_in(timeline: AgentTimeline | None) -> float:
    """Compute the height, inch, of the charts below the map."""
    if timeline is None:
        return 0.0
    return TIME_IN + len(timeline.charts) * (CHART_IN + CHART_GAP_IN) + HEAD_IN


def _beside(ax: Axes, inches: float) -> float:
    """Convert inches to the right of axes into a fraction of their width."""
    figure = ax.get_figure(root=True)
    assert figure is not None
    return 1.0 + inches / (ax.get_position().width * figure.get_figwidth())


def _number(value: float, chart: Chart) -> str:
    digits = 3 if chart.min_span < 1.0 else 1
    text = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # no minus before a zero
    return f"{text}{'' if chart.unit == '°' else ' '}{chart.unit}"
