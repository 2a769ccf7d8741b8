"""Markings that are no lane lines: crosswalks of parallel bars, stop lines, arrows and letters."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from log2sim.geometry import Array
from log2sim.lanes.detection.chains import Chain
from log2sim.lanes.detection.curves import Curve
from log2sim.lanes.detection.evidence import log_odds_of_line
from log2sim.lanes.detection.layers import log_paint
from log2sim.lanes.detection.lines import PaintedLine
from log2sim.lanes.detection.profiles import Pieces
from log2sim.lanes.detection.strokes import trace
from log2sim.mapping.ground_map import GroundMap

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
MAX_SYMBOLS, SYMBOL_STEP_M, SAME_SYMBOL_M = 3, 20.0, 0.3  # in a row, from one to the next, and parts of one
MAX_ACROSS_M = 2.5  # within a lane
ROAD_AROUND_M = 4.0  # whose mean is nearly that of the road
OUTLINE_ERROR_M, HULL_ERROR_M = 0.03, 0.15


@dataclass(frozen=True, eq=False)
class PaintedArea:
    """Paint with an outline.

    Attributes
    ----------
    kind : str
        "crosswalk" or "other".
    outline : (P, 2) float64, m
    width_m : float
        Of a crosswalk its extent along the road, of others the lesser extent.
    pieces : Pieces
        What shows it.
    log_odds : float
        That it is a marking.
    """

    kind: str
    outline: Array
    width_m: float
    pieces: Pieces
    log_odds: float


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
            stops.append(_with_odds(line, line.log_odds + (ALONE if angle is None else 0.0)))
        else:
            others.append(line)
    return stops, others


def _with_odds(line: PaintedLine, odds: float) -> PaintedLine:
    return PaintedLine(line.xy, line.kind, line.width_m, line.pieces, line.painted_m, line.dashes, odds)


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
    if extent.min() < 0.3 and area > 0.7 * extent.prod():  # a plain stroke
        return None
    simple = cv2.approxPolyDP(contour, OUTLINE_ERROR_M / res, True).reshape(-1, 2).astype(np.float64)
    outline = np.stack(
        [x0 + (simple[:, 0] + columns.start + 0.5) * res, y1 - (simple[:, 1] + rows.start + 0.5) * res], 1
    )
    return outline if len(outline) >= 3 else None
