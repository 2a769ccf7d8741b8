"""Lines on the road against true ones: found and missed length, lateral error, kinds and colors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from numpy.typing import NDArray

from log2sim.datatypes import Marking, RoadBorder
from log2sim.evaluation.lanes.area import Area, sampled
from log2sim.geometry import Array

MATCH_M = 0.3
LATERAL_REACH_M = 1.0
"""Found points farther from every true line than this, about a third of a lane, belong to none and have no lateral error."""

Line = Marking | RoadBorder


@dataclass(frozen=True, eq=False)
class Samples:
    """Points of lines, S in all.

    Attributes
    ----------
    xy_m : (S, 2) float64, m
    length_m : (S,) float64, m
        That each stands for.
    line : (S,) int64
        Index of its line.
    """

    xy_m: Array
    length_m: Array
    line: NDArray[np.int64]

    @classmethod
    def of(cls, lines: Sequence[Line]) -> Samples:
        """Sample lines."""
        parts = [sampled(line.points_m) for line in lines]
        counts = [len(xy) for xy, _, _ in parts]
        return cls(
            np.concatenate([np.zeros((0, 2)), *(xy for xy, _, _ in parts)]),
            np.repeat([length for _, _, length in parts], counts),
            np.repeat(np.arange(len(lines)), counts),
        )

    def where(self, chosen: NDArray[np.bool_]) -> Samples:
        """Select samples (S,)."""
        return Samples(self.xy_m[chosen], self.length_m[chosen], self.line[chosen])


def nearest(samples: Samples, lines: Sequence[Line]) -> tuple[NDArray[np.int64], Array]:
    """Find the nearest line (S,) of each sample and its distance (S,) in m; -1 and infinite without lines."""
    index, distance = np.full(len(samples.line), -1), np.full(len(samples.line), np.inf)
    geometries = [shapely.LineString(line.points_m[:, :2]) for line in lines]
    if len(geometries) == 0 or len(index) == 0:
        return index, distance
    (rows, found), away = shapely.STRtree(geometries).query_nearest(
        shapely.points(samples.xy_m), all_matches=False, return_distance=True
    )
    index[rows], distance[rows] = found, away
    return index, distance


def line_figures(found: Sequence[Line], true: Sequence[Line], area: Area) -> dict[str, Any]:
    """Compare found lines with true ones.

    Returns
    -------
    dict
        `precision` is the share of found length within `MATCH_M` of a true line, `recall` the share of true length within
        that of a found one, where a sensor saw the ground; `recall_20_m` the same within 20 m of the path. The lateral errors are distances of found points to the nearest
        true line within `LATERAL_REACH_M`. None where there is nothing to compute a figure from.
    """
    ours = Samples.of(found)
    ours = ours.where(area.counts(ours.xy_m))
    theirs = Samples.of(true)
    theirs = theirs.where(area.expects(theirs.xy_m))
    nearest_true, away = nearest(ours, true)
    _, missed_by = nearest(theirs, found)
    right = away <= MATCH_M
    found_m, true_m = float(ours.length_m.sum()), float(theirs.length_m.sum())
    false_m = float(ours.length_m[~right].sum())
    close = area.is_close(theirs.xy_m)
    beside = away <= LATERAL_REACH_M
    return {
        "true_m": true_m,
        "found_m": found_m,
        "precision": share(ours.length_m, right),
        "recall": share(theirs.length_m, missed_by <= MATCH_M),
        "recall_20_m": share(theirs.length_m[close], missed_by[close] <= MATCH_M),
        "lateral_median_m": weighted_quantile(away[beside], ours.length_m[beside], 0.5),
        "lateral_p95_m": weighted_quantile(away[beside], ours.length_m[beside], 0.95),
        "false_m_per_100_m": None if area.path_m < 1 else 100 * false_m / area.path_m,
        **_agreement(found, true, ours.where(right), nearest_true[right]),
    }


def _agreement(
    found: Sequence[Line], true: Sequence[Line], ours: Samples, matched: NDArray[np.int64]
) -> dict[str, float | None]:
    """Shares of the matched length whose kind, and whose color where both sides state one, is right."""
    kinds = _same([line.kind for line in found], [line.kind for line in true], ours.line, matched)
    colors, theirs = ([getattr(line, "color", None) for line in lines] for lines in (found, true))
    stated = np.array([colors[i] is not None and theirs[k] is not None for i, k in zip(ours.line, matched)], dtype=bool)
    same = _same(colors, theirs, ours.line, matched)
    return {
        "kind_accuracy": share(ours.length_m, kinds),
        "color_accuracy": share(ours.length_m[stated], same[stated]),
    }


def _same(
    ours: Sequence[str | None], theirs: Sequence[str | None], i: NDArray[np.int64], k: NDArray[np.int64]
) -> NDArray[np.bool_]:
    if len(i) == 0:
        return np.zeros(0, dtype=bool)
    return np.asarray(np.array(ours, dtype=object)[i] == np.array(theirs, dtype=object)[k], dtype=bool)


def share(weight: Array, chosen: NDArray[np.bool_]) -> float | None:
    """Share of the weights (N,) that is chosen (N,), None where they are all zero."""
    total = float(weight.sum())
    return float(weight[chosen].sum()) / total if total > 0 else None


def weighted_quantile(values: Array, weight: Array, q: float) -> float | None:
    """Smallest of values (N,) that `q` of the weight (N,) does not exceed, None without any."""
    if len(values) == 0 or weight.sum() <= 0:
        return None
    order = np.argsort(values)
    reached = np.cumsum(weight[order])
    k = min(int(np.searchsorted(reached, q * reached[-1])), len(order) - 1)
    return float(values[order[k]])
