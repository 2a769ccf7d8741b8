"""Assignment, gates, medians, quantiles, runs of a mask, and polynomials fitted to windows."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry.transforms import Array

# Gates of squared Mahalanobis distances, by degrees of freedom and probability: 95 %, 99 % and 99.9 %.
CHI2_2DOF_95 = 5.991
CHI2_2DOF_99 = 9.21
CHI2_2DOF_999 = 13.8
CHI2_4DOF_999 = 18.5
NEVER = 1e6
"""Cost of no pair above which as many pairs as possible are chosen, where those of pairs are much smaller."""


def choose_pairs(
    first: NDArray[np.signedinteger[Any]], second: NDArray[np.signedinteger[Any]], cost: Array, none: float = NEVER
) -> NDArray[np.intp]:
    """Choose among possible pairs (P,), each once, those (K,) of the best assignment; `none` is what it costs to leave one out.

    What no chain of possible pairs connects does not compete: each group of the others is assigned on its own, so that a long
    log with many tracks takes no table of all pairs. Pairs that are alone, nearly all in a sparse scene, take no solver.
    """
    usable = np.flatnonzero(cost < none)
    row, column = (np.unique(side[usable], return_inverse=True)[1] for side in (first, second))
    alone = (np.bincount(row)[row] == 1) & (np.bincount(column)[column] == 1)
    if alone.all():
        return usable
    from scipy.optimize import linear_sum_assignment
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    contested, row, column = usable[~alone], row[~alone], column[~alone]
    count = int(max(row.max(), column.max())) + 1
    graph = coo_array((np.ones(len(row)), (row, column + count)), shape=(2 * count, 2 * count))
    group = connected_components(graph, directed=False)[1][row]
    order = np.argsort(group, kind="stable")
    chosen = [usable[alone]]
    for pairs in np.split(order, np.flatnonzero(np.diff(group[order])) + 1):
        (rows, r), (columns, c) = (np.unique(side[pairs], return_inverse=True) for side in (row, column))
        table, place = np.full((len(rows), len(columns)), none), np.full((len(rows), len(columns)), -1)
        table[r, c], place[r, c] = cost[contested[pairs]], contested[pairs]
        taken = place[linear_sum_assignment(table)]
        chosen.append(taken[taken >= 0])
    return np.sort(np.concatenate(chosen))


def runs_of(mask: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """List the runs of True in a mask (T,): the first row of each and the one after its last."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8)))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist()))


def median(values: NDArray[Any]) -> float:
    """Return the median of values (N,), N > 0, none of them NaN: `np.median`, which takes ten times as long for a few hundred."""
    k = len(values) // 2
    ordered = np.partition(values, k)
    return float(ordered[k]) if len(values) % 2 else float((ordered[:k].max() + ordered[k]) / 2)


def weighted_quantile(values: Array, weight: Array, share: float) -> float:
    """Return the smallest of the values (N,), N > 0, that hold a share of the weight (N,) together with all smaller ones."""
    order = np.argsort(values, kind="stable")
    reached = np.cumsum(weight[order])
    return float(values[order[min(int(np.searchsorted(reached, reached[-1] * share)), len(order) - 1)]])


def fit_windows(values: NDArray[Any], window: int, degree: int, derivative: int = 0, spacing: float = 1.0) -> Any:
    """Fit a polynomial to the odd `window` around each of the values (N,) and return it, or a derivative; at either end the last window's.

    Savitzky and Golay (1964): `scipy.signal.savgol_filter`, which fits both ends anew for each call.
    """
    half, weights = window // 2, _window_weights(window, degree, derivative, spacing)
    inside = np.correlate(values, weights[half], "valid")
    return np.concatenate([weights[:half] @ values[:window], inside, weights[half + 1 :] @ values[-window:]])


@lru_cache(maxsize=64)
def _window_weights(window: int, degree: int, derivative: int, spacing: float) -> Array:
    """Return the weights (W, W) of the values of a window in the polynomial, or its derivative, at each of them."""
    at = np.arange(-(window // 2), window // 2 + 1) * spacing
    fit = np.linalg.pinv(np.vander(at, degree + 1, increasing=True))
    return sum(
        (math.perm(k, derivative) * np.outer(at ** (k - derivative), fit[k]) for k in range(derivative, degree + 1)),
        start=np.zeros((window, window)),
    )
