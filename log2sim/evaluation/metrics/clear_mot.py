"""Association of truth and reconstruction over time as CLEAR MOT defines it, and its counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.metrics.pairs import Index, Mask, Pairs, assign


@dataclass(frozen=True, eq=False)
class Association:
    """`match` (A, T) int64: which reconstructed agent each truth agent has at each tick, -1 for none.

    `used` (B, T) bool: reconstructed agents matched within their group. `absorbed` (B, T) bool: those without a match
    of their group that stand on a labeled object of another group.
    """

    match: NDArray[np.int64]
    used: Mask
    absorbed: Mask


def associate(pairs: Pairs, truths: int, others: int, ticks: int) -> Association:
    """Match agents tick by tick, keeping what was matched before while it is within the gate.

    Notes
    -----
    Bernardin and Stiefelhagen (2008), section 2.2.1: first the correspondences of the past that still hold, then
    the most pairs with the least total distance among the rest. A truth agent remembers its last match over gaps. Where
    two truth agents remember the same one, the nearer keeps it.
    """
    match = np.full((truths, ticks), -1, dtype=np.int64)
    used, absorbed = np.zeros((others, ticks), dtype=bool), np.zeros((others, ticks), dtype=bool)
    last = np.full(truths, -1, dtype=np.int64)
    bounds = pairs.bounds(ticks)
    for t in range(ticks):
        near = pairs.take(np.arange(bounds[t], bounds[t + 1]))
        for same_group_only, choose in ((True, _kept), (True, _nearest), (False, _nearest)):
            free = (match[near.truth, t] < 0) & ~used[near.other, t] & (near.same_group | (not same_group_only))
            chosen = choose(near, np.flatnonzero(free), last)
            if same_group_only:
                match[near.truth[chosen], t] = near.other[chosen]
                used[near.other[chosen], t] = True
            else:
                absorbed[near.other[chosen], t] = True
        last = np.where(match[:, t] >= 0, match[:, t], last)
    return Association(match, used, absorbed)


def _kept(near: Pairs, rows: Index, last: Index) -> Index:
    """Those of the candidate `rows` that continue the last match of their truth agent; the nearest of rivals."""
    rows = rows[last[near.truth[rows]] == near.other[rows]]
    rows = rows[np.argsort(near.distance_m[rows], kind="stable")]
    _, first = np.unique(near.other[rows], return_index=True)
    return rows[first]


def _nearest(near: Pairs, rows: Index, last: Index) -> Index:
    """Of the candidate `rows` the most pairs with the least total distance."""
    distance = near.distance_m[rows]
    # One more pair must always be worth more than any saving in distance.
    bonus = 1.0 + distance.sum()
    return rows[assign(near.truth[rows], near.other[rows], bonus - distance)]


def switches(match: NDArray[np.int64], counted: Mask) -> Mask:
    """Mark (A, T) the counted ticks at which a truth agent's match differs from its last one at a counted tick."""
    held = np.where(counted, match, -1)
    out = np.zeros(match.shape, dtype=bool)
    last = np.full(len(match), -1, dtype=np.int64)
    for t in range(match.shape[1]):
        now = held[:, t]
        out[:, t] = (now >= 0) & (last >= 0) & (now != last)
        last = np.where(now >= 0, now, last)
    return out


def mota(truth_ticks: int, missed: int, false: int, id_switches: int) -> float | None:
    """Multiple object tracking accuracy, 1 - (misses + false + switches) / truth; None without truth."""
    return 1 - (missed + false + id_switches) / truth_ticks if truth_ticks else None
