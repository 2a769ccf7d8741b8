"""Straight pieces of ridges, profiles across them, and how likely they are paint."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from log2sim.geometry import Array, median
from log2sim.road.ground_map import GroundMap
from log2sim.road.ridges import EXPECTED_COLOR, Layer, RidgePoints, Samples, log_intensity, sample
from log2sim.road.surface import USUAL
from log2sim.road.weights import WEIGHTS

AROUND_M = 0.25


def at_height(ground: GroundMap, xy: Array) -> Array:
    """Put points (N, 2) on the ground: (N, 3), m. Where the height is unknown it is that of the nearest point, or 0."""
    reach = max(1, round(AROUND_M / ground.resolution_m))
    rows = ((ground.extent_m[3] - xy[:, 1]) / ground.resolution_m).astype(int)
    columns = ((xy[:, 0] - ground.extent_m[0]) / ground.resolution_m).astype(int)
    z = np.full(len(xy), np.nan)
    for k, (r, c) in enumerate(zip(rows, columns)):
        part = ground.height_m[max(r - reach, 0) : max(r + reach + 1, 0), max(c - reach, 0) : max(c + reach + 1, 0)]
        known = part[np.isfinite(part)]
        if known.size:
            z[k] = np.median(known)
    known = np.isfinite(z)
    if not known.any():
        everywhere = ground.height_m[::20, ::20]
        level = float(np.nanmedian(everywhere)) if np.isfinite(everywhere).any() else 0.0
        return np.column_stack([xy, np.full(len(xy), level)])
    s = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(xy, axis=0), axis=1))])
    return np.column_stack([xy, np.interp(s, s[known], z[known])])


PAINT_WIDTH_M = 0.13  # of the usual lines of 0.1 to 0.15 m
PROFILE_M, PROFILE_STEP_M, ALONG_SAMPLES = 1.5, 0.05, 11
MIN_SEEN = 0.6  # share of a profile's middle; of what is hidden beside a line, the other side tells
MAX_SHIFT_M = 0.12  # from the ridge, which is as fine as a coarse cell, to the middle of the paint
FLANK_M = (0.08, 0.4)  # from the middle: where the road beside the paint is looked for
# From the edge: between a line and a curb there are often 0.1 m of road, and paint may be blurred so far.
SIDES_M = ((0.03, 0.13), (0.1, 0.3))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Straight pieces of ridges."""

    xy: Array  # (N, 2), m: middles
    direction: Array  # (N,), rad in [0, pi)
    length_m: Array  # `length_m`, `width_m`: (N,): width at half of the contrast
    width_m: Array
    # `color`, `color_sigma`: (N,): contrast of the logarithm of color to the brighter side, and its standard error; NaN
    # where no camera saw it
    color: Array
    color_sigma: Array
    # (N,): logarithm by which it is brighter than the brightest quarter of the ground within 1.5 m, on the darker side
    outshines: Array
    yellow: Array  # (N,): contrast of yellowness
    # `reflected`, `reflected_sigma`: (N,): contrast of the logarithm of LiDAR intensity, and its standard error; NaN
    # where LiDAR saw too little
    reflected: Array
    reflected_sigma: Array
    # `above_road`, `beside_road`: (N,): logarithms by which LiDAR intensity, there and on the darker side, is above what the road
    # around the ego's way returns
    above_road: Array
    beside_road: Array
    resolved: Array  # (N,): share of paint there that LiDAR resolves

    def __len__(self) -> int:
        """Count the pieces."""
        return len(self.xy)

    def take(self, chosen: NDArray[Any]) -> Pieces:
        """Choose pieces by a mask or by indices."""
        return Pieces(*(getattr(self, f.name)[chosen] for f in fields(self)))

    @property
    def by_camera(self) -> bool:
        """Whether a camera saw any of them well enough for its contrast."""
        return bool(np.isfinite(self.color).any())

    @property
    def along(self) -> Array:
        """Points (K, 2), m, along all pieces, a coarse cell apart."""
        count = np.maximum(np.rint(self.length_m / CELL_M).astype(int), 1)
        piece = np.repeat(np.arange(len(self)), count)
        share = (np.arange(len(piece)) - np.repeat(np.cumsum(count) - count, count) + 0.5) / count[piece] - 0.5
        step = np.stack([np.cos(self.direction), np.sin(self.direction)], 1) * self.length_m[:, None]
        return np.asarray(self.xy[piece] + share[:, None] * step[piece])

    @cached_property
    def ends(self) -> Array:
        """Both ends (N, 2, 2), m."""
        half = np.stack([np.cos(self.direction), np.sin(self.direction)], 1) * self.length_m[:, None] / 2
        return np.stack([self.xy - half, self.xy + half], 1)


