"""Paths that begin or end on a route of others are continued along it: there a vehicle was first or last seen, not put down."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from log2sim.geometry import Array
from log2sim.lanes.graph.driven_paths import DrivenPath
from log2sim.lanes.graph.matching import Match, Run
from log2sim.lanes.graph.polyline import SPACING_M
from log2sim.lanes.graph.routes import Route

REACH_M = 30.0
"""How far: through a junction of four lanes each way."""

MAX_KINK_RAD = float(np.deg2rad(12.0))
"""A vehicle that is turned more against the route is about to leave it, or has come from elsewhere."""


def continued(routes: Sequence[Route], path: DrivenPath, match: Match) -> DrivenPath:
    """Return a path with up to `REACH_M` of the routes on which it begins and ends."""
    first, last = match.runs[0], match.runs[-1]
    before = _along(routes, match, first, first.first, -1)
    after = _along(routes, match, last, last.last, 1)
    if not len(before) and not len(after):
        return path
    return path.with_points(np.concatenate([before, path.line.points_m, after]))


def _along(routes: Sequence[Route], match: Match, run: Run, k: int, sign: int) -> Array:
    """Points (N, 3) of the run's route before (-1) or after (1) sample k, eased from the path's offset to the middle."""
    if run.route < 0 or abs(match.turn_rad[k]) > MAX_KINK_RAD:
        return np.zeros((0, 3))
    line = routes[run.route].line
    s = match.s_m[k]
    room = min(REACH_M, s if sign < 0 else line.length_m - s)
    if room < SPACING_M:
        return np.zeros((0, 3))
    ahead = np.linspace(0.0, room, int(np.ceil(room / SPACING_M)) + 1)[1:]
    u = ahead / room
    slope = sign * np.tan(match.turn_rad[k])
    aside = match.aside_m[k] * (1 - u) ** 2 * (1 + 2 * u) + slope * room * u * (1 - u) ** 2
    points = line.offset(s + sign * ahead, aside)
    return points[::sign]
