"""Association of truth and reconstruction over time as CLEAR MOT defines it, and its counts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.evaluation.metrics.pairs import Index, Mask, Pairs, assign


@dataclass(frozen=True, eq=False)
class Association:
    """Matches of A truth agents and B reconstructed agents at T ticks.

    Attributes
    ----------
    match : (A, T) int64
        Index of the reconstructed agent, -1 for none.
    used : (B, T) bool
        Reconstructed agents matched within their group of categories.
    absorbed : (B, T) bool
        Reconstructed agents without such a match that are at a labeled object of another group.
    """

    match: NDArray[np.int64]
    used: Mask
    absorbed: Mask


def associate(pairs: Pairs, truths: int, others: int, ticks: int) -> Association:
    """Match agents tick by tick, keeping what was matched before while it is within the gate.

    Notes
    -----
    Bernardin and Stiefelhagen (2008), section 2.2.1: previous matches within the gate are kept, then the remaining agents
    are matched with the most pairs and the least total distance. A truth agent keeps its previous match over gaps. When two
    truth agents have the same previous match, the nearer one keeps it.
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
    """Select the candidate `rows` that continue the last match of their truth agent; the nearest of several."""
    rows = rows[last[near.truth[rows]] == near.other[rows]]
    rows = rows[np.argsort(near.distance_m[rows], kind="stable")]
    _, first = np.unique(near.other[rows], return_index=True)
    return rows[first]


def _nearest(near: Pairs, rows: Index, last: Index) -> Index:
    """Select of the candidate `rows` the most pairs with the least total distance."""
    distance = near.distance_m[rows]
    # One more pair always outweighs any saving in distance.
    bonus = 1.0 + distance.sum()
    return rows[assign(near.truth[rows], near.other[rows], bonus - distance)]


def switches(match: NDArray[np.int64], counted: Mask) -> Mask:
    """Mark (A, T) identity switches: counted ticks with another match than at the last counted tick with one."""
    held = np.where(counted, match, -1)
    out = np.zeros(match.shape, dtype=bool)
    last = np.full(len(match), -1, dtype=np.int64)
    for t in range(match.shape[1]):
        now = held[:, t]
        out[:, t] = (now >= 0) & (last >= 0) & (now != last)
        last = np.where(now >= 0, now, last)
    return out


def mota(truth_ticks: int, missed: int, false: int, id_switches: int) -> float | None:
    """Compute the multiple object tracking accuracy, 1 - (misses + false + switches) / truth; None without truth."""
    return 1 - (missed + false + id_switches) / truth_ticks if truth_ticks else None
