"""Truth and reconstruction at the same ticks, matched, with what counts on either side."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from log2sim.datatypes import IgnoreRegions
from log2sim.evaluation.metrics.align import StateTable
from log2sim.evaluation.metrics.clear_mot import associate, switches
from log2sim.evaluation.metrics.label_coverage import ignored_ticks
from log2sim.evaluation.metrics.pairs import Index, Mask, Pairs, gate_m, near_pairs
from log2sim.evaluation.metrics.truth import MIN_POINTS
from log2sim.geometry import Array

MIN_COUNTED_S = 1.0
"""A truth agent counts when its counted ticks make up at least this time."""

MIN_HIT_POINTS = 5
"""Of LiDARs on an object that some sensor hit. Waymo's first level of difficulty is drawn at as many."""

REASONS = {
    "other_category": "of a category that was not asked for",
    "out_of_range": "out of range",
    "few_points": f"fewer than {MIN_POINTS} LiDAR points",
    "not_in_picture": "less than half in a picture",
    "hidden": "hidden according to the truth",
    "short": f"in sight for less than {MIN_COUNTED_S:g} s",
}
"""Why a labeled object does not count at a tick; the first that applies."""

COUNTED, NOT_LABELED = 0, -1


@dataclass(frozen=True)
class Selection:
    """Which agents are compared: within `max_range_m` of the ego, None for all, and of these `categories`."""

    max_range_m: float | None
    categories: frozenset[str]

    def covers(self, side: StateTable) -> Mask:
        """Mark (A, T) the ticks at which an agent is present and selected."""
        return side.present & self.near(side) & self.chosen(side)[:, None]

    def near(self, side: StateTable) -> Mask:
        """Mark (A, T) the ticks at which an agent is within range."""
        return np.ones_like(side.present) if self.max_range_m is None else side.range_m <= self.max_range_m

    def chosen(self, side: StateTable) -> Mask:
        """Mark (A,) the agents of the selected categories."""
        return np.isin(side.category, list(self.categories))


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
    why_not : (A, T) int64
        Where it is labeled: 0 where it counts, else 1 + the place of the reason in `REASONS`; -1 where it is not labeled.
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
    why_not: Index
    switched: Mask
    selected: Mask
    false: Mask
    ignored: Mask

    @property
    def asked_for(self) -> Mask:
        """Mark (A, T) the labeled ticks of the truth that are within range and of a selected category."""
        return np.asarray((self.why_not == COUNTED) | (self.why_not > list(REASONS).index("out_of_range") + 1))


def compare(
    truth: StateTable, other: StateTable, tick_s: float, selection: Selection, *, visibility_stated: bool = True
) -> Comparison:
    """Match agents and mark what counts.

    Parameters
    ----------
    truth, other : StateTable
    tick_s : float, s
        Interval of the ticks.
    selection : Selection
    visibility_stated : bool
        Whether the truth states what is visible; else it follows from `MIN_POINTS` points and from pictures.
    """
    same_group = truth.group[:, None] == other.group[None]
    pairs = near_pairs(truth.xy_m, other.xy_m, gate_m(truth.size_m[:, 0]), same_group)
    found = associate(pairs, len(truth.ids), len(other.ids), truth.range_m.shape[1])
    in_sight = counted = selection.covers(truth) & truth.visible
    # Half a tick of tolerance, since stamps jitter.
    enough = counted.sum(1) * tick_s >= MIN_COUNTED_S - tick_s / 2 if tick_s else np.zeros(len(counted), dtype=bool)
    counted = in_sight & enough[:, None]
    few = ~truth.visible & (truth.lidar_points < MIN_POINTS) & (not visibility_stated)
    hidden = ~truth.visible & visibility_stated
    first = [~truth.labeled, counted, ~selection.chosen(truth)[:, None], ~selection.near(truth), few]
    codes = [NOT_LABELED, COUNTED, *range(1, len(REASONS) + 1)]
    why_not = np.select([*first, ~truth.visible & ~hidden, hidden, in_sight], codes, NOT_LABELED)
    selected = selection.covers(other)
    false = selected & ~found.used & ~found.absorbed
    switched = switches(found.match, counted)
    none = np.zeros_like(false)
    return Comparison(truth, other, pairs, found.match, counted, why_not, switched, selected, false, none)


def coverage(c: Comparison, selected: Mask) -> dict[str, Any]:
    """Count what was labeled at the selected ticks (A, T) of the truth, what of it counts, and why the rest does not.

    Returns
    -------
    dict
        Agent-ticks: "labeled", "counted", "why_not" by the names in `REASONS`; "hit", those within range and of a selected
        category with at least `MIN_HIT_POINTS` LiDAR points, counted or not, "hit_matched" and "hit_recall" of these; all
        three None where nobody counted the points.
    """
    labeled = selected & (c.why_not != NOT_LABELED)
    wanted = selected & c.asked_for
    counts = np.bincount(c.why_not[labeled], minlength=len(REASONS) + 1)
    hit = wanted & (c.truth.lidar_points >= MIN_HIT_POINTS)
    ticks, matched = int(hit.sum()), int((hit & (c.match >= 0)).sum())
    known = bool(np.isfinite(c.truth.lidar_points[wanted]).any())
    return {
        "labeled": int(labeled.sum()),
        "counted": int(counts[COUNTED]),
        "why_not": {name: int(count) for name, count in zip(REASONS, counts[1:], strict=True)},
        "hit": ticks if known else None,
        "hit_matched": matched if known else None,
        "hit_recall": matched / ticks if ticks else None,
    }


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
