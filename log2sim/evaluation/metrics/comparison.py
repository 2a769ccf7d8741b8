"""Truth and reconstruction at the same ticks, matched, with what counts on either side."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from log2sim.datatypes import IgnoreRegions
from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.clear_mot import associate, switches
from log2sim.evaluation.metrics.label_coverage import ignored_ticks
from log2sim.evaluation.metrics.pairs import Index, Mask, Pairs, gate_m, near_pairs
from log2sim.geometry import Array

MIN_COUNTED_S = 1.0
"""A truth agent counts when its counted ticks make up at least this time."""


@dataclass(frozen=True)
class Selection:
    """Which agents are compared: within `max_range_m` of the ego, None for all, and of these `categories`."""

    max_range_m: float | None
    categories: frozenset[str]

    def covers(self, side: StateTable) -> Mask:
        """Mark (A, T) the ticks at which an agent is present and selected."""
        near = np.ones_like(side.present) if self.max_range_m is None else side.range_m <= self.max_range_m
        return side.present & near & np.isin(side.category, list(self.categories))[:, None]


@dataclass(frozen=True, eq=False)
class Comparison:
    """A truth agents and B reconstructed agents at T ticks, matched.

    Attributes
    ----------
    truth, other : StateTable
        Truth and reconstruction.
    pairs : Pairs
    match : (A, T) int64
        Index of the reconstructed agent, -1 for none.
    counted : (A, T) bool
        Ticks at which a truth agent counts.
    switched : (A, T) bool
        Identity switches.
    selected : (B, T) bool
        Ticks at which a reconstructed agent is present, within range and of a selected category.
    false : (B, T) bool
        Ticks at which a reconstructed agent is false.
    ignored : (B, T) bool
        Unmatched ticks in ignore regions.
    """

    truth: StateTable
    other: StateTable
    pairs: Pairs
    match: Index
    counted: Mask
    switched: Mask
    selected: Mask
    false: Mask
    ignored: Mask


def compare(truth: StateTable, other: StateTable, tick_s: float, selection: Selection) -> Comparison:
    """Match agents and mark what counts; `tick_s` is the interval of the ticks, s."""
    same_group = truth.group[:, None] == other.group[None]
    pairs = near_pairs(truth.xy_m, other.xy_m, gate_m(truth.size_m[:, 0]), same_group)
    found = associate(pairs, len(truth.ids), len(other.ids), truth.range_m.shape[1])
    counted = selection.covers(truth) & truth.visible
    # Half a tick of tolerance, since stamps jitter.
    enough = counted.sum(1) * tick_s >= MIN_COUNTED_S - tick_s / 2 if tick_s else np.zeros(len(counted), dtype=bool)
    counted &= enough[:, None]
    selected = selection.covers(other)
    false = selected & ~found.used & ~found.absorbed
    switched = switches(found.match, counted)
    return Comparison(truth, other, pairs, found.match, counted, switched, selected, false, np.zeros_like(false))


def without_ignored(c: Comparison, regions: IgnoreRegions | None, truth_ticks_s: Array, shift_m: Array) -> Comparison:
    """Move false ticks in ignore regions, and of categories never labeled, to the ignored ones.

    Parameters
    ----------
    c : Comparison
    regions : IgnoreRegions or None
        None where the labels are complete.
    truth_ticks_s : (T,) float64, s
    shift_m : (3,) float64, m
        From the truth's map to the scenario's.
    """
    if regions is None:
        return c
    in_truth_map = replace(c.other, xy_m=c.other.xy_m - shift_m[:2], z_m=c.other.z_m - shift_m[2])
    never = c.false & np.isin(c.other.category, regions.categories)[:, None]
    ignored = never | ignored_ticks(regions, truth_ticks_s, in_truth_map, c.false & ~never)
    return replace(c, false=c.false & ~ignored, ignored=ignored)


def matched_ticks(c: Comparison, truth_selected: Mask) -> Mask:
    """Mark (B, T) the ticks at which a reconstructed agent matches a selected truth agent."""
    i, t = np.nonzero(truth_selected & (c.match >= 0))
    hit = np.zeros(c.false.shape, dtype=bool)
    hit[c.match[i, t], t] = True
    return hit
