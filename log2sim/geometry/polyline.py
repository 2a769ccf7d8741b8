"""Polylines on the ground: stations, offsets, projection and crossings."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry.transforms import Array, wrap_angle

# Of the vertices: on the tightest curve of a car (5 m) the middle of a chord is 6 mm off.
SPACING_M = 0.5
# Headings that differ by a radian count as much as so many meters when the nearest vertex is looked for.
TURN_M = 6.0
# Of the chords whose intersections are computed: on a curve of 10 m they are 5 cm off, which only shifts a junction's edge.
CROSSING_STEP_M = 2.0
# Feet this far beyond an end are on the line: resampling moves ends by less.
INSIDE_M = 0.01
# Lines that meet at less than a degree run into each other, and where they do is not known.
MIN_SINE = 0.02


class Projection(NamedTuple):
    """Where points are relative to a polyline."""

    s_m: Array  # (N,): stations of the feet, beyond the ends where a point is before or after it
    aside_m: Array  # (N,): to the left
    turn_rad: Array  # (N,): headings of the points minus that of the line, in [-pi, pi)
    inside: NDArray[np.bool_]  # (N,): whether the foot is on the polyline


@dataclass(frozen=True, eq=False)
class Polyline:
    """A directed line."""

    points_m: Array  # (N, 3): vertices in the map frame, N >= 2, about `SPACING_M` apart, none twice in a row

    @classmethod
    def through(cls, points_m: Array, spacing_m: float = SPACING_M) -> Polyline:
        """Resample points (N, 3) at equal steps of at most `spacing_m`."""
        way = _way(points_m)
        kept = np.concatenate([[True], np.diff(np.maximum.accumulate(way)) > 1e-9])
        way, points = way[kept], points_m[kept]
        at = np.linspace(0.0, way[-1], max(int(np.ceil(way[-1] / spacing_m - 1e-9)), 1) + 1)
        return cls(np.column_stack([np.interp(at, way, column) for column in points.T]))

    @cached_property
    def s_m(self) -> Array:
        """Stations (N,) of the vertices."""
        return _way(self.points_m)

    @property
    def length_m(self) -> float:
        """Length on the ground plane."""
        return float(self.s_m[-1])

    @cached_property
    def heading_rad(self) -> Array:
        """Unwrapped headings (N,) at the vertices: of the circle through each and both its neighbors."""
        steps = np.diff(self.points_m[:, :2], axis=0)
        length = np.hypot(*steps.T)
        chord = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
        if len(chord) == 1:
            return np.repeat(chord, 2)
        inner = (chord[:-1] * length[1:] + chord[1:] * length[:-1]) / (length[1:] + length[:-1])
        first, last = 2 * chord[0] - inner[0], 2 * chord[-1] - inner[-1]
        return np.concatenate([[first], inner, [last]])

    def at(self, s_m: Array) -> Array:
        """Return points (K, 3) at stations (K,); beyond the ends straight on."""
        s = np.asarray(s_m, dtype=np.float64)
        points = np.column_stack([np.interp(s, self.s_m, column) for column in self.points_m.T])
        beyond = s - np.clip(s, 0.0, self.length_m)
        heading = self.heading_at(s)
        points[:, 0] += beyond * np.cos(heading)
        points[:, 1] += beyond * np.sin(heading)
        return points

    def heading_at(self, s_m: Array) -> Array:
        """Return headings (K,) at stations (K,)."""
        return np.asarray(np.interp(s_m, self.s_m, self.heading_rad))

    def offset(self, s_m: Array, aside_m: Array) -> Array:
        """Return the points (K, 3) that lie `aside_m` (K,) to the left of stations (K,)."""
        points, heading = self.at(s_m), self.heading_at(s_m)
        points[:, 0] -= aside_m * np.sin(heading)
        points[:, 1] += aside_m * np.cos(heading)
        return points

    def part(self, first_m: float, last_m: float) -> Array:
        """Return the points (K, 3) from one station to another."""
        inner = self.s_m[(self.s_m > first_m + 1e-6) & (self.s_m < last_m - 1e-6)]
        return self.at(np.concatenate([[first_m], inner, [last_m]]))

    @cached_property
    def _tree(self) -> Any:
        from scipy.spatial import cKDTree

        return cKDTree(_features(self.points_m[:, :2], self.heading_rad))

    @cached_property
    def bounds_m(self) -> tuple[Array, Array]:
        """Least and greatest x, y."""
        return self.points_m[:, :2].min(axis=0), self.points_m[:, :2].max(axis=0)

    def is_near(self, other: Polyline, reach_m: float) -> bool:
        """Return whether another may be within a distance: the boxes around both are."""
        (low, high), (from_m, to_m) = self.bounds_m, other.bounds_m
        return not (np.any(from_m - reach_m > high) or np.any(to_m + reach_m < low))

    def project(self, xy_m: Array, heading_rad: Array) -> Projection:
        """Project points (N, 2) with headings (N,): of the parts nearby, on the one that leads their way."""
        near = self._tree.query(_features(xy_m, heading_rad))[1]
        points, last = self.points_m[:, :2], len(self.points_m) - 1
        best_s, best_aside = np.zeros(len(xy_m)), np.full(len(xy_m), np.inf)
        best = np.full(len(xy_m), np.inf)
        for shift in (-1, 0):  # the two segments that meet at the nearest vertex
            k = np.clip(near + shift, 0, last - 1)
            start, step = points[k], points[k + 1] - points[k]
            length = np.hypot(*step.T)
            unit = step / length[:, None]
            gap = xy_m - start
            along, aside = (gap * unit).sum(axis=1), unit[:, 0] * gap[:, 1] - unit[:, 1] * gap[:, 0]
            low, high = np.where(k == 0, -np.inf, 0.0), np.where(k == last - 1, np.inf, length)
            held = np.clip(along, low, high)
            distance = np.hypot(along - held, aside)
            better = distance < best
            best = np.where(better, distance, best)
            best_s = np.where(better, self.s_m[k] + held, best_s)
            best_aside = np.where(better, np.where(aside == 0, 0.0, np.copysign(distance, aside)), best_aside)
        inside = (best_s >= -INSIDE_M) & (best_s <= self.length_m + INSIDE_M)
        return Projection(best_s, best_aside, wrap_angle(heading_rad - self.heading_at(best_s)), inside)


def crossings(one: Polyline, two: Polyline) -> Array:
    """Return where two polylines, or one and itself, intersect: stations on both (K, 2), m."""
    low, high = (np.maximum(one.bounds_m[0], two.bounds_m[0]), np.minimum(one.bounds_m[1], two.bounds_m[1]))
    if np.any(low > high):
        return np.zeros((0, 2))
    from scipy.spatial import cKDTree

    # Stations and points about `CROSSING_STEP_M` apart, and the pairs of chords between them that may intersect, in rising order.
    s, t = (
        np.linspace(0.0, line.length_m, max(int(np.ceil(line.length_m / CROSSING_STEP_M)), 1) + 1)
        for line in (one, two)
    )
    a, b = one.at(s)[:, :2], two.at(t)[:, :2]
    trees = [cKDTree((points[:-1] + points[1:]) / 2) for points in (a, b)]
    reach = sum(float(np.hypot(*np.diff(points, axis=0).T).max()) for points in (a, b)) / 2
    near = trees[0].sparse_distance_matrix(trees[1], reach * (1 + 1e-9), output_type="ndarray")
    near = near[np.lexsort((near["j"], near["i"]))]
    i, j = near["i"], near["j"]
    da, db, gap = np.diff(a, axis=0)[i], np.diff(b, axis=0)[j], b[j] - a[i]
    det = da[:, 0] * db[:, 1] - da[:, 1] * db[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        f = (gap[:, 0] * db[:, 1] - gap[:, 1] * db[:, 0]) / det
        g = (gap[:, 0] * da[:, 1] - gap[:, 1] * da[:, 0]) / det
    sine = np.abs(det) / (np.hypot(*da.T) * np.hypot(*db.T))
    hit = (sine > MIN_SINE) & (f >= 0) & (f < 1) & (g >= 0) & (g < 1)
    found = np.column_stack([s[i] + f * np.diff(s)[i], t[j] + g * np.diff(t)[j]])[hit]
    return np.asarray(found[found[:, 0] < found[:, 1] - CROSSING_STEP_M] if one is two else found)


def _way(points_m: Array) -> Array:
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points_m[:, :2], axis=0).T))])


def _features(xy_m: Array, heading_rad: Array) -> Array:
    return np.column_stack([xy_m, TURN_M * np.cos(heading_rad), TURN_M * np.sin(heading_rad)])