def no_pieces(count: int, **known: Array) -> Pieces:
    """Make pieces of which only some attributes are known; the others are 1, so that all are alike."""
    plain = {f.name: np.ones((count, 2) if f.name == "xy" else count) for f in fields(Pieces)}
    return Pieces(**(plain | known))


def measure_pieces(ground: GroundMap, lines: Array) -> Pieces:
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
    shift, width = (left + right) / 2, right - left
    inside = np.abs(across - shift[:, None]) <= np.maximum(width / 2 - 0.02, 0.03)[:, None]
    # From the edges of the paint outwards, on either side: the road beside it, near and farther.
    away = [side * (across - shift[:, None]) - width[:, None] / 2 for side in (-1, 1)]
    sides = [[(distance > low) & (distance < high) for low, high in SIDES_M] for distance in away]
    by_color = _contrast(samples.paint, inside, sides, one_side=True)[:2]
    yellow = _contrast(samples.yellow, inside, sides, one_side=True)[0]
    reflected, reflected_sigma, difference = _contrast(samples.intensity, inside, sides, one_side=False)
    xy = lines[:, :2] + shift[:, None] * np.stack([-s, c], 1)
    far = [side * (across - shift[:, None]) > width[:, None] / 2 + 0.1 for side in (-1, 1)]
    around = [_quiet(np.nanquantile, np.where(part, color, np.nan), q=0.75) for part in far]
    # Beside a road there are brighter grounds; the road itself is on one side at least.
    outshines = _quiet(np.nanmean, np.where(inside, color, np.nan)) - np.fmin(*around)
    above_road = _quiet(np.nanmean, np.where(inside, intensity, np.nan)) - float(log_intensity(np.array(USUAL)))
    resolved = np.ones(len(lines))
    if ground.spacing_m is not None:
        row, column = (np.rint(a).astype(int) for a in ground.raster.cells_of(lines[:, :2]))
        rows, columns = ground.alpha.shape
        spacing = ground.spacing_m[np.clip(row, 0, rows - 1), np.clip(column, 0, columns - 1)].astype(np.float64)
        # How likely one of points that are scattered at random so far apart lies within half the width of paint.
        resolved = 1 - np.exp(-np.pi / 4 * (PAINT_WIDTH_M / spacing) ** 2)
    by_lidar = reflected, reflected_sigma, above_road, above_road - reflected - difference
    return Pieces(xy, lines[:, 2], lines[:, 3], width, *by_color, outshines, yellow, *by_lidar, resolved)


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
) -> tuple[Array, Array, Array]:
    """Contrast (N,) of samples (N, along, across) to the brighter side, its standard error, and the sides' difference."""
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
    contrast, error, uneven = (np.where(count >= 3, v, np.nan) for v in (mean, sigma, np.abs(left - right)))
    return contrast, error, uneven


def _masked_mean(values: Layer, mask: NDArray[Any]) -> Array:
    """Mean (N, along) over the samples across that a mask (N, P) has."""
    known = np.isfinite(values) & mask[:, None, :]
    count = known.sum(2)
    total = np.where(known, values, 0).sum(2, dtype=np.float64)
    return np.asarray(np.divide(total, count, out=np.full(count.shape, np.nan), where=count > 0), np.float64)


# Contrast of logarithms of LiDAR intensity of paint and of other ridges: mean, sigma.
PAINT_REFLECTS, OTHER_REFLECTS = (0.8, 0.35), (0.0, 0.12)
MAX_BY_LIDAR = 6.0
MIN_REFLECTING = 2  # pieces

