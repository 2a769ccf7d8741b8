"""Smooth curves through points of a line, and the paint along them."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solveh_banded
from scipy.ndimage import percentile_filter

from log2sim.geometry import Array, median, runs_of
from log2sim.road.ground_map import GroundMap
from log2sim.road.paint_network import PaintMaps
from log2sim.road.ridges import sample

KNOT_M = 0.5
# Change of curvature per meter that is ordinary: clothoids of A = 30 m (1 / A**2) at low speed; RAL 2012 has A of 90 m to
# 300 m on rural roads, which smooths itself as points are many.
CURVATURE_RATE_PER_M2 = 1.0e-3
POINT_SIGMA_M = 0.03  # of the end of a piece, across it
MAX_STEP_M = 2.0  # between points that are given out
CHORD_ERROR_M = 0.004
ROBUST_SIGMAS = 2.5
ROUNDS = 4


@dataclass(frozen=True, eq=False)
class Curve:
    """Points at equal distances along a line."""

    xy: Array  # (P, 2), m

    @property
    def s(self) -> Array:
        """Length (P,) from the first point, m."""
        return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(self.xy, axis=0), axis=1))])

    @property
    def normal(self) -> Array:
        """Unit vectors (P, 2) to the left."""
        d = np.gradient(self.xy, axis=0)
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        return np.stack([-d[:, 1], d[:, 0]], 1)

    def at(self, s: Array) -> Array:
        """Points (N, 2) at lengths (N,), m."""
        own = self.s
        return np.stack([np.interp(s, own, self.xy[:, k]) for k in range(2)], 1)


def fit_curve(points: Array, sigma_m: float = POINT_SIGMA_M) -> Curve:
    """Fit a curve to points (N, 2) in order along it, N >= 2.

    The sum of squared distances, in sigmas, plus that of the curvature's rate of change, in `CURVATURE_RATE_PER_M2`, along
    the line (its third derivative by length) is the least; points far off count less (Huber). Bands of seven diagonals:
    the cost grows as the length.
    """
    s = np.concatenate([[0.0], np.cumsum(np.maximum(np.linalg.norm(np.diff(points, axis=0), axis=1), 1e-6))])
    # The ends of pieces may overlap: points are ordered along the polyline of the middles of neighbors, which goes forward where
    # its corners go back.
    middle = np.concatenate([points[:1], (points[1:] + points[:-1]) / 2, points[-1:]])
    step = np.gradient(middle, axis=0)
    step = (step[1:] + step[:-1]) / 2
    norm = np.linalg.norm(step, axis=1, keepdims=True)
    chord = np.broadcast_to(points[-1] - points[0], step.shape)
    step = np.divide(step, norm, out=chord.copy(), where=norm > 1e-9)
    ahead = np.concatenate([[0.0], np.cumsum(np.einsum("ij,ij->i", np.diff(points, axis=0), step[1:]))])
    order = np.argsort(ahead, kind="stable")
    points, along = points[order], ahead[order] - ahead[order[0]]
    s = along if along[-1] > 0 else s
    knots = max(int(np.ceil(s[-1] / KNOT_M)) + 1, 4)
    place = s / s[-1] * (knots - 1)
    spacing = s[-1] / (knots - 1)
    weight = np.full(len(points), 1 / sigma_m**2)
    # What few points leave open is straight: the curve is fitted as its distance from the chord.
    chord = points[0] + np.linspace(0, 1, knots)[:, None] * (points[-1] - points[0])
    offset = points - (points[0] + (place / (knots - 1))[:, None] * (points[-1] - points[0]))
    xy = chord
    for _ in range(ROUNDS):
        xy = chord + _solve(offset, place, weight, knots, spacing)
        low = np.minimum(place.astype(int), knots - 2)
        part = (place - low)[:, None]
        distance = np.linalg.norm(points - (xy[low] * (1 - part) + xy[low + 1] * part), axis=1)
        weight = 1 / sigma_m**2 / np.maximum(distance / (ROBUST_SIGMAS * sigma_m), 1)
    return Curve(xy)


def _solve(points: Array, place: Array, weight: Array, knots: int, spacing: float) -> Array:
    low = np.minimum(place.astype(int), knots - 2)
    part = place - low
    bands = np.zeros((4, knots))  # upper form: row 3 is the diagonal
    np.add.at(bands[3], low, weight * (1 - part) ** 2)
    np.add.at(bands[3], low + 1, weight * part**2)
    np.add.at(bands[2], low + 1, weight * part * (1 - part))
    right = np.zeros((knots, 2))
    np.add.at(right, low, (weight * (1 - part))[:, None] * points)
    np.add.at(right, low + 1, (weight * part)[:, None] * points)
    # Third differences over spacing**3 are rates of curvature; each stands for `spacing` of length.
    stiff = spacing / (CURVATURE_RATE_PER_M2 * spacing**3) ** 2
    third = np.array([-1.0, 3.0, -3.0, 1.0])
    for i in range(4):
        for j in range(i, 4):
            bands[3 - (j - i), j : knots - 3 + j] += stiff * third[i] * third[j]
    bands[3] += 1e-9 * bands[3].max()
    return np.asarray(solveh_banded(bands, right))


def thin(curve: Array) -> Array:
    """Leave out points (P, 2) without which the line is the same within `CHORD_ERROR_M`, up to `MAX_STEP_M` apart."""
    origin = curve[0]
    kept = cv2.approxPolyDP((curve - origin).astype(np.float32).reshape(-1, 1, 2), CHORD_ERROR_M, False).reshape(-1, 2)
    corners = np.asarray(kept, np.float64) + origin
    out = [corners[:1]]
    for a, b in pairwise(corners):
        count = max(1, int(np.ceil(np.linalg.norm(b - a) / MAX_STEP_M)))
        out.append(a + (b - a) * (np.arange(1, count + 1) / count)[:, None])
    return np.concatenate(out)


STEP_M = 0.1
SMOOTH_M = 0.5
LAG = round(SMOOTH_M / STEP_M)
MIN_NOISE = 0.03  # of logarithms of rounded values
FLANKS_M = (0.08, 0.14, 0.2, 0.26)  # from the edge of the paint
ON_SHARE = 0.4  # of the contrast that a line usually has where it is painted
# Contrasts are compared with those of the paint within this length, which holds a period of dashes, but with no less than a share
# of what the whole line has: far away it stands out less than near the ego, and where it has ended there is noise alone.
LEVEL_M, MIN_LEVEL = 30.0, 0.4
# Dashes and gaps are 1 m and more (MUTCD dotted lines: 2 ft dashes, 4 ft gaps; RMS: 1.5 m); flakes of worn paint are less.
MIN_DASH_M, MIN_GAP_M = 0.5, 0.6
MAX_DASH_M = 13.0  # Japan: 8 m; Germany: 6 m; ramps: 12 m
LONG_M = 4.0
# Periods of dashed lines: 2 m (MUTCD dotted lines: 6 ft) to 24 m.
PERIODS_M, PHASE_M, MIN_BARE_M = (1.6, 26.0), 0.25, 0.8
MIN_ON, MAX_OFF = 0.35, 0.12  # shares with paint within dashes and between them
MIN_GAIN = 8.0  # nats, as a hundred periods at as many phases are tried
# Roads that join are 5.5 m wide and lines end some meters before them; a worn dash or two leave less than that, or than three gaps.
JUNCTION_M, LONG_GAPS, FEW_GAPS = 10.0, 3.0, 3
SOLID_DASHES = 2.5  # a stroke so many times as long as the dashes beside it is a solid part


@dataclass(frozen=True, eq=False)
class Trace:
    """Paint along a curve, every `STEP_M`."""

    s: Array  # (P,), m
    on: NDArray[np.bool_]  # (P,): whether there is paint
    seen: NDArray[np.bool_]  # (P,): whether a sensor saw the ground

    def strokes(self) -> Array:
        """Begin and end (K, 2) of the parts with paint, m, without flakes and small gaps."""
        runs = np.array(runs_of(self.on), dtype=np.intp).reshape(-1, 2) - [0, 1]
        merged: list[list[float]] = []
        for begin, end in self.s[runs] + np.array([-STEP_M / 2, STEP_M / 2]):
            between = self.seen[(self.s > merged[-1][1]) & (self.s < begin)] if merged else self.seen[:0]
            hidden = len(between) > 0 and float(np.mean(between)) <= 0.5
            if merged and (begin - merged[-1][1] < MIN_GAP_M or hidden):
                merged[-1][1] = end
            else:
                merged.append([begin, end])
        return np.array([m for m in merged if m[1] - m[0] >= MIN_DASH_M]).reshape(-1, 2)

    def painted_m(self, begin_m: float, end_m: float) -> float:
        """Measure the length with paint between two places."""
        return STEP_M * int(np.count_nonzero(self.on & (self.s >= begin_m) & (self.s <= end_m)))


@dataclass(frozen=True)
class Stretch:
    """A part of a curve that is one marking."""

    begin_m: float
    end_m: float
    kind: str  # "solid" or "dashed"
    dashes: int  # number of dashes, 1 for a solid line


def trace(ground: GroundMap, maps: PaintMaps, curve: Curve, width_m: float) -> Trace:
    """Look along a curve for paint of a width."""
    length = float(curve.s[-1])
    s = np.arange(STEP_M / 2, max(length, STEP_M), STEP_M)
    xy = curve.at(s)
    normal = Curve(xy).normal if len(xy) > 1 else np.zeros_like(xy)
    inside = np.array([-width_m / 4, 0.0, width_m / 4])
    sides = width_m / 2 + np.array(FLANKS_M)
    across = np.concatenate([inside, -sides, sides])
    seen = sample(ground, xy[:, :1] + normal[:, :1] * across[None, :], xy[:, 1:] + normal[:, 1:] * across[None, :])
    # Beside a bright curb a line hardly stands out by color, and under water or between far rings not by intensity: both together,
    # as the best filter for known contrasts in independent noise weighs them. Known is what each usually has nearby.
    total, weight = np.zeros(len(s)), np.zeros(len(s))
    for values in (seen.paint, seen.intensity):
        contrast = _smoothed(_ridge(values))
        known = np.isfinite(contrast)
        if np.count_nonzero(known) < 3:
            continue
        # Paint begins and ends at few places, so that most differences over half a meter are noise.
        steps = np.abs(contrast[LAG:] - contrast[:-LAG])
        steps = steps[np.isfinite(steps)]
        noise = max(median(steps) / (0.6745 * np.sqrt(2)), MIN_NOISE) if len(steps) else 1.0
        expected = _paint_contrast(contrast[known])
        total[known] += contrast[known] * expected / noise**2
        weight[known] += expected**2 / noise**2
    share = np.divide(total, weight, out=np.full(len(s), np.nan), where=weight > 0)
    likely = cv2.blur(maps.at(maps.lane_line, xy).reshape(-1, 1), (1, LAG)).ravel() > 0.5
    return Trace(s, (np.nan_to_num(share) > ON_SHARE) | likely, np.isfinite(share))


def _ridge(values: NDArray[np.float32]) -> Array:
    """Contrast (P,) to the brighter side of samples (P, 3 inside + left + right)."""
    each = len(FLANKS_M)
    known = np.isfinite(values).astype(np.float32)
    filled = np.nan_to_num(values)

    def mean(part: slice) -> Array:
        total, count = filled[:, part].sum(1, dtype=np.float64), known[:, part].sum(1)
        # LiDAR hits few cells: those of 0.5 m along are taken together.
        total, count = (cv2.blur(a.reshape(-1, 1), (1, 5)).ravel() for a in (total, count.astype(np.float64)))
        return np.asarray(np.divide(total, count, out=np.full(len(total), np.nan), where=count > 0), np.float64)

    left, right = mean(slice(3, 3 + each)), mean(slice(3 + each, None))
    return np.asarray(mean(slice(0, 3)) - np.fmax(left, right))


def _smoothed(contrast: Array) -> Array:
    """Average contrasts (P,) over `SMOOTH_M`; NaN stays."""
    known: NDArray[np.bool_] = np.isfinite(contrast)
    size = (1, 2 * round(SMOOTH_M / STEP_M / 2) + 1)
    values = np.nan_to_num(contrast), known.astype(np.float64)
    total, count = (cv2.blur(a.reshape(-1, 1), size).ravel() for a in values)
    return np.asarray(np.divide(total, count, out=np.full(len(total), np.nan), where=known))


def _paint_contrast(contrast: Array) -> Array:
    """Return the contrast (P,) that paint has near each place of a line, 0 where nothing stands out."""
    # Dashes of a quarter of the period (MUTCD: 10 ft of 40 ft): the upper eighth is the middle of their paint.
    level = float(np.quantile(contrast, 0.875))
    near = percentile_filter(contrast, 87.5, round(LEVEL_M / STEP_M), mode="nearest")
    return np.asarray(np.maximum(near, MIN_LEVEL * level).clip(0), np.float64)


def stretches_of(strokes: Array) -> list[Stretch]:
    """Part strokes (K, 2) along a curve into solid and dashed stretches."""
    out: list[Stretch] = []
    solid: list[Array] = []
    # Dashed lines become solid before a junction: much longer strokes begin or end there.
    length = strokes[:, 1] - strokes[:, 0]
    short = length[length <= MAX_DASH_M]
    dash = median(short) if len(short) else 0.0
    long = (length > SOLID_DASHES * dash) & (length > LONG_M) if len(short) > 1 else length > MAX_DASH_M
    for part in np.split(strokes, np.flatnonzero(np.diff(long)) + 1) if len(strokes) else ():
        if part[0, 1] - part[0, 0] <= MAX_DASH_M and is_dashed(part):
            out += _solid_parts(solid)
            solid = []
            # Where several dashes are missing in a row, the line ends before a junction and begins again behind it.
            gaps = part[1:, 0] - part[:-1, 1]
            usual = median(gaps) if len(gaps) > FEW_GAPS else float(gaps.min(initial=np.inf))
            pieces = np.split(part, np.flatnonzero(gaps > max(JUNCTION_M, LONG_GAPS * usual)) + 1)
            out += [Stretch(float(p[0, 0]), float(p[-1, 1]), "dashed", len(p)) for p in pieces]
        else:
            solid += list(part)
    return out + _solid_parts(solid)


def is_dashed(strokes: Array) -> bool:
    """Whether strokes (K, 2) are dashes at one distance, some of them worn in part or altogether.

    The strokes are laid over each other by every possible period. Of a dashed line, the phases with paint are together,
    and the others are bare: of the best period by likelihood that is to be so beyond chance.
    """
    if len(strokes) == 2:
        length, gap = strokes[:, 1] - strokes[:, 0], strokes[1, 0] - strokes[0, 1]
        alike = length.max() < 1.4 * length.min() + 0.3 and length.max() <= MAX_DASH_M
        return bool(alike and MIN_BARE_M <= gap <= JUNCTION_M)
    if len(strokes) < 2:
        return False
    s = np.arange(strokes[0, 0], strokes[-1, 1], STEP_M)
    on = (np.searchsorted(strokes[:, 0], s, side="right") - np.searchsorted(strokes[:, 1], s, side="right")) > 0
    # Periods are distances of neighbors, adjusted to their distance from first to last.
    middle = strokes.mean(axis=1)
    steps = np.concatenate([np.diff(edge[::every]) / every for edge in (middle, *strokes.T) for every in (1, 2)])
    steps = np.unique(np.round(steps[(steps >= PERIODS_M[0]) & (steps <= PERIODS_M[1])] / PHASE_M) * PHASE_M)
    length = np.concatenate([middle[-1:] - middle[:1], strokes[-1] - strokes[0]])
    adjusted = (length[:, None] / np.maximum(np.rint(length[:, None] / steps), 1)).ravel()
    periods = np.unique(np.round(np.concatenate([steps, adjusted]), 2))
    best, gain = None, MIN_GAIN
    for period in periods[1.5 * periods <= strokes[-1, 1] - strokes[0, 0]]:
        found = _fold(s, on, float(period))
        if found is not None and found[0] > gain:
            gain, best = found[0], found
    return best is not None and best[1] >= MIN_ON and best[2] <= MAX_OFF


def _fold(s: Array, on: NDArray[np.bool_], period: float) -> tuple[float, float, float] | None:
    """Gain in log-likelihood by dashes of a period, and the shares with paint within dashes and between them."""
    bins = max(round(period / PHASE_M), 4)
    phase = np.minimum((s % period / period * bins).astype(int), bins - 1)
    count, painted = np.bincount(phase, minlength=bins), np.bincount(phase, on, minlength=bins)
    rate = painted / np.maximum(count, 1)
    inside = rate > 0.5 * rate.max()
    if np.count_nonzero(inside != np.roll(inside, 1)) != 2 or period * (~inside).mean() < MIN_BARE_M:
        return None
    n1, k1 = count[inside].sum(), painted[inside].sum()
    n0, k0 = count[~inside].sum(), painted[~inside].sum()
    # Neighbors are not independent: flakes are as long as the smoothing.
    gain = (_entropy(k1, n1) + _entropy(k0, n0) - _entropy(k1 + k0, n1 + n0)) * STEP_M / SMOOTH_M
    return float(gain), float(k1 / n1), float(k0 / n0)


def _entropy(k: float, n: float) -> float:
    return float(sum(a * np.log(a / n) for a in (k, n - k) if a > 0))


def _solid_parts(strokes: list[Array]) -> list[Stretch]:
    """Join strokes to solid lines with worn places; where more is bare than painted, the line ends."""
    out: list[list[float]] = []  # begin, end, length with paint
    for begin, end in strokes:
        bare = begin - out[-1][1] if out else np.inf
        if out and bare <= max(2.0, 0.5 * min(out[-1][2], 12.0)):
            out[-1][1] = end
            out[-1][2] += end - begin
        else:
            out.append([begin, end, end - begin])
    return [Stretch(float(b), float(e), "solid", 1) for b, e, _ in out]
