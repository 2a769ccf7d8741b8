"""Lane lines in one picture, whose ground is laid out flat: the course that all of them follow, and where lines run along it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from log2sim.datatypes import Marking
from log2sim.geometry import Array, Camera
from log2sim.road.ground_map import GroundMap
from log2sim.road.samples import sample

TOLERANCE_M, TOLERANCE_PER_M = 0.12, 0.01  # of a line's course: its own error, and that of a ground that is not flat
SAME_LINE_M = 0.6  # double lines are one lane line
MAX_SLOPE = 0.35  # of lines that run along the road where the camera is
STEP_M = 0.5
BEND_SIGMA_PER_M = 0.01  # half the curvature of a radius of 50 m; a line counts as one observation, however long it is
MIN_WEIGHT = 0.8


@dataclass(frozen=True, eq=False)
class RoadShape:
    """y = offset + slope x + bend x**2 of all lane lines, each with its own offset."""

    slope: float  # `slope`, `bend`: bend in 1/m
    bend: float

    def course(self, x: Array) -> Array:
        """Return y (N,) of the line through the origin."""
        return np.asarray(self.slope * x + self.bend * x**2)


@dataclass(frozen=True, eq=False)
class LaneLine:
    """A line beside a lane, along the course of the road."""

    offset_m: float  # to the left of the camera
    log_odds: float  # that it is a lane line; not calibrated
    markings: tuple[Marking, ...]  # those of its pieces that were detected one by one; may be none
    points_m: Array  # (N, 3): from the camera on, continued along the course


def find_shape(markings: list[Marking], weights: Array) -> tuple[RoadShape, list[int]] | None:
    """Find the course that most lane lines follow, by weight, and the indices of those that do.

    `markings`: lane lines. `weights`: (N,): what each counts.
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


# Across the course, m.
ACROSS_M, SIDE_M = 0.05, 14.0
NEAREST_M, FARTHEST_M = 3.0, 70.0  # from the camera, where lines are looked for
# Of the height of the picture: from one sample along the course to the next, so that near paint counts by its pixels.
ROW_SHARE = 1 / 300
# Half the width of paint; from where and to where on either side of it contrast is measured: m, and at least so many pixels.
HALF_PAINT, ROAD_FROM, ROAD_TO = (0.05, 0.5), (0.15, 1.2), (0.4, 3.0)
# Least noise of logarithms: of brightness plus yellowness, and of yellowness alone, as a yellow line between concrete and
# asphalt is not brighter than both.
MIN_NOISE = (0.03, 0.01)
FROM_SIGMAS, TO_SIGMAS = 1.0, 4.0  # contrast below the first counts nothing, above the second no more
# An offset needs so many visible samples; with fewer than the second it counts less; the last bounds memory.
MIN_SAMPLES, FULL_SAMPLES, MAX_SAMPLES = 40, 60, 1000
MIN_HEIGHT_M = 0.5  # of the camera
# Texture has as much contrast at all offsets around; a line has more than so many times their median.
AROUND_M, TIMES_AROUND = 3.0, 4.0
MIN_RESPONSE = 0.1  # sigmas, mean of all samples: full contrast in one of thirty
MIN_YELLOW = 0.06  # logarithm; fresh paint has 0.5 and more, worn, blurred and far away a tenth of it
# Log-odds that are added where pieces of paint were detected, too, and those of a line that has nothing else.
ALSO_IN_PIECES, ONLY_IN_PIECES = 1.0, 0.7
# Lanes are 2.5 to 3.75 m wide, where lengths are known to a fifth.
LANE_M = (2.0, 4.6)
NO_NEIGHBOR = -0.5  # log-odds of a line that is farther than that from the next one
# Lines of one road have road between them: within this distance, in this share of the samples, over most of the width.
ROAD_WITHIN_M, MIN_ROAD, MOST = 40.0, 0.3, 0.8
DRIFT_SIGMA_M, OFF_M = 0.2, 0.15  # of a line from the course at 30 m; residual at which a sample counts half


@dataclass(frozen=True, eq=False)
class _Straightened:
    """A picture's ground with its course along a straight line: samples (N,) ahead of the camera, (M,) across."""

    ahead_m: Array
    across_m: Array
    paint: Array  # (N, M): see `Samples`; NaN where the ground is not visible
    yellow: Array
    is_road: Array  # (N, M): whether it has the color of the road in front of the camera; NaN where not visible


