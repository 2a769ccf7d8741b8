"""Ridges of a map: where it is brighter than to both sides, as paint on a road is.

A shadow's edge, a curb or the seam of two asphalts is a step: brighter than one side only. The lesser of the two contrasts
is taken, therefore (symmetric local threshold: Veit, Tarel, Nicolle, Charbonnier, "Evaluation of road marking feature
extraction", ITSC 2008), of means along 1 m in several directions, so that grain averages out and lines do not.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from log2sim.files.arrays import Columns
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap

# Lines are 0.1 m wide at least (Vienna Convention; MUTCD 3A.06; RMS), so they fill such cells.
COARSE_M = 0.1
# Added to pixel values before the logarithm: what noise and rounding of a dark picture amount to.
DARK_LEVEL = 4.0
# Yellow paint on concrete is hardly brighter than it but much more yellow; half the weight, as blue is noisier.
YELLOW_WEIGHT = 1.0
# Returns of asphalt are as weak as 1 % to 10 %: keeps the logarithm of the weakest from ruling.
DARK_INTENSITY = 0.02
TILE_CELLS = 1024

Layer = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class CoarseTile:
    """Part of a map in cells of about `COARSE_M`, with margins that neighboring tiles repeat."""

    paint: Layer  # (R, C): logarithm of brightness, plus that of yellowness
    # `peak`, `dip`: (R, C): the same of the brightest and the darkest cell of the map in each: lines, and gaps between
    # a line and a curb, that are as narrow as a coarse cell seldom fill one
    peak: Layer
    dip: Layer
    seen: Layer  # (R, C): share of each cell that a camera saw
    intensity: Layer  # (R, C): logarithm of LiDAR intensity
    hit: Layer  # (R, C): 1 where LiDAR saw the ground
    core: tuple[slice, slice]  # (slice, slice): rows and columns without the margins
    origin: tuple[int, int]  # (int, int): row and column of the coarse map at which the tile begins


def log_color(bgr: NDArray[np.uint8]) -> tuple[Layer, Layer]:
    """Compute brightness and yellowness (...,) of colors (..., 3), as logarithms of ratios of pixel values."""
    b, g, r = (bgr[..., k].astype(np.float32) + np.float32(DARK_LEVEL) for k in range(3))
    bright = np.log((r + g) * np.float32(0.5))
    return bright, np.log(np.minimum(r, g) / b)


def log_paint(bgr: NDArray[np.uint8]) -> Layer:
    """Compute what stands out where there is white or yellow paint, (...,) of colors (..., 3)."""
    bright, yellow = log_color(bgr)
    return np.asarray(bright + np.float32(YELLOW_WEIGHT) * yellow, np.float32)


def log_intensity(intensity: NDArray[np.floating]) -> Layer:
    """Compute logarithms (...,) of intensities in [0, 1]; NaN where LiDAR saw nothing."""
    return np.asarray(np.log(np.maximum(intensity, 0) + np.float32(DARK_INTENSITY)), np.float32)


def iterate_tiles(ground: GroundMap, factor: int, margin_cells: int) -> Iterator[CoarseTile]:
    """Yield the parts of a map that some sensor saw, in cells `factor` times as long."""
    rows, columns = (size // factor for size in ground.alpha.shape)
    for r in range(0, rows, TILE_CELLS):
        for c in range(0, columns, TILE_CELLS):
            r0, r1 = max(r - margin_cells, 0), min(r + TILE_CELLS + margin_cells, rows)
            c0, c1 = max(c - margin_cells, 0), min(c + TILE_CELLS + margin_cells, columns)
            fine = (slice(r0 * factor, r1 * factor), slice(c0 * factor, c1 * factor))
            core = (slice(r - r0, min(r + TILE_CELLS, rows) - r0), slice(c - c0, min(c + TILE_CELLS, columns) - c0))
            alpha, hit = ground.alpha[fine] > 0, np.isfinite(ground.intensity[fine])
            by_camera, by_lidar = alpha.any(), hit.any()
            if by_camera or by_lidar:
                nothing = np.zeros((r1 - r0, c1 - c0), np.float32)
                paint, seen, peak, dip, intensity, share = (nothing,) * 6
                if by_camera:
                    values = log_paint(ground.color_bgr[fine])
                    paint, seen = coarse_means(values, alpha, factor)
                    parts = [(slice(i, None, factor), slice(j, None, factor)) for i, j in np.ndindex(factor, factor)]
                    peak = np.max([np.where(alpha[part], values[part], -np.inf) for part in parts], axis=0)
                    dip = np.min([np.where(alpha[part], values[part], np.inf) for part in parts], axis=0)
                    peak, dip = (np.where(seen > 0, layer, 0).astype(np.float32) for layer in (peak, dip))
                if by_lidar:
                    intensity, share = coarse_means(log_intensity(ground.intensity[fine]), hit, factor)
                yield CoarseTile(paint, peak, dip, seen, intensity, (share > 0).astype(np.float32), core, (r0, c0))


def coarse_means(values: Layer, valid: Mask, factor: int) -> tuple[Layer, Layer]:
    """Average valid values (R, C) in squares of `factor` cells along an edge; the second result is the share that is valid."""
    size = (values.shape[1] // factor, values.shape[0] // factor)
    share = np.asarray(cv2.resize(valid.astype(np.float32), size, interpolation=cv2.INTER_AREA), np.float32)
    total = cv2.resize(np.where(valid, values, 0).astype(np.float32), size, interpolation=cv2.INTER_AREA)
    return np.divide(total, share, out=np.zeros_like(share), where=share > 0), share


@dataclass(frozen=True, eq=False)
class Samples:
    """What a map holds at points."""

    bright: Layer  # `bright`, `yellow`: (...,): logarithms; NaN where no camera saw the ground
    yellow: Layer
    intensity: Layer  # (...,): logarithm of LiDAR intensity; NaN where it saw nothing

    @property
    def paint(self) -> Layer:
        """What stands out where there is white or yellow paint."""
        return np.asarray(self.bright + np.float32(YELLOW_WEIGHT) * self.yellow, np.float32)


def sample(ground: GroundMap, x: Array, y: Array) -> Samples:
    """Sample a map at points (N, M) of the map frame: colors between cells, the others at the nearest cell."""
    u = ((x - ground.extent_m[0]) / ground.resolution_m - 0.5).astype(np.float32)
    v = ((ground.extent_m[3] - y) / ground.resolution_m - 0.5).astype(np.float32)
    rows, columns = np.rint(v).astype(np.int32), np.rint(u).astype(np.int32)
    inside = (rows >= 0) & (rows < ground.alpha.shape[0]) & (columns >= 0) & (columns < ground.alpha.shape[1])
    rows, columns = np.where(inside, rows, 0), np.where(inside, columns, 0)
    intensity = np.where(inside, ground.intensity[rows, columns], np.nan)
    if not ground.has_color:
        unseen = np.full(u.shape, np.nan, np.float32)
        return Samples(unseen, unseen, log_intensity(intensity))
    color = np.asarray(cv2.remap(ground.color_bgr, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE), np.uint8)
    bright, yellow = log_color(color)
    hidden = ~inside | (ground.alpha[rows, columns] == 0)
    bright[hidden] = np.nan
    yellow[hidden] = np.nan
    return Samples(bright, yellow, log_intensity(intensity))


DIRECTIONS = 12  # 15 deg apart: at worst a line of 0.12 m leaves the middle of the mean at its ends
ALONG_M = 1.0
# Lines of 0.1 to 0.15 m, wide ones of 0.25 to 0.3 m, stop lines and bars of crosswalks of 0.4 to 0.6 m.
WIDTHS_M = (0.1, 0.3, 0.5)
FLANK_M = 0.2  # bars of crosswalks are as little as 0.3 m apart
GAP_M = 0.1  # between paint and flank: its blurred edge
MARGIN_M = 2.0
# Paint that is worn until one sees it no more is 1.1 times as bright as the road (values of pixels, with their gamma).
MIN_CONTRAST = 0.1
# What is so bright is looked at however rough its surroundings are: vehicles and curbs stand beside lines.
CLEAR_CONTRAST = 0.25
MIN_SIGMAS = 4.0  # of the same filter's response to the texture around
BLOCK_M = 4.0  # texture is measured within
# Of a normal distribution that share is within so many sigmas; what stands on part of a block does not count.
TEXTURE_QUANTILE, TEXTURE_SIGMAS = 0.35, 0.454
MIN_SEEN = 0.7  # share of a cell
MIN_HIT = 0.5  # of the cells around by LiDAR, where no camera saw the ground: single rings are lines themselves
MAX_POINTS = 400_000  # bound of memory: 40 km of lines
HIGH_PASS_M = 1.5
# Contrasts of ordinary paint to asphalt, as logarithms: pixel values 1.6 times as large (their gamma has reflectances 3 times
# as large), LiDAR intensity 3 times.
EXPECTED_COLOR, EXPECTED_INTENSITY = 0.5, 1.1
MIN_BRIGHT = 100  # cells that tell how much paint reflects


@dataclass(frozen=True, eq=False)
class RidgePoints(Columns):
    """Points in the middle of ridges, one for each coarse cell along them."""

    xy_map: Array  # (N, 2), m
    direction: Array  # (N,): rad in [0, pi), map frame
    strength: Array  # (N,): response in sigmas of the texture, or probability


def find_ridges(ground: GroundMap) -> RidgePoints:
    """Find points on ridges of color, LiDAR intensity, or both together."""
    factor = max(1, round(COARSE_M / ground.resolution_m))
    cell = ground.resolution_m * factor
    found = [np.zeros((0, 4))]  # column, row, direction and strength, in cells of the coarse map
    for tile in iterate_tiles(ground, factor, round(MARGIN_M / cell)):
        response, direction, noise = _respond(_join(tile, cell), cell)
        # What is so bright is looked at however rough its surroundings are; intensities of grass are as bright.
        noise = np.where(tile.seen > MIN_SEEN, np.minimum(noise, CLEAR_CONTRAST / MIN_SIGMAS), noise)
        found.append(_crests(response / noise, direction, tile) + np.array([tile.origin[1], tile.origin[0], 0, 0]))
    points = np.concatenate(found)
    if len(points) > MAX_POINTS:
        points = points[np.argsort(-points[:, 3], kind="stable")[:MAX_POINTS]]
    x, y = ground.extent_m[0] + (points[:, 0] + 0.5) * cell, ground.extent_m[3] - (points[:, 1] + 0.5) * cell
    return RidgePoints(np.stack([x, y], 1), points[:, 2], points[:, 3])


def _join(tile: CoarseTile, cell_m: float) -> tuple[Layer, Layer, Layer]:
    """Add both sensors' contrasts to the surroundings, each by what it tells of paint, in units of the camera's.

    The best filter for known contrasts in independent noise weighs by contrast over variance. The others are those of
    the brightest and the darkest cells.
    """
    by_camera = bool(np.any(tile.seen))
    if by_camera:
        around = round(HIGH_PASS_M / cell_m)
        color, peak, dip = (high_pass(values, tile.seen, around) for values in (tile.paint, tile.peak, tile.dip))
        if not np.any(tile.hit):
            return color, peak, dip
    # Means over what was hit within 3 x 3 cells: rings of LiDAR leave gaps.
    hit = cv2.blur(tile.hit, (3, 3))
    filled = np.divide(cv2.blur(tile.intensity * tile.hit, (3, 3)), hit, out=np.zeros_like(hit), where=hit > 1e-3)
    intensity = high_pass(filled, (hit > 1e-3).astype(np.float32), round(HIGH_PASS_M / cell_m))
    if not by_camera:
        return intensity, intensity, intensity
    c, i = _spread(color, tile.seen), _spread(intensity, tile.hit)
    # Paint under water returns no light to a LiDAR: by as much as what looks like paint stands out there, it counts.
    bright = (color > EXPECTED_COLOR / 2) & (tile.hit > MIN_HIT)
    shown = EXPECTED_INTENSITY
    if np.count_nonzero(bright) >= MIN_BRIGHT:
        shown = float(np.clip(np.median(intensity[bright]) / np.median(color[bright]) * EXPECTED_COLOR, 0, shown))
    ratio = (shown / i**2) / (EXPECTED_COLOR / c**2)
    share = 1 / (1 + ratio)

    def joined(by_color: Layer) -> Layer:
        both = np.float32(share) * by_color + np.float32(1 - share) * intensity
        return np.asarray(np.where(hit <= 1e-3, by_color, np.where(tile.seen > 0, both, intensity)), np.float32)

    return joined(color), joined(peak), joined(dip)


def _spread(flat: Layer, valid: Layer) -> float:
    """Sigma of cells by their median, at least that of rounded values."""
    values = np.abs(flat[valid > 0])[::7]
    return max(float(np.median(values)) / 0.6745, 0.03) if len(values) else 0.03


def high_pass(values: Layer, valid: Layer, around: int) -> Layer:
    """Subtract the mean within some cells to all sides, so that what was not seen (0 now) looks like its surroundings."""
    size = (2 * around + 1,) * 2
    share = cv2.blur(valid, size)
    mean = np.divide(cv2.blur(values * valid, size), share, out=np.zeros_like(values), where=share > 1e-6)
    return np.asarray(np.where(valid > 0, values - mean, 0), np.float32)


def _respond(layers: tuple[Layer, Layer, Layer], cell_m: float) -> tuple[Layer, NDArray[np.uint8], Layer]:
    """Find the strongest response of each cell (R, C), the number of its direction, and the sigma on texture."""
    flat = layers[0]
    best = np.zeros(flat.shape, np.float32)
    direction = np.zeros(flat.shape, np.uint8)
    noise = np.ones_like(flat)
    for k in range(DIRECTIONS):
        there, back, size = turn_image(flat.shape, np.pi * k / DIRECTIONS)
        # By LiDAR alone all three are one layer, which is warped and blurred once.
        turned = {id(layer): layer for layer in layers}
        length = _cells(ALONG_M, cell_m), 1
        means = ((key, cv2.blur(warp(layer, there, size), length)) for key, layer in turned.items())
        turned = {key: np.asarray(mean, np.float32) for key, mean in means}
        along, brightest, darkest = (turned[id(layer)] for layer in layers)
        if k == 0:
            # Contrast of ridges of the least width to the mean of both sides, as texture has it, too.
            flank = cv2.blur(along, (1, _cells(FLANK_M, cell_m)))
            reach, plain = _reach(WIDTHS_M[0], cell_m), np.zeros_like(along)
            inner = _middle(along, brightest, WIDTHS_M[0], cell_m)[reach:-reach]
            plain[reach:-reach] = inner - (flank[: -2 * reach] + flank[2 * reach :]) / 2
            noise = _block_sigma(warp(plain, back, (flat.shape[1], flat.shape[0])), cell_m)
        response = _across(along, brightest, darkest, cell_m)
        response = warp(response, back, (flat.shape[1], flat.shape[0]))
        better = np.asarray(cv2.compare(response, best, cv2.CMP_GT), np.uint8)
        cv2.max(response, best, dst=best)
        direction[better > 0] = k
    return best, direction, noise


def warp(image: Layer, matrix: Array, size: tuple[int, int]) -> Layer:
    """Warp an image by an affine map (2, 3) to a size (columns, rows), 0 outside."""
    return np.asarray(cv2.warpAffine(image, matrix, size, flags=cv2.INTER_LINEAR), np.float32)


def _across(along: Layer, brightest: Layer, darkest: Layer, cell_m: float) -> Layer:
    """Respond to ridges along the rows by the lesser contrast of the best width; the layers are means along the rows."""
    # A line of a cell's width has dark gaps of a cell's width beside it, as between a line and a curb: the darker of the first
    # and the second cell, as gaps may straddle both.
    gap, best = np.minimum(darkest[1:], darkest[:-1]), np.zeros_like(brightest)
    np.maximum(brightest[2:-2] - np.maximum(gap[3:], gap[:-3]), 0, out=best[2:-2])
    flank = cv2.blur(along, (1, _cells(FLANK_M, cell_m)))
    for width_m in WIDTHS_M:
        reach = _reach(width_m, cell_m)
        contrast = np.maximum(flank[: -2 * reach], flank[2 * reach :])
        np.subtract(_middle(along, brightest, width_m, cell_m)[reach:-reach], contrast, out=contrast)
        np.maximum(best[reach:-reach], contrast, out=best[reach:-reach])
    return best


def _middle(along: Layer, brightest: Layer, width_m: float, cell_m: float) -> Layer:
    """Mean over the width of the paint."""
    middle = _cells(width_m, cell_m) | 1
    return brightest if middle == 1 else np.asarray(cv2.blur(along, (1, middle)), np.float32)


def _reach(width_m: float, cell_m: float) -> int:
    """Cells from the middle of the paint to that of the flank, whose own middle lies half a cell off if it is even."""
    return round((width_m / 2 + GAP_M / 2 + FLANK_M / 2) / cell_m + 0.25)


def _cells(length_m: float, cell_m: float) -> int:
    return max(1, round(length_m / cell_m))


def turn_image(shape: tuple[int, ...], angle: float) -> tuple[Array, Array, tuple[int, int]]:
    """Return affine maps (2, 3) to an image whose rows run along an angle and back, and its size (columns, rows)."""
    rows, columns = shape
    c, s = abs(np.cos(angle)), abs(np.sin(angle))
    size = (int(np.ceil(columns * c + rows * s)), int(np.ceil(columns * s + rows * c)))
    # Counter-clockwise in the map is clockwise in rows that count downwards.
    middle = (columns / 2 - 0.5, rows / 2 - 0.5)
    there = np.asarray(cv2.getRotationMatrix2D(middle, -float(np.degrees(angle)), 1.0), np.float64)
    there[:, 2] += (np.array(size) - (columns, rows)) / 2
    return there, np.asarray(cv2.invertAffineTransform(there), np.float64), size


def _block_sigma(plain: Layer, cell_m: float) -> Layer:
    """Estimate the sigma (R, C) of the response to texture by what is usual in blocks, as lines are few in each."""
    block = max(8, round(BLOCK_M / cell_m / 2))
    rows, columns = plain.shape
    values = np.abs(plain[::2, ::2])
    grid = np.full((-(-values.shape[0] // block), -(-values.shape[1] // block)), np.nan, np.float32)
    for i, j in np.ndindex(grid.shape):
        part = values[i * block : (i + 1) * block, j * block : (j + 1) * block]
        part = part[part > 0]  # exactly 0 where nothing was seen
        if part.size > 20:
            grid[i, j] = np.quantile(part, TEXTURE_QUANTILE) / TEXTURE_SIGMAS
    # A perfectly even ground has no texture: what then counts is the least contrast.
    least = np.float32(MIN_CONTRAST / MIN_SIGMAS)
    grid = np.maximum(np.where(np.isfinite(grid), grid, least), least)
    return np.asarray(cv2.resize(grid, (columns, rows), interpolation=cv2.INTER_LINEAR), np.float32)


def _crests(strength: Layer, direction: NDArray[np.uint8], tile: CoarseTile) -> Array:
    """Keep cells that respond most across their direction: column, row, direction, strength (N, 4)."""
    known = np.zeros(strength.shape, bool)
    known[tile.core] = (tile.seen[tile.core] > MIN_SEEN) | (cv2.blur(tile.hit, (7, 7))[tile.core] > MIN_HIT)
    rows, columns = np.nonzero((strength > MIN_SIGMAS) & known)
    angle = direction[rows, columns].astype(np.float64) * (np.pi / DIRECTIONS)
    crest, x, y = crests_across(strength, rows, columns, angle)
    return np.stack([x, y, angle[crest], strength[rows, columns][crest].astype(np.float64)], 1)


def crests_across(
    strength: Layer, rows: NDArray[np.intp], columns: NDArray[np.intp], angle: Array
) -> tuple[Mask, Array, Array]:
    """Choose cells (N,) that no other exceeds across their direction, rad counterclockwise from the columns; columns and rows between cells."""
    dx, dy = -np.sin(angle), -np.cos(angle)  # to the left of the direction; rows count downwards
    here = strength[rows, columns].astype(np.float64)
    sides = [
        map_coordinates(strength, [rows + k * dy, columns + k * dx], order=1, mode="nearest").astype(np.float64)
        for k in (-2, -1, 1, 2)
    ]
    crest = here >= np.max(sides, axis=0)
    lower, upper = sides[1][crest], sides[2][crest]
    bend = 2 * here[crest] - lower - upper
    shift = np.divide(upper - lower, 2 * bend, out=np.zeros_like(bend), where=bend > 0).clip(-0.5, 0.5)
    return crest, columns[crest] + shift * dx[crest], rows[crest] + shift * dy[crest]
