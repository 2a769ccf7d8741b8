"""The result as the document of `bench.json` and as a table for the terminal."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Any

from log2sim.documents import check
from log2sim.errors import ScenarioError
from log2sim.evaluation.bench.benchmark import Benchmark
from log2sim.evaluation.bench.bootstrap import error_interval
from log2sim.evaluation.bench.panels import Panel
from log2sim.evaluation.bench.pareto import Point, short
from log2sim.geometry import NS_PER_S
from log2sim.version import __version__

VERSION = 1
# Figures of the table next to the error, in panels that have them.
COLUMNS = (
    ("recall", "recall", 3),
    ("precision", "precis.", 3),
    ("position_rmse_m", "pos rmse m", 2),
    ("placed_share", "placed", 3),
    ("median_m", "median m", 2),
    ("near_error_m", "<25 m", 2),
    ("far_error_m", ">25 m", 2),
    ("center_error_m", "center m", 2),
    ("seam_m", "seam m", 3),
    ("seam_aligned_m", "aligned m", 3),
    ("jitter_m", "jitter m", 4),
)


def document(result: Benchmark) -> dict[str, Any]:
    """Return the document of `schemas/bench-1.json`."""
    context, config = result.context, result.context.grid.present.config
    t = context.schedule.t_ns
    out = {
        "bench_version": VERSION,
        "log": {"name": context.log.name, "format": context.log.format, "digest": context.log.digest},
        "log2sim_version": __version__,
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "ticks": len(t),
        "duration_s": int(t[-1] - t[0]) / NS_PER_S,
        "cameras": list(context.plan.cameras),
        "truth": context.truth.name if context.truth is not None else None,
        "max_range_m": context.scope.max_range_m,
        "categories": None if context.scope.categories is None else list(context.scope.categories),
        "config": config.to_dict(),
        "notes": list(result.notes),
        "panels": [_panel(p) for p in result.panels],
    }
    check(out, "bench-1", ScenarioError)
    return out


def _panel(panel: Panel) -> dict[str, Any]:
    recommendation = panel.recommendation
    return {
        "stage": panel.stage,
        "error": {"figure": panel.error, "label": panel.label, "unit": panel.unit},
        "points": [
            {
                "setting": p.setting,
                "present": p.present,
                "on_front": on_front,
                "ms_per_tick": round(p.ms_per_tick, 4),
                "error": _finite(p.error),
                "error_interval": _interval(p),
                "figures": _finite(p.figures),
            }
            for p, on_front in zip(panel.points, panel.on_front, strict=True)
        ],
        "supports": {
            "setting": recommendation.supported,
            "present": recommendation.present,
            "agrees": None if recommendation.supported is None else recommendation.agrees,
            "reason": recommendation.reason,
        },
    }


def _interval(point: Point) -> list[float] | None:
    found = error_interval(point.by_object) if point.error is not None else None
    return None if found is None else [round(value, 6) for value in found]


def _finite(value: Any) -> Any:
    """Round nested figures to six decimals; None for a number that is not finite."""
    if isinstance(value, Mapping):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, float):
        return round(value, 6) if math.isfinite(value) else None
    return value


def format_table(result: Benchmark) -> str:
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
    columns = [c for c in COLUMNS if any(p.figures.get(c[0]) is not None for p in panel.points)]
    head = ["", "", "ms a tick", f"error {panel.unit}".strip(), "5-95 %", *(title for _, title, _ in columns)]
    cells = [head] + [
        [
            f"  {'*' if p.present else ' '}{'+' if on_front else ' '}",
            p.setting,
            short(p.ms_per_tick),
            short(p.error),
            "-" if (interval := _interval(p)) is None else " - ".join(map(short, interval)),
            *(_cell(p.figures.get(key), digits) for key, _, digits in columns),
        ]
        for p, on_front in _by_time(panel)
    ]
    widths = [max(len(row[k]) for row in cells) for k in range(len(head))]
    return ["  ".join(c.ljust(w) if k < 2 else c.rjust(w) for k, (c, w) in enumerate(zip(r, widths))) for r in cells]


def _by_time(panel: Panel) -> list[tuple[Point, bool]]:
    return sorted(zip(panel.points, panel.on_front, strict=True), key=lambda pair: pair[0].ms_per_tick)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
