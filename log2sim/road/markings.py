"""Markings and borders of roads in a map of the ground, without a network."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array, median
from log2sim.road.ground_map import GroundMap
from log2sim.road.lines import Chain, PaintedLine, color_of, dashed_chains, find_lines, sources_of, touching_chains
from log2sim.road.paint import (
    Pieces,
    at_height,
    evidence_of_line,
    find_pieces,
    fit_lines,
    no_pieces,
    table_of,
    weighted_sum,
)
from log2sim.road.ridges import (
    Layer,
    RidgePoints,
    coarse_means,
    find_ridges,
    log_color,
    log_intensity,
    log_paint,
    turn_image,
    warp,
)
from log2sim.road.strokes import Curve, fit_curve, thin, trace
from log2sim.road.weights import WEIGHTS

# Bars of crosswalks: 0.3 to 0.6 m wide, as far apart (StVO sign 293: 0.5 m; MUTCD 3C: 12 to 24 in, gaps up to 60 in).
BAR_WIDTH_M, BAR_LENGTH_M, BAR_STEP_M = (0.22, 0.85), (1.2, 10.0), (0.5, 2.4)
MAX_BAR_TURN_RAD = np.deg2rad(10)
MIN_BARS = 3
BARS_IN_LINE = 0.6  # share of their length by which neighbors may be shifted (slanting crosswalks)
# Stop lines: 0.3 to 0.6 m wide (MUTCD 12 to 24 in; StVO sign 294: 0.5 m), as long as a lane or a carriageway is wide.
STOP_WIDTH_M, STOP_LENGTH_M = (0.22, 0.85), (1.5, 20.0)
LANE_LINE_WITHIN_M, MIN_STOP_ANGLE_RAD = 10.0, np.deg2rad(60)
MAX_LANE_LINE_WIDTH_M = 0.35
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
    evidence: dict[str, float]  # that it is a marking, see `evidence_of_line`

    @cached_property
    def log_odds(self) -> float:
        """Log-odds that it is a marking."""
        return weighted_sum(self.evidence, WEIGHTS[table_of(self.pieces, bars=self.kind == "crosswalk")])


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
    count, group = connected_components(coo_matrix(_beside([bar for _, bar in bars])), directed=False)
    areas, used = [], set()
    for label in range(count):
        chosen = [bars[k] for k in np.flatnonzero(group == label)]
        if len(chosen) < MIN_BARS:
            continue
        used |= {k for k, _ in chosen}
        own = pieces.take(np.concatenate([bar.members for _, bar in chosen]))
        lengths = [bar.length_m for _, bar in chosen]
        evidence = evidence_of_line(own, sum(lengths), dashes=len(chosen), bars=True)
        corners = []
        for _, bar in chosen:
            d = np.array([np.cos(bar.direction), np.sin(bar.direction)]) * bar.length_m / 2
            n = np.array([-np.sin(bar.direction), np.cos(bar.direction)]) * bar.width_m / 2
            corners += [bar.middle + d + n, bar.middle + d - n, bar.middle - d - n, bar.middle - d + n]
        origin = np.mean(corners, axis=0)
        hull = cv2.approxPolyDP(cv2.convexHull((np.array(corners) - origin).astype(np.float32)), HULL_ERROR_M, True)
        outline = np.asarray(hull, np.float64).reshape(-1, 2) + origin
        areas.append(PaintedArea("crosswalk", outline, float(np.median(lengths)), own, evidence))
    # What is left of a bar, as where a shadow parts it, is no line.
    inside = np.zeros(len(pieces), dtype=bool)
    for area in (area for area in areas if area.log_odds > 0):
        inside |= shapely.contains_xy(shapely.Polygon(area.outline), *pieces.xy.T)
    return areas, [chain for k, chain in enumerate(chains) if k not in used and not inside[chain.members].all()]


def _bar_of(ground: GroundMap, pieces: Pieces, chain: Chain) -> _Bar | None:
    width = median(pieces.width_m[chain.members])
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
    alike = np.maximum(width[:, None], width) <= 1.6 * np.minimum(width[:, None], width)
    alike &= np.maximum(length[:, None], length) <= 2.0 * shorter
    beside = near & alike & (turn <= MAX_BAR_TURN_RAD)
    return np.asarray(beside | beside.T)


def part_stop_lines(lines: list[PaintedLine]) -> tuple[list[PaintedLine], list[PaintedLine]]:
    """Part wide strokes across the road from lane lines: stop lines, others."""
    lanes = [one for one in lines if one.width_m <= MAX_LANE_LINE_WIDTH_M and one.length_m >= 3.0]
    stops, others = [], []
    for line in lines:
        wide = STOP_WIDTH_M[0] <= line.width_m <= STOP_WIDTH_M[1]
        fits = wide and STOP_LENGTH_M[0] <= line.length_m <= STOP_LENGTH_M[1] and line.dashes < 3
        middle, chord = line.xy.mean(axis=0), line.xy[-1] - line.xy[0]
        nearest, angle = LANE_LINE_WITHIN_M, None  # of the lane lines; the angle to it in [0, pi / 2]
        for lane in lanes if fits else ():
            distance = np.linalg.norm(lane.xy - middle, axis=1)
            k = int(np.argmin(distance))
            if lane is not line and distance[k] < nearest:
                nearest = float(distance[k])
                tangent = lane.xy[min(k + 1, len(lane.xy) - 1)] - lane.xy[max(k - 1, 0)]
                cross = chord[0] * tangent[1] - chord[1] * tangent[0]
                angle = float(np.arctan2(abs(cross), abs(chord @ tangent)))
        if fits and (angle is None or angle >= MIN_STOP_ANGLE_RAD):
            stops.append(replace(line, evidence=line.evidence | {"no_lane_line": float(angle is None)}))
        else:
            others.append(line)
    return stops, others


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
                areas.append(PaintedArea("other", outline, float(extent.min()), line.pieces, line.evidence))
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
    x, y = x0 + (simple[:, 0] + columns.start + 0.5) * res, y1 - (simple[:, 1] + rows.start + 0.5) * res
    return np.stack([x, y], 1) if len(simple) >= 3 else None


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

    Both sides of a border are compared over `ACROSS_M` by yellowness, LiDAR intensity and height, each in sigmas of one
    surface. One side has to look like the ground beside lane lines, so without them there are no borders.
    """
    lines = [m.points_m[:, :2] for m in markings if m.is_lane_line]
    if not lines:
        return (), ("no borders of roads seen: without lane lines it is not known which surface is the road",)
    coarse = _coarsen(ground)
    around = [xy + shift for xy in lines for shift in ((0.6, 0.6), (-0.6, -0.6), (0.6, -0.6), (-0.6, 0.6))]
    cells = _cells(coarse, ground, np.concatenate(around))
    road = np.full(2, np.nan)  # its yellowness and intensity
    for k in range(2):
        known = coarse.known[k][cells] > 0
        if known.any():
            road[k] = np.median(coarse.values[k][cells][known])
    # Under paint there is road, which would look like another surface.
    paint = _draw_paint(coarse, ground, markings)
    for k in np.flatnonzero(np.isfinite(road)).tolist():
        coarse.values[k][paint] = road[k]
    points = _steps(coarse, ground, road)
    fitted = fit_lines(points, coarse.cell_m)
    pieces = no_pieces(len(fitted), xy=fitted[:, :2], direction=fitted[:, 2], length_m=fitted[:, 3])
    found = [_border_of(coarse, ground, chain.corners(pieces), lines) for chain in touching_chains(pieces)]
    kept = sorted((b for b in found if b is not None), key=lambda b: -b.confidence)
    named = tuple(replace(border, id=f"border-{k + 1}") for k, border in enumerate(kept))
    return named, () if named else ("no borders of roads seen: the surface does not change beside the lane lines",)