# Shares that are compared of the contrast which dry paint has. Under a film of water paint returns 7 to 15 % of it, to some LiDARs, which
# compress strong returns, a fifth; that one map in ten is such is an assumption.
RETURNED, LOW_PRIOR = np.array([0.07, 0.1, 0.14, 0.2, 1.0]), 0.1
DRY = np.where(RETURNED < 1, -np.inf, 0.0)  # log-probabilities

MIN_OUTSHINING = 0.4  # share of its contrast
PLAIN_CONTRAST = 0.2  # logarithm of color: worn paint
MAX_DASHES = 4  # from the third on
WIDE_M = 0.3  # up to which lane lines are as wide as any (VwV-StVO: broad lines of 0.25 m and 0.3 m)
# Paint returns three times as much as the road; worn and blurred, a sixth more. Grass and sidewalks return a third more and beyond.
MIN_ABOVE_ROAD, BRIGHT_GROUND = 0.15, 0.3


def evidence_of_line(
    pieces: Pieces, painted_m: float, *, dashes: int, shares: Array = DRY, bars: bool = False
) -> dict[str, float]:
    """Gather the evidence that pieces in a line, or in the `bars` of a crosswalk, are paint, by the names in `WEIGHTS`.

    `shares`: log-probabilities of the shares of its dry contrast that paint has in LiDAR intensities of this map, see
    `log_probabilities_of_shares`; by default all of it.
    """
    width_m = median(pieces.width_m)
    varies = median(np.abs(pieces.width_m - width_m)) / width_m if len(pieces) > 2 and not bars else 0.0
    contrast = np.log(np.maximum(pieces.color, 1e-3) / PLAIN_CONTRAST)
    if not pieces.by_camera:
        contrast = np.log(np.maximum(pieces.reflected, 1e-3) / PAINT_REFLECTS[0])
    # Of pieces around which alone a camera saw the ground, none outshines it.
    finite = np.isfinite(pieces.outshines)
    outshines = pieces.outshines[finite] > MIN_OUTSHINING * np.maximum(pieces.color, 1e-3)[finite]
    share = float(np.mean(outshines)) if finite.any() else np.nan
    evidence = {
        "bias": 1.0,
        "length": np.log(max(painted_m, 0.5)),
        "dashes": np.log(dashes) if bars else min(max(dashes - 2, 0), MAX_DASHES),
        "varies": np.clip((varies - 0.2) / 0.3, 0, 1),
        "wide": np.clip((width_m - WIDE_M) / WIDE_M, 0, 1),
        "contrast": np.clip(median_known(contrast), -3, 1.5),
        "outshone": np.clip((0.5 - share) / 0.4, 0, 1),
        "reflects": by_lidar(pieces, shares if pieces.by_camera else DRY),
        # Wet paint may return less than a dry road does.
        "dull": np.clip(1 - median_known(pieces.above_road) / MIN_ABOVE_ROAD, 0, 2) * np.exp(shares[-1]),
        "unresolved": 1 - median(pieces.resolved) if np.isfinite(pieces.reflected).any() else 0.0,
        "bright_beside": np.clip(median_known(pieces.beside_road) / BRIGHT_GROUND, 0, 1.5),
    }
    return {name: float(value) if np.isfinite(value) else 0.0 for name, value in evidence.items()}


def table_of(pieces: Pieces, kind: str = "line") -> str:
    """Name the weights of the evidence for pieces: by what they are parts of, and by the sensors that saw enough of them.

    `kind`: "crosswalk", "stop_line" or that of any other line.
    """
    if kind == "other":
        return kind
    if kind in ("crosswalk", "stop_line"):
        return f"{kind}, {'camera' if pieces.by_camera else 'LiDAR'}"
    enough = _reflected(pieces) is not None
    if pieces.by_camera:
        return "line, camera and LiDAR" if enough else "line, camera"
    return "line, LiDAR" if enough else "line, few returns"


# Odds that the network has to give to count, as it knows simulated roads alone; more of lines that one sensor alone shows, by the costs of
# `tools/fits/lines.py`. With 1 instead of 3, lane lines of 17 scenes are .965 instead of .977 precise, of what stands out .862 instead of .853 is found.
NETWORK_ODDS, ALONE_ODDS = 3.0, {"line, camera": 6.0, "line, LiDAR": 12.0, "line, few returns": 12.0}


