"""Straight pieces of lines, and the profiles across them."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.files.arrays import Columns
from log2sim.geometry import Array
from log2sim.road.ground_map import GroundMap
from log2sim.road.paint_network import CELL_M, LinePoints, PaintMaps
from log2sim.road.samples import Layer, Samples, sample

PROFILE_M, PROFILE_STEP_M, ALONG_SAMPLES = 1.5, 0.05, 11
MIN_SEEN = 0.6  # share of a profile's middle; of what is hidden beside a line, the other side tells
MAX_SHIFT_M = 0.12  # from the point, which is as fine as a cell, to the middle of the paint
FLANK_M = (0.08, 0.4)  # from the middle: where the road beside the paint is looked for
# From the edge: between a line and a curb there are often 0.1 m of road, and paint may be blurred so far.
SIDES_M = ((0.03, 0.13), (0.1, 0.3))
MIN_WIDTH_M = 0.05  # of a cell of the map
MIN_COLOR, MIN_REFLECTED = 0.02, 0.05  # logarithms of color, two steps of a pixel's value, and of LiDAR intensity
# Around a point, along and beside its line, and within what distance of paint points that do not stand out count nothing.
AROUND_POINT_M, BESIDE_M, TAIL_M = np.arange(-3, 4) * 0.1, (0.1, 0.2), 3.0


@dataclass(frozen=True, eq=False)
class Pieces(Columns):
    """Straight pieces of lines."""

    xy: Array  # (N, 2), m: middles
    direction: Array  # (N,), rad in [0, pi)
    length_m: Array  # (N,)
    width_m: Array  # (N,): at half of the contrast
    # `color`, `color_sigma`: (N,): contrast of the logarithm of color to the brighter side, and its standard error; NaN
    # where no camera saw it
    color: Array
    color_sigma: Array
    yellow: Array  # (N,): contrast of yellowness
    # `reflected`, `reflected_sigma`: (N,): contrast of the logarithm of LiDAR intensity, and its standard error; NaN
    # where LiDAR saw too little
    reflected: Array
    reflected_sigma: Array

    @classmethod
    def all_alike(cls, lines: Array) -> Pieces:
        """Make pieces of lines (N, 4), x, y, direction, length, that differ in nothing else."""
        return cls(lines[:, :2], lines[:, 2], lines[:, 3], *np.ones((6, len(lines))))

    @property
    def along(self) -> Array:
        """Points (K, 2), m, along all pieces, a cell apart."""
        count = np.maximum(np.rint(self.length_m / CELL_M).astype(int), 1)
        piece = np.repeat(np.arange(len(self)), count)
        share = (np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[piece] - 0.5
        step = np.stack([np.cos(self.direction), np.sin(self.direction)], 1) * self.length_m[:, None]
        return np.asarray(self.xy[piece] + share[:, None] * step[piece])

    def ends(self, chosen: NDArray[np.int64]) -> Array:
        """Both ends (K, 2, 2), m, of some pieces (K,)."""
        angle, half_m = self.direction[chosen], self.length_m[chosen, None] / 2
        half = np.stack([np.cos(angle), np.sin(angle)], 1) * half_m
        return np.stack([self.xy[chosen] - half, self.xy[chosen] + half], 1)


def find_pieces(ground: GroundMap, maps: PaintMaps, points: LinePoints) -> Pieces:
    """Fit straight pieces to points of lines and measure the profile across each."""
    parts = (points.take(slice(k, k + PROFILES_AT_ONCE)) for k in range(0, len(points), PROFILES_AT_ONCE))
    shown = np.concatenate([np.zeros(0, dtype=bool), *(stand_out(ground, maps, part) for part in parts)])
    if shown.any():
        # The probability reaches beyond the ends of strokes, where nothing tells the direction.
        shown |= cKDTree(points.xy_map[shown]).query(points.xy_map)[0] > TAIL_M
        points = points.take(shown)
    lines = fit_lines(points)
    if not len(lines):
        return Pieces.all_alike(lines)
    chunks = (lines[k : k + PROFILES_AT_ONCE] for k in range(0, len(lines), PROFILES_AT_ONCE))
    return Pieces.join([measure_pieces(ground, maps, chunk) for chunk in chunks])


def stand_out(ground: GroundMap, maps: PaintMaps, points: LinePoints) -> NDArray[np.bool_]:
    """Return which points (N,) of lines are brighter than both sides to a camera or LiDAR."""
    half_m = maps.at(maps.width_m, points.xy_map)[:, None] / 2
    sides = np.concatenate([half_m + BESIDE_M[0], half_m + BESIDE_M[1]], axis=1)
    across = np.concatenate([half_m * [-0.5, 0.0, 0.5], -sides, sides], axis=1)[:, None]
    along = AROUND_POINT_M[:, None]
    c, s = np.cos(points.direction)[:, None, None], np.sin(points.direction)[:, None, None]
    x, y = (
        points.xy_map[:, 0, None, None] + along * c - across * s,
        points.xy_map[:, 1, None, None] + along * s + across * c,
    )
    seen = sample(ground, x.reshape(len(x), -1), y.reshape(len(y), -1))
    shown = np.zeros(len(points), dtype=bool)
    for values, least in ((seen.paint, MIN_COLOR), (seen.intensity, MIN_REFLECTED)):
        means = _quiet(np.nanmean, values.reshape(x.shape))
        inside, left, right = (_quiet(np.nanmean, means[:, part]) for part in (slice(0, 3), slice(3, 5), slice(5, 7)))
        shown |= inside > np.fmax(left, right) + least
    return shown


def measure_pieces(ground: GroundMap, maps: PaintMaps, lines: Array) -> Pieces:
    """Measure the profiles across lines (N, 4): x, y, direction, length."""
    steps = round(PROFILE_M / PROFILE_STEP_M)
    across = np.arange(-steps, steps + 1, dtype=np.float64) * PROFILE_STEP_M
    along = (np.arange(ALONG_SAMPLES) + 0.5) / ALONG_SAMPLES - 0.5
    c, s = np.cos(lines[:, 2]), np.sin(lines[:, 2])
    # (N, along, across)
    u = np.broadcast_to((along[None] * lines[:, 3:4])[:, :, None], (len(lines), ALONG_SAMPLES, len(across)))
    x = lines[:, 0, None, None] + u * c[:, None, None] - across * s[:, None, None]
    y = lines[:, 1, None, None] + u * s[:, None, None] + across * c[:, None, None]
    flat = (len(lines), ALONG_SAMPLES * len(across))
    seen = sample(ground, x.reshape(flat), y.reshape(flat))
    samples = Samples(*(a.reshape(x.shape) for a in (seen.bright, seen.yellow, seen.intensity)))
    color, intensity = (_quiet(np.nanmean, a) for a in (samples.paint, samples.intensity))
    by_camera = np.isfinite(color[:, np.abs(across) <= 0.5]).mean(1) > MIN_SEEN
    # Of values, not of their logarithms, in which edges that are blurred lie farther out.
    left, right = _edges(np.exp(np.where(by_camera[:, None], color, intensity)), across)
    # What does not stand out where it is, as between dots, is where and as wide as the network says.
    shift, width = np.nan_to_num((left + right) / 2), right - left
    width = np.where(width > 0, width, maps.at(maps.width_m, lines[:, :2]).clip(MIN_WIDTH_M))
    inside = np.abs(across - shift[:, None]) <= np.maximum(width / 2 - 0.02, 0.03)[:, None]
    # From the edges of the paint outwards, on either side: the road beside it, near and farther.
    away = [side * (across - shift[:, None]) - width[:, None] / 2 for side in (-1, 1)]
    sides = [[(distance > low) & (distance < high) for low, high in SIDES_M] for distance in away]
    by_color = _contrast(samples.paint, inside, sides, one_side=True)
    yellow = _contrast(samples.yellow, inside, sides, one_side=True)[0]
    by_lidar = _contrast(samples.intensity, inside, sides, one_side=False)
    xy = lines[:, :2] + shift[:, None] * np.stack([-s, c], 1)
    return Pieces(xy, lines[:, 2], lines[:, 3], width, *by_color, yellow, *by_lidar)


def _quiet(function: Any, values: NDArray[Any], **options: Any) -> Array:
    """Reduce rows, of which some may be NaN altogether."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)
        return np.asarray(function(values, axis=1, **options), np.float64)


