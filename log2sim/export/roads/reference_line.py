"""Fits the reference line of a road to a path: lines and arcs with continuous tangents, within 1 cm of it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from log2sim.geometry import Array

# Largest distance of the smoothing spline from the path, and of the arcs from the spline: together below 1 cm.
SPLINE_M, ARCS_M = 0.007, 0.002
# Between points farther apart a path is sampled on their connecting line.
MAX_STEP_M = 0.25
SAMPLE_M = 0.2
# Longer paths are sampled more coarsely, which bounds the run time.
MAX_POINTS = 20_000
# RMS distances of the points from the spline that are tried, from the smoothest curve to interpolation.
SIGMAS_M = (*(SPLINE_M / 2 * 0.7**k for k in range(8)), 0.0)
MAX_PARAMETER_SPEED = 1.2
# Lines are bent over so much of them to begin and end where others do; straight ones that differ by less stay as they are.
PIN_M = 8.0
EXACT_M, EXACT_RAD = 1e-6, 1e-6
# An arc with a smaller sagitta is written as a line.
MAX_LINE_SAGITTA_M = 1e-6


@dataclass(frozen=True, eq=False)
class ReferenceLine:
    """Lines and arcs, each beginning where the one before ends.

    `pieces` (K, 6): station, x, y and heading of its start, length, and curvature, positive to the left and 0 of a line.
    """

    pieces: Array

    @property
    def length_m(self) -> float:
        """Total length."""
        return float(self.pieces[-1, 0] + self.pieces[-1, 4])

    def at(self, s_m: Array) -> Array:
        """Return points (N, 3) x, y, heading at stations (N,)."""
        starts = self.pieces[:, 0]
        at = self.pieces[np.clip(np.searchsorted(starts, s_m, side="right") - 1, 0, None)]
        return _along(at[:, 1:4], at[:, 5], s_m - at[:, 0])

    def extended(self, before_m: float, after_m: float) -> ReferenceLine:
        """Extend by straight lines before and after; stations are counted from the new start."""
        (_, x, y, heading, *_), last = self.pieces[0], self.pieces[-1:]
        start = (x - before_m * np.cos(heading), y - before_m * np.sin(heading), heading, before_m, 0.0)
        end = (*_along(last[:, 1:4], last[:, 5], last[:, 4])[0], after_m, 0.0)
        return joined_pieces([start, *(tuple(row) for row in self.pieces[:, 1:]), end])


def _along(start: Array, curvature_1pm: Array, along_m: Array) -> Array:
    """Return points (N, 3) x, y, heading at distances (N,) along arcs that begin at (N, 3)."""
    x, y, heading = start.T
    turned = curvature_1pm * along_m
    chord = along_m * np.sinc(turned / (2 * np.pi))
    return np.column_stack(
        [x + chord * np.cos(heading + turned / 2), y + chord * np.sin(heading + turned / 2), heading + turned]
    )


def joined_pieces(steps: Sequence[tuple[float, ...]]) -> ReferenceLine:
    """Join pieces (x, y, heading, length, curvature); consecutive collinear lines become one."""
    pieces: list[tuple[float, ...]] = []
    for x, y, heading, length, curvature in steps:
        if length <= 0:
            continue
        if pieces and curvature == 0 == pieces[-1][5] and abs(heading - pieces[-1][3]) < 1e-9:
            _, x, y, heading, before, _ = pieces.pop()
            length += before
        s = pieces[-1][0] + pieces[-1][4] if pieces else 0.0
        pieces.append((s, x, y, heading, length, curvature))
    return ReferenceLine(np.array(pieces, dtype=np.float64).reshape(-1, 6))


def fit(xy_m: Array, start: Array | None = None, end: Array | None = None) -> tuple[ReferenceLine, Array]:
    """Fit lines and arcs to points (N, 2), m, at least two, in order along the path; return the line and the points' stations (N,).

    `start`, `end`: x, y, heading (3,) with which the line begins and ends exactly, next to the first and last point.

    A smoothing spline removes millimeter noise, which would become curvature; then each stretch of it is replaced by the
    longest pair of arcs within `ARCS_M` of it, with continuous tangents (biarcs: Bolton 1975).
    Cost: a banded least-squares problem per spline, and O(N log N) for the arcs.
    """
    samples, sample_of_point = _spline(xy_m)
    if start is not None or end is not None:
        samples, sample_of_point = _pinned(samples, sample_of_point, start, end)
    ends = _longest_biarcs(samples)
    steps, stations = [], np.zeros(len(samples))
    s = 0.0
    for i, j in pairwise(ends):
        pair = _biarc(samples[i], samples[j])
        steps += pair
        length = sum(step[3] for step in pair)
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(samples[i : j + 1, :2], axis=0).T))])
        stations[i : j + 1] = s + travelled / travelled[-1] * length
        s += length
    return joined_pieces(steps), np.interp(sample_of_point, np.arange(len(samples)), stations)


def _pinned(samples: Array, rows: Array, start: Array | None, end: Array | None) -> tuple[Array, Array]:
    """Bend samples (M, 3) over up to `PIN_M` so that they begin and end as told; `rows` (N,) are those of points in them."""
    way = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(samples[:, :2], axis=0).T))])
    if len(samples) == 2:  # of a straight line only the ends are there
        gaps = [pose - samples[k] for k, pose in ((0, start), (-1, end)) if pose is not None]
        turns = [np.angle(np.exp(1j * gap[2])) for gap in gaps]
        if all(np.hypot(*gap[:2]) < EXACT_M and abs(turn) < EXACT_RAD for gap, turn in zip(gaps, turns)):
            return samples, rows
        share = np.linspace(0.0, 1.0, max(int(np.ceil(way[-1] / SAMPLE_M)), 2) + 1)
        samples = samples[0] + share[:, None] * (samples[1] - samples[0])
        rows, way = rows * (len(share) - 1), share * way[-1]
    moved = samples.copy()
    reach = min(PIN_M, way[-1])
    for k, pose, since, sign in ((0, start, way, 1.0), (-1, end, way[-1] - way, -1.0)):
        if pose is None:
            continue
        u = np.clip(since / reach, 0.0, 1.0)
        turn = float(np.angle(np.exp(1j * (pose[2] - samples[k, 2]))))
        fade, swing = (1 - u) ** 2 * (1 + 2 * u), u * (1 - u) ** 2 * reach
        left = np.array([-np.sin(samples[k, 2]), np.cos(samples[k, 2])])
        moved[:, :2] += fade[:, None] * (pose[:2] - samples[k, :2]) + sign * turn * swing[:, None] * left
    steps = np.gradient(moved[:, :2], way, axis=0) - np.gradient(samples[:, :2], way, axis=0)
    heading = samples[:, 2]
    moved[:, 2] = heading + steps[:, 1] * np.cos(heading) - steps[:, 0] * np.sin(heading)
    for k, pose in ((0, start), (-1, end)):
        if pose is not None:
            moved[k, :2] = pose[:2]
            moved[k, 2] = samples[k, 2] + np.angle(np.exp(1j * (pose[2] - samples[k, 2])))
    return moved, rows


def _spline(xy_m: Array) -> tuple[Array, Array]:
    """Return samples (M, 3) x, y, heading of a smooth curve within `SPLINE_M` of points (N, 2), and the points' rows in them."""
    from scipy.interpolate import splev, splprep

    straight_on = _straight_samples(xy_m)
    if straight_on is not None:
        return straight_on
    steps = np.hypot(*np.diff(xy_m, axis=0).T)
    travelled = np.concatenate([[0.0], np.cumsum(steps)])
    parts = np.maximum(np.ceil(steps / max(MAX_STEP_M, travelled[-1] / MAX_POINTS)).astype(int), 1)
    u = np.concatenate([a + np.arange(n) / n * d for a, n, d in zip(travelled, parts, steps)] + [travelled[-1:]])
    dense = np.column_stack([np.interp(u, travelled, xy_m[:, k]) for k in (0, 1)])
    at = np.linspace(0.0, travelled[-1], int(np.clip(np.ceil(travelled[-1] / SAMPLE_M), 2, MAX_POINTS)) + 1)
    for sigma_m in SIGMAS_M:
        # With full output it raises no warnings; the two checks below refuse what it could not solve.
        (tck, _), *_ = splprep(dense.T, u=u, k=min(3, len(u) - 1), s=len(u) * sigma_m**2, full_output=1, quiet=1)
        (x, y), (dx, dy) = splev(at, tck), splev(at, tck, der=1)
        # Its parameter is the distance along the path; a much larger speed means overshoot between two points.
        calm = np.hypot(dx, dy).max() <= MAX_PARAMETER_SPEED
        if calm and np.hypot(*(np.array(splev(u, tck)) - dense.T)).max() <= SPLINE_M:
            break
    heading = np.unwrap(np.arctan2(dy, dx))
    return np.column_stack([x, y, heading]), travelled / travelled[-1] * (len(at) - 1)