def surer_log_odds(pieces: Pieces, kind: str, evidence: Mapping[str, float], network: float) -> float:
    """Log-odds of a marking by its evidence or by those of the network, whichever is surer: either knows paint that the other does not."""
    table = table_of(pieces, kind)
    required = np.log(ALONE_ODDS.get(table, NETWORK_ODDS))
    return float(max(weighted_sum(evidence, WEIGHTS[table]), network - required))


def weighted_sum(evidence: Mapping[str, float], weights: Mapping[str, float]) -> float:
    """Add up evidence by its weights: log-odds."""
    return sum(weight * evidence.get(name, 0.0) for name, weight in weights.items())


# Errors that all returns along a line share, as by the angle of a ring to the ground.
SHARED_SIGMA = 0.015
MIN_PAINTED_M = 4.0  # of lines by which that share is estimated


def by_lidar(pieces: Pieces, shares: Array = DRY) -> float:
    """Log-odds by LiDAR intensity, given the log-probabilities of the shares that paint returns; 0 where it saw too little."""
    contrast = _reflected(pieces)
    if contrast is None:
        return 0.0
    paint, other = (float(np.logaddexp.reduce(of + shares)) for of in _log_densities(np.array(contrast), RETURNED))
    return float(np.clip(paint - other, -MAX_BY_LIDAR, MAX_BY_LIDAR))


def log_probabilities_of_shares(lines: Iterable[tuple[Pieces, float, int]]) -> Array:
    """Estimate how probable it is that paint has each share in `RETURNED` of its dry contrast in LiDAR intensities of a map.

    `lines`: pieces, length with paint, m, and number of dashes. Those that stand out to a camera count, by the likelihood of their
    contrasts to LiDAR, each of paint as likely as by the camera or of something else. Few lines often leave it open.
    """
    odds, contrasts = [], []
    for pieces, painted_m, dashes in lines:
        contrast = _reflected(pieces) if painted_m > MIN_PAINTED_M else None
        if contrast is not None and median_known(pieces.color) > EXPECTED_COLOR / 2:
            by_camera = evidence_of_line(pieces, painted_m, dashes=dashes) | {"dull": 0.0, "bright_beside": 0.0}
            odds.append(weighted_sum(by_camera, WEIGHTS["line, camera"]))
            contrasts.append(contrast)
    if not contrasts:
        return DRY
    paint, other = _log_densities(np.array(contrasts)[:, None], RETURNED)
    prior_odds = np.array(odds)[:, None]
    likelihood = np.logaddexp(paint + prior_odds, other) - np.logaddexp(prior_odds, 0)
    prior = np.log(np.where(RETURNED < 1, LOW_PRIOR / (len(RETURNED) - 1), 1 - LOW_PRIOR))
    total = likelihood.sum(axis=0) + prior
    return np.asarray(total - np.logaddexp.reduce(total))


def _reflected(pieces: Pieces) -> tuple[float, float, float] | None:
    """Contrast of the logarithm of LiDAR intensity of a line, its standard error, and `resolved`; None where LiDAR saw too little."""
    known = np.isfinite(pieces.reflected) & np.isfinite(pieces.reflected_sigma)
    if np.count_nonzero(known) < MIN_REFLECTING:
        return None
    values = pieces.reflected[known]
    error = median(pieces.reflected_sigma[known]) / np.sqrt(len(values))
    # Without a camera the contrast is all there is to go by.
    return median(values), float(error), median(pieces.resolved[known]) if pieces.by_camera else 1.0


def _log_densities(reflected: Array, returned: Array) -> tuple[Array, Array]:
    """Logarithms of the densities (...) of contrasts (..., 3), see `_reflected`, for paint and for something else."""
    mean, error, resolved = np.moveaxis(reflected, -1, 0)
    # Paint that LiDAR does not resolve looks like something else.
    spread = np.hypot(resolved * PAINT_REFLECTS[1], (1 - resolved) * OTHER_REFLECTS[1])
    out = []
    for expected, sigma in ((resolved * PAINT_REFLECTS[0], spread), (OTHER_REFLECTS[0], OTHER_REFLECTS[1])):
        sigma = np.sqrt((returned * sigma) ** 2 + error**2 + SHARED_SIGMA**2)
        out.append(-0.5 * ((mean - returned * expected) / sigma) ** 2 - np.log(sigma))
    return out[0], out[1]


