"""What one agent of a replay was told, did and missed over time, as strips below the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.lines import Line2D
from matplotlib.ticker import FuncFormatter, MaxNLocator

from log2sim.datatypes import Scenario
from log2sim.geometry import Array
from log2sim.visualization.plot.layout import (
    HEAD_IN,
    LEFT_IN,
    SIDE_IN,
    STRIP_GAP_IN,
    STRIP_IN,
    TIME_IN,
    WIDTH_IN,
    Sheet,
)
from log2sim.visualization.plot.roles import Cast, Role
from log2sim.visualization.plot.style import ALARM, FONT, FRAME, GRID, INK, MUTED, PAPER, halo, printable

KMH = 3.6


@dataclass(frozen=True, eq=False)
class Line:
    """One curve of a strip; a `ribbon` is what the thin line over it was asked to do, `quiet` what matters less."""

    label: str
    t_s: Array
    values: Array
    look: str = "thin"


@dataclass(frozen=True, eq=False)
class Strip:
    """Curves that share an axis, which spans at least `least_span` in `unit`; the last curve is the one read out."""

    name: str
    unit: str
    least_span: float
    lines: tuple[Line, ...]


@dataclass(frozen=True, eq=False)
class Story:
    """Whose strips they are, the strips, and when it hit somebody whom it does not hit in the log."""

    role: Role
    driver: str
    strips: tuple[Strip, ...]
    hits_s: tuple[float, ...] = ()


def story_of(replay: Any, scenario: Scenario, cast: Cast) -> Story | None:
    """The strips of the ego, else of the follower farthest from its path; None where nobody but the log drives."""
    if replay is None:
        return None
    roles = {r.agent.id: r for r in cast.movers}
    driven = [a for a in replay.agents if a.id in roles and a.cross_track_m is not None]
    if not driven:
        return None
    agent = next((a for a in driven if a.id == "ego"), None) or max(
        driven, key=lambda a: float(np.max(np.abs(a.cross_track_m)))
    )
    role = roles[agent.id]
    events = [e for e in replay.metrics.get("collisions", ()) if agent.id in e["agents"] and not e["in_log"]]
    return Story(role, agent.driver, _strips(agent, role), tuple(e["t_s"] for e in events))


def _strips(agent: Any, role: Role) -> tuple[Strip, ...]:
    t, w = agent.t_s, role.agent.waypoints
    out = [
        Strip(
            "speed", "km/h", 4.0,
            (Line("log", w.t_s, w.speed_mps * KMH, "ribbon"), Line("replay", t, agent.speed_mps * KMH)),
        )
    ]  # fmt: skip
    if agent.commands is not None:
        told = agent.commands
        # Along the pedal's own direction, which in reverse is against the heading.
        done = agent.accel_mps2 * told.gear
        out += [
            Strip("pedal", "m/s²", 1.0, (Line("told", t, told.pedal_mps2, "ribbon"), Line("done", t, done))),
            Strip(
                "steering", "°", 2.0,
                (
                    Line("told", t, np.degrees(told.steer_rad), "ribbon"),
                    Line("done", t, np.degrees(agent.steer_rad)),
                ),
            ),
        ]  # fmt: skip
    lines = (Line("along (+ ahead)", t, agent.along_track_m, "quiet"), Line("across (+ left)", t, agent.cross_track_m))
    return (*out, Strip("off the log", "m", 0.1, lines))


@dataclass(frozen=True, eq=False)
class DrawnStrips:
    """The axes of the strips, from the top, and the strips they show."""

    story: Story
    axes: tuple[Axes, ...]
    moving: list[Any] = field(default_factory=list)

    def start(self) -> None:
        """Make the parts that move."""
        hidden: dict[str, Any] = {"animated": True}
        for ax, strip in zip(self.axes, self.story.strips):
            cursor = ax.axvline(0.0, color=INK, lw=0.9, **hidden)
            (dot,) = ax.plot([], [], "o", ms=4, mfc=self.story.role.color, mec=PAPER, mew=0.7, zorder=9, **hidden)
            value = _read_out(ax, "", **hidden)
            self.moving.append((ax, strip, cursor, dot, value))

    def show(self, t_s: float) -> None:
        """Paint the moment `t_s` over the ground."""
        for ax, strip, cursor, dot, value in self.moving:
            line = strip.lines[-1]
            there = line.t_s[0] - 1e-6 <= t_s <= line.t_s[-1] + 1e-6
            now = float(np.interp(t_s, line.t_s, line.values))
            cursor.set_xdata([t_s, t_s])
            dot.set_data([t_s] if there else [], [now] if there else [])
            value.set_text(_number(now, strip) if there else "")
            for artist in (cursor, dot):
                ax.draw_artist(artist)
            ax.figure.draw_artist(value)


def draw_strips(sheet: Sheet, story: Story, span_s: tuple[float, float], *, moving: bool) -> DrawnStrips:
    """Draw the strips into the foot of the sheet; a still says the largest values, a moving one the present one."""
    height = sheet.figure.get_figheight()
    count = len(story.strips)
    top = TIME_IN + count * (STRIP_IN + STRIP_GAP_IN)
    width = WIDTH_IN - LEFT_IN - SIDE_IN - 0.2
    axes: list[Axes] = []
    for k, strip in enumerate(story.strips):
        bottom = top - (k + 1) * (STRIP_IN + STRIP_GAP_IN) + STRIP_GAP_IN
        ax = sheet.figure.add_axes((LEFT_IN / WIDTH_IN, bottom / height, width / WIDTH_IN, STRIP_IN / height))
        _draw_strip(ax, strip, story, span_s, last=k == count - 1, moving=moving)
        axes.append(ax)
    role = story.role
    name = role.label if role.is_ego or role.label == role.agent.id else f"{role.label} · {role.agent.id}"
    sheet.figure.text(
        LEFT_IN / WIDTH_IN, (top + HEAD_IN - 0.16) / height, f"{printable(name, 40)} in the replay, driven by {_spoken(story.driver)}",
        family=FONT, fontsize=8.5, fontweight="bold", color=role.color, parse_math=False, va="baseline",
    )  # fmt: skip
    return DrawnStrips(story, tuple(axes))


def foot_in(story: Story | None) -> float:
    """Height in inches that the strips take below the map."""
    if story is None:
        return 0.0
    return TIME_IN + len(story.strips) * (STRIP_IN + STRIP_GAP_IN) + HEAD_IN


def _draw_strip(ax: Axes, strip: Strip, story: Story, span_s: tuple[float, float], *, last: bool, moving: bool) -> None:
    color = story.role.color
    looks: dict[str, dict[str, Any]] = {
        "ribbon": {"color": to_rgba(color, 0.28), "lw": 3.4, "solid_capstyle": "round"},
        "quiet": {"color": MUTED, "lw": 1.0, "ls": (0, (3, 1.6))},
        "thin": {"color": color, "lw": 1.2},
    }
    ax.set(xlim=span_s, facecolor="#FBFCFD")
    ax.set_ylim(*_limits(strip))
    ax.axhline(0.0, color=FRAME, lw=0.8, zorder=1)
    for t in story.hits_s:
        ax.axvline(t, color=ALARM, lw=1.0, zorder=2)
    handles = [ax.plot(line.t_s, line.values, zorder=3, **looks[line.look])[0] for line in strip.lines]
    _style(ax, last=last)
    _legend(ax, strip, handles, [line.label if moving else _with_largest(line, strip) for line in strip.lines])


def _style(ax: Axes, *, last: bool) -> None:
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, lw=0.7)
    ax.yaxis.set_major_locator(MaxNLocator(nbins=3, steps=[1, 2, 5, 10]))
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:.6g}".replace("-", "−")))
    ax.tick_params(labelsize=6.5, colors=MUTED, length=2.0, width=0.6, labelfontfamily=FONT, labelbottom=last)
    if last:
        ax.set_xlabel("time (s)", fontsize=7.5, color=MUTED, family=FONT)
    for spine in ax.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def _legend(ax: Axes, strip: Strip, handles: Sequence[Line2D], labels: Sequence[str]) -> None:
    legend = ax.legend(
        handles[::-1], labels[::-1], title=f"{strip.name} ({strip.unit})", alignment="left",
        loc="upper left", bbox_to_anchor=(_beside(ax, 0.2), 1.06), borderaxespad=0, borderpad=0, frameon=False,
        prop={"family": FONT, "size": 6.5}, title_fontproperties={"family": FONT, "size": 7, "weight": "bold"},
        handlelength=2.0, labelspacing=0.35, handletextpad=0.7, labelcolor=INK,
    )  # fmt: skip
    legend.get_title().set_color(INK)


def _read_out(ax: Axes, text: str, **style: Any) -> Any:
    """A value at the right edge of the sheet, level with the strip's name."""
    return ax.text(
        _beside(ax, SIDE_IN + 0.2 - 0.12), 1.06, text, transform=ax.transAxes, ha="right", va="top", fontsize=7.0,
        family=FONT, color=INK, parse_math=False, path_effects=halo(), clip_on=False, **style,
    )  # fmt: skip


