"""Borders of roads in a map of the ground: where the surface changes beside lane lines."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.datatypes.log_odds import probability_of
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.road.lines import touching_chains
from log2sim.road.paint import at_height, fit_lines, no_pieces, weighted_sum
from log2sim.road.ridges import Layer, RidgePoints, coarse_means, log_color, log_intensity, turn_image, warp
from log2sim.road.strokes import fit_curve, thin
from log2sim.road.weights import WEIGHTS

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
MIN_STEP = 1.8  # sigmas, together
MIN_SEEN = 0.5
ROAD_TOLERANCE = 1.5  # sigmas that a road may differ from where lane lines are
MIN_BORDER_M = 5.0
NEAR_LINE_M = 12.0  # borders farther from all lane lines are those of something else


@dataclass(frozen=True, eq=False)
class _Coarse:
    """Layers (K, R, C) of a map in cells of `cell_m`: yellowness and intensity in sigmas, height in sigmas; and where known."""

    values: NDArray[np.float32]
    known: NDArray[np.float32]
    cell_m: float


@dataclass(frozen=True, eq=False)
class Edge:
    """A line on one side of which the surface is that of the road."""

    xy: Array  # (P, 2), m
    curb: bool
    sources: tuple[str, ...]
    table: str  # of its weights
    evidence: dict[str, float]  # that it is the border of a road, by the names in `WEIGHTS`

    @cached_property
    def log_odds(self) -> float:
        """Log-odds that it is the border of a road."""
        return weighted_sum(self.evidence, WEIGHTS[self.table])


def find_borders(ground: GroundMap, markings: tuple[Marking, ...]) -> tuple[tuple[RoadBorder, ...], tuple[str, ...]]:
    """Find borders of the roads that lane lines are painted on; the second result says why there are none."""
    if not any(m.is_lane_line for m in markings):
        return (), ("no borders of roads seen: without lane lines it is not known which surface is the road",)
    likely = sorted((e for e in find_edges(ground, markings) if e.log_odds > 0), key=lambda e: -e.log_odds)
    borders = tuple(
        RoadBorder(
            f"border-{k + 1}", "curb" if edge.curb else "edge", at_height(ground, thin(edge.xy)),
            float(probability_of(edge.log_odds)), edge.sources,
        )
        for k, edge in enumerate(likely)
    )  # fmt: skip
    return borders, () if borders else ("no borders of roads seen: the surface does not change beside the lane lines",)


def find_edges(ground: GroundMap, markings: tuple[Marking, ...]) -> list[Edge]:
    """Find where the surface changes beside the lane lines among some markings, of which there is one at least.

    Both sides of an edge are compared over `ACROSS_M` by yellowness, LiDAR intensity and height, each in sigmas of one
    surface. One side has to look like the ground beside lane lines.
    """
    lines = [m.points_m[:, :2] for m in markings if m.is_lane_line]
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
    near = cKDTree(np.concatenate(lines))
    found = [_edge_of(coarse, ground, chain.corners(pieces), near) for chain in touching_chains(pieces)]
    return [edge for edge in found if edge is not None]


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
    above_differs, compared = below_differs, below_differs
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
            compared = compared | both
            below_differs = below_differs | (both & (np.abs(below - np.float32(road[k])) > ROAD_TOLERANCE))
            above_differs = above_differs | (both & (np.abs(above - np.float32(road[k])) > ROAD_TOLERANCE))
    surface = np.square(_surface_step(steps[0], steps[1], boths[1]))
    height = steps[HEIGHT] * np.float32(HEIGHT_SIGMA_M)
    out = (np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.float32))
    for layer, other, rise in zip(out, (below_differs, above_differs), (height, -height)):
        curb = np.where((rise > CURB_M[0]) & (rise < CURB_M[1]), np.square(steps[HEIGHT]), 0)  # only up, and no wall
        layer[reach:-reach] = np.where(compared & ~other, np.sqrt(surface + curb), 0)
    return out


def _surface_step(yellow: NDArray[Any], intensity: NDArray[Any], by_lidar: NDArray[Any]) -> NDArray[Any]:
    """Join steps of yellowness and intensity (...), sigmas.

    Shadows are bluer than the sun's light but reflect LiDAR as before, so color counts no more than intensity where that
    is known, and half without.
    """
    y, i = np.abs(yellow), np.abs(intensity)
    return np.asarray(np.where(by_lidar, np.hypot(i, np.minimum(y, i)), y / 2))


def _edge_of(coarse: _Coarse, ground: GroundMap, corners: Array, lines: cKDTree) -> Edge | None:
    """Gather the evidence of a chain of steps; None for one that is short, or far from points of lane lines."""
    length = float(np.linalg.norm(np.diff(corners, axis=0), axis=1).sum())
    if length < MIN_BORDER_M:
        return None
    curve = fit_curve(corners, sigma_m=coarse.cell_m / 2)
    if np.median(lines.query(curve.xy[::4])[0]) > NEAR_LINE_M:
        return None
    # Steps of each layer across the line, in sigmas, where both sides are known.
    reach, steps = GAP_M + ACROSS_M / 2, []
    left, right = (_cells(coarse, ground, curve.xy + side * reach * curve.normal) for side in (1, -1))
    for values, seen in zip(coarse.values, coarse.known):
        both = np.minimum(seen[left], seen[right]) > 0
        steps.append((values[left] - values[right])[both].astype(np.float64))
    by_color, by_lidar, by_height = (float(abs(np.median(s))) if len(s) > 3 else 0.0 for s in steps)
    curb = CURB_M[0] <= by_height * HEIGHT_SIGMA_M <= CURB_M[1]
    known = [name for name, of in (("camera", steps[0]), ("LiDAR", steps[1])) if len(of) > 3]
    shown = (("camera", by_color > 1), ("lidar", by_lidar > 1 or curb))
    sources, table = tuple(name for name, shows in shown if shows), f"border, {' and '.join(known) or 'LiDAR'}"
    return Edge(curve.xy, curb, sources, table, {"bias": 1.0, "length": float(np.log(length)), "curb": float(curb)})