def _edges(profile: Array, across: Array) -> tuple[Array, Array]:
    """Positions (N,) left and right of the middle where profiles (N, P) fall to half of their contrast on that side."""
    # Gaps, where LiDAR hit no cell, are filled from their neighbors; `soft` is blurred, too.
    known = np.isfinite(profile).astype(np.float64)
    total, count = cv2.blur(np.nan_to_num(profile), (3, 1)), cv2.blur(known, (3, 1))
    soft = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    filled = np.where(known > 0, profile, soft)
    near = np.abs(across) <= MAX_SHIFT_M
    peak = np.argmax(np.where(near, soft, -np.inf), axis=1)
    top = soft[np.arange(len(profile)), peak]
    # Lines wider than the blur have a flat top: its mean is nearer to the paint than its largest value.
    edges = []
    distance = across - across[peak][:, None]
    roads = []
    for side in (-1, 1):
        flank = (side * distance > FLANK_M[0]) & (side * distance < FLANK_M[1]) & np.isfinite(soft)
        roads.append(np.where(flank, soft, np.inf).min(axis=1))
    for side, road, other in zip((-1, 1), roads, roads[::-1]):
        road = np.where(np.isfinite(road), road, np.where(np.isfinite(other), other, np.nan))
        edges.append(_crossing(filled, peak, road + (top - road) / 2, side, across))
    return edges[0], edges[1]


