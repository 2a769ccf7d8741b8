"""Labeled 3D boxes between the stamps at which they were drawn, without their ids."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array, wrap_angle

MAX_AGE_S = 0.06  # a box older than this is only used when it can be moved to the frame
MAX_GAP_S = 1.1  # labels at 1 Hz and denser are interpolated
MAX_SPEED_MPS = 50.0
SIZE_WEIGHT = 3.0


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes of one moment in the map frame: `category` (L,), `center_m` (L, 3), `size_m` (L, 3), `yaw_rad` (L,)."""

    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array


def boxes_at(moments: Mapping[int, Boxes], t_ns: int) -> Boxes | None:
    """Boxes at a stamp: those of the nearest moment, each moved towards its partner in the moment beyond.

    Parameters
    ----------
    moments
        Boxes by stamp in ns, stamps in rising order.

    Returns
    -------
    Boxes or None
        None where no moment is near enough.

    Notes
    -----
    Partners are mutual nearest neighbors in place and size. At 10 Hz a car at 15 m/s is 0.75 m off between two moments,
    a box without a partner stays where it was: it is new or about to leave.
    """
    stamps = list(moments)
    if not stamps:
        return None
    i = bisect_left(stamps, t_ns)
    before, after = stamps[max(i - 1, 0)], stamps[min(i, len(stamps) - 1)]
    near, far = (before, after) if t_ns - before <= after - t_ns or before == after else (after, before)
    between = before < t_ns < after and after - before <= MAX_GAP_S * NS_PER_S
    if not between:
        return moments[near] if abs(near - t_ns) <= MAX_AGE_S * NS_PER_S else None
    return moved(moments[near], moments[far], (t_ns - near) / (far - near), abs(far - near) / NS_PER_S)


def moved(boxes: Boxes, others: Boxes, fraction: float, span_s: float) -> Boxes:
    """Move boxes by a fraction in [0, 1] of the way to their partners, which lie `span_s` away in time."""
    own, partner = mutual_partners(boxes, others, MAX_SPEED_MPS * span_s)
    center, yaw = boxes.center_m.copy(), boxes.yaw_rad.copy()
    center[own] += fraction * (others.center_m[partner] - boxes.center_m[own])
    yaw[own] = wrap_angle(yaw[own] + fraction * wrap_angle(others.yaw_rad[partner] - boxes.yaw_rad[own]))
    return Boxes(boxes.category, center, boxes.size_m, yaw)


def mutual_partners(a: Boxes, b: Boxes, gate_m: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of boxes in `a` and `b` that are each other's nearest of the same category, at most `gate_m` apart."""
    if not len(a.center_m) or not len(b.center_m):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = np.linalg.norm(a.center_m[:, None] - b.center_m[None], axis=-1)
    cost = distance + SIZE_WEIGHT * np.linalg.norm(a.size_m[:, None] - b.size_m[None], axis=-1)
    cost = np.where((a.category[:, None] == b.category[None]) & (distance <= gate_m), cost, np.inf)
    partner = np.argmin(cost, axis=1)
    own = np.arange(len(partner))
    mutual = np.isfinite(cost[own, partner]) & (np.argmin(cost, axis=0)[partner] == own)
    return own[mutual], partner[mutual]
