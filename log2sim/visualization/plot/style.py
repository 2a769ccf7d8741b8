"""Colors, markers and the font of the pictures."""

from __future__ import annotations

import io
from functools import cache
from pathlib import Path
from typing import Any

from matplotlib import font_manager
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ft2font import FT2Font
from matplotlib.patheffects import AbstractPathEffect, withStroke

from log2sim.files.documents import replaced

# Ego, titles and truth.
INK = "#1B2330"
MUTED = "#667080"
# Movers beyond those that have a color of their own.
CROWD_COLOR = "#7C8794"
GRID = "#E4E8ED"
FRAME = "#B9C1CB"
PARKED_FACE, PARKED_EDGE = "#D5DAE1", "#A9B2BE"
PAPER = "#FFFFFF"
ALARM = "#C8102E"
TAIL_ALPHA, TRACK_ALPHA = 0.65, 0.22  # opacity of tails and of whole tracks in animations
# Mark of collisions that belong to the replay.
COLLISION_MARK: dict[str, Any] = {"marker": "X", "ms": 8.5, "mfc": ALARM, "mec": PAPER, "mew": 0.9}
WARNING = "#B35C00"
# Of what one end of a cooperative log alone observed; as on the page.
END_COLOR = {"vehicle": "#1F6FB2", "road": "#8E3B9E"}
LANE_FACE, LANE_ARROW = "#EBEEF2", "#C9D0D9"
# Paint on the ground; white paint is dark, since the pictures are white.
MARKING_COLOR = {"white": "#55606E", "yellow": "#C58A00"}
SENSOR_COLOR, SENSOR_PT = END_COLOR["road"], 7.0
BORDER_COLOR = "#9A7B5B"
SIGNAL_COLOR = {
    "red": "#D11F1F", "red_yellow": "#E2711D", "yellow": "#E0A800", "green": "#1D9A4B", "off": "#3A434F", "unknown": "#9AA3AE",
}  # fmt: skip
# Colors distinguishable with color vision deficiency: Okabe and Ito (2008) without black and yellow, then Tol's muted
# set (2021) and four more of other lightness.
PALETTE = (
    "#0072B2", "#E69F00", "#009E73", "#CC79A7", "#D55E00", "#56B4E9", "#882255", "#999933", "#332288", "#44AA99",
    "#AA4499", "#117733", "#CC6677", "#6699CC", "#A6761D", "#661100", "#5E9B2F", "#8C6BB1", "#2F6F7E", "#B8860B",
)  # fmt: skip
# Marker of a group of categories, on the map for what is smaller than a car, and in the legend.
MARKERS = {"vehicle": "s", "two_wheeler": "D", "pedestrian": "o", "other": "^"}
FONT = "DejaVu Sans"


def halo(width_pt: float = 2.2) -> list[AbstractPathEffect]:
    """Make a white outline that keeps letters readable on lines and pictures."""
    return [withStroke(linewidth=width_pt, foreground=PAPER, alpha=0.9)]


def new_figure(width_in: float, height_in: float, **style: Any) -> Figure:
    """Make a white figure that needs no display."""
    figure = Figure(figsize=(width_in, height_in), facecolor=PAPER, **style)
    FigureCanvasAgg(figure)
    return figure


def save_png(figure: Figure, path: Path, dpi: float) -> None:
    """Write a figure as a PNG, atomically; the same figure gives the same bytes."""
    with replaced(path) as temporary:
        figure.savefig(temporary, format="png", dpi=dpi, metadata={"Software": None})


def png_bytes(figure: Figure, dpi: float) -> bytes:
    """Return a figure as a PNG."""
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=dpi, metadata={"Software": None})
    return data.getvalue()


def style_axes(ax: Axes, *, size_pt: float = 7.0, length_pt: float = 2.5, grid: bool = True) -> None:
    """Give axes pale frames, muted ticks and a grid below what is drawn."""
    ax.set_axisbelow(True)
    if grid:
        ax.grid(True, color=GRID, lw=0.7)
    ax.tick_params(labelsize=size_pt, colors=MUTED, length=length_pt, width=0.6, labelfontfamily=FONT)
    for spine in ax.spines.values():
        spine.set(color=FRAME, linewidth=0.8)


def printable_label(text: str, longest: int = 80) -> str:
    """Put text on one line of at most `longest` letters, with "?" for characters that the font lacks."""
    known = _characters()
    line = "".join(c if ord(c) in known else "?" for c in " ".join(text.split()))
    return line if len(line) <= longest else line[: longest - 1] + "…"


@cache
def _characters() -> frozenset[int]:
    return frozenset(FT2Font(font_manager.findfont(FONT)).get_charmap())
