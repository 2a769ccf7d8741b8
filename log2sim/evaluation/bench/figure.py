"""The figure: error against run time, one panel for each stage, with the Pareto front as a line."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from log2sim.documents import replaced
from log2sim.evaluation.bench.benchmark import Benchmark
from log2sim.evaluation.bench.bootstrap import error_interval
from log2sim.evaluation.bench.label_placement import place_labels
from log2sim.evaluation.bench.panels import Panel
from log2sim.evaluation.bench.pareto import Point
from log2sim.geometry import Array
from log2sim.visualization.plot.style import CROWD_COLOR, FONT, FRAME, GRID, INK, MUTED, PALETTE, PAPER, printable

COLUMNS = 3
CELL_IN = (4.3, 3.6)
MARGIN_IN = {"left": 0.62, "right": 0.2, "top": 0.62, "bottom": 0.56}
HEAD_IN = 0.62
FRONT, CHOSEN = PALETTE[0], PALETTE[4]


def write_picture(result: Benchmark, path: Path, *, dpi: int = 150) -> None:
    """Write all panels into a PNG, atomically."""
    figure = draw(result)
    with replaced(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi, metadata={"Software": None})


def draw(result: Benchmark) -> Figure:
    """Draw all panels; the last cell explains the marks and gives the recommendations."""
    rows = -(-(len(result.panels) + 1) // COLUMNS)
    width, height = COLUMNS * CELL_IN[0], rows * CELL_IN[1] + HEAD_IN
    figure = Figure(figsize=(width, height), facecolor=PAPER)
    FigureCanvasAgg(figure)
    _title(figure, result)
    for k, panel in enumerate(result.panels):
        _draw_panel(figure.add_axes(_cell(k, rows, width, height)), panel)
    _draw_recommendations(figure.add_axes(_cell(len(result.panels), rows, width, height)), result)
    return figure


def _cell(k: int, rows: int, width: float, height: float) -> tuple[float, float, float, float]:
    """Compute left, bottom, width, height of the axes of cell `k` as fractions of the figure."""
    column, row = k % COLUMNS, k // COLUMNS
    x = column * CELL_IN[0] + MARGIN_IN["left"]
    y = (rows - 1 - row) * CELL_IN[1] + MARGIN_IN["bottom"]
    w = CELL_IN[0] - MARGIN_IN["left"] - MARGIN_IN["right"]
    h = CELL_IN[1] - MARGIN_IN["bottom"] - MARGIN_IN["top"]
    return x / width, y / height, w / width, h / height


def _title(figure: Figure, result: Benchmark) -> None:
    context = result.context
    height = figure.get_figheight()
    against = f"truth: {context.truth.name}" if context.truth is not None else "no truth"
    cameras, lidars = len(context.plan.cameras), len(context.log.lidars)
    counts = [(len(context.schedule), "tick"), (cameras, "camera") if cameras else (lidars, "LiDAR")]
    parts = [f"{n} {what}{'s' * (n != 1)}" for n, what in counts]
    if context.truth is not None and context.scope.max_range_m is not None:
        parts.append(f"within {context.scope.max_range_m:g} m")
    if context.truth is not None and context.scope.categories is not None:
        parts.append(", ".join(context.scope.categories))
    text = " · ".join([*parts, against, "one stage's setting changed at a time"])
    style: dict[str, Any] = {"family": FONT, "ha": "left", "va": "baseline", "parse_math": False}
    x = MARGIN_IN["left"] / figure.get_figwidth()
    title = printable(f"{context.log.name}: error against run time", 90)
    figure.text(x, 1 - 0.38 / height, title, fontsize=13, fontweight="bold", color=INK, **style)
    figure.text(x, 1 - 0.6 / height, printable(text, 150), fontsize=8, color=MUTED, **style)


def _draw_panel(ax: Axes, panel: Panel) -> None:
    shown = [(p, f) for p, f in zip(panel.points, panel.on_front, strict=True) if p.error is not None]
    _style(ax)
    style: dict[str, Any] = {"transform": ax.transAxes, "family": FONT, "va": "baseline", "parse_math": False}
    ax.text(0, 1.1, panel.stage, fontsize=10, fontweight="bold", color=INK, **style)
    label = f"{panel.label}{f' ({panel.unit})' * bool(panel.unit)}"
    ax.text(0, 1.035, printable(label, 90), fontsize=6.8, color=MUTED, **style)
    hidden = [p.setting for p in panel.points if p.error is None]
    if hidden:
        ax.text(0.02, 0.025, printable(f"no error known: {', '.join(hidden)}"), fontsize=6.8, color=MUTED, **style)
    if not shown:
        ax.set(xticks=[], yticks=[])
        return
    points = [p for p, _ in shown]
    x = np.array([p.ms_per_tick for p in points])
    y = np.array([p.error for p in points], dtype=np.float64)
    present = next((p for p in points if p.present), None)
    spread = None if present is None else error_interval(present.by_object)
    if present is not None and spread is not None:
        ax.vlines(present.ms_per_tick, *spread, color=CROWD_COLOR, lw=1.0, alpha=0.6, zorder=1.8)
    _limits(ax, x, np.append(y, spread or ()))
    front = sorted((p.ms_per_tick, float(p.error or 0.0)) for p, f in shown if f)
    ax.step(*zip(*front), where="post", color=FRONT, lw=1.3, alpha=0.55, zorder=2)
    for point, on_front in shown:
        _mark(ax, point, on_front=on_front, chosen=point.setting == panel.recommendation.supported)
    corners = [k for (a, b), (c, d) in pairwise(front) for k in ((a, b), (c, b), (c, d))]
    place_labels(ax, points, np.column_stack([x, y]), np.array(corners).reshape(-1, 2))


def _mark(ax: Axes, point: Point, *, on_front: bool, chosen: bool) -> None:
    x, y = np.array([point.ms_per_tick]), np.array([point.error], dtype=np.float64)
    if chosen:
        ax.plot(x, y, "o", ms=13, mfc="none", mec=CHOSEN, mew=1.6, zorder=3)
    face, edge = (FRONT, PAPER) if on_front else (PAPER, CROWD_COLOR)
    ax.plot(
        x, y, "D" if point.present else "o", ms=6.5 if point.present else 5.5, mfc=face, mec=edge, mew=1.1, zorder=4
    )


def _style(ax: Axes) -> None:
    ax.set_facecolor("#FBFCFD")
    ax.set_axisbelow(True)
    ax.grid(True, color=GRID, lw=0.7)
    ax.tick_params(labelsize=7, colors=MUTED, length=2.5, width=0.6, labelfontfamily=FONT)
    ax.set_xlabel("run time (ms a tick)", fontsize=7.2, color=MUTED, family=FONT)
    for spine in ax.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def _limits(ax: Axes, x: Array, y: Array) -> None:
    """Set a logarithmic time axis at least a factor of three wide, and room for labels on the error axis."""
    low, high = np.log10(max(x.min(), 1e-3)), np.log10(max(x.max(), 1e-3))
    wide = max((high - low) * 1.5, np.log10(3.0))
    start, end = 10 ** ((low + high - wide) / 2), 10 ** ((low + high + wide) / 2)
    ax.set_xscale("log")
    ax.set_xlim(start, end)
    digits = (1, 2, 5) if end > 6 * start else (1, 1.5, 2, 3, 4, 5, 6, 8)
    steps = [m * 10.0**k for k in range(-4, 7) for m in digits]
    ax.xaxis.set_major_locator(FixedLocator([s for s in steps if start <= s <= end]))
    ax.xaxis.set_minor_locator(NullLocator())
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    room = max(float(np.ptp(y)) * 0.22, float(y.max()) * 0.1, 1e-6)
    ax.set_ylim(max(float(y.min()) - room, -0.4 * room), float(y.max()) + room)


def _draw_recommendations(ax: Axes, result: Benchmark) -> None:
    """Draw the legend and the recommendations."""
    ax.set_axis_off()
    ax.set(xlim=(0, 1), ylim=(0, 1))
    mark: dict[str, Any] = {"ls": "none", "mew": 1.1}
    handles = [
        (Line2D([], [], marker="D", ms=6.5, mfc=FRONT, mec=PAPER, **mark), "present setting, on the front"),
        (Line2D([], [], marker="D", ms=6.5, mfc=PAPER, mec=CROWD_COLOR, **mark), "present setting, behind it"),
        (Line2D([], [], marker="o", ms=12, mfc="none", mec=CHOSEN, ls="none", mew=1.6), "what the figures support"),
        (Line2D([], [], marker="o", ms=5.5, mfc=FRONT, mec=PAPER, **mark), "on the Pareto front"),
        (Line2D([], [], marker="o", ms=5.5, mfc=PAPER, mec=CROWD_COLOR, **mark), "behind it"),
        (Line2D([], [], color=CROWD_COLOR, lw=1.0, alpha=0.6), "5 to 95 % of resamples"),
    ]
    ax.legend(
        [h for h, _ in handles], [t for _, t in handles], loc="upper left", bbox_to_anchor=(-0.03, 1.14), frameon=False,
        ncols=2, prop={"family": FONT, "size": 7.0}, labelcolor=INK, handletextpad=0.5, columnspacing=1.2, labelspacing=0.7,
    )  # fmt: skip
    y = 0.86
    for panel in result.panels:
        for k, line in enumerate(wrap(printable(panel.recommendation.reason, 240), 50)):
            head = panel.stage if k == 0 else ""
            ax.text(0, y, head, fontsize=7.2, family=FONT, color=INK, weight="bold", va="top", parse_math=False)
            ax.text(0.23, y, line, fontsize=7.2, family=FONT, color=INK, va="top", parse_math=False)
            y -= 0.058
        y -= 0.03
    for note in result.notes:
        for line in wrap(printable(f"Note: {note}", 240), 70):
            ax.text(0, y, line, fontsize=6.6, family=FONT, color=MUTED, va="top", parse_math=False)
            y -= 0.05
