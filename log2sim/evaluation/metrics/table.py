"""Metrics as a table for the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from log2sim.evaluation.lanes.figures import map_lines
from log2sim.evaluation.metrics.correctness_table import correctness_lines

COLUMNS = (
    ("recall", "recall", 3),
    ("precision", "precis.", 3),
    ("position_rmse_m", "pos rmse m", 2),
    ("position_median_m", "pos med m", 2),
    ("yaw_median_deg", "yaw med deg", 1),
    ("speed_rmse_mps", "speed rmse m/s", 2),
    ("size_median_m", "size med m", 2),
    ("id_switches", "id sw", 0),
    ("mota", "MOTA", 3),
    ("hota", "HOTA", 3),
)


def format_table(result: Mapping[str, Any]) -> str:
    """Format a result of `evaluate`: a line for all, for each range and category, and for the ego; '-' for None.

    A second table says what is wrong with the agents, and the worst are named; lines below it tell of map features, colors of
    vehicles and traffic lights.
    """
    lines = [("all", result)]
    lines += [(f"{name} m", figures) for name, figures in (result["by_range"] or {}).items()]
    lines += list(result["by_category"].items())
    cells = [["", "agents", *(title for _, title, _ in COLUMNS)]]
    for name, figures in lines:
        agents = str(figures["counts"]["truth_agents"])
        cells.append([name, agents, *(_cell(figures[key], digits) for key, _, digits in COLUMNS)])
    ego = result["ego"]
    if ego is not None:
        cells.append(["ego", "", *(_cell(ego[key], digits) if key in ego else "" for key, _, digits in COLUMNS)])
    widths = [max(len(row[k]) for row in cells) for k in range(len(cells[0]))]
    rows = [[row[0].ljust(widths[0]), *(c.rjust(w) for c, w in zip(row[1:], widths[1:]))] for row in cells]
    below = [*correctness_lines(result["correctness"]), *map_lines(result)]
    return "\n".join(["  ".join(row).rstrip() for row in rows] + below)


def _cell(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"
