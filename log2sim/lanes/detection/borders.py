"""Borders of roads in a map of the ground: where the surface on which lane lines are painted ends, or a curb rises."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from log2sim.datatypes import Marking, RoadBorder
from log2sim.geometry import Array
from log2sim.lanes.detection.chains import touching_chains
from log2sim.lanes.detection.curves import fit_curve, thin
from log2sim.lanes.detection.evidence import probability
from log2sim.lanes.detection.heights import at_height
from log2sim.lanes.detection.layers import Layer, Mask, log_color, log_intensity
from log2sim.lanes.detection.pieces import fit_lines
from log2sim.lanes.detection.profiles import no_pieces
from log2sim.lanes.detection.ridges import RidgePoints, turn_image, warp
from log2sim.mapping.ground_map import GroundMap

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
MIN_BORDER_M, MIN_CONFIDENCE = 5.0, 0.5
AT_CROSSWALK_M = 1.0
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
    areas = [m.points_m[:, :2].astype(np.float32) for m in markings if m.kind == "crosswalk"]
    found = [_border_of(coarse, ground, chain.corners(pieces), lines) for chain in touching_chains(pieces)]
    kept = sorted((b for b in found if b is not None and not _is_paint(b, areas)), key=lambda b: -b.confidence)
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
    if probability(odds) < MIN_CONFIDENCE or np.median(distance) > NEAR_LINE_M:
        return None
    shown = (("camera", by_color > 1), ("lidar", by_lidar > 1 or curb))
    sources = tuple(name for name, shows in shown if shows)
    return RoadBorder("", "curb" if curb else "edge", at_height(ground, thin(curve.xy)), probability(odds), sources)


def _is_paint(border: RoadBorder, areas: list[NDArray[np.float32]]) -> bool:
    """Whether most of a border is at a crosswalk, whose paint is another surface, too."""
    xy = border.points_m[:, :2].tolist()
    at = [max((cv2.pointPolygonTest(area, p, True) for area in areas), default=-np.inf) > -AT_CROSSWALK_M for p in xy]
    return bool(np.mean(at) > 0.5)


def _steps_along(coarse: _Coarse, ground: GroundMap, xy: Array, normal: Array) -> list[Array]:
    """Measure the steps (N,) of each layer across a line, in sigmas, where both sides are known."""
    reach = GAP_M + ACROSS_M / 2
    sides = [_cells(coarse, ground, xy + side * reach * normal) for side in (-1, 1)]
    out = []
    for values, known in zip(coarse.values, coarse.known):
        both = np.minimum(*(known[cells] for cells in sides)) > 0
        out.append((values[sides[1]] - values[sides[0]])[both].astype(np.float64))
    return out
