"""Simplification of trajectories: waypoints that interpolation restores within a tolerance are left out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Waypoints
from log2sim.geometry import Array

# Largest deviation of an omitted waypoint from the line between its neighbors: x, y, z, yaw, speed.
TOLERANCE_M, TOLERANCE_RAD, TOLERANCE_MPS = 0.01, 0.002, 0.02
# Of a standard deviation, as a share: an error of a tenth changes no decision. With the tolerance of what it belongs to.
SIGMA_SHARE = 0.1
MAX_INTERVAL_S = 1.0


def simplify(agents: Sequence[Agent]) -> list[Agent]:
    """Leave out waypoints of straight motion at constant speed; `quality` counts those left out."""
    return [_simplified(agent) for agent in agents]


def _simplified(agent: Agent) -> Agent:
    waypoints = simplify_waypoints(agent.waypoints)
    omitted = len(agent.waypoints) - len(waypoints)
    if not omitted:
        return agent
    return replace(agent, waypoints=waypoints, quality={**agent.quality, "waypoints_left_out": omitted})


def simplify_waypoints(waypoints: Waypoints) -> Waypoints:
    """Leave out the waypoints that linear interpolation restores, keeping intervals of at most `MAX_INTERVAL_S`.

    Where `observed` changes, both neighbors are kept.
    """
    kept = waypoints_to_keep(waypoints)
    if len(kept) == len(waypoints):
        return waypoints
    return waypoints.take(kept)


def waypoints_to_keep(w: Waypoints) -> NDArray[np.intp]:
    """Select the indices (K,) of the waypoints to keep, first and last among them.

    Notes
    -----
    Greedy: from each kept waypoint the farthest next one is searched with steps that double, then halve.
    """
    columns, tolerances = _toleranced(w)
    kept, last = [0], len(w) - 1
    while kept[-1] < last:
        start = kept[-1]
        step, reach = 1, 1
        while step and start + reach < last:
            end = min(start + reach + step, last)
            if _is_linear(w.t_s, columns, tolerances, start, end):
                reach, step = end - start, 2 * step
            else:
                step //= 2
        kept.append(start + reach)
    return np.array(kept, dtype=np.intp)


def _toleranced(w: Waypoints) -> tuple[Array, Array]:
    """Return the columns (T, K) of waypoints and the tolerances (T, K) of each value."""
    exact = np.full(len(w), 0.0)
    columns = [(w.x_m, exact + TOLERANCE_M), (w.y_m, exact + TOLERANCE_M), (w.z_m, exact + TOLERANCE_M)]
    columns += [(np.unwrap(w.yaw_rad), exact + TOLERANCE_RAD), (w.speed_mps, exact + TOLERANCE_MPS)]
    sigmas = (w.sigma_xy_m, TOLERANCE_M), (w.sigma_yaw_rad, TOLERANCE_RAD), (w.sigma_speed_mps, TOLERANCE_MPS)
    columns += [(s, tolerance + SIGMA_SHARE * s) for s, tolerance in sigmas if s is not None]
    columns.append((w.observed.astype(np.float64), exact))
    values, tolerances = zip(*columns)
    return np.column_stack(values), np.column_stack(tolerances)


def _is_linear(t: Array, columns: Array, tolerances: Array, start: int, end: int) -> bool:
    """Decide whether the rows between two lie on the line between these, `observed` included."""
    if t[end] - t[start] > MAX_INTERVAL_S or columns[start, -1] != columns[end, -1]:
        return False
    share = (t[start + 1 : end] - t[start]) / (t[end] - t[start])
    line = columns[start] + share[:, None] * (columns[end] - columns[start])
    return bool((np.abs(columns[start + 1 : end] - line) <= tolerances[start + 1 : end]).all())
