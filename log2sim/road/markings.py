"""Markings and borders of roads in a map of the ground."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import DisjointSet

from log2sim.datatypes import Marking, RoadBorder
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array
from log2sim.road.borders import MIN_CONFIDENCE, find_borders
from log2sim.road.curves import thin
from log2sim.road.ground_map import GroundMap, at_height
from log2sim.road.lines import END_SHARE, MIN_YELLOW, Paint, find_lines
from log2sim.road.paint_network import KINDS, PaintMaps, find_crests, find_paint_maps
from log2sim.road.pieces import find_pieces
from log2sim.road.samples import sample

# Crosswalks have three bars of 0.3 m and more, 1.5 m long (MUTCD 3C); letters are as small as 0.4 m (bicycles: 1 m), arrows 7.5 m long and 2 m wide.
AREA_M2 = {"crosswalk": (2.0, 400.0), "other": (0.15, 12.0)}
LEAST = {"crosswalk": 0.5, "other": 0.15}  # probability of their cells: those of few cells are unsure
RING_CELLS = 3  # of road around a marking, whose color is compared
OUTLINE_ERROR_M = {"crosswalk": 0.15, "other": 0.05}
# Parts of a crosswalk, between which bars are worn off, hidden by a vehicle or left out on an island, are less than a lane and a bar apart.
MAX_PART_GAP_M = 5.0
MAX_ENCLOSED = 2.0  # area of both parts with what is between, over that of the parts: those across two roads that meet enclose more


def find_areas(ground: GroundMap, maps: PaintMaps, kind: str) -> list[Paint]:
    """Find markings of a kind that have an outline, also unlikely ones."""
    probability, cell_m2 = maps.probability[KINDS.index(kind)], maps.raster.resolution_m**2
    _, labels, boxes, _ = cv2.connectedComponentsWithStats((probability > LEAST[kind]).astype(np.uint8))
    shapes = list[NDArray[np.int32]]()  # columns and rows (P, 1, 2) of outlines
    for k, (x, y, w, h, count) in enumerate(boxes.tolist()):
        part = probability[y : y + h, x : x + w] * (labels[y : y + h, x : x + w] == k)
        if k == 0 or count * cell_m2 < AREA_M2[kind][0]:
            continue
        inside = (part > END_SHARE * np.quantile(part[part > 0], 0.9)).astype(np.uint8)
        outlines = cv2.findContours(inside, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE, offset=(x, y))[0]
        shapes.append(np.asarray(max(outlines, key=cv2.contourArea), np.int32))
    if kind == "crosswalk":
        shapes = _join_parts(shapes, MAX_PART_GAP_M / maps.raster.resolution_m)
    areas = []
    for shape in shapes:
        simple = cv2.approxPolyDP(shape, OUTLINE_ERROR_M[kind] / maps.raster.resolution_m, True)[:, 0]
        if len(simple) < 3:
            continue
        mask = np.zeros(np.ptp(shape[:, 0], axis=0)[::-1] + 1, np.uint8)
        low = shape[:, 0].min(axis=0)
        cv2.fillPoly(mask, [shape[:, 0] - low], 1)
        rows, columns = np.nonzero(mask)
        if not AREA_M2[kind][0] <= len(rows) * cell_m2 <= AREA_M2[kind][1]:
            continue
        cells = maps.raster.xy_of(rows + low[1], columns + low[0])
        width_m = (min(cv2.minAreaRect(shape)[1]) + 1) * maps.raster.resolution_m
        outline = maps.raster.xy_of(simple[:, 1], simple[:, 0])
        odds = maps.object_log_odds(kind, cells)
        ring = cv2.dilate(np.pad(mask, RING_CELLS), np.ones((2 * RING_CELLS + 1,) * 2)) - np.pad(mask, RING_CELLS)
        rows, columns = np.nonzero(ring)
        road = maps.raster.xy_of(rows + low[1] - RING_CELLS, columns + low[0] - RING_CELLS)
        areas.append(Paint(kind, outline, width_m, *_shown_by(ground, cells, road), odds))
    return areas


def _join_parts(shapes: list[NDArray[np.int32]], most_cells: float) -> list[NDArray[np.int32]]:
    """Join outlines (P, 1, 2) that are parts of one crosswalk, and make each convex."""
    shapes = [_hull(shape) for shape in shapes]
    groups = DisjointSet(range(len(shapes)))
    for i, j in zip(*np.triu_indices(len(shapes), 1)):
        one, two = shapes[i], shapes[j]
        distance = -max(cv2.pointPolygonTest(one, (float(x), float(y)), True) for x, y in two[:, 0])
        parts = cv2.contourArea(one) + cv2.contourArea(two)
        if distance <= most_cells and cv2.contourArea(_hull(np.concatenate([one, two]))) <= MAX_ENCLOSED * parts:
            groups.merge(i, j)
    return [_hull(np.concatenate([shapes[k] for k in sorted(group)])) for group in groups.subsets()]


def _hull(shape: NDArray[np.int32]) -> NDArray[np.int32]:
    return np.asarray(cv2.convexHull(shape), np.int32)


def _shown_by(ground: GroundMap, cells: Array, road: Array) -> tuple[str | None, tuple[str, ...]]:
    """Tell the color of paint in cells (N, 2), m, against that of the road (M, 2), None where no camera saw both; and the sensors that saw most of it."""
    seen, around = (sample(ground, xy[:, :1], xy[:, 1:]) for xy in (cells, road))
    known = [bool(np.isfinite(values).mean() > 0.5) for values in (seen.bright, seen.intensity)]
    color = None
    if known[0] and np.isfinite(around.yellow).any():
        # Of bars the brighter half; light may be yellow, too.
        bright = seen.bright >= np.nanmedian(seen.bright)
        contrast = np.nanmedian(seen.yellow[bright]) - np.nanmedian(around.yellow)
        color = "yellow" if contrast > MIN_YELLOW else "white"
    return color, tuple(name for name, of in zip(("camera", "lidar"), known) if of)


MIN_LINE_M = 2.0  # shorter plain strokes tell no lane


def find_markings(ground: GroundMap) -> tuple[tuple[Marking, ...], tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find markings and road borders in a map of the ground.

    `ground`: color, LiDAR intensity and height; each may be missing in part or altogether.

    Returns `markings`: sure ones first; `borders`; `notes`: what was not found, and why.

    A network gives each cell the probability of each kind (`paint_network`). Where lines are likeliest there are straight pieces with
    profiles (`pieces`), chains of pieces are smooth curves (`lines`, `curves`). A marking is as likely as its cells. The cost grows with
    the area that was seen.
    """
    by_camera, by_lidar = ground.has_color, bool(np.isfinite(ground.intensity).any())
    if not by_camera and not by_lidar:
        return (), (), ("no markings seen: no sensor saw the ground",)
    maps = find_paint_maps(ground)
    markings = list_markings(ground, maps, min_confidence=MIN_CONFIDENCE, min_line_m=MIN_LINE_M)
    borders, notes = find_borders(ground, maps, markings)
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


