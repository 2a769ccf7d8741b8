"""Candidate pairs of truth and reconstructed agents at each tick, and one-to-one assignment."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

GATE_M = 2.0
GATE_PER_LENGTH = 0.25


def gate_m(length_m: Array) -> Array:
    """Compute the gate (A,), m: the largest distance of matching box centers, by the truth's length (A,), m.

    Notes
    -----
    nuScenes matches within 2 m. The center of a partly visible bus or truck is uncertain by more, so the gate is at least a
    quarter of the length.
    """
    return np.maximum(GATE_M, GATE_PER_LENGTH * np.asarray(length_m, dtype=np.float64))


@dataclass(frozen=True, eq=False)
class Pairs:
    """Pairs within the gate, sorted by tick.

    Attributes
    ----------
    tick : (P,) int64
    truth, other : (P,) int64
        Indices of the truth agent and of the reconstructed agent.
    distance_m : (P,) float64
    similarity : (P,) float64
        1 - distance / gate; 0 across groups of categories.
    same_group : (P,) bool
    """

    tick: Index
    truth: Index
    other: Index
    distance_m: Array
    similarity: Array
    same_group: Mask

    def take(self, index: Mask | Index) -> Pairs:
        """Return the rows at `index`."""
        return Pairs(
            self.tick[index],
            self.truth[index],
            self.other[index],
            self.distance_m[index],
            self.similarity[index],
            self.same_group[index],
        )

    def bounds(self, ticks: int) -> Index:
        """Return row numbers (T + 1,): the pairs of tick t are rows bounds[t] to bounds[t + 1]."""
        return np.searchsorted(self.tick, np.arange(ticks + 1))


def near_pairs(truth_xy: Array, other_xy: Array, gates_m: Array, same_group: Mask) -> Pairs:
    """Collect the pairs within the gate.

    Parameters
    ----------
    truth_xy, other_xy : (A, T, 2), (B, T, 2) float64, m
        Box centers in one frame, NaN where an agent is absent.
    gates_m : (A,) float64
    same_group : (A, B) bool
    """
    found: list[tuple[Index, ...]] = []
    distances = []
    for t in range(truth_xy.shape[1]):
        a, b = np.flatnonzero(np.isfinite(truth_xy[:, t, 0])), np.flatnonzero(np.isfinite(other_xy[:, t, 0]))
        gap = truth_xy[a, None, t] - other_xy[None, b, t]
        distance = np.hypot(gap[..., 0], gap[..., 1])
        i, j = np.nonzero(distance <= gates_m[a, None])
        found.append((np.full(len(i), t), a[i], b[j]))
        distances.append(distance[i, j])
    if not found:
        none = np.zeros(0, dtype=np.int64)
        return Pairs(none, none, none, np.zeros(0), np.zeros(0), np.zeros(0, dtype=bool))
    tick, truth, other = (np.concatenate(column) for column in zip(*found))
    distance_m = np.concatenate(distances)
    same = same_group[truth, other]
    similarity = np.where(same, 1 - distance_m / gates_m[truth], 0.0)
    return Pairs(tick, truth, other, distance_m, similarity, same)


def assign(rows: Index, cols: Index, score: Array) -> Index:
    """Choose pairs one to one so that the sum of their scores is greatest.

    Parameters
    ----------
    rows, cols : (P,) int64
        The candidate pairs, each once.
    score : (P,) float64
        Greater than 0 for a pair that may be chosen.

    Returns
    -------
    (K,) int64
        Indices of the chosen candidates.

    Notes
    -----
    Pairs whose row and column have no other candidate, nearly all in a sparse scene, are chosen without the solver.
    """
    usable = np.flatnonzero(score > 0)
    if len(usable) == 0:
        return usable
    row_names, r = np.unique(rows[usable], return_inverse=True)
    col_names, c = np.unique(cols[usable], return_inverse=True)
    alone = (np.bincount(r)[r] == 1) & (np.bincount(c)[c] == 1)
    if np.all(alone):
        return usable
    from scipy.optimize import linear_sum_assignment

    contested = usable[~alone]
    row_names, r = np.unique(rows[contested], return_inverse=True)
    col_names, c = np.unique(cols[contested], return_inverse=True)
    matrix = np.zeros((len(row_names), len(col_names)))
    place = np.full(matrix.shape, -1, dtype=np.int64)
    matrix[r, c], place[r, c] = score[contested], contested
    i, j = linear_sum_assignment(matrix, maximize=True)
    chosen = place[i, j]
    return np.sort(np.concatenate([usable[alone], chosen[chosen >= 0]]))