def _straighten(ground: GroundMap, road: GroundMap, camera: Camera, shape: RoadShape) -> _Straightened:
    """Sample the ground on both sides of the course of its lines; `road` is the same map without what is no road."""
    focal_px, (x0, _, height_m) = camera.K[0, 0], camera.mount_T_cam[:3, 3]
    step = max(ROW_SHARE * camera.height_px / (focal_px * max(height_m, MIN_HEIGHT_M)), 1 / NEAREST_M / MAX_SAMPLES)
    ahead = 1 / np.arange(1 / FARTHEST_M, 1 / NEAREST_M, step)
    across = np.arange(-SIDE_M, SIDE_M + ACROSS_M / 2, ACROSS_M)
    x = np.broadcast_to((ahead + x0)[:, None], (len(ahead), len(across)))
    y = shape.course(ahead + x0)[:, None] + across
    whole = sample(ground, x, y)
    is_road = np.where(np.isnan(whole.bright), np.nan, np.isfinite(sample(road, x, y).bright))
    return _Straightened(ahead, across, whole.paint.astype(float), whole.yellow.astype(float), is_road)


def find_lane_lines(
    ground: GroundMap, road: GroundMap, camera: Camera, shape: RoadShape, markings: list[Marking], far_m: float
) -> list[LaneLine]:
    """Find the lines that run along a course, from left to right.

    `ground`, `road`: the ground and what of it is road. `markings`: pieces of lines that follow the course. `far_m`: to where
    lines are continued, from the camera.

    Worn paint, distant dashes and yellow lines on concrete have little contrast at any one place, but the sum along the course is
    significant. Of the offsets where it is, those are chosen that are most likely together: lanes of road lie between them.
    """
    flat = _straighten(ground, road, camera, shape)
    lines = _candidates(flat, camera, shape, far_m)
    offsets = [_offset(_even(marking.points_m), shape) for marking in markings]
    for group in _groups(offsets):
        offset, members = float(np.mean([offsets[k] for k in group])), tuple(markings[k] for k in group)
        same = [k for k, line in enumerate(lines) if abs(line.offset_m - offset) < SAME_LINE_M / 2]
        if same:
            k = min(same, key=lambda k: abs(lines[k].offset_m - offset))
            lines[k] = replace(lines[k], log_odds=lines[k].log_odds + ALSO_IN_PIECES, markings=members)
        else:
            lines.append(LaneLine(offset, ONLY_IN_PIECES, members, _along(shape, camera, far_m, offset)))
    return _side_by_side(sorted(lines, key=lambda line: -line.offset_m), flat)


def _along(shape: RoadShape, camera: Camera, far_m: float, offset_m: float, drift: float = 0.0) -> Array:
    """Return the points (N, 3) of a line at an offset from the course, which changes by `drift` m per meter."""
    x = np.arange(0, far_m, STEP_M)
    own_x = camera.mount_T_cam[0, 3]
    y = shape.course(x + own_x) + offset_m + drift * np.minimum(x, FARTHEST_M)
    return np.column_stack([x + own_x, y, np.zeros(len(x))])


def _candidates(flat: _Straightened, camera: Camera, shape: RoadShape, far_m: float) -> list[LaneLine]:
    """List lines at the offsets along which contrast adds up, strongest first."""
    pixel_m = flat.ahead_m / camera.K[0, 0]
    contrasts = [_contrast(values, pixel_m) for values in (flat.paint, flat.yellow)]
    response, mean = [], []
    for contrast, least in zip(contrasts, MIN_NOISE):
        known = np.isfinite(contrast)
        # Of each row, as noise grows with distance; lines are a small part of a row.
        noise = np.array([np.median(np.abs(c[k])) / 0.6745 if k.any() else np.inf for c, k in zip(contrast, known)])
        sigmas = np.nan_to_num(contrast / np.maximum(noise, least)[:, None])
        response.append(np.clip(sigmas - FROM_SIGMAS, 0, TO_SIGMAS - FROM_SIGMAS))
        count = known.sum(axis=0)
        along = np.where(count >= MIN_SAMPLES, response[-1].sum(axis=0) / np.maximum(count, FULL_SAMPLES), 0)
        mean.append(along - TIMES_AROUND * median_filter(along, round(AROUND_M / ACROSS_M) | 1, mode="nearest"))
    reach = round(SAME_LINE_M / ACROSS_M)
    best, kind = np.max(mean, axis=0), np.argmax(mean, axis=0)
    lines = []
    while best.max() >= MIN_RESPONSE:
        middle = int(best.argmax())
        value, k = best[middle], kind[middle]
        best[max(middle - reach, 0) : middle + reach + 1] = 0
        near = slice(max(middle - reach, 0), middle + reach + 1)
        strength, off = response[k][:, near], flat.across_m[near] - flat.across_m[middle]
        rows = strength.any(axis=1)
        strength, contrast = strength[rows], contrasts[k][rows, near]
        if k == 1 and np.median(np.nanmax(contrast, axis=1)) < MIN_YELLOW:
            continue
        total = strength.sum(axis=1)
        shift, drift = _drift(flat.ahead_m[rows], strength @ off / total, total)
        offset = float(flat.across_m[middle] + shift)
        points = _along(shape, camera, far_m, offset, drift)
        lines.append(LaneLine(offset, float(np.log(value / MIN_RESPONSE)), (), points))
    return lines


