"""Error against run time of the pipeline over methods and settings, as panels, figure, document and table."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from textwrap import wrap
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.ticker import FixedLocator, FuncFormatter, NullLocator

from log2sim.config import Config
from log2sim.datatypes import Log, Scenario
from log2sim.errors import MissingExtra, ScenarioError
from log2sim.evaluation.bench import settings
from log2sim.evaluation.bench.runs import STAGE as ENDS_STAGE
from log2sim.evaluation.bench.runs import (
    BenchContext,
    Progress,
    ends_settings,
    homography_points,
    make_context,
    make_context_of_ends,
    run_all,
    whole_points,
)
from log2sim.evaluation.bench.scores import EVERYTHING, ScoreScope
from log2sim.evaluation.metrics.evaluator import rounded_tree
from log2sim.evaluation.road import cell
from log2sim.files.documents import check
from log2sim.files.version import __version__
from log2sim.geometry import NS_PER_S, Array
from log2sim.visualization.plot import style

__all__ = ["Benchmark", "Panel", "ScoreScope", "bench"]
OWN_STAGES = {"detect": ("detect",), "measure": ("measure", "fuse"), "smooth": ("smooth",)}
WITHOUT_TRUTH = "the log has no labels: these figures say how steady a setting is, not how right"


@dataclass(frozen=True)
class Panel:
    """The settings of a stage."""

    stage: str
    # error, label, unit: key of the figure that is the error, its description and its unit.
    error: str
    label: str
    unit: str
    points: tuple[settings.Point, ...]
    on_front: tuple[bool, ...]  # which points are Pareto-optimal
    recommendation: settings.Recommendation


# Key, description and unit of a stage's error with truth, and without.
ERRORS = {
    "detect": (
        ("error_m", "position error, missed and false objects counted", "m"),
        ("gap_share", "part of the objects' ticks without a detection", ""),
    ),
    "measure": (
        ("error_m", "error of measured centers, cut at 2 m", "m"),
        ("smoothing_residual_m", "measurements' distance from the smoothed path", "m"),
    ),
    "homography": (("error_m", "feet of obstacles placed by it alone, distance from LiDAR's, cut at 2 m", "m"),) * 2,
    "smooth": (
        ("state_error_m", "error of the position one second ahead", "m"),
        ("jitter_m", "jitter of waypoints", "m"),
    ),
    "whole run": (
        ("error_m", "position error, missed and false objects counted", "m"),
        ("jitter_m", "jitter of waypoints", "m"),
    ),
    ENDS_STAGE: (
        ("error_m", "vehicle, road, and both by LiDAR: position error, missed and false objects counted", "m"),
        ("jitter_m", "vehicle, road, and both by LiDAR: jitter of waypoints", "m"),
    ),
}


def make_panels(context: BenchContext, report: Progress, default: Sequence[settings.Point] = ()) -> list[Panel]:
    """Run all settings and make one panel for each stage and one for whole runs, with those of the default beside them."""
    runs, observations = run_all(context, report)
    homographies = homography_points(context, observations, report)
    # Where there is no default beside them, the run of the present settings is marked.
    present_name = f"{context.grid.present.config.detect.name} alone" if default else "present settings"
    whole, error = list(default), ERRORS["whole run"][context.truth is None][0]
    for r in runs:
        name, marked = present_name if r.setting.present else r.setting.key, r.setting.present and not default
        stages = {stage: context.ms_per_tick(s) for stage, s in r.stages_s.items()}
        ms = context.ms_per_tick(r.seconds)
        whole.append(r.score.point(name, marked, ms, error, stages_ms_per_tick=stages))
    if homographies:  # whole runs state the share of the obstacles that their homographies place
        shares = {f"homography: {p.setting}": p.figures["placed_share"] for p in homographies}
        present = next(p for p in homographies if p.present).figures["placed_share"]
        placed = [shares.get(p.setting, present) for p in whole]
        whole = [replace(p, figures={**p.figures, "placed_share": share}) for p, share in zip(whole, placed)]

    def own(stage: str) -> list[settings.Point]:
        points = []
        for r in runs:
            if r is not runs[0] and r.setting.stage != stage:  # the present run belongs to every stage
                continue
            name = r.setting.name if r.setting.stage == stage else getattr(context.grid, stage)[0].name
            ms = context.ms_per_tick(sum(r.stages_s.get(s, 0.0) for s in OWN_STAGES[stage]))
            score = r.measurement_score if stage == "measure" and context.truth is not None else r.score
            points.append(score.point(name, r.setting.present, ms, ERRORS[stage][context.truth is None][0]))
        return points

    points = {
        "detect": own("detect"), "measure": own("measure"), "homography": homographies, "smooth": own("smooth"),
        "whole run": whole,
    }  # fmt: skip
    whole_ms, known = context.ms_per_tick(runs[0].seconds), context.truth is not None
    return [_panel(stage, found, whole_ms, known) for stage, found in points.items() if found]


def _panel(stage: str, points: Sequence[settings.Point], whole_ms: float, known: bool) -> Panel:
    error, label, unit = ERRORS[stage][0 if known else 1]
    recommendation = settings.recommend(points, unit, whole_ms)
    if not known and stage != "homography":
        recommendation = settings.Recommendation(None, recommendation.present, WITHOUT_TRUTH)
    errors = [np.nan if p.error is None else p.error for p in points]
    front = settings.pareto_front([p.ms_per_tick for p in points], errors)
    return Panel(stage, error, label, unit, tuple(points), tuple(front.tolist()), recommendation)


@dataclass(frozen=True, eq=False)
class Benchmark:
    """The result of a benchmark."""

    context: BenchContext  # what all runs had in common
    panels: tuple[Panel, ...]  # one for each stage
    notes: tuple[str, ...]  # what could not be measured, and why

    def __repr__(self) -> str:
        """Return the log and the stages in one line."""
        return f"<Benchmark of {self.context.log.name!r:.80}: {', '.join(p.stage for p in self.panels)}>"

    def to_dataframe(self) -> Any:
        """Return a pandas DataFrame with one row for each stage and setting: time, error and the figures of the stage.

        Raises `MissingExtra` when pandas is not installed.
        """
        try:
            import pandas as pd
        except ImportError:
            raise MissingExtra("to_dataframe", "dataframe") from None
        rows = [
            {
                "stage": panel.stage, "setting": point.setting, "present": point.present, "on_front": on_front,
                "ms_per_tick": point.ms_per_tick, "error": point.error, "unit": panel.unit, **point.figures,
            }
            for panel in self.panels
            for point, on_front in zip(panel.points, panel.on_front, strict=True)
        ]  # fmt: skip
        return pd.DataFrame(rows)


def bench(
    log: Log,
    config: Config | None = None,
    *,
    truth: Scenario | None = None,
    scope: ScoreScope = EVERYTHING,
    detectors: tuple[str, ...] = (),
    progress: Progress | None = None,
) -> Benchmark:
    """Run a log with the present settings and with every alternative of one stage at a time.

    Methods for images are compared with a detector in images alone. Where `reconstruct` searches sweeps, too, its default
    is one more whole run, and what the others are measured against.

    Of a log with LiDARs on the vehicle and at the road, the ends alone and all levels of their fusion are compared, too.

    Raises `LogError` or `ConfigError` or `MissingExtra` for a log that cannot be read or has neither a camera nor
    LiDARs at both ends, invalid settings, or a detector whose package is missing.

    `log`: from `open_log`. `config`: the present settings; the defaults without. `truth`: without it only figures that need no truth
    are computed. `scope`: which objects are compared with the truth. `detectors`: detectors to compare with that of `config`.
    `progress`: called as `progress(what, done, total)`.
    """
    report = progress or (lambda what, done, total: None)
    config = config or Config()
    ends = ends_settings(log, config)
    if log.cameras:
        grid = settings.make_grid(log, config, detectors)
        context = make_context(log, grid, truth, report, scope)
        default = settings.default_settings(log, config)
        panels = make_panels(context, report, whole_points(log, default, truth, scope, report))
        detector = grid.present.config.detect.name
        notes = [
            note
            for note, holds in {
                "no truth: jitter, gaps, residuals of the homography and consistency with LiDAR are all that is measured": truth is None,
                f"detector '{detector}' has no setting of tiles or input size to compare": len(grid.detect) == 1,
                "too few obstacles with LiDAR points within 60 m to judge homographies by": all(p.stage != "homography" for p in panels),
            }.items()
            if holds
        ]  # fmt: skip
    else:
        context = make_context_of_ends(log, ends, truth, scope)
        panels, notes = [], ["the log has no camera: only vehicle, road, and both are compared"]
    if ends:
        points = whole_points(log, ends, truth, scope, report)
        panels.append(_panel(ENDS_STAGE, points, points[0].ms_per_tick, truth is not None))
    return Benchmark(context, tuple(panels), tuple(notes))


SIZE_PT, LETTER_PT, LINE_PT, POINT_PT = 6.8, 3.9, 9.0, 6.0
# Labels farther from their point than this get a leader line.
MIN_LEADER_PT = 11.5
# Candidates for a label by preference: horizontal gap from its point, which side of it, and vertical offset, in points.
CANDIDATES = np.array([
    (side * 10.0, side, rise)
    for rise in (0, 9, -9, 16, -16, 24, -24, 34, -34, 46, -46, 60, -60, 76, -76)
    for side in (1, -1, 0)
    if side or abs(rise) > 9
])  # fmt: skip


def place_point_labels(ax: Axes, points: Sequence[settings.Point], xy: Array, line: Array) -> None:
    """Label points (K, 2) with their settings, clear of each other and of a line with corners `line` (n, 2)."""
    pt, to_data = float(ax.figure.dpi) / 72, ax.transData.inverted()
    at, corners = ax.transData.transform(xy) / pt, ax.transData.transform(line) / pt
    present = next((p for p in points if p.present), points[0])
    frame = np.array(ax.get_window_extent().extents) / pt + [3, 3, -3, -3]
    # Rectangles that labels keep off, left, bottom, right, top in points; covering a point costs three times as much as a label.
    ends = np.stack([corners[:-1], corners[1:]])
    taken = [
        *(3 * [*np.hstack([at - POINT_PT, at + POINT_PT])]), *np.hstack([ends.min(axis=0) - 1, ends.max(axis=0) + 1]),
    ]  # fmt: skip
    for k in sorted(range(len(points)), key=lambda k: (not points[k].present, -at[k, 1])):
        # Without its stage where the name identifies it; with the share found or placed where the present setting has more.
        _, _, name = points[k].setting.partition(": ")
        name = points[k].setting if name in ("", "on", "off") else name
        if not points[k].covers_as_many_as(present):
            key, share = min(points[k].coverage.items(), key=lambda item: item[1])
            name = f"{name} ({share:.0%} {settings.COVERAGE[key]})"
        name = style.printable_label(name, 42)
        size = np.array([len(name) * LETTER_PT, LINE_PT])
        middle = at[k] + np.column_stack([CANDIDATES[:, 0] + CANDIDATES[:, 1] * size[0] / 2, CANDIDATES[:, 2]])
        boxes = np.hstack([middle - size / 2, middle + size / 2])
        cost = _shared(boxes, np.array(taken)).sum(axis=1) + 9 * (size.prod() - _shared(boxes, frame[None])[:, 0])
        box = boxes[int(np.argmin(cost + np.arange(len(boxes))))]
        taken.append(box)
        end = np.clip(at[k], box[:2], box[2:])
        if np.hypot(*(end - at[k])) > MIN_LEADER_PT:
            ax.plot(*to_data.transform(pt * np.stack([at[k], end])).T, color=style.CROWD_COLOR, lw=0.6, zorder=1.5)
        x, y = to_data.transform(pt * np.array([box[0], box[1::2].mean()]))
        ax.text(
            x, y, name, fontsize=SIZE_PT, family=style.FONT, color=style.INK, va="center_baseline", ha="left", parse_math=False,
            weight="bold" if points[k].present else "normal", path_effects=style.halo(1.8), zorder=5,
        )  # fmt: skip


def _shared(a: Array, b: Array) -> Array:
    """Areas (N, M) that rectangles (N, 4) and (M, 4) share."""
    low, high = np.maximum(a[:, None, :2], b[None, :, :2]), np.minimum(a[:, None, 2:], b[None, :, 2:])
    return np.asarray(np.clip(high - low, 0, None).prod(axis=2))


COLUMNS = 3
CELL_IN = (4.3, 3.6)
MARGIN_IN = {"left": 0.62, "right": 0.2, "top": 0.62, "bottom": 0.56}
HEAD_IN = 0.62
FRONT, CHOSEN = style.PALETTE[0], style.PALETTE[4]


def write_picture(result: Benchmark, path: Path) -> None:
    """Draw all panels into a PNG, atomically; the last cell explains the marks and gives the recommendations."""
    rows = -(-(len(result.panels) + 1) // COLUMNS)
    width, height = COLUMNS * CELL_IN[0], rows * CELL_IN[1] + HEAD_IN
    figure, context = style.new_figure(width, height), result.context
    against = f"truth: {context.truth.name}" if context.truth is not None else "no truth"
    cameras, lidars = len(context.plan.cameras), len(context.log.lidars)
    counts = [(len(context.schedule), "tick"), (cameras, "camera") if cameras else (lidars, "LiDAR")]
    parts = [f"{n} {what}{'s' * (n != 1)}" for n, what in counts]
    if context.truth is not None and context.scope.max_range_m is not None:
        parts.append(f"within {context.scope.max_range_m:g} m")
    if context.truth is not None and context.scope.categories is not None:
        parts.append(", ".join(context.scope.categories))
    text = " · ".join([*parts, against, "one stage's setting changed at a time"])
    look: dict[str, Any] = {"family": style.FONT, "ha": "left", "va": "baseline", "parse_math": False}
    x = MARGIN_IN["left"] / figure.get_figwidth()
    title = style.printable_label(f"{context.log.name}: error against run time", 90)
    figure.text(x, 1 - 0.38 / height, title, fontsize=13, fontweight="bold", color=style.INK, **look)
    figure.text(x, 1 - 0.6 / height, style.printable_label(text, 150), fontsize=8, color=style.MUTED, **look)
    w = CELL_IN[0] - MARGIN_IN["left"] - MARGIN_IN["right"]
    h = CELL_IN[1] - MARGIN_IN["bottom"] - MARGIN_IN["top"]
    for k, panel in enumerate([*result.panels, None]):
        row, column = divmod(k, COLUMNS)
        x, y = column * CELL_IN[0] + MARGIN_IN["left"], (rows - 1 - row) * CELL_IN[1] + MARGIN_IN["bottom"]
        ax = figure.add_axes((x / width, y / height, w / width, h / height))
        if panel is None:
            _draw_recommendations(ax, result)
        else:
            _draw_panel(ax, panel)
    style.save_png(figure, path, 150)


def _draw_panel(ax: Axes, panel: Panel) -> None:
    shown = [(p, f) for p, f in zip(panel.points, panel.on_front, strict=True) if p.error is not None]
    ax.set_facecolor("#FBFCFD")
    style.style_axes(ax)
    ax.set_xlabel("run time (ms a tick)", fontsize=7.2, color=style.MUTED, family=style.FONT)
    look: dict[str, Any] = {"transform": ax.transAxes, "family": style.FONT, "va": "baseline", "parse_math": False}
    ax.text(0, 1.1, panel.stage, fontsize=10, fontweight="bold", color=style.INK, **look)
    label = f"{panel.label}{f' ({panel.unit})' * bool(panel.unit)}"
    ax.text(0, 1.035, style.printable_label(label, 90), fontsize=6.8, color=style.MUTED, **look)
    hidden = [p.setting for p in panel.points if p.error is None]
    if hidden:
        unknown = style.printable_label(f"no error known: {', '.join(hidden)}")
        ax.text(0.02, 0.025, unknown, fontsize=6.8, color=style.MUTED, **look)
    if not shown:
        ax.set(xticks=[], yticks=[])
        return
    points = [p for p, _ in shown]
    x = np.array([p.ms_per_tick for p in points])
    y = np.array([p.error for p in points], dtype=np.float64)
    present = next((p for p in points if p.present), None)
    spread = None if present is None else settings.error_interval(present.by_object)
    if present is not None and spread is not None:
        ax.vlines(present.ms_per_tick, *spread, color=style.CROWD_COLOR, lw=1.0, alpha=0.6, zorder=1.8)
    _limits(ax, x, np.append(y, spread or ()))
    front = sorted((p.ms_per_tick, float(p.error or 0.0)) for p, f in shown if f)
    ax.step(*zip(*front), where="post", color=FRONT, lw=1.3, alpha=0.55, zorder=2)
    for point, on_front in shown:
        at = np.array([[point.ms_per_tick], [point.error]], dtype=np.float64)
        if point.setting == panel.recommendation.supported:
            ax.plot(*at, "o", ms=13, mfc="none", mec=CHOSEN, mew=1.6, zorder=3)
        face, edge = (FRONT, style.PAPER) if on_front else (style.PAPER, style.CROWD_COLOR)
        shape, size = ("D", 6.5) if point.present else ("o", 5.5)
        ax.plot(*at, shape, ms=size, mfc=face, mec=edge, mew=1.1, zorder=4)
    corners = [k for (a, b), (c, d) in pairwise(front) for k in ((a, b), (c, b), (c, d))]
    place_point_labels(ax, points, np.column_stack([x, y]), np.array(corners).reshape(-1, 2))


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
    look: dict[str, Any] = {"family": style.FONT, "va": "top", "parse_math": False}
    mark: dict[str, Any] = {"ls": "none", "mew": 1.1}
    handles = [
        (Line2D([], [], marker="D", ms=6.5, mfc=FRONT, mec=style.PAPER, **mark), "present setting, on the front"),
        (
            Line2D([], [], marker="D", ms=6.5, mfc=style.PAPER, mec=style.CROWD_COLOR, **mark),
            "present setting, behind it",
        ),
        (Line2D([], [], marker="o", ms=12, mfc="none", mec=CHOSEN, ls="none", mew=1.6), "what the figures support"),
        (Line2D([], [], marker="o", ms=5.5, mfc=FRONT, mec=style.PAPER, **mark), "on the Pareto front"),
        (Line2D([], [], marker="o", ms=5.5, mfc=style.PAPER, mec=style.CROWD_COLOR, **mark), "behind it"),
        (Line2D([], [], color=style.CROWD_COLOR, lw=1.0, alpha=0.6), "5 to 95 % of resamples"),
    ]
    ax.legend(
        [h for h, _ in handles], [t for _, t in handles], loc="upper left", bbox_to_anchor=(-0.03, 1.14), frameon=False,
        ncols=2, prop={"family": style.FONT, "size": 7.0}, labelcolor=style.INK, handletextpad=0.5, columnspacing=1.2, labelspacing=0.7,
    )  # fmt: skip
    y = 0.86
    for panel in result.panels:
        for k, line in enumerate(wrap(style.printable_label(panel.recommendation.reason, 240), 50)):
            head = panel.stage if k == 0 else ""
            ax.text(0, y, head, fontsize=7.2, color=style.INK, weight="bold", **look)
            ax.text(0.23, y, line, fontsize=7.2, color=style.INK, **look)
            y -= 0.058
        y -= 0.03
    for note in result.notes:
        for line in wrap(style.printable_label(f"Note: {note}", 240), 70):
            ax.text(0, y, line, fontsize=6.6, color=style.MUTED, **look)
            y -= 0.05


VERSION = 1
# Figures of the table next to the error, in panels that have them.
TABLE_COLUMNS = (
    ("recall", "recall", 3), ("precision", "precis.", 3), ("position_rmse_m", "pos rmse m", 2), ("placed_share", "placed", 3),
    ("median_m", "median m", 2), ("near_error_m", "<25 m", 2), ("far_error_m", ">25 m", 2), ("center_error_m", "center m", 2),
    ("jitter_m", "jitter m", 4),
)  # fmt: skip


def bench_document(result: Benchmark) -> dict[str, Any]:
    """Return the document of `schemas/bench-1.json`."""
    context, config = result.context, result.context.grid.present.config
    t = context.schedule.t_ns
    panels = [
        {
            "stage": panel.stage,
            "error": {"figure": panel.error, "label": panel.label, "unit": panel.unit},
            "points": [
                {
                    "setting": p.setting, "present": p.present, "on_front": on_front, "ms_per_tick": round(p.ms_per_tick, 4),
                    "error": rounded_tree(p.error), "error_interval": _interval(p), "figures": rounded_tree(p.figures),
                }
                for p, on_front in zip(panel.points, panel.on_front, strict=True)
            ],
            "supports": {
                "setting": (advice := panel.recommendation).supported, "present": advice.present,
                "agrees": None if advice.supported is None else advice.agrees, "reason": advice.reason,
            },
        }
        for panel in result.panels
    ]  # fmt: skip
    out = {
        "bench_version": VERSION,
        "log": {"name": context.log.name, "format": context.log.format, "digest": context.log.digest},
        "log2sim_version": __version__,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(), "ticks": len(t),
        "duration_s": int(t[-1] - t[0]) / NS_PER_S, "cameras": list(context.plan.cameras),
        "truth": context.truth.name if context.truth is not None else None, "max_range_m": context.scope.max_range_m,
        "categories": None if context.scope.categories is None else list(context.scope.categories),
        "config": config.to_dict(), "notes": list(result.notes), "panels": panels,
    }  # fmt: skip
    check(out, "bench-1", ScenarioError)
    return out


def _interval(point: settings.Point) -> list[float] | None:
    found = settings.error_interval(point.by_object) if point.error is not None else None
    return None if found is None else [round(value, 6) for value in found]


def format_benchmark(result: Benchmark) -> str:
    """Format one block for each stage, then the recommendations."""
    lines = [
        "* present setting   + on the Pareto front: no setting is as accurate in less time",
        "5-95 %: error over resamples of the objects, '-' with fewer than five of them",
        "",
    ]
    for panel in result.panels:
        lines += [f"{panel.stage}: {panel.label}", *_rows(panel), ""]
    lines += ["What the figures support:"]
    lines += [f"  {p.stage:<11} {p.recommendation.reason}" for p in result.panels]
    return "\n".join([*lines, *(f"note: {n}" for n in result.notes)])


def _rows(panel: Panel) -> list[str]:
    columns = [c for c in TABLE_COLUMNS if any(p.figures.get(c[0]) is not None for p in panel.points)]
    head = ["", "", "ms a tick", f"error {panel.unit}".strip(), "5-95 %", *(title for _, title, _ in columns)]
    cells = [head] + [
        [
            f"  {'*' if p.present else ' '}{'+' if on_front else ' '}",
            p.setting,
            settings.short(p.ms_per_tick),
            settings.short(p.error),
            "-" if (interval := _interval(p)) is None else " - ".join(map(settings.short, interval)),
            *(cell(p.figures.get(key), digits) for key, _, digits in columns),
        ]
        for p, on_front in sorted(zip(panel.points, panel.on_front, strict=True), key=lambda pair: pair[0].ms_per_tick)
    ]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    return ["  ".join(c.ljust(w) if k < 2 else c.rjust(w) for k, (c, w) in enumerate(zip(r, widths))) for r in cells]