def _straight_samples(xy_m: Array) -> tuple[Array, Array] | None:
    """Return the ends of the line through all points (N, 2) as `_spline` does, or None if it is not within `SPLINE_M` of them."""
    middle = xy_m.mean(axis=0)
    across, along = np.linalg.eigh(np.cov((xy_m - middle).T))[1].T
    along = along if (xy_m[-1] - xy_m[0]) @ along > 0 else -along
    s = (xy_m - middle) @ along
    if np.abs((xy_m - middle) @ across).max() > SPLINE_M or np.any(np.diff(s) <= 0):
        return None
    heading = np.arctan2(along[1], along[0])
    ends = np.array([[*(middle + v * along), heading] for v in (s[0], s[-1])])
    return ends, (s - s[0]) / (s[-1] - s[0])


def _longest_biarcs(samples: Array) -> list[int]:
    """Return indices of the samples (M, 3) between which biarcs stay within `ARCS_M`; the step doubles, then is bisected."""
    ends, last = [0], len(samples) - 1
    while ends[-1] < last:
        start, reach, step = ends[-1], 1, 1
        while step and start + reach < last:
            end = min(start + reach + step, last)
            if _deviation(samples[start : end + 1]) <= ARCS_M:
                reach, step = end - start, 2 * step
            else:
                step //= 2
        ends.append(start + reach)
    return ends


