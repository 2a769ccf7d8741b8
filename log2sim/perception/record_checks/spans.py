"""Spans of time: records in a row that are at fault, and gaps between records."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S

# Faults of one sensor nearer to each other than this are reported as one, and more than so many all together.
JOINED_S = 1.0
MAX_SPANS = 3
# Busy recorders drop a record now and then. Longer than this, and than so many periods, a stream is interrupted.
MIN_GAP_S = 0.5
MIN_GAP_PERIODS = 3.0
# Fewer records have no usual period.
MIN_STAMPS = 3


@dataclass(frozen=True)
class Span:
    """Records of one stream that are at fault.

    Attributes
    ----------
    start_ns, end_ns : int
        Stamps of the first and the last.
    count, total : int
        Records at fault, and all from the first to the last of them.
    """

    start_ns: int
    end_ns: int
    count: int
    total: int


def spans_of(t_ns: NDArray[np.int64], at_fault: NDArray[np.bool_]) -> list[Span]:
    """Join records (F,) at fault, rising in time, to spans: those near each other, or all where they are many."""
    rows = np.flatnonzero(at_fault)
    if len(rows) == 0:
        return []
    cuts = np.flatnonzero(np.diff(t_ns[rows]) > JOINED_S * NS_PER_S) + 1
    parts = np.split(rows, cuts if len(cuts) < MAX_SPANS else cuts[:0])
    return [Span(int(t_ns[p[0]]), int(t_ns[p[-1]]), len(p), int(p[-1] - p[0] + 1)) for p in parts]


def gaps_of(t_ns: NDArray[np.int64], start_ns: int, end_ns: int) -> list[tuple[int, int]]:
    """Find the gaps of a stream (F,) between two stamps that are much longer than its period: stamps where they start and end."""
    if len(t_ns) < MIN_STAMPS:
        return []
    shortest_ns = max(MIN_GAP_PERIODS * float(np.median(np.diff(t_ns))), MIN_GAP_S * NS_PER_S)
    around = np.concatenate([[start_ns], t_ns[(t_ns > start_ns) & (t_ns < end_ns)], [end_ns]])
    return [(int(around[k]), int(around[k + 1])) for k in np.flatnonzero(np.diff(around) > shortest_ns)]
