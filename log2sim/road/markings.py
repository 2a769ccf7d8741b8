"""Markings and borders of roads in a map of the ground."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import shapely
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array, median
from log2sim.road.borders import find_borders
from log2sim.road.ground_map import GroundMap
from log2sim.road.lines import Chain, PaintedLine, color_of, dashed_chains, find_lines, sources_of, touching_chains
from log2sim.road.paint import (
    DRY,
    Pieces,
    at_height,
    evidence_of_line,
    find_pieces,
    median_known,
    surer_log_odds,
)
from log2sim.road.paint_network import PaintMaps, find_crests, find_paint_maps
from log2sim.road.ridges import RidgePoints, find_ridges, log_paint
from log2sim.road.strokes import Curve, thin, trace

# Bars of crosswalks: 0.3 to 0.6 m wide, as far apart (StVO sign 293: 0.5 m; MUTCD 3C: 12 to 24 in, gaps up to 60 in).
BAR_WIDTH_M, BAR_LENGTH_M, BAR_STEP_M = (0.22, 0.85), (1.2, 10.0), (0.5, 2.4)
MAX_BAR_TURN_RAD = np.deg2rad(10)
MIN_BARS = 3
NEAR_RIDGE_M = 1.0  # within which the network's probability reaches beyond the ends of strokes
# Parts of a crosswalk, between which bars are worn off, hidden by a vehicle or left out on an island, are less than a lane and a bar apart.
MAX_PART_GAP_M = 5.0
BARS_IN_LINE = 0.6  # share of their length by which neighbors may be shifted (slanting crosswalks)
# Stop lines: 0.3 to 0.6 m wide (MUTCD 12 to 24 in; StVO sign 294: 0.5 m), as long as a lane or a carriageway is wide.
STOP_WIDTH_M, STOP_LENGTH_M = (0.22, 0.85), (1.5, 20.0)
SURE_STOP_M = 6.0  # two lanes: longer ones are no more likely, as streaks of light are as long
LANE_LINE_WITHIN_M, MIN_STOP_ANGLE_RAD = 10.0, np.deg2rad(60)
MAX_LANE_LINE_WIDTH_M = 0.35
# Arrows are 1.5 to 7.5 m long, letters less (MUTCD 3B.20; RMS 1).
MAX_SYMBOL_M, MIN_SYMBOL_M2, MAX_SYMBOL_M2 = 9.0, 0.15, 12.0
FLAKE_M = 0.1  # gaps in worn paint
MAX_SYMBOLS, SYMBOL_STEP_M, SAME_SYMBOL_M = 3, 20.0, 0.3  # in a row, from one to the next, and parts of one
MAX_ACROSS_M = 3.0  # within a lane
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
    network: float  # log-odds that it is one, by the network
    bars_m: Sequence[float] = ()  # lengths of the bars of a crosswalk

    @cached_property
    def log_odds(self) -> float:
        """Log-odds that it is a marking."""
        return surer_log_odds(self.pieces, self.kind, self.evidence, self.network)


@dataclass(frozen=True, eq=False)
class _Bar:
    """A short wide stroke: middle (2,), direction, length, width, and its pieces."""

    middle: Array
    direction: float
    length_m: float
    width_m: float
    members: NDArray[np.int64]


def evidence_of_bars(pieces: Pieces, lengths_m: Sequence[float], shares: Array = DRY) -> dict[str, float]:
    """Gather the evidence that bars of some lengths are a crosswalk, as `evidence_of_line`."""
    return evidence_of_line(pieces, sum(lengths_m), dashes=len(lengths_m), shares=shares, bars=True)


def find_crosswalks(
    ground: GroundMap, maps: PaintMaps, pieces: Pieces, chains: list[Chain]
) -> tuple[list[PaintedArea], list[Chain]]:
    """Find crosswalks among chains of touching pieces; also the chains that are left."""
    bars = [(k, bar) for k, chain in enumerate(chains) if (bar := _bar_of(ground, maps, pieces, chain)) is not None]
    parts = [part for part in _rows_of(bars, BAR_STEP_M[1]) if len(part) >= MIN_BARS]
    areas, used = [], set()
    for chosen in _rows_of([bar for part in parts for bar in part], MAX_PART_GAP_M):
        used |= {k for k, _ in chosen}
        own = pieces.take(np.concatenate([bar.members for _, bar in chosen]))
        lengths = [bar.length_m for _, bar in chosen]
        evidence, odds = evidence_of_bars(own, lengths), maps.object_log_odds("crosswalk", own.along)
        corners = []
        for _, bar in chosen:
            d = np.array([np.cos(bar.direction), np.sin(bar.direction)]) * bar.length_m / 2
            n = np.array([-np.sin(bar.direction), np.cos(bar.direction)]) * bar.width_m / 2
            corners += [bar.middle + d + n, bar.middle + d - n, bar.middle - d - n, bar.middle - d + n]
        origin = np.mean(corners, axis=0)
        hull = cv2.approxPolyDP(cv2.convexHull((np.array(corners) - origin).astype(np.float32)), HULL_ERROR_M, True)
        outline = np.asarray(hull, np.float64).reshape(-1, 2) + origin
        areas.append(PaintedArea("crosswalk", outline, float(np.median(lengths)), own, evidence, odds, lengths))
    # What is left of a bar, as where a shadow parts it, is no line.
    inside = np.zeros(len(pieces), dtype=bool)
    for area in (area for area in areas if area.log_odds > 0):
        inside |= shapely.contains_xy(shapely.Polygon(area.outline), *pieces.xy.T)
    return areas, [chain for k, chain in enumerate(chains) if k not in used and not inside[chain.members].all()]


def _bar_of(ground: GroundMap, maps: PaintMaps, pieces: Pieces, chain: Chain) -> _Bar | None:
    width = median(pieces.width_m[chain.members])
    corners = chain.corners(pieces)
    chord = corners[-1] - corners[0]
    length = float(np.linalg.norm(chord))
    if not (BAR_WIDTH_M[0] <= width <= BAR_WIDTH_M[1] and BAR_LENGTH_M[0] <= length <= BAR_LENGTH_M[1]):
        return None
    # Ridges reach beyond the ends of short strokes.
    strokes = trace(ground, maps, Curve(corners[[0, -1]]), width).strokes()
    if not len(strokes):
        return None
    begin, end = strokes[0, 0], strokes[-1, 1]
    direction = float(np.arctan2(chord[1], chord[0]) % np.pi)
    middle = corners[0] + chord / length * (begin + end) / 2
    return _Bar(middle, direction, float(end - begin), width, chain.members)


def _rows_of(numbered: list[tuple[int, _Bar]], max_step_m: float) -> list[list[tuple[int, _Bar]]]:
    """Group bars that are parallel, alike and side by side, from one to the next at most `max_step_m`."""
    if not numbered:
        return []
    bars = [bar for _, bar in numbered]
    middle, direction = np.array([b.middle for b in bars]), np.array([b.direction for b in bars])
    length, width = np.array([b.length_m for b in bars]), np.array([b.width_m for b in bars])
    turn = np.abs((direction[:, None] - direction + np.pi / 2) % np.pi - np.pi / 2)
    offset = middle[None] - middle[:, None]
    c, s = np.cos(direction)[:, None], np.sin(direction)[:, None]
    along, across = np.abs(offset[..., 0] * c + offset[..., 1] * s), np.abs(offset[..., 1] * c - offset[..., 0] * s)
    shorter = np.minimum(length[:, None], length)
    near = (across >= BAR_STEP_M[0]) & (across <= max_step_m) & (along <= BARS_IN_LINE * shorter)
    alike = np.maximum(width[:, None], width) <= 1.6 * np.minimum(width[:, None], width)
    alike &= np.maximum(length[:, None], length) <= 2.0 * shorter
    beside = near & alike & (turn <= MAX_BAR_TURN_RAD)
    count, group = connected_components(coo_matrix(beside | beside.T), directed=False)
    return [[numbered[k] for k in np.flatnonzero(group == label)] for label in range(count)]


def part_stop_lines(maps: PaintMaps, lines: list[PaintedLine]) -> tuple[list[PaintedLine], list[PaintedLine]]:
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
            length = min(line.evidence["length"], np.log(SURE_STOP_M))
            evidence = line.evidence | {"no_lane_line": float(angle is None), "length": float(length)}
            odds = maps.object_log_odds("stop_line", line.pieces.along)
            stops.append(replace(line, kind="stop_line", evidence=evidence, network=odds))
        else:
            others.append(line)
    return stops, others


def part_symbols(
    ground: GroundMap, maps: PaintMaps, lines: list[PaintedLine]
) -> tuple[list[PaintedArea], list[PaintedLine]]:
    """Part arrows, letters and other small paint from lane lines: outlines of all that may be symbols, and the lines that remain."""
    areas, remaining = list[PaintedArea](), []
    for line in lines:
        found: list[PaintedArea | None] = []
        if line.dashes <= MAX_SYMBOLS and line.length_m <= MAX_SYMBOL_M + SYMBOL_STEP_M * (line.dashes - 1):
            # Arrows one behind the other look like dashes: their pieces are looked at one by one.
            found = [_symbol_at(ground, maps, line, xy) for xy in (line.pieces.xy if line.dashes > 1 else [line.xy])]
        shapes = [area for area in found if area is not None]
        areas += shapes
        # What lies in a row is of one kind.
        if len(shapes) <= len(found) / 2 or sum(area.log_odds for area in shapes) <= 0:
            remaining.append(line)
    apart = list[PaintedArea]()
    for area in sorted(areas, key=lambda area: -area.log_odds):
        middle = tuple(area.outline.mean(axis=0).tolist())
        if not any(cv2.pointPolygonTest(o.outline.astype(np.float32), middle, True) > -SAME_SYMBOL_M for o in apart):
            apart.append(area)
    return apart, remaining


def _symbol_at(ground: GroundMap, maps: PaintMaps, line: PaintedLine, xy: Array) -> PaintedArea | None:
    """Outline the paint at points (N, 2) of a line; None where no camera saw it, or it is too large or too small."""
    xy = xy.reshape(-1, 2)
    low, high = xy.min(axis=0) - MAX_SYMBOL_M / 2, xy.max(axis=0) + MAX_SYMBOL_M / 2
    res, (x0, _, _, y1) = ground.resolution_m, ground.extent_m
    rows = slice(max(int((y1 - high[1]) / res), 0), max(int((y1 - low[1]) / res), 0))
    columns = slice(max(int((low[0] - x0) / res), 0), max(int((high[0] - x0) / res), 0))
    color = ground.color_bgr[rows, columns]
    expected = median_known(line.pieces.color)
    if not color.size or not np.isfinite(expected):
        return None
    paint, seen = log_paint(color), (ground.alpha[rows, columns] > 0).astype(np.float32)
    size = (round(ROAD_AROUND_M / res) | 1,) * 2
    share = cv2.blur(seen, size)
    road = np.divide(cv2.blur(paint * seen, size), share, out=np.full_like(share, np.inf), where=share > 0.1)
    mask = ((paint > road + 0.4 * expected) & (seen > 0)).astype(np.uint8)
    closed = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((round(FLAKE_M / res) | 1,) * 2))
    labels = cv2.connectedComponents(closed)[1]
    u = np.clip(((xy[:, 0] - x0) / res).astype(int) - columns.start, 0, mask.shape[1] - 1)
    v = np.clip(((y1 - xy[:, 1]) / res).astype(int) - rows.start, 0, mask.shape[0] - 1)
    under = labels[v, u]
    under = under[under > 0]
    if not len(under):
        return None
    own = (labels == np.bincount(under).argmax()).astype(np.uint8)
    contour = max(cv2.findContours(own, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0], key=cv2.contourArea)
    area = float(own.sum()) * res**2
    extent = (np.array(cv2.minAreaRect(contour)[1]) + 1) * res
    if not (MIN_SYMBOL_M2 <= area <= MAX_SYMBOL_M2 and extent.max() <= MAX_SYMBOL_M and extent.min() <= MAX_ACROSS_M):
        return None
    simple = cv2.approxPolyDP(contour, OUTLINE_ERROR_M / res, True).reshape(-1, 2).astype(np.float64)
    if len(simple) < 3:
        return None
    x, y = x0 + (simple[:, 0] + columns.start + 0.5) * res, y1 - (simple[:, 1] + rows.start + 0.5) * res
    inside = own > 0
    contrast = float(np.median(paint[inside])) - float(np.median(road[inside]))
    texture = max(float(np.median(np.abs(paint - road)[(mask == 0) & (seen > 0)])), 1e-3)
    evidence = {
        "bias": 1.0,
        "clear": float(np.clip(np.log(max(contrast, 1e-3) / texture), 0, 4)),
        "filled": area / float(extent.prod()),
        "slender": float(np.log(extent.max() / extent.min())),
        "widens": _widens(own),
        "mid_lane": line.evidence.get("mid_lane", 0.0),
        "hidden": float(1 - seen[cv2.dilate(own, np.ones((9, 9), np.uint8)) > 0].mean()),
    }
    v, u = np.nonzero(inside)
    cells = np.stack([x0 + (u + columns.start + 0.5) * res, y1 - (v + rows.start + 0.5) * res], 1)
    odds = maps.object_log_odds("other", cells)
    return PaintedArea("other", np.stack([x, y], 1), float(extent.min()), line.pieces, evidence, odds)


def _widens(mask: NDArray[np.uint8]) -> float:
    """Logarithm by which the widest part of a shape, across its length, is wider than the middle one: an arrow's head."""
    xy = np.stack(np.nonzero(mask), axis=1).astype(np.float64)
    xy -= xy.mean(axis=0)
    along = xy @ np.linalg.eigh(xy.T @ xy)[1][:, 1]
    width = np.bincount((along - along.min()).astype(np.intp))
    return float(np.log(np.quantile(width, 0.95) / np.median(width)))


