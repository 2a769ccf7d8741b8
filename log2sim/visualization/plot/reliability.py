"""Reliability diagram: the share of right ones over their confidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from matplotlib.axes import Axes

from log2sim.visualization.plot import style

SIDE_IN = 3.4
# Area of the mark of the bin with the most boxes; the others in proportion, which shows what they weigh.
MAX_MARK_PT2 = 120.0

MIN_MARK_PT2 = 9.0


@dataclass(frozen=True)
class Reliability:
    """One diagram."""

    name: str
    noun: str  # what is counted, in the plural: "boxes", "ticks"
    error: float  # expected calibration error
    # Float), count, mean confidence and share of right ones of each bin that is not empty.
    bins: tuple[tuple[int, float, float], ...]


def write_reliability(diagrams: Sequence[Reliability], path: Path) -> None:
    """Write diagrams side by side into a PNG, atomically."""
    figure = style.new_figure(SIDE_IN * max(len(diagrams), 1), SIDE_IN + 0.3, layout="constrained")
    for k, diagram in enumerate(diagrams, start=1):
        _draw(figure.add_subplot(1, len(diagrams), k), diagram)
    style.save_png(figure, path, 150)


def _draw(axes: Axes, diagram: Reliability) -> None:
    count, confidence, right = zip(*diagram.bins)
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
    axes.set_ylabel(f"share of right {diagram.noun}", fontsize=8, color=style.MUTED, family=style.FONT)
    title = f"{style.printable_label(diagram.name, 40)}: {sum(count)} {diagram.noun}, error {diagram.error:.3f}"
    axes.set_title(title, fontsize=8.5, color=style.INK, family=style.FONT, loc="left")
