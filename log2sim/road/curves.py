"""Smooth curves through points of a line."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import cv2
import numpy as np
from scipy.linalg import solveh_banded

from log2sim.geometry import Array

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

    @cached_property
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
        return np.stack([np.interp(s, self.s, self.xy[:, k]) for k in range(2)], 1)


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