def _contrast(values: Array, pixel_m: Array) -> Array:
    """Compute the contrast (N, M) of each place to the brighter of both sides; NaN where too little is visible."""
    known = np.isfinite(values)
    pad = np.zeros((len(values), 1))
    total = np.hstack([pad, np.cumsum(np.where(known, values, 0), axis=1, dtype=np.float64)])
    count = np.hstack([pad, np.cumsum(known, axis=1)])
    row, place = np.arange(len(values))[:, None], np.arange(values.shape[1])

    def cells(length_m: float, length_px: float) -> NDArray[np.intp]:
        return np.rint(np.maximum(length_m, length_px * pixel_m) / ACROSS_M).astype(np.intp)[:, None]

    def mean(first: NDArray[np.intp], last: NDArray[np.intp]) -> Array:
        low, high = (np.clip(place + v, 0, values.shape[1]) for v in (first, last + 1))
        number = count[row, high] - count[row, low]
        enough = (number > 0) & (2 * number >= high - low)
        among = total[row, high] - total[row, low]
        return np.asarray(np.divide(among, number, out=np.full(values.shape, np.nan), where=enough))

    paint, begin, end = (cells(*length) for length in (HALF_PAINT, ROAD_FROM, ROAD_TO))
    return np.asarray(mean(-paint, paint) - np.maximum(mean(-end, -begin), mean(begin, end)))


def _drift(ahead_m: Array, off_m: Array, weight: Array) -> tuple[float, float]:
    """Fit the offset at the camera and its change per meter to offsets (N,) at distances (N,), m, robustly."""
    rows = np.column_stack([np.ones(len(ahead_m)), ahead_m])
    solution = np.zeros(2)
    prior = np.diag([1.0, (30 / DRIFT_SIGMA_M) ** 2])
    for _ in range(4):
        w = weight / (1 + ((off_m - rows @ solution) / OFF_M) ** 2)
        solution = np.asarray(np.linalg.solve(rows.T @ (w[:, None] * rows) + prior, rows.T @ (w * off_m)), np.float64)
    return float(solution[0]), float(solution[1])


def _side_by_side(lines: list[LaneLine], flat: _Straightened) -> list[LaneLine]:
    """Choose lines, of those sorted from left to right, that are most likely together."""
    best: list[tuple[float, list[LaneLine]]] = []  # log-odds and lines of the best choice that ends with each line
    for k, line in enumerate(lines):
        choices = [(line.log_odds, [line])]
        for (odds, before), left in zip(best, lines[:k]):
            width = left.offset_m - line.offset_m
            if width >= LANE_M[0] and _is_road(flat, line.offset_m, left.offset_m):
                choices.append((odds + line.log_odds + (NO_NEIGHBOR if width > LANE_M[1] else 0.0), [*before, line]))
        best.append(max(choices, key=lambda choice: choice[0]))
    return max(best, key=lambda choice: choice[0])[1] if best else []


def _is_road(flat: _Straightened, right_m: float, left_m: float) -> bool:
    """Whether there is road between two offsets from the course."""
    between = (flat.across_m > right_m + SAME_LINE_M / 2) & (flat.across_m < left_m - SAME_LINE_M / 2)
    part = flat.is_road[flat.ahead_m < ROAD_WITHIN_M][:, between]
    visible = np.isfinite(part).sum(axis=1)
    enough = visible > 0.5 * np.count_nonzero(between)
    return bool(enough.any() and np.mean(np.nansum(part, axis=1)[enough] > MOST * visible[enough]) >= MIN_ROAD)
