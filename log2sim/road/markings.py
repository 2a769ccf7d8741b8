"""Markings and borders of roads in a map of the ground, without a network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.road.lines import Chain, PaintedLine, color_of, dashed_chains, find_lines, sources_of, touching_chains
from log2sim.road.paint import Pieces, at_height, find_pieces, fit_lines, log_odds_of_line, no_pieces, probability
from log2sim.road.ridges import (
    Layer,
    Mask,
    RidgePoints,
    find_ridges,
    log_color,
    log_intensity,
    log_paint,
    turn_image,
    warp,
)
from log2sim.road.strokes import Curve, fit_curve, thin, trace

# Bars of crosswalks: 0.3 to 0.6 m wide, as far apart (StVO sign 293: 0.5 m; MUTCD 3C: 12 to 24 in, gaps up to 60 in).
BAR_WIDTH_M, BAR_LENGTH_M, BAR_STEP_M = (0.22, 0.85), (1.2, 10.0), (0.5, 2.4)
MAX_BAR_TURN_RAD = np.deg2rad(10)
MIN_BARS = 3
SURE_BARS, FEW_BARS = 6, -3.0  # fewer are often side by side by chance in LiDAR intensities of grass
BARS_IN_LINE = 0.6  # share of their length by which neighbors may be shifted (slanting crosswalks)
# Stop lines: 0.3 to 0.6 m wide (MUTCD 12 to 24 in; StVO sign 294: 0.5 m), as long as a lane or a carriageway is wide.
STOP_WIDTH_M, STOP_LENGTH_M = (0.22, 0.85), (1.5, 20.0)
LANE_LINE_WITHIN_M, MIN_STOP_ANGLE_RAD = 10.0, np.deg2rad(60)
MAX_LANE_LINE_WIDTH_M = 0.35
ALONE = -1.0  # log-odds of a stop line beside which no lane line is seen
# Arrows are 1.5 to 7.5 m long, letters less (MUTCD 3B.20; RMS 1).
MAX_SYMBOL_M, MIN_SYMBOL_M2, MAX_SYMBOL_M2 = 9.0, 0.15, 12.0
# A plain stroke fills its rectangle, also where it is blurred; an arrow of as many widths length half of it.
PLAIN_SHARE, PLAIN_ASPECT = 0.6, 6.0
MAX_SYMBOLS, SYMBOL_STEP_M, SAME_SYMBOL_M = 3, 20.0, 0.3  # in a row, from one to the next, and parts of one
MAX_ACROSS_M = 2.5  # within a lane
ROAD_AROUND_M = 4.0  # whose mean is nearly that of the road
OUTLINE_ERROR_M, HULL_ERROR_M = 0.03, 0.15


@dataclass(frozen=True, eq=False)
class PaintedArea:
    """Paint with an outline."""

    kind: str  # "crosswalk" or "other"
    outline: Array  # (P, 2), m
    width_m: float  # of a crosswalk its extent along the road, of others the lesser extent
    pieces: Pieces  # what shows it
    log_odds: float  # that it is a marking


@dataclass(frozen=True, eq=False)
class _Bar:
    """A short wide stroke: middle (2,), direction, length, width, and its pieces."""

    middle: Array
    direction: float
    length_m: float
    width_m: float
    members: NDArray[np.int64]


def find_crosswalks(ground: GroundMap, pieces: Pieces, chains: list[Chain]) -> tuple[list[PaintedArea], list[Chain]]:
    """Find crosswalks among chains of touching pieces; also the chains that are left."""
    bars = [(k, bar) for k, chain in enumerate(chains) if (bar := _bar_of(ground, pieces, chain)) is not None]
    if len(bars) < MIN_BARS:
        return [], chains
    group = _group(_beside([bar for _, bar in bars]))
    areas, used = [], set()
    for label in range(int(group.max()) + 1):
        chosen = [bars[k] for k in np.flatnonzero(group == label)]
        if len(chosen) >= MIN_BARS:
            areas.append(_crosswalk(pieces, [bar for _, bar in chosen]))
            used |= {k for k, _ in chosen}
    return areas, [chain for k, chain in enumerate(chains) if k not in used]


def _bar_of(ground: GroundMap, pieces: Pieces, chain: Chain) -> _Bar | None:
    width = float(np.median(pieces.width_m[chain.members]))
    corners = chain.corners(pieces)
    chord = corners[-1] - corners[0]
    length = float(np.linalg.norm(chord))
    if not (BAR_WIDTH_M[0] <= width <= BAR_WIDTH_M[1] and BAR_LENGTH_M[0] <= length <= BAR_LENGTH_M[1]):
        return None
    # Ridges reach beyond the ends of short strokes.
    strokes = trace(ground, Curve(corners[[0, -1]]), width).strokes()
    if not len(strokes):
        return None
    begin, end = strokes[0, 0], strokes[-1, 1]
    direction = float(np.arctan2(chord[1], chord[0]) % np.pi)
    middle = corners[0] + chord / length * (begin + end) / 2
    return _Bar(middle, direction, float(end - begin), width, chain.members)


def _beside(bars: list[_Bar]) -> NDArray[np.bool_]:
    """Mask (B, B) of bars that are parallel and side by side."""
    middle, direction = np.array([b.middle for b in bars]), np.array([b.direction for b in bars])
    length, width = np.array([b.length_m for b in bars]), np.array([b.width_m for b in bars])
    turn = np.abs((direction[:, None] - direction + np.pi / 2) % np.pi - np.pi / 2)
    offset = middle[None] - middle[:, None]
    c, s = np.cos(direction)[:, None], np.sin(direction)[:, None]
    along, across = np.abs(offset[..., 0] * c + offset[..., 1] * s), np.abs(offset[..., 1] * c - offset[..., 0] * s)
    shorter = np.minimum(length[:, None], length)
    near = (across >= BAR_STEP_M[0]) & (across <= BAR_STEP_M[1]) & (along <= BARS_IN_LINE * shorter)
    alike = (np.maximum(width[:, None], width) <= 1.6 * np.minimum(width[:, None], width)) & (
        np.maximum(length[:, None], length) <= 2.0 * shorter
    )
    beside = near & alike & (turn <= MAX_BAR_TURN_RAD)
    return np.asarray(beside | beside.T)


def _group(linked: NDArray[np.bool_]) -> NDArray[np.int32]:
    return np.asarray(connected_components(coo_matrix(linked), directed=False)[1], np.int32)


def _crosswalk(pieces: Pieces, bars: list[_Bar]) -> PaintedArea:
    corners = np.concatenate([_corners(bar) for bar in bars])
    own = pieces.take(np.concatenate([bar.members for bar in bars]))
    odds = log_odds_of_line(own, sum(bar.length_m for bar in bars), dashes=len(bars), alone=False)
    if not np.isfinite(own.color).any() and len(bars) < SURE_BARS:
        odds += FEW_BARS
    return PaintedArea("crosswalk", _hull(corners), float(np.median([bar.length_m for bar in bars])), own, odds)


def _corners(bar: _Bar) -> Array:
    d = np.array([np.cos(bar.direction), np.sin(bar.direction)]) * bar.length_m / 2
    n = np.array([-np.sin(bar.direction), np.cos(bar.direction)]) * bar.width_m / 2
    return np.array([bar.middle + d + n, bar.middle + d - n, bar.middle - d - n, bar.middle - d + n])


def _hull(points: Array) -> Array:
    origin = points.mean(axis=0)
    hull = cv2.convexHull((points - origin).astype(np.float32))
    simple = np.asarray(cv2.approxPolyDP(hull, HULL_ERROR_M, True), np.float64)
    return np.asarray(simple.reshape(-1, 2) + origin)


def part_stop_lines(lines: list[PaintedLine]) -> tuple[list[PaintedLine], list[PaintedLine]]:
    """Part wide strokes across the road from lane lines: stop lines, others."""
    lanes = [one for one in lines if one.width_m <= MAX_LANE_LINE_WIDTH_M and one.length_m >= 3.0]
    stops, others = [], []
    for line in lines:
        wide = STOP_WIDTH_M[0] <= line.width_m <= STOP_WIDTH_M[1]
        fits = wide and STOP_LENGTH_M[0] <= line.length_m <= STOP_LENGTH_M[1] and line.dashes < 3
        angle = _angle_to_lanes(line, [one for one in lanes if one is not line]) if fits else 0.0
        if fits and (angle is None or angle >= MIN_STOP_ANGLE_RAD):
            stops.append(replace(line, log_odds=line.log_odds + (ALONE if angle is None else 0.0)))
        else:
            others.append(line)
    return stops, others


def _angle_to_lanes(line: PaintedLine, lanes: list[PaintedLine]) -> float | None:
    """Angle in [0, pi / 2] to the nearest of the lane lines; None where none is near."""
    middle, chord = line.xy.mean(axis=0), line.xy[-1] - line.xy[0]
    best, angle = LANE_LINE_WITHIN_M, None
    for lane in lanes:
        distance = np.linalg.norm(lane.xy - middle, axis=1)
        k = int(np.argmin(distance))
        if distance[k] < best:
            best = float(distance[k])
            tangent = lane.xy[min(k + 1, len(lane.xy) - 1)] - lane.xy[max(k - 1, 0)]
            cross = chord[0] * tangent[1] - chord[1] * tangent[0]
            angle = float(np.arctan2(abs(cross), abs(chord @ tangent)))
    return angle


def part_symbols(ground: GroundMap, lines: list[PaintedLine]) -> tuple[list[PaintedArea], list[PaintedLine]]:
    """Part arrows, letters and other small paint from lane lines: symbols with their outlines, others."""
    outlines: list[NDArray[np.float32]] = []
    areas, used = [], set()
    for line in lines:
        if line.dashes > MAX_SYMBOLS or line.length_m > MAX_SYMBOL_M + SYMBOL_STEP_M * (line.dashes - 1):
            continue
        # Arrows one behind the other look like dashes: their pieces are looked at one by one.
        found = [_outline_around(ground, line, xy) for xy in (line.pieces.xy if line.dashes > 1 else [line.xy])]
        shapes = [outline for outline in found if outline is not None]
        if len(shapes) <= len(found) / 2:
            continue
        used.add(id(line))
        for outline in shapes:
            middle = tuple(outline.mean(axis=0).tolist())
            if not any(cv2.pointPolygonTest(other, middle, True) > -SAME_SYMBOL_M for other in outlines):
                outlines.append(outline.astype(np.float32))
                extent = np.array(cv2.minAreaRect(outlines[-1])[1])
                areas.append(PaintedArea("other", outline, float(extent.min()), line.pieces, line.log_odds))
    return areas, [line for line in lines if id(line) not in used]


def _outline_around(ground: GroundMap, line: PaintedLine, xy: Array) -> Array | None:
    """Outline (P, 2) of the paint at points (N, 2) of a line; None where it is a plain stroke, or too large."""
    xy = xy.reshape(-1, 2)
    low, high = xy.min(axis=0) - MAX_SYMBOL_M / 2, xy.max(axis=0) + MAX_SYMBOL_M / 2
    res, (x0, _, _, y1) = ground.resolution_m, ground.extent_m
    rows = slice(max(int((y1 - high[1]) / res), 0), max(int((y1 - low[1]) / res), 0))
    columns = slice(max(int((low[0] - x0) / res), 0), max(int((high[0] - x0) / res), 0))
    color = ground.color_bgr[rows, columns]
    contrast = line.pieces.color[np.isfinite(line.pieces.color)]
    if not color.size or not len(contrast):
        return None
    paint, seen = log_paint(color), (ground.alpha[rows, columns] > 0).astype(np.float32)
    size = (round(ROAD_AROUND_M / res) | 1,) * 2
    share = cv2.blur(seen, size)
    road = np.divide(cv2.blur(paint * seen, size), share, out=np.full_like(share, np.inf), where=share > 0.1)
    mask = ((paint > road + 0.4 * float(np.median(contrast))) & (seen > 0)).astype(np.uint8)
    labels = cv2.connectedComponents(mask)[1]
    u = np.clip(((xy[:, 0] - x0) / res).astype(int) - columns.start, 0, mask.shape[1] - 1)
    v = np.clip(((y1 - xy[:, 1]) / res).astype(int) - rows.start, 0, mask.shape[0] - 1)
    under = labels[v, u]
    under = under[under > 0]
    if not len(under):
        return None
    own = (labels == np.bincount(under).argmax()).astype(np.uint8)
    contour = max(cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=cv2.contourArea)
    area = float(own.sum()) * res**2
    extent = np.array(cv2.minAreaRect(contour)[1]) * res
    fits = MIN_SYMBOL_M2 <= area <= MAX_SYMBOL_M2 and extent.max() <= MAX_SYMBOL_M and extent.min() <= MAX_ACROSS_M
    if not fits or len(contour) < 4:
        return None
    if area > PLAIN_SHARE * extent.prod() and (extent.min() < 0.3 or extent.max() > PLAIN_ASPECT * extent.min()):
        return None
    simple = cv2.approxPolyDP(contour, OUTLINE_ERROR_M / res, True).reshape(-1, 2).astype(np.float64)
    outline = np.stack(
        [x0 + (simple[:, 0] + columns.start + 0.5) * res, y1 - (simple[:, 1] + rows.start + 0.5) * res], 1
    )
    return outline if len(outline) >= 3 else None


CELL_M = 0.2
DIRECTIONS = 8
HEIGHT = 2  # the last of the layers
ALONG_M, ACROSS_M = 2.0, 0.8
GAP_M = 0.2  # to either side of a border: curbs, and lines painted next to it
# What surfaces of one kind differ by, as logarithms: yellowness (grass, earth and paving against asphalt) and intensity.
# Brightness does not count, as shadows change it most; neither yellowness nor intensity follow them.
YELLOW_SIGMA, INTENSITY_SIGMA = 0.03, 0.2
CURB_M = (0.05, 0.25)  # heights of curbs
HEIGHT_SIGMA_M = 0.03
MIN_STEP, CLEAR_STEP = 1.8, 3.0  # sigmas, together
MIN_SEEN = 0.5
ROAD_TOLERANCE = 1.5  # sigmas that a road may differ from where lane lines are
# Log-odds: a meter of seam, patch or wear is much more frequent than that of a border, long ones are not.
PRIOR, PER_METER, MAX_BY_LENGTH, PER_SIGMA = -3.0, 0.15, 4.5, 0.7
MIN_BORDER_M, MIN_BORDER_CONFIDENCE = 5.0, 0.5
NEAR_LINE_M = 12.0  # borders farther from all lane lines are those of something else


@dataclass(frozen=True, eq=False)
class _Coarse:
    """Layers (K, R, C) of a map in cells of `cell_m`: yellowness and intensity in sigmas, height in sigmas; and where known."""

    values: NDArray[np.float32]
    known: NDArray[np.float32]
    cell_m: float


def find_borders(ground: GroundMap, markings: tuple[Marking, ...]) -> tuple[tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find borders of the roads that lane lines are painted on; the second result says why there are none.

    Notes
    -----
    Both sides of a border are compared over `ACROSS_M` by yellowness, LiDAR intensity and height, each in sigmas of one
    surface. One side has to look like the ground beside lane lines, so without them there are no borders.
    """
    lines = [m.points_m[:, :2] for m in markings if m.is_lane_line]
    if not lines:
        return (), ("no borders of roads seen: without lane lines it is not known which surface is the road",)
    coarse = _coarsen(ground)
    road = _road_at(coarse, ground, np.concatenate(lines))
    points = _steps(coarse, ground, road)
    fitted = fit_lines(points, coarse.cell_m)
    pieces = no_pieces(len(fitted), xy=fitted[:, :2], direction=fitted[:, 2], length_m=fitted[:, 3])
    found = [_border_of(coarse, ground, chain.corners(pieces), lines) for chain in touching_chains(pieces)]
    kept = sorted((b for b in found if b is not None), key=lambda b: -b.confidence)
    named = tuple(
        RoadBorder(f"border-{k + 1}", b.kind, b.points_m, b.confidence, b.sources) for k, b in enumerate(kept)
    )
    return named, () if named else ("no borders of roads seen: the surface does not change beside the lane lines",)


