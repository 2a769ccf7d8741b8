"""Placement of point labels in a plot so that they overlap each other, points and lines least."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from log2sim.evaluation.bench.pareto import COVERAGE, Point
from log2sim.geometry import Array
from log2sim.visualization.plot.style import CROWD_COLOR, FONT, INK, halo, printable

SIZE_PT, LETTER_PT, LINE_PT, POINT_PT = 6.8, 3.9, 9.0, 6.0
# Points nearer to each other than this share one block of labels.
MAX_SHARED_LABEL_PT = 7.0
# Labels farther from their point than this get a leader line.
MIN_LEADER_PT = 11.5
# Candidates for a block of labels by preference: side, horizontal gap and vertical offset from its point, in points.
CANDIDATES = tuple(
    (side, gap, rise)
    for rise in (0, 9, -9, 16, -16, 24, -24, 34, -34, 46, -46, 60, -60, 76, -76)
    for side, gap in ((1, 10), (-1, 10), (0, 0))
    if side or abs(rise) > 9
)

Box = tuple[float, float, float, float]
"""Left, bottom, right, top in display pixels."""


def place_labels(ax: Axes, points: Sequence[Point], xy: Array, line: Array) -> None:
    """Label points (K, 2) with their settings, clear of a line with corners `line` (n, 2)."""
    pt = float(ax.figure.dpi) / 72
    at = ax.transData.transform(xy)
    present = next(p for p in points if p.present) if any(p.present for p in points) else points[0]
    # Covering a point costs three times as much as covering a label.
    taken = 3 * [_around(u, v, POINT_PT * pt) for u, v in at] + _along(ax.transData.transform(line), pt)
    frame = ax.get_window_extent()
    inside = (frame.x0 + 3 * pt, frame.y0 + 3 * pt, frame.x1 - 3 * pt, frame.y1 - 3 * pt)
    for members in sorted(_together(at, MAX_SHARED_LABEL_PT * pt), key=lambda m: -float(at[m[0], 1])):
        members = sorted(members, key=lambda k: not points[k].present)
        names = [printable(_label(points[k], present), 42) for k in members]
        box = _best_box(at[members].mean(axis=0), names, taken, inside, pt)
        taken.append(box)
        _lead(ax, at[members].mean(axis=0), box, pt)
        for k, (member, name) in enumerate(zip(members, names)):
            x, y = ax.transData.inverted().transform((box[0], box[3] - (k + 0.5) * LINE_PT * pt))
            ax.text(
                x, y, name, fontsize=SIZE_PT, family=FONT, color=INK, va="center_baseline", ha="left", parse_math=False,
                weight="bold" if points[member].present else "normal", path_effects=halo(1.8), zorder=5,
            )  # fmt: skip


def short_name(setting: str) -> str:
    """Drop the stage from a setting whose name identifies its stage."""
    stage, _, name = setting.partition(": ")
    return setting if name in ("", "on", "off") or stage == "smooth" else name


def _label(point: Point, present: Point) -> str:
    """Name a point, with the share of objects that it finds or places where the present setting does so with more."""
    name = short_name(point.setting)
    if point.covers_as_many_as(present):
        return name
    key, share = min(point.coverage.items(), key=lambda item: item[1])
    return f"{name} ({share:.0%} {COVERAGE[key]})"


def _together(at: Array, reach: float) -> list[list[int]]:
    """Group the indices of points within `reach` of the first of each group."""
    groups: list[list[int]] = []
    for k, place in enumerate(at):
        group = next((g for g in groups if np.hypot(*(at[g[0]] - place)) < reach), None)
        if group is None:
            groups.append([k])
        else:
            group.append(k)
    return groups


def _best_box(at: Array, names: Sequence[str], taken: Sequence[Box], inside: Box, pt: float) -> Box:
    width, height = max(map(len, names)) * LETTER_PT * pt, len(names) * LINE_PT * pt
    boxes, costs = [], []
    for k, (side, gap, rise) in enumerate(CANDIDATES):
        u = at[0] + side * gap * pt - (0.0, width / 2, width)[(1, 0, -1).index(side)]
        v = at[1] + (rise + np.sign(rise) * (len(names) - 1) * LINE_PT / 2) * pt
        box = (float(u), float(v - height / 2), float(u + width), float(v + height / 2))
        boxes.append(box)
        costs.append(sum(_shared(box, other) for other in taken) + 9 * (width * height - _shared(box, inside)) + k)
    return boxes[int(np.argmin(costs))]


def _lead(ax: Axes, at: Array, box: Box, pt: float) -> None:
    """Draw a leader line from labels to their point when they are far from it."""
    end = np.clip(at, box[:2], box[2:])
    if np.hypot(*(end - at)) > MIN_LEADER_PT * pt:
        line = ax.transData.inverted().transform(np.stack([at, end]))
        ax.plot(*line.T, color=CROWD_COLOR, lw=0.6, zorder=1.5)


def _around(u: float, v: float, reach: float) -> Box:
    return (u - reach, v - reach, u + reach, v + reach)


def _along(corners: Array, pt: float) -> list[Box]:
    """Cover a line of horizontal and vertical segments with boxes."""
    low, high = np.minimum(corners[:-1], corners[1:]) - pt, np.maximum(corners[:-1], corners[1:]) + pt
    return [(float(a), float(b), float(c), float(d)) for (a, b), (c, d) in zip(low, high)]


def _shared(a: Box, b: Box) -> float:
    """Compute the area that two boxes share, px^2."""
    return max(min(a[2], b[2]) - max(a[0], b[0]), 0.0) * max(min(a[3], b[3]) - max(a[1], b[1]), 0.0)
