"""Few waypoints for straight constant motion: those left out lie between their neighbors, within a stated tolerance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Waypoints
from log2sim.geometry import Array

# Largest departure of a waypoint left out from the line between those kept: x, y, z, yaw, speed, sigma of the position.
TOLERANCE_M, TOLERANCE_RAD, TOLERANCE_MPS = 0.01, 0.002, 0.02
TOLERANCES = np.array([TOLERANCE_M] * 3 + [TOLERANCE_RAD, TOLERANCE_MPS, TOLERANCE_M])
MAX_INTERVAL_S = 1.0


def simplify_waypoints(waypoints: Waypoints) -> Waypoints:
    """The waypoints without those that linear interpolation gives back, at most `MAX_INTERVAL_S` apart.

    Where something begins or ends to be observed both neighbors stay.
    """
    kept = waypoints_to_keep(waypoints)
    if len(kept) == len(waypoints):
        return waypoints
    names = (*Waypoints.FLOATS, "observed")
    return Waypoints(**{k: getattr(waypoints, k)[kept] for k in names})


def waypoints_to_keep(w: Waypoints) -> NDArray[np.intp]:
    """Indices (K,) of the waypoints to keep, first and last among them.

    Notes
    -----
    Greedy: from each kept waypoint the next is as far as steps that double, then halve, find it.
    """
    columns = np.column_stack([w.x_m, w.y_m, w.z_m, np.unwrap(w.yaw_rad), w.speed_mps, w.sigma_xy_m])
    kept, last = [0], len(w) - 1
    while kept[-1] < last:
        start = kept[-1]
        step, reach = 1, 1
        while step and start + reach < last:
            end = min(start + reach + step, last)
            if _between(w.t_s, columns, w.observed, start, end):
                reach, step = end - start, 2 * step
            else:
                step //= 2
        kept.append(start + reach)
    return np.array(kept, dtype=np.intp)


def _between(t: Array, columns: Array, observed: NDArray[np.bool_], start: int, end: int) -> bool:
    """Whether the rows between two are on the line from one to the other, and as observed as these."""
    if t[end] - t[start] > MAX_INTERVAL_S or observed[start : end + 1].min() != observed[start : end + 1].max():
        return False
    share = (t[start + 1 : end] - t[start]) / (t[end] - t[start])
    line = columns[start] + share[:, None] * (columns[end] - columns[start])
    return bool((np.abs(columns[start + 1 : end] - line) <= TOLERANCES).all())
