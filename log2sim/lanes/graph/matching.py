"""Which routes a path follows, and where."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.lanes.graph.polyline import Polyline

ENTER_M = 1.5
"""A vehicle closer than this to a route is on it: half of the narrowest usual lane, 3.0 m (RAA 2008, urban roads)."""

STAY_M = 2.2
"""It is on it until it is farther away than the narrowest lane of roadworks is wide; a lane beside cannot be nearer."""

MAX_TURN_RAD = float(np.deg2rad(30.0))
"""Larger differences of heading are crossings of a route."""

JUMP_M = 5.0
"""Stations of two neighboring samples that differ by more belong to two passes of the same route."""

SHORT_M = 2.0
"""Stretches off all routes that are shorter are gaps between two routes."""


class Run(NamedTuple):
    """Samples `first` to `last` (inclusive) of a path on a route, -1 for none."""

    route: int
    first: int
    last: int


@dataclass(frozen=True, eq=False)
class Match:
    """Where a path is on routes.

    Attributes
    ----------
    runs : tuple of Run
        In order; together they hold every sample once.
    s_m, aside_m, turn_rad : (N,) float64
        Station on the route of the run, offset to its left and difference of heading; NaN off all routes.
    """

    runs: tuple[Run, ...]
    s_m: Array
    aside_m: Array
    turn_rad: Array


def match(routes: Sequence[Polyline], line: Polyline, enter_m: float = ENTER_M, stay_m: float = STAY_M) -> Match:
    """Match the vertices of a path to routes."""
    n = len(line.points_m)
    shape = (len(routes), n)
    s, aside, turn = np.full(shape, np.nan), np.full(shape, np.inf), np.full(shape, np.inf)
    stay = np.zeros(shape, dtype=bool)
    low, high = line.bounds_m
    for r, route in enumerate(routes):
        if np.any(route.bounds_m[0] - stay_m > high) or np.any(route.bounds_m[1] + stay_m < low):
            continue
        at = route.project(line.points_m[:, :2], line.heading_rad)
        s[r], aside[r], turn[r] = at.s_m, at.aside_m, at.turn_rad
        stay[r] = at.inside & (np.abs(at.aside_m) <= stay_m) & (np.abs(at.turn_rad) <= MAX_TURN_RAD)
    route_of = _choose(s, np.where(stay, np.abs(aside), np.inf), enter_m)
    runs = _runs(route_of, s)
    runs = _absorb(runs, route_of, stay, s)
    pick = np.maximum(route_of, 0), np.arange(n)
    on = route_of >= 0
    if not len(routes):
        return Match(runs, *(np.full(n, np.nan) for _ in range(3)))
    return Match(runs, *(np.where(on, column[pick], np.nan) for column in (s, aside, turn)))


def _choose(s: Array, distance: Array, enter_m: float) -> NDArray[np.intp]:
    """Choose a route (N,) for each sample: the one before while it is near, else the nearest."""
    n = distance.shape[1]
    chosen = np.full(n, -1)
    if not len(distance):
        return chosen
    nearest = distance.argmin(axis=0)
    least = distance[nearest, np.arange(n)]
    current = -1
    for k in range(n):
        if current >= 0:
            goes_on = distance[current, k] < np.inf and abs(s[current, k] - s[current, k - 1]) <= JUMP_M
            if goes_on and (distance[current, k] <= enter_m or least[k] > enter_m):
                chosen[k] = current
                continue
        current = int(nearest[k]) if least[k] <= enter_m else -1
        chosen[k] = current
    return chosen


def _runs(route_of: NDArray[np.intp], s: Array) -> tuple[Run, ...]:
    """Cut samples where the route changes or its station jumps."""
    n = len(route_of)
    changed = np.diff(route_of) != 0
    if len(s):
        own = s[np.maximum(route_of, 0), np.arange(n)]
        changed |= (np.abs(np.diff(own)) > JUMP_M) & (route_of[1:] >= 0)
    cuts = np.concatenate([[0], np.flatnonzero(changed) + 1, [n]])
    return tuple(Run(int(route_of[a]), int(a), int(b) - 1) for a, b in itertools.pairwise(cuts))


def _absorb(runs: tuple[Run, ...], route_of: NDArray[np.intp], stay: NDArray[np.bool_], s: Array) -> tuple[Run, ...]:
    """Put stretches that were never far from one route on it; `route_of` is changed in place."""
    for run in runs:
        if run.route >= 0 or not len(stay):
            continue
        rows = slice(run.first, run.last + 1)
        level = (np.abs(np.diff(s[:, rows], axis=1)) <= JUMP_M).all(axis=1)
        held = np.asarray(stay[:, rows].all(axis=1) & level)
        if held.any():
            beside = [route_of[k] for k in (run.first - 1, run.last + 1) if 0 <= k < len(route_of)]
            best = next((r for r in beside if r >= 0 and held[r]), int(np.flatnonzero(held)[0]))
            route_of[rows] = best
    return _runs(route_of, s)