def _coarsen(ground: GroundMap) -> _Coarse:
    factor = max(1, round(CELL_M / ground.resolution_m))
    rows, columns = (size // factor for size in ground.alpha.shape)
    part = (slice(rows * factor), slice(columns * factor))

    def mean(values: Callable[[], NDArray[np.float32]], valid: Mask) -> tuple[Layer, Layer]:
        if not valid.any():
            return np.zeros((rows, columns), np.float32), np.zeros((rows, columns), np.float32)
        size = (columns, rows)
        share = np.asarray(cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
        total = cv2.resize(np.where(valid, values(), 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
        return np.divide(total, share, out=np.zeros_like(share), where=share > 0), share

    seen, hit, level = (
        ground.alpha[part] > 0,
        np.isfinite(ground.intensity[part]),
        np.isfinite(ground.height_m[part]),
    )
    layers = (
        mean(lambda: log_color(ground.color_bgr[part])[1] / np.float32(YELLOW_SIGMA), seen),
        mean(lambda: log_intensity(ground.intensity[part]) / np.float32(INTENSITY_SIGMA), hit),
        mean(lambda: ground.height_m[part] / np.float32(HEIGHT_SIGMA_M), level),
    )
    values, known = (np.stack([layer[k] for layer in layers]) for k in (0, 1))
    return _Coarse(values, (known > 0).astype(np.float32), factor * ground.resolution_m)


def _cells(coarse: _Coarse, ground: GroundMap, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows = ((ground.extent_m[3] - xy[:, 1]) / coarse.cell_m).astype(np.int64)
    columns = ((xy[:, 0] - ground.extent_m[0]) / coarse.cell_m).astype(np.int64)
    shape = coarse.values.shape[1:]
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)


def _road_at(coarse: _Coarse, ground: GroundMap, on_lines: Array) -> Array:
    """Yellowness and intensity (2,) of the road: medians around lane lines; NaN where unknown."""
    around = np.concatenate([on_lines + shift for shift in ((0.6, 0.6), (-0.6, -0.6), (0.6, -0.6), (-0.6, 0.6))])
    rows, columns = _cells(coarse, ground, around)
    out = np.full(2, np.nan)
    for k in range(2):
        known = coarse.known[k, rows, columns] > 0
        if known.any():
            out[k] = np.median(coarse.values[k, rows, columns][known])
    return out


def _steps(coarse: _Coarse, ground: GroundMap, road: Array) -> RidgePoints:
    """Find points where the road is on one side only."""
    seen = [bool(layer.any()) for layer in coarse.known]
    height, width = coarse.values.shape[1:]
    best = np.zeros((height, width), np.float32)
    number = np.zeros(best.shape, np.uint8)
    for k in range(DIRECTIONS):
        there, back, size = turn_image((height, width), np.pi * k / DIRECTIONS)
        turned, known = (
            [warp(layer, there, size) if some else None for layer, some in zip(layers, seen, strict=True)]
            for layers in (coarse.values, coarse.known)
        )
        for way, step in enumerate(_step(turned, known, road, size, coarse.cell_m)):
            response = warp(step, back, (width, height))
            better = response > best
            best[better], number[better] = response[better], k + way * DIRECTIONS
    rows, columns = np.nonzero(best > MIN_STEP)
    angle = number[rows, columns] * (np.pi / DIRECTIONS)
    across = np.stack([-np.cos(angle), -np.sin(angle)])  # rows, columns
    here = best[rows, columns]
    sides = [map_coordinates(best, np.stack([rows, columns]) + s * across, order=1) for s in (-2, -1, 1, 2)]
    crest = here >= np.max(sides, axis=0)
    x = ground.extent_m[0] + (columns[crest] + 0.5) * coarse.cell_m
    y = ground.extent_m[3] - (rows[crest] + 0.5) * coarse.cell_m
    return RidgePoints(np.stack([x, y], 1), angle[crest] % np.pi, here[crest].astype(np.float64))


def _step(
    turned: list[Layer | None], known: list[Layer | None], road: Array, size: tuple[int, int], cell_m: float
) -> tuple[Layer, Layer]:
    """Sigmas by which the ground on one side of the rows differs from the road on the other: road below, road above.

    Layers are None where nothing of them is known; `size` is that of the others (columns, rows).
    """
    kernel = (round(ALONG_M / cell_m), round(ACROSS_M / cell_m))
    reach = round((GAP_M + ACROSS_M / 2) / cell_m)
    shape = (max(size[1] - 2 * reach, 0), size[0])
    steps: list[NDArray[Any]] = []
    boths: list[NDArray[Any]] = []
    below_differs: NDArray[Any] = np.zeros(shape, bool)
    above_differs, told = below_differs, below_differs
    for k, (values, valid) in enumerate(zip(turned, known, strict=True)):
        if values is None or valid is None:
            steps.append(np.zeros(shape, np.float32))
            boths.append(np.zeros(shape, bool))
            continue
        share = np.asarray(cv2.blur(valid, kernel), np.float32)
        mean = np.divide(cv2.blur(values * valid, kernel), share, out=np.zeros_like(share), where=share > MIN_SEEN)
        above, below = mean[: -2 * reach], mean[2 * reach :]
        both = np.minimum(share[: -2 * reach], share[2 * reach :]) > MIN_SEEN
        steps.append(np.where(both, above - below, 0))
        boths.append(both)
        if k != HEIGHT and np.isfinite(road[k]):
            told = told | both
            below_differs = below_differs | (both & (np.abs(below - np.float32(road[k])) > ROAD_TOLERANCE))
            above_differs = above_differs | (both & (np.abs(above - np.float32(road[k])) > ROAD_TOLERANCE))
    surface = np.square(_surface_step(steps[0], steps[1], boths[1]))
    height = steps[HEIGHT] * np.float32(HEIGHT_SIGMA_M)
    out = (np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.float32))
    for layer, other, rise in zip(out, (below_differs, above_differs), (height, -height)):
        curb = np.where((rise > CURB_M[0]) & (rise < CURB_M[1]), np.square(steps[HEIGHT]), 0)  # only up, and no wall
        layer[reach:-reach] = np.where(told & ~other, np.sqrt(surface + curb), 0)
    return out


def _surface_step(yellow: NDArray[Any], intensity: NDArray[Any], by_lidar: NDArray[Any]) -> NDArray[Any]:
    """Join steps of yellowness and intensity (...), sigmas.

    Shadows are bluer than the sun's light but reflect LiDAR as before, so color counts no more than intensity where that
    is known, and half without.
    """
    y, i = np.abs(yellow), np.abs(intensity)
    return np.asarray(np.where(by_lidar, np.hypot(i, np.minimum(y, i)), y / 2))


def _border_of(coarse: _Coarse, ground: GroundMap, corners: Array, lines: list[Array]) -> RoadBorder | None:
    """Rate a chain of steps; None for one that is short, unlikely, or far from lane lines."""
    length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    if length < MIN_BORDER_M:
        return None
    curve = fit_curve(corners, sigma_m=coarse.cell_m / 2)
    distance = cKDTree(np.concatenate(lines)).query(curve.xy[::4])[0]
    steps = _steps_along(coarse, ground, curve.xy, curve.normal)
    by_color, by_lidar, by_height = (float(abs(np.median(s))) if len(s) > 3 else 0.0 for s in steps)
    sigmas = float(_surface_step(np.array(by_color), np.array(by_lidar), np.array(len(steps[1]) > 3)))
    curb = CURB_M[0] <= by_height * HEIGHT_SIGMA_M <= CURB_M[1]
    odds = PRIOR + min(PER_METER * length, MAX_BY_LENGTH) + PER_SIGMA * min(sigmas - MIN_STEP, CLEAR_STEP) + 2.0 * curb
    if probability(odds) < MIN_BORDER_CONFIDENCE or np.median(distance) > NEAR_LINE_M:
        return None
    shown = (("camera", by_color > 1), ("lidar", by_lidar > 1 or curb))
    sources = tuple(name for name, shows in shown if shows)
    return RoadBorder("", "curb" if curb else "edge", at_height(ground, thin(curve.xy)), probability(odds), sources)


def _steps_along(coarse: _Coarse, ground: GroundMap, xy: Array, normal: Array) -> list[Array]:
    """Measure the steps (N,) of each layer across a line, in sigmas, where both sides are known."""
    reach = GAP_M + ACROSS_M / 2
    sides = [_cells(coarse, ground, xy + side * reach * normal) for side in (-1, 1)]
    out = []
    for values, known in zip(coarse.values, coarse.known):
        both = np.minimum(*(known[cells] for cells in sides)) > 0
        out.append((values[sides[1]] - values[sides[0]])[both].astype(np.float64))
    return out


MIN_CONFIDENCE = 0.5  # what is rather not there than there is left out
MIN_LINE_M = 2.0  # shorter plain strokes tell no lane


def find_markings(ground: GroundMap) -> tuple[tuple[Marking, ...], tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find markings and road borders in a map of the ground.

    `ground`: color, LiDAR intensity and height; each may be missing in part or altogether.

    Returns `markings`: sure ones first; `borders`; `notes`: what was not found, and why.

    Notes
    -----
    Ridges of color and LiDAR intensity (`ridges`) become straight pieces with profiles (`pieces`), chains of pieces
    (`chains`) and smooth curves (`curves`). What lies along a curve tells solid from dashed lines (`strokes`), parallel
    bars are crosswalks, and wide strokes across lanes are stop lines (`areas`). Each is rated by both sensors
    (`evidence`). The cost grows with the area that was seen.
    """
    markings = list_markings(ground, min_confidence=MIN_CONFIDENCE, min_line_m=MIN_LINE_M)
    notes = _notes(ground, markings)
    if not np.any(ground.alpha) and not np.isfinite(ground.intensity).any():
        return (), (), notes
    borders, more = find_borders(ground, markings)
    return markings, borders, (*notes, *more)


def list_markings(
    ground: GroundMap, *, min_confidence: float, min_line_m: float, symbols: bool = True
) -> tuple[Marking, ...]:
    """List markings, sure ones first, from a confidence and, for plain strokes, a length on; `symbols` tells arrows apart."""
    pieces = find_pieces(ground, find_ridges(ground))
    areas, chains = find_crosswalks(ground, pieces, touching_chains(pieces))
    lines = find_lines(ground, pieces, dashed_chains(pieces, chains))
    stops, lines = part_stop_lines(lines)
    if symbols:
        small, lines = part_symbols(ground, lines)
        areas += small
    found = [_marking_of_area(ground, area) for area in areas]
    found += [_marking_of_line(ground, line, "stop_line") for line in stops]
    long = [line for line in lines if line.kind == "dashed" or line.length_m >= min_line_m]
    found += [_marking_of_line(ground, line, line.kind) for line in long]
    markings = sorted((m for m in found if m.confidence >= min_confidence), key=lambda m: -m.confidence)
    return tuple(replace(marking, id=f"marking-{k + 1}") for k, marking in enumerate(markings))


def _marking_of_line(ground: GroundMap, line: PaintedLine, kind: str) -> Marking:
    points = at_height(ground, thin(line.xy))
    return Marking("", kind, points, line.width_m, line.color, probability(line.log_odds), line.sources)


def _marking_of_area(ground: GroundMap, area: PaintedArea) -> Marking:
    points = at_height(ground, area.outline)
    shown_by = (color_of(area.pieces), probability(area.log_odds), sources_of(area.pieces))
    return Marking("", area.kind, points, area.width_m, *shown_by)


def _notes(ground: GroundMap, markings: tuple[Marking, ...]) -> tuple[str, ...]:
    notes = []
    by_camera, by_lidar = bool(np.any(ground.alpha)), bool(np.isfinite(ground.intensity).any())
    if not by_camera and not by_lidar:
        return ("no markings seen: no sensor saw the ground",)
    if not by_camera:
        notes.append("markings by LiDAR intensity only: no camera saw the ground; their colors are unknown")
    if not by_lidar:
        notes.append(
            "markings by cameras only: no LiDAR intensity of the ground; light streaks are harder to tell from paint"
        )
    if not markings:
        notes.append("no markings seen: no paint stands out from the ground")
    return tuple(notes)
