"""Areas: conflicts that belong together, as a junction's do."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from log2sim.lanes.graph.beside import Beside
from log2sim.lanes.graph.conflicts import Conflict, hold
from log2sim.lanes.graph.routes import Route

MIN_SECTION_M = 4.0
"""Between two conflicts nearer than this no vehicle can wait: they are one junction."""

Stretch = tuple[float, float, int]
"""First and last station on a route, and the conflict or area that it belongs to."""


@dataclass(frozen=True)
class Areas:
    """Conflicts that belong together.

    Attributes
    ----------
    stretches : mapping of int to list of Stretch
        By route, in order and apart.
    crossing : frozenset of int
        Areas in which lanes cross.
    """

    stretches: Mapping[int, Sequence[Stretch]]
    crossing: frozenset[int]


class Union:
    """Sets of the numbers below `count` that are united step by step (Tarjan 1975)."""

    def __init__(self, count: int) -> None:
        self._parent = list(range(count))

    def root(self, k: int) -> int:
        """Return the number that stands for the set of k."""
        while self._parent[k] != k:
            self._parent[k] = self._parent[self._parent[k]]
            k = self._parent[k]
        return k

    def unite(self, one: int, two: int) -> None:
        """Make one set of two."""
        one, two = self.root(one), self.root(two)
        self._parent[max(one, two)] = min(one, two)


def join_conflicts(routes: Sequence[Route], conflicts: Sequence[Conflict], beside: Sequence[Beside]) -> Areas:
    """Join conflicts whose stretches overlap, on any route, and let lanes side by side enter a junction together."""
    union = Union(len(conflicts))
    stretches: dict[int, list[Stretch]] = {}
    for k, conflict in enumerate(conflicts):
        for interval in conflict.intervals:
            stretches.setdefault(interval.route, []).append((interval.first_m, interval.last_m, k))
    for _ in range(len(routes) + 1):
        stretches = {route: _merge(items, union) for route, items in stretches.items()}
        if not _spread(routes, stretches, beside):
            break
    crossing = frozenset(union.root(k) for k, conflict in enumerate(conflicts) if conflict.crossing)
    merged = {route: _merge(items, union) for route, items in stretches.items()}
    return Areas({route: [(a, b, union.root(k)) for a, b, k in items] for route, items in merged.items()}, crossing)


def _merge(items: Iterable[Stretch], union: Union) -> list[Stretch]:
    """Unite stretches that overlap or leave no section between them."""
    out: list[Stretch] = []
    for first, last, k in sorted(items):
        if out and first - out[-1][1] < MIN_SECTION_M:
            union.unite(k, out[-1][2])
            out[-1] = (out[-1][0], max(out[-1][1], last), union.root(k))
        else:
            out.append((first, last, union.root(k)))
    return out


def _spread(routes: Sequence[Route], stretches: dict[int, list[Stretch]], beside: Sequence[Beside]) -> bool:
    """Add the stretches of each route to those beside it; return whether any was new."""
    grown = False
    for pair in beside:
        if not pair.same_way:
            continue
        for first, last, k in list(stretches.get(pair.route, ())):
            if last < pair.s_m[0] or first > pair.s_m[-1]:
                continue
            ends = [
                np.interp(v, pair.s_m, pair.other_s_m) if pair.s_m[0] <= v <= pair.s_m[-1] else None
                for v in (first, last)
            ]
            a = (
                ends[0]
                if ends[0] is not None
                else ends[1] - (last - first)
                if ends[1] is not None
                else pair.other_s_m[0]
            )
            b = ends[1] if ends[1] is not None else a + (last - first)
            held = hold(routes[pair.other], pair.other, float(a), float(b))
            own = stretches.setdefault(pair.other, [])
            if held.last_m > held.first_m and not any(
                low <= held.first_m + 0.1 and high >= held.last_m - 0.1 and j == k for low, high, j in own
            ):
                own.append((held.first_m, held.last_m, k))
                grown = True
    return grown