def _beside(ax: Axes, inches: float) -> float:
    """The place so many inches to the right of axes, as a share of their width."""
    return 1.0 + inches / (ax.get_position().width * WIDTH_IN)


def _limits(strip: Strip) -> tuple[float, float]:
    values = np.concatenate([line.values for line in strip.lines])
    low, high = min(float(values.min()), 0.0), max(float(values.max()), 0.0)
    missing = max(strip.least_span - (high - low), 0.0)
    # What never goes below zero keeps zero at its foot.
    below = 0.0 if low == 0.0 and high >= strip.least_span else missing / 2
    pad = 0.08 * max(high - low, strip.least_span)
    return low - below - pad, high + missing - below + pad


def _with_largest(line: Line, strip: Strip) -> str:
    largest = float(line.values[np.argmax(np.abs(line.values))])
    return f"{line.label} · max {_number(largest, strip)}"


def _number(value: float, strip: Strip) -> str:
    digits = 3 if strip.least_span < 1.0 else 1
    text = f"{round(value, digits) + 0.0:.{digits}f}".replace("-", "−")  # no minus before a zero
    return f"{text}{'' if strip.unit == '°' else ' '}{strip.unit}"


def _spoken(driver: str) -> str:
    return {"pid": "PID", "policy": "a policy", "reactive": "what is ahead"}.get(driver, driver)