def find_paint(ground: GroundMap, maps: PaintMaps) -> list[Paint]:
    """Find what may be paint, also the unlikely."""
    areas = [area for kind in AREA_M2 for area in find_areas(ground, maps, kind)]
    crosswalks = np.zeros(maps.raster.shape, np.uint8)
    for one in areas:
        if one.kind == "crosswalk" and one.log_odds > 0:
            cells = np.rint(np.column_stack(maps.raster.cells_of(one.xy)[::-1])).astype(np.int32)
            cv2.fillPoly(crosswalks, [cells], 1)
    return areas + find_lines(maps, find_pieces(ground, maps, find_crests(maps, maps.line)), crosswalks > 0)


def list_markings(
    ground: GroundMap, maps: PaintMaps, *, min_confidence: float, min_line_m: float
) -> tuple[Marking, ...]:
    """List markings, sure ones first, from a confidence and, for plain strokes, a length on."""
    found = list[Marking]()
    for one in sorted(find_paint(ground, maps), key=lambda one: -one.log_odds):
        confidence = float(probability_of(one.log_odds))
        if confidence >= min_confidence and (one.kind != "solid" or one.length_m >= min_line_m):
            points_m = at_height(ground, one.xy if one.kind in AREA_M2 else thin(one.xy))
            name = f"marking-{len(found) + 1}"
            found.append(Marking(name, one.kind, points_m, one.width_m, one.color, confidence, one.sources))
    return tuple(found)
