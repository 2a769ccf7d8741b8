"""Reliability diagram: the share of right boxes over their scores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from log2sim.documents import replaced
from log2sim.visualization.plot.style import FONT, FRAME, GRID, INK, MUTED, PALETTE, PAPER, printable

SIDE_IN = 3.4
MAX_MARK_PT2 = 120.0
"""Area of the mark of the bin with the most boxes; the others in proportion, which shows what they weigh."""

MIN_MARK_PT2 = 9.0


def write_reliability(classes: Mapping[str, Mapping[str, Any]], path: Path, *, dpi: int = 150) -> None:
    """Write the diagrams of several classes into a PNG, atomically.

    Parameters
    ----------
    classes : mapping of str to mapping
        By name of the class: "expected_calibration_error", "boxes", and "bins" with "boxes", "mean_score" and "precision".
    path : Path
    """
    figure = draw_reliability(classes)
    with replaced(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi, metadata={"Software": None})


def draw_reliability(classes: Mapping[str, Mapping[str, Any]]) -> Figure:
    """Draw one diagram for each class with boxes, side by side."""
    shown = {name: table for name, table in classes.items() if table["boxes"]}
    figure = Figure(figsize=(SIDE_IN * max(len(shown), 1), SIDE_IN + 0.3), facecolor=PAPER, layout="constrained")
    FigureCanvasAgg(figure)
    for k, (name, table) in enumerate(shown.items(), start=1):
        _draw(figure.add_subplot(1, len(shown), k), name, table)
    return figure


def _draw(axes: Axes, name: str, table: Mapping[str, Any]) -> None:
    bins: Sequence[Mapping[str, Any]] = [b for b in table["bins"] if b["boxes"]]
    most = max(b["boxes"] for b in bins)
    area = [max(MAX_MARK_PT2 * b["boxes"] / most, MIN_MARK_PT2) for b in bins]
    score, precision = [b["mean_score"] for b in bins], [b["precision"] for b in bins]
    axes.plot([0, 1], [0, 1], color=FRAME, lw=1, zorder=1)
    axes.plot(score, precision, color=PALETTE[0], lw=1.2, zorder=2)
    axes.scatter(score, precision, s=area, color=PALETTE[0], edgecolor=PAPER, lw=0.6, zorder=3, clip_on=False)
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.grid(color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=7, color=FRAME, labelcolor=MUTED)
    axes.spines[:].set_color(FRAME)
    axes.set_xlabel("mean score", fontsize=8, color=MUTED, family=FONT)
    axes.set_ylabel("share of right boxes", fontsize=8, color=MUTED, family=FONT)
    title = f"{printable(name, 40)}: {table['boxes']} boxes, error {table['expected_calibration_error']:.3f}"
    axes.set_title(title, fontsize=8.5, color=INK, family=FONT, loc="left")
