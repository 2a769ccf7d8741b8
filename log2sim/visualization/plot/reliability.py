"""Reliability diagrams: the share of right ones over their confidence."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from log2sim.visualization.plot import style

SIDE_IN = 3.4
# Area of the mark of the bin with the most boxes; the others in proportion, which shows what they weigh.
MAX_MARK_PT2, MIN_MARK_PT2 = 120.0, 9.0


def write_reliability(result: Mapping[str, Any], path: Path) -> None:
    """Write the diagrams of a result of `evaluate` or `evaluate_boxes` side by side into a PNG, atomically.

    They are of the scores of each class, or of confidences: of ticks, of agents, and of the ticks of each kind.
    """
    if "classes" in result:
        keys = ("boxes", "mean_score", "precision")
        tables = [(name, "boxes", figures["calibration"]) for name, figures in result["classes"].items()]
    else:
        keys = ("count", "mean_confidence", "right")
        found = result["correctness"]
        tables = [("all", noun, found["calibration"][noun]) for noun in ("ticks", "agents")]
        kinds = found["by_kind"] if len(found["by_kind"]) > 1 else {}
        tables += [(name, "ticks", figures["calibration"]["ticks"]) for name, figures in kinds.items()]
    tables = [entry for entry in tables if entry[2][keys[0]]]
    figure = style.new_figure(SIDE_IN * max(len(tables), 1), SIDE_IN + 0.3, layout="constrained")
    for k, (name, noun, table) in enumerate(tables, start=1):
        axes = figure.add_subplot(1, len(tables), k)
        count, confidence, right = zip(*([b[key] for key in keys] for b in table["bins"] if b[keys[0]]))
        area = [max(MAX_MARK_PT2 * n / max(count), MIN_MARK_PT2) for n in count]
        axes.plot([0, 1], [0, 1], color=style.FRAME, lw=1, zorder=1)
        axes.plot(confidence, right, color=style.PALETTE[0], lw=1.2, zorder=2)
        axes.scatter(
            confidence, right, s=area, color=style.PALETTE[0], edgecolor=style.PAPER, lw=0.6, zorder=3, clip_on=False
        )
        axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
        axes.grid(color=style.GRID, lw=0.6)
        axes.set_axisbelow(True)
        axes.tick_params(labelsize=7, color=style.FRAME, labelcolor=style.MUTED)
        axes.spines[:].set_color(style.FRAME)
        axes.set_xlabel("mean confidence", fontsize=8, color=style.MUTED, family=style.FONT)
        axes.set_ylabel(f"share of right {noun}", fontsize=8, color=style.MUTED, family=style.FONT)
        error = table["expected_calibration_error"]
        title = f"{style.printable_label(name, 40)}: {sum(count)} {noun}, error {error:.3f}"
        axes.set_title(title, fontsize=8.5, color=style.INK, family=style.FONT, loc="left")
    style.save_png(figure, path, 150)