def _coarsen(ground: GroundMap) -> _Coarse:
    factor = max(1, round(CELL_M / ground.resolution_m))
    rows, columns = (size // factor for size in ground.alpha.shape)
    part = (slice(rows * factor), slice(columns * factor))
    intensity, height_m = ground.intensity[part], ground.height_m[part]
    layers = (
        (log_color(ground.color_bgr[part])[1] / np.float32(YELLOW_SIGMA), ground.alpha[part] > 0),
        (log_intensity(intensity) / np.float32(INTENSITY_SIGMA), np.isfinite(intensity)),
        (height_m / np.float32(HEIGHT_SIGMA_M), np.isfinite(height_m)),
    )
    means = [coarse_means(values, valid, factor) for values, valid in layers]
    values, known = (np.stack(column) for column in zip(*means))
    return _Coarse(values, (known > 0).astype(np.float32), factor * ground.resolution_m)


def _draw_paint(coarse: _Coarse, ground: GroundMap, markings: tuple[Marking, ...]) -> NDArray[np.bool_]:
    """Mask of the cells (R, C) that markings touch."""
    mask = np.zeros(coarse.values.shape[1:], np.uint8)
    for marking in markings:
        rows, columns = ground.raster.cells_of(marking.points_m[:, :2])
        at = (np.stack([columns, rows], axis=1) + 0.5) * ground.resolution_m / coarse.cell_m - 0.5
        corners = np.rint(at).astype(np.int32)
        if marking.is_lane_line or marking.kind == "stop_line":
            cv2.polylines(mask, [corners], False, 1, round(marking.width_m / coarse.cell_m) + 1)
        else:
            cv2.fillPoly(mask, [corners], 1)
    return mask > 0


def _cells(coarse: _Coarse, ground: GroundMap, xy: Array) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    rows = ((ground.extent_m[3] - xy[:, 1]) / coarse.cell_m).astype(np.int64)
    columns = ((xy[:, 0] - ground.extent_m[0]) / coarse.cell_m).astype(np.int64)
    shape = coarse.values.shape[1:]
    return np.clip(rows, 0, shape[0] - 1), np.clip(columns, 0, shape[1] - 1)


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
    # Steps of each layer across the line, in sigmas, where both sides are known.
    reach, steps = GAP_M + ACROSS_M / 2, []
    left, right = (_cells(coarse, ground, curve.xy + side * reach * curve.normal) for side in (1, -1))
    for values, known in zip(coarse.values, coarse.known):
        both = np.minimum(known[left], known[right]) > 0
        steps.append((values[left] - values[right])[both].astype(np.float64))
    by_color, by_lidar, by_height = (float(abs(np.median(s))) if len(s) > 3 else 0.0 for s in steps)
    sigmas = float(_surface_step(np.array(by_color), np.array(by_lidar), np.array(len(steps[1]) > 3)))
    curb = CURB_M[0] <= by_height * HEIGHT_SIGMA_M <= CURB_M[1]
    odds = PRIOR + min(PER_METER * length, MAX_BY_LENGTH) + PER_SIGMA * min(sigmas - MIN_STEP, CLEAR_STEP) + 2.0 * curb
    if probability_of(odds) < MIN_BORDER_CONFIDENCE or np.median(distance) > NEAR_LINE_M:
        return None
    shown = (("camera", by_color > 1), ("lidar", by_lidar > 1 or curb))
    sources = tuple(name for name, shows in shown if shows)
    return RoadBorder(
        "", "curb" if curb else "edge", at_height(ground, thin(curve.xy)), float(probability_of(odds)), sources
    )


MIN_CONFIDENCE = 0.5  # what is rather not there than there is left out
MIN_LINE_M = 2.0  # shorter plain strokes tell no lane


def find_markings(ground: GroundMap) -> tuple[tuple[Marking, ...], tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find markings and road borders in a map of the ground.

    `ground`: color, LiDAR intensity and height; each may be missing in part or altogether.

    Returns `markings`: sure ones first; `borders`; `notes`: what was not found, and why.

    Ridges of color and LiDAR intensity (`ridges`) become straight pieces with profiles (`paint`), chains of pieces
    (`lines`) and smooth curves. Strokes along a curve are a solid or a dashed line (`strokes`), parallel bars are
    crosswalks, and wide strokes across lanes are stop lines. Evidence of each by both sensors is weighed (`paint`,
    `weights`). The cost grows with the area that was seen.
    """
    by_camera, by_lidar = ground.has_color, bool(np.isfinite(ground.intensity).any())
    if not by_camera and not by_lidar:
        return (), (), ("no markings seen: no sensor saw the ground",)
    markings = list_markings(ground, min_confidence=MIN_CONFIDENCE, min_line_m=MIN_LINE_M)
    borders, notes = find_borders(ground, markings)
    if not markings:
        notes = ("no markings seen: no paint stands out from the ground", *notes)
    if not by_lidar:
        alone = (
            "markings by cameras only: no LiDAR intensity of the ground; light streaks are harder to tell from paint"
        )
        notes = (alone, *notes)
    if not by_camera:
        alone = "markings by LiDAR intensity only: no camera saw the ground; their colors are unknown"
        notes = (alone, *notes)
    return markings, borders, notes


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
    long = [line for line in lines if line.kind == "dashed" or line.length_m >= min_line_m]
    painted: list[tuple[str, Array, PaintedArea | PaintedLine]] = [(area.kind, area.outline, area) for area in areas]
    painted += [("stop_line", thin(line.xy), line) for line in stops]
    painted += [(line.kind, thin(line.xy), line) for line in long]
    found = []
    for kind, xy, one in painted:
        shown_by = color_of(one.pieces), float(probability_of(one.log_odds)), sources_of(one.pieces)
        if shown_by[1] >= min_confidence:
            found.append(Marking("", kind, at_height(ground, xy), one.width_m, *shown_by))
    markings = sorted(found, key=lambda m: -m.confidence)
    return tuple(replace(marking, id=f"marking-{k + 1}") for k, marking in enumerate(markings))
