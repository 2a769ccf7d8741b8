"""The course of a road in one picture, shared by its lane lines: what does not follow it stands on the road, or beside it.

Lane lines run beside each other. Edges of vehicles, walls and masts that stand upright point away from the camera when
they are laid out flat, so they do not.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from log2sim.datatypes import Marking
from log2sim.geometry import Array

TOLERANCE_M, TOLERANCE_PER_M = 0.12, 0.01  # of a line's course: its own error, and that of a ground that is not flat
SAME_LINE_M = 0.6  # double lines are one lane line
MAX_SLOPE = 0.35  # of lines that run along the road where the camera is
STEP_M = 0.5
BEND_SIGMA_PER_M = 0.01  # half the curvature of a radius of 50 m; a line counts as one observation, however long it is
MIN_WEIGHT = 0.8


@dataclass(frozen=True, eq=False)
class RoadShape:
    """y = offset + slope x + bend x**2 of all lane lines, each with its own offset.

    Attributes
    ----------
    slope, bend : float
        bend in 1/m.
    """

    slope: float
    bend: float

    def course(self, x: Array) -> Array:
        """Return y (N,) of the line through the origin."""
        return np.asarray(self.slope * x + self.bend * x**2)


@dataclass(frozen=True, eq=False)
class LaneLine:
    """Markings that are one line beside a lane, and its course from end to end of what can be seen.

    Attributes
    ----------
    offset_m : float
        To the left of the camera.
    markings : tuple of Marking
    points_m : (N, 3) float64, m
        Beyond the markings by the course of the others.
    """

    offset_m: float
    markings: tuple[Marking, ...]
    points_m: Array


def find_shape(markings: list[Marking], weights: Array) -> tuple[RoadShape, list[int]] | None:
    """Find the course that most lane lines follow, by weight, and the indices of those that do.

    Parameters
    ----------
    markings : list of Marking
        Lane lines.
    weights : (N,) float64
        What each counts.
    """
    points = [_even(marking.points_m) for marking in markings]
    best: tuple[float, RoadShape, list[int]] | None = None
    for seed in range(len(markings)):
        shape = _fit([points[seed]], weights[[seed]])
        for _ in range(2):
            member = [k for k in range(len(markings)) if _follows(points[k], shape)]
            if not member:
                break
            shape = _fit([points[k] for k in member], weights[member])
        member = [k for k in range(len(markings)) if _follows(points[k], shape)]
        # Lines at several offsets tell more than one alone, which upright things give, too.
        offsets = _groups([_offset(points[k], shape) for k in member])
        score = sum(min(float(weights[[member[i] for i in group]].sum()), 1.0) for group in offsets)
        if abs(shape.slope) <= MAX_SLOPE and member and (best is None or score > best[0]):
            best = (score, shape, member)
    return None if best is None or best[0] < MIN_WEIGHT else (best[1], best[2])


def join_lines(markings: list[Marking], shape: RoadShape, near_m: float, far_m: float) -> list[LaneLine]:
    """Join markings at one offset to lane lines, and continue these by the course of all."""
    points = [_even(marking.points_m) for marking in markings]
    offsets = [_offset(p, shape) for p in points]
    lines = []
    for group in _groups(offsets):
        order = sorted(group, key=lambda k: points[k][:, 0].min())
        own = np.concatenate([points[k] for k in order])
        own = own[np.argsort(own[:, 0], kind="stable")]
        lines.append(
            LaneLine(
                float(np.mean([offsets[k] for k in group])),
                tuple(markings[k] for k in order),
                _continued(own, shape, near_m, far_m),
            )
        )
    return sorted(lines, key=lambda line: -line.offset_m)


def _continued(points: Array, shape: RoadShape, near_m: float, far_m: float) -> Array:
    """Continue a line to both ends, beside the course where it was seen last."""
    x = np.arange(min(near_m, points[0, 0]), max(far_m, points[-1, 0]) + STEP_M, STEP_M)
    beside = points[:, 1] - shape.course(points[:, 0])
    # Medians of the nearest 5 m, as single points would shift all that lies beyond.
    first, last = (float(np.median(part)) for part in (beside[: 1 + int(5 / STEP_M)], beside[-1 - int(5 / STEP_M) :]))
    y = shape.course(x) + np.interp(x, points[:, 0], beside, left=first, right=last)
    return np.column_stack([x, y, np.full(len(x), float(np.median(points[:, 2])))])


def _even(points: Array) -> Array:
    """Points at equal steps along x."""
    order = np.argsort(points[:, 0], kind="stable")
    low, high = points[order[0], 0], points[order[-1], 0]
    x = np.linspace(low, high, max(int((high - low) / STEP_M), 2))
    return np.column_stack([x, *(np.interp(x, points[order, 0], points[order, k]) for k in (1, 2))])


def _offset(points: Array, shape: RoadShape) -> float:
    return float(np.median(points[:, 1] - shape.course(points[:, 0])))


def _follows(points: Array, shape: RoadShape) -> bool:
    beside = points[:, 1] - shape.course(points[:, 0])
    span = float(np.ptp(points[:, 0]))
    spread = float(np.abs(beside - np.median(beside)).max())
    turn = abs(float(np.polyfit(points[:, 0], beside, 1)[0])) if span > 0 else np.inf
    reach = float(points[:, 0].max())
    return spread <= TOLERANCE_M + TOLERANCE_PER_M * reach and turn <= 0.02 + 2 * TOLERANCE_M / max(span, 1.0)


def _groups(offsets: list[float]) -> list[list[int]]:
    """Group indices of offsets that are near their neighbors."""
    order = np.argsort(offsets, kind="stable")
    groups: list[list[int]] = []
    for k in order.tolist():
        if groups and offsets[k] - offsets[groups[-1][-1]] <= SAME_LINE_M:
            groups[-1].append(k)
        else:
            groups.append([k])
    return groups


def _fit(lines: list[Array], weights: Array) -> RoadShape:
    """Fit one course to lines, each with its own offset; bends need length to be seen, or are slight."""
    rows, right = [], []
    for k, (points, weight) in enumerate(zip(lines, weights)):
        x, y = points[:, 0], points[:, 1]
        # Pixels shrink with distance, and errors grow.
        w = np.sqrt(weight / len(x)) / (TOLERANCE_M + TOLERANCE_PER_M * x)
        block = np.zeros((len(x), 2 + len(lines)))
        block[:, 0], block[:, 1], block[:, 2 + k] = w * x, w * x**2, w
        rows.append(block)
        right.append(w * y)
    prior = np.zeros((1, 2 + len(lines)))
    prior[0, 1] = 1 / BEND_SIGMA_PER_M
    rows.append(prior)
    right.append(np.zeros(1))
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return RoadShape(float(solution[0]), float(solution[1]))