def _crossing(profile: Array, peak: NDArray[Any], half: Array, side: int, across: Array) -> Array:
    """Position (N,) of the first crossing of a level, going to one side from the peak; NaN where there is none."""
    steps = len(across)
    index = np.arange(len(profile))
    at = np.full(len(profile), np.nan)
    for k in range(1, steps):
        column, before = peak + side * k, peak + side * (k - 1)
        inside = (column >= 0) & (column < steps)
        value = profile[index, np.clip(column, 0, steps - 1)]
        crossed = np.isnan(at) & inside & (value < half)
        if crossed.any():
            previous = profile[index, np.clip(before, 0, steps - 1)]
            fall = previous - value
            part = np.divide(previous - half, fall, out=np.full(len(fall), 0.5), where=np.isfinite(fall) & (fall > 0))
            at[crossed] = (across[np.clip(before, 0, steps - 1)] + side * np.clip(part, 0, 1) * PROFILE_STEP_M)[crossed]
    return at


def _contrast(
    values: Layer, inside: NDArray[np.bool_], sides: list[list[NDArray[np.bool_]]], *, one_side: bool
) -> tuple[Array, Array]:
    """Contrast (N,) of samples (N, along, across) to the brighter side, and its standard error."""
    middle, beside = _masked_mean(values, inside), []
    for near, far in ([_masked_mean(values, part) for part in side] for side in sides):
        # The part whose mean is darker.
        mean, other = _quiet(np.nanmean, near), _quiet(np.nanmean, far)
        beside.append(np.where((mean < other)[:, None] | ~np.isfinite(other)[:, None], near, far))
    left, right = (_quiet(np.nanmean, b) for b in beside)
    ridge = middle - np.maximum(*beside)
    count = np.isfinite(ridge).sum(1)
    mean = _quiet(np.nanmean, middle) - (np.fmax if one_side else np.maximum)(left, right)
    sigma = _quiet(np.nanstd, ridge) / np.sqrt(np.maximum(count - 1, 1))
    return np.where(count >= 3, mean, np.nan), np.where(count >= 3, sigma, np.nan)


def _masked_mean(values: Layer, mask: NDArray[Any]) -> Array:
    """Mean (N, along) over the samples across that a mask (N, P) has."""
    known = np.isfinite(values) & mask[:, None, :]
    count = known.sum(2)
    total = np.where(known, values, 0).sum(2, dtype=np.float64)
    return np.asarray(np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0), np.float64)


HALF_PIECE_M = 1.0
ACROSS_M = 0.15  # a cell of error, and the bend of a curve of 6 m radius within a piece
MAX_TURN_RAD = np.deg2rad(20)  # directions of single points err
MIN_POINTS = 5
MIN_PIECE_M = 0.4
MIN_COVERED = 0.6  # share of a piece's length that has points
PROFILES_AT_ONCE = 4000  # bound of memory


def fit_lines(points: LinePoints) -> Array:
    """Fit lines to points, the likeliest first, each point to one: x, y, direction, length (N, 4)."""
    if not len(points.xy_map):
        return np.zeros((0, 4))
    tree = cKDTree(points.xy_map)
    free = np.ones(len(points.xy_map), bool)
    lines = []
    for seed in np.argsort(-points.probability, kind="stable"):
        if not free[seed]:
            continue
        near = np.array(tree.query_ball_point(points.xy_map[seed], HALF_PIECE_M))
        near = near[free[near]]
        free[seed] = False
        if len(near) < MIN_POINTS:
            continue
        line = _fit_line(points, int(seed), near)
        if line is not None:
            lines.append(line[0])
            free[line[1]] = False
    return np.array(lines).reshape(-1, 4)


def _fit_line(points: LinePoints, seed: int, near: NDArray[Any]) -> tuple[Array, NDArray[Any]] | None:
    """Fit a line through a seed to points near it; also the indices of those that it explains."""
    xy = points.xy_map[near] - points.xy_map[seed]
    turn = np.abs((points.direction[near] - points.direction[seed] + np.pi / 2) % np.pi - np.pi / 2)
    angle, center = float(points.direction[seed]), np.zeros(2)
    chosen = turn < MAX_TURN_RAD
    for width in (2 * ACROSS_M, ACROSS_M):
        along, across = _turned(xy - center, angle)
        member = chosen & (np.abs(across) < width)
        if np.count_nonzero(member) < MIN_POINTS:
            return None
        center = xy[member].mean(axis=0)
        off = xy[member] - center
        moments = off.T @ off  # of which only the directions are asked for
        angle = float(0.5 * np.arctan2(2 * moments[0, 1], moments[0, 0] - moments[1, 1]))
    along, across = _turned(xy - center, angle)
    member = chosen & (np.abs(across) < ACROSS_M)
    if np.count_nonzero(member) < MIN_POINTS:
        return None
    begin, end = along[member].min(), along[member].max()
    length = end - begin + CELL_M
    covered = len(set(np.floor((along[member] - begin) / CELL_M + 0.5).tolist())) * CELL_M
    if length < MIN_PIECE_M or covered < MIN_COVERED * length:
        return None
    middle = points.xy_map[seed] + center + (begin + end) / 2 * np.array([np.cos(angle), np.sin(angle)])
    explained = near[(np.abs(across) < 2 * ACROSS_M) & (along > begin - CELL_M) & (along < end + CELL_M)]
    return np.array([*middle, angle % np.pi, length]), explained


def _turned(xy: Array, angle: float) -> tuple[Array, Array]:
    c, s = np.cos(angle), np.sin(angle)
    return xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s
