"""Borders of roads in a map of the ground: where the network says that the surface of the road ends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array, median
from log2sim.road.curves import Curve, fit_curve, thin
from log2sim.road.ground_map import GroundMap, at_height
from log2sim.road.lines import Paint, touching_chains
from log2sim.road.paint_network import PaintMaps, find_crests
from log2sim.road.pieces import Pieces, fit_lines
from log2sim.road.samples import sample

MIN_CONFIDENCE = 0.5  # what is rather not there than there is left out
MIN_BORDER_M = 5.0
NEAR_LINE_M = 12.0  # three lanes: borders farther from all lane lines are those of something else
POINT_SIGMA_M = 0.1  # a cell
BESIDE_M = (0.3, 0.6, 0.9)  # to either side: beyond curbs and lines painted next to them
CURB_M = (0.05, 0.25)  # heights of curbs
MIN_KNOWN = 0.5  # share of the length along which a sensor saw both sides


def find_borders(
    ground: GroundMap, maps: PaintMaps, markings: tuple[Marking, ...]
) -> tuple[tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find borders of roads, sure ones first; the second result says why there are none.

    Where there are lane lines among the markings, borders lie near them.
    """
    lines = [m.points_m[:, :2] for m in markings if m.is_lane_line]
    near = cKDTree(np.concatenate(lines)) if lines else None
    found = list[RoadBorder]()
    for edge in sorted(find_edges(ground, maps), key=lambda edge: -edge.log_odds):
        confidence = float(probability_of(edge.log_odds))
        if confidence >= MIN_CONFIDENCE and (near is None or np.median(near.query(edge.xy)[0]) <= NEAR_LINE_M):
            name, points_m = f"border-{len(found) + 1}", at_height(ground, thin(edge.xy))
            found.append(RoadBorder(name, edge.kind, points_m, confidence, edge.sources))
    return tuple(found), () if found else ("no borders of roads seen: no edge of a road stands out from the ground",)


def find_edges(ground: GroundMap, maps: PaintMaps) -> list[Paint]:
    """Find what may be borders of roads, also the unlikely."""
    pieces, found = Pieces.all_alike(fit_lines(find_crests(maps, maps.border))), []
    for chain in touching_chains(pieces):
        curve = fit_curve(chain.corners(pieces), POINT_SIGMA_M)
        if curve.s[-1] < MIN_BORDER_M:
            continue
        kind, sources = _measure(ground, curve)
        if sources:  # where no sensor observed both sides the map ends
            found.append(Paint(kind, curve.xy, 0.0, None, sources, maps.object_log_odds("border", curve.xy)))
    return found


def _measure(ground: GroundMap, curve: Curve) -> tuple[str, tuple[str, ...]]:
    """Tell a curb, where the ground steps up or down, from the edge of a surface, and which sensors saw both sides of it."""
    sides = [curve.xy[:, None] + side * np.array(BESIDE_M)[:, None] * curve.normal[:, None] for side in (-1, 1)]
    heights, known = list[Array](), list[NDArray[np.bool_]]()
    for xy in sides:
        seen = sample(ground, xy[..., 0], xy[..., 1])
        cell, inside = ground.raster.index_of(xy.reshape(-1, 2))
        height = np.where(inside, ground.height_m.ravel()[cell], np.nan)
        heights.append(height.reshape(xy.shape[:2]))
        known.append(np.array([np.isfinite(v).any(axis=1) for v in (seen.bright, seen.intensity)]))
    share = (known[0] & known[1]).mean(axis=1)
    step = (heights[0] - heights[1])[np.isfinite(heights[0]) & np.isfinite(heights[1])]
    curb = len(step) > 3 and CURB_M[0] <= abs(median(step)) <= CURB_M[1]
    return "curb" if curb else "edge", tuple(name for name, of in zip(("camera", "lidar"), share) if of > MIN_KNOWN)