MIN_CONFIDENCE = 0.5  # what is rather not there than there is left out
MIN_LINE_M = 2.0  # shorter plain strokes tell no lane


def find_markings(ground: GroundMap) -> tuple[tuple[Marking, ...], tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find markings and road borders in a map of the ground.

    `ground`: color, LiDAR intensity and height; each may be missing in part or altogether.

    Returns `markings`: sure ones first; `borders`; `notes`: what was not found, and why.

    Ridges of color and LiDAR intensity (`ridges`) become straight pieces with profiles (`paint`), chains of pieces
    (`lines`) and smooth curves, and so do lines that a network sees (`paint_network`). Strokes along a curve are a solid or a dashed line (`strokes`), parallel bars are
    crosswalks, and wide strokes across lanes are stop lines. Evidence of each by both sensors is weighed (`paint`,
    `weights`), beside what the network says. The cost grows with the area that was seen.
    """
    by_camera, by_lidar = ground.has_color, bool(np.isfinite(ground.intensity).any())
    if not by_camera and not by_lidar:
        return (), (), ("no markings seen: no sensor saw the ground",)
    markings = list_markings(ground, find_paint_maps(ground), min_confidence=MIN_CONFIDENCE, min_line_m=MIN_LINE_M)
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


def find_paint(
    ground: GroundMap, maps: PaintMaps, *, symbols: bool = True
) -> tuple[list[PaintedArea], list[PaintedLine]]:
    """Find what may be paint, also the unlikely; `symbols` tells arrows apart."""
    points, likely = find_ridges(ground), find_crests(maps, maps.lane_line)
    # Ridges are where paint is to a few centimeters; the network adds lines where there are none.
    if len(points.xy_map):
        likely = likely.take(cKDTree(points.xy_map).query(likely.xy_map)[0] > NEAR_RIDGE_M)
    pieces = find_pieces(ground, RidgePoints.join([points, likely]))
    areas, chains = find_crosswalks(ground, maps, pieces, touching_chains(pieces))
    lines, shares = find_lines(ground, maps, pieces, dashed_chains(pieces, chains))
    areas = [replace(area, evidence=evidence_of_bars(area.pieces, area.bars_m, shares)) for area in areas]
    stops, lines = part_stop_lines(maps, lines)
    if symbols:
        small, lines = part_symbols(ground, maps, lines)
        areas += small
    return areas, stops + lines


def list_markings(
    ground: GroundMap, maps: PaintMaps, *, min_confidence: float, min_line_m: float, symbols: bool = True
) -> tuple[Marking, ...]:
    """List markings, sure ones first, from a confidence and, for plain strokes, a length on; `symbols` tells arrows apart."""
    areas, lines = find_paint(ground, maps, symbols=symbols)
    return markings_of(ground, areas, lines, min_confidence, min_line_m)


def markings_of(
    ground: GroundMap, areas: list[PaintedArea], lines: list[PaintedLine], min_confidence: float, min_line_m: float
) -> tuple[Marking, ...]:
    """Choose the likely ones, sure ones first."""
    painted: list[tuple[Array, PaintedArea | PaintedLine]] = [(area.outline, area) for area in areas]
    painted += [(thin(line.xy), line) for line in lines if line.kind != "solid" or line.length_m >= min_line_m]
    found = []
    for xy, one in painted:
        shown_by = color_of(one.pieces), float(probability_of(one.log_odds)), sources_of(one.pieces)
        if shown_by[1] >= min_confidence:
            found.append(Marking("", one.kind, at_height(ground, xy), one.width_m, *shown_by))
    markings = sorted(found, key=lambda m: -m.confidence)
    return tuple(replace(marking, id=f"marking-{k + 1}") for k, marking in enumerate(markings))
