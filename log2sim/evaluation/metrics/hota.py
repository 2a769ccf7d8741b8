"""Higher order tracking accuracy (HOTA) with its detection and association parts."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from log2sim.evaluation.metrics.pairs import Mask, Pairs, assign
from log2sim.geometry import Array

ALPHAS: Array = np.arange(1, 20) / 20
"""Similarity thresholds 0.05, 0.10, ... 0.95 over which the figures are averaged."""


@dataclass(frozen=True)
class Hota:
    """HOTA with its detection and association parts, each the mean over `ALPHAS`."""

    hota: float
    det_a: float
    ass_a: float


def hota(pairs: Pairs, truth_present: Mask, other_present: Mask) -> Hota | None:
    """Score the tracking.

    Parameters
    ----------
    pairs : Pairs
        Candidates; those of absent agents and those with similarity 0 are left out.
    truth_present, other_present : (A, T), (B, T) bool
        Which agents count at which ticks.

    Returns
    -------
    Hota or None
        None when there is no truth.

    Notes
    -----
    Luiten et al., "HOTA", IJCV 129 (2021). Matches of a tick maximize the sum of similarity times the global alignment of
    both identities. Without any reconstructed agent all figures are 0.
    """
    if not truth_present.any():
        return None
    if not other_present.any():
        return Hota(0.0, 0.0, 0.0)
    present = truth_present[pairs.truth, pairs.tick] & other_present[pairs.other, pairs.tick] & (pairs.similarity > 0)
    pairs = pairs.take(present)
    truth_count, other_count = truth_present.sum(1), other_present.sum(1)
    alignment = _alignment(pairs, truth_count, other_count, truth_present.shape[1])
    matched = _matched(pairs, alignment[pairs.truth, pairs.other] * pairs.similarity, truth_present.shape[1])
    det_a, ass_a = np.zeros(len(ALPHAS)), np.zeros(len(ALPHAS))
    total = int(truth_count.sum() + other_count.sum())
    for k, alpha in enumerate(ALPHAS):
        # A similarity equal to the threshold counts, despite rounding.
        hits = matched.take(matched.similarity >= alpha - 1e-12)
        if len(hits.tick) == 0:
            continue
        # TPA: how often a pair of identities matched; FNA, FPA: how often one of them was present without the other.
        pair_code = hits.truth * len(other_present) + hits.other
        code, tpa = np.unique(pair_code, return_counts=True)
        i, j = np.divmod(code, len(other_present))
        ass_a[k] = np.sum(tpa * tpa / (truth_count[i] + other_count[j] - tpa)) / tpa.sum()
        det_a[k] = tpa.sum() / (total - tpa.sum())
    return Hota(float(np.sqrt(det_a * ass_a).mean()), float(det_a.mean()), float(ass_a.mean()))


def _alignment(pairs: Pairs, truth_count: Array, other_count: Array, ticks: int) -> Array:
    """Compute the Jaccard alignment (A, B) of the identities over all ticks, before the one-to-one assignment."""
    row_sum, col_sum = np.zeros((len(truth_count), ticks)), np.zeros((len(other_count), ticks))
    np.add.at(row_sum, (pairs.truth, pairs.tick), pairs.similarity)
    np.add.at(col_sum, (pairs.other, pairs.tick), pairs.similarity)
    share = row_sum[pairs.truth, pairs.tick] + col_sum[pairs.other, pairs.tick] - pairs.similarity
    potential = np.zeros((len(truth_count), len(other_count)))
    np.add.at(potential, (pairs.truth, pairs.other), pairs.similarity / share)
    union = truth_count[:, None] + other_count[None] - potential
    return np.divide(potential, union, out=np.zeros_like(potential), where=union > 0)


def _matched(pairs: Pairs, score: Array, ticks: int) -> Pairs:
    bounds = pairs.bounds(ticks)
    chosen = [
        begin + assign(pairs.truth[begin:end], pairs.other[begin:end], score[begin:end])
        for begin, end in pairwise(bounds)
    ]
    return pairs.take(np.concatenate(chosen))