def median_known(values: Array) -> float:
    """Return the median of what is finite; NaN where nothing is."""
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


HALF_PIECE_M = 1.0
ACROSS_M = 0.15  # half a coarse cell of error, and the bend of a curve of 6 m radius within a piece
MAX_TURN_RAD = np.deg2rad(20)  # the directions of ridge points are 15 deg apart
MIN_POINTS = 5
MIN_PIECE_M = 0.4
MIN_COVERED = 0.6  # share of a piece's length that has ridge points
CELL_M = 0.1  # distance of ridge points along a line
PROFILES_AT_ONCE = 4000  # bound of memory


def find_pieces(ground: GroundMap, points: RidgePoints) -> Pieces:
    """Fit straight pieces to ridge points and measure the profile across each."""
    lines = fit_lines(points)
    if not len(lines):
        return no_pieces(0)
    parts = [measure_pieces(ground, lines[k : k + PROFILES_AT_ONCE]) for k in range(0, len(lines), PROFILES_AT_ONCE)]
    pieces = Pieces(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Pieces)))
    return pieces.take(np.isfinite(pieces.width_m) & (pieces.width_m > 0))


def fit_lines(points: RidgePoints, cell_m: float = CELL_M) -> Array:
    """Fit lines to ridge points, the strongest first, each point to one: x, y, direction, length (N, 4).

    Points are `cell_m` apart along a line; all lengths are in proportion to that.
    """
    scale = cell_m / CELL_M
    if not len(points.xy_map):
        return np.zeros((0, 4))
    tree = cKDTree(points.xy_map)
    free = np.ones(len(points.xy_map), bool)
    lines = []
    for seed in np.argsort(-points.strength, kind="stable"):
        if not free[seed]:
            continue
        near = np.array(tree.query_ball_point(points.xy_map[seed], HALF_PIECE_M * scale))
        near = near[free[near]]
        free[seed] = False
        if len(near) < MIN_POINTS:
            continue
        line = _fit_line(points, int(seed), near, scale)
        if line is not None:
            lines.append(line[0])
            free[line[1]] = False
    return np.array(lines).reshape(-1, 4)


def _fit_line(points: RidgePoints, seed: int, near: NDArray[Any], scale: float) -> tuple[Array, NDArray[Any]] | None:
    """Fit a line through a seed to points near it; also the indices of those that it explains."""
    xy = points.xy_map[near] - points.xy_map[seed]
    turn = np.abs((points.direction[near] - points.direction[seed] + np.pi / 2) % np.pi - np.pi / 2)
    angle, center = float(points.direction[seed]), np.zeros(2)
    chosen = turn < MAX_TURN_RAD
    across_m, cell_m = ACROSS_M * scale, CELL_M * scale
    for width in (2 * across_m, across_m):
        along, across = _turned(xy - center, angle)
        member = chosen & (np.abs(across) < width)
        if np.count_nonzero(member) < MIN_POINTS:
            return None
        center = xy[member].mean(axis=0)
        off = xy[member] - center
        moments = off.T @ off  # of which only the directions are asked for
        angle = float(0.5 * np.arctan2(2 * moments[0, 1], moments[0, 0] - moments[1, 1]))
    along, across = _turned(xy - center, angle)
    member = chosen & (np.abs(across) < across_m)
    if np.count_nonzero(member) < MIN_POINTS:
        return None
    begin, end = along[member].min(), along[member].max()
    length = end - begin + cell_m
    covered = len(set(np.floor((along[member] - begin) / cell_m + 0.5).tolist())) * cell_m
    if length < MIN_PIECE_M * scale or covered < MIN_COVERED * length:
        return None
    middle = points.xy_map[seed] + center + (begin + end) / 2 * np.array([np.cos(angle), np.sin(angle)])
    explained = near[(np.abs(across) < 2 * across_m) & (along > begin - cell_m) & (along < end + cell_m)]
    return np.array([*middle, angle % np.pi, length]), explained


def _turned(xy: Array, angle: float) -> tuple[Array, Array]:
    c, s = np.cos(angle), np.sin(angle)
    return xy[:, 0] * c + xy[:, 1] * s, xy[:, 1] * c - xy[:, 0] * s