def _deviation(samples: Array) -> float:
    """How far the biarc from the first to the last of samples (M, 3) passes from those between."""
    line = joined_pieces(_biarc(samples[0], samples[-1]))
    if abs(samples[-1, 2] - samples[0, 2]) > np.pi / 2 or not len(line.pieces):
        return np.inf
    travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(samples[:, :2], axis=0).T))])
    x, y, heading = line.at(travelled / travelled[-1] * line.length_m).T
    across = -np.sin(heading) * (samples[:, 0] - x) + np.cos(heading) * (samples[:, 1] - y)
    return float(np.abs(across).max())


def _biarc(start: Array, end: Array) -> list[tuple[float, ...]]:
    """Two arcs (x, y, heading, length, curvature) from one x, y, heading (3,) to another, with equal tangent lengths."""
    p, q = start[:2], end[:2]
    t, v = (np.array([np.cos(h), np.sin(h)]) for h in (start[2], end[2]))
    chord, spread = q - p, 2 * (1 - float(t @ v))
    along = float(chord @ (t + v))
    # d**2 * spread + 2 * d * along = |chord|**2, in the form that does not cancel when the headings are nearly equal.
    d = float(chord @ chord) / (along + np.sqrt(along**2 + spread * float(chord @ chord)))
    middle = (p + q + d * (t - v)) / 2
    first = _arc(p, start[2], middle)
    return [first, _arc(middle, first[2] + first[3] * first[4], q)]


def _arc(start: Array, heading: float, end: Array) -> tuple[float, ...]:
    chord = end - start
    distance = float(np.hypot(*chord))
    c, s = np.cos(heading), np.sin(heading)
    off = float(np.arctan2(c * chord[1] - s * chord[0], chord @ [c, s]))
    if distance * abs(off) / 4 < MAX_LINE_SAGITTA_M:
        return float(start[0]), float(start[1]), heading, distance, 0.0
    return float(start[0]), float(start[1]), heading, distance * off / np.sin(off), 2 * np.sin(off) / distance
