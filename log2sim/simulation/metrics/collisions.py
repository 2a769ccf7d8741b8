"""Contacts of oriented boxes over time, and the collisions that they form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ScenarioError
from log2sim.geometry import Array, wrap_angle
from log2sim.simulation.metrics.box_tracks import BoxTracks, RowIndex, spacing_s
from log2sim.simulation.metrics.continuous_collision import RelativeMotion, first_contact
from log2sim.simulation.vehicles.vehicle import Columns

CHUNK = 20
"""Rows in one broad phase."""

BATCH = 100_000
"""Pairs evaluated together, which bounds memory."""

MAX_PAIRS = 50_000
"""Pairs of agents whose motion over `CHUNK` rows is compared at once: a million rows."""

MAX_CONTACTS = 2_000_000
"""Contacts that are kept, some 80 MB: a thousand pairs that overlap for 100 s. More are no traffic."""

SAME_CONTACT_S = 0.5  # contacts of a pair that are closer in time form one collision
SCENARIO_WINDOW_S = 0.5  # the scenario has a collision itself when its boxes overlap within this time of it,
SCENARIO_MARGIN_M = 0.1  # or pass with a smaller gap than this, which is below the errors of boxes

REPLAY, RECONSTRUCTION, SCENARIO = "replay", "reconstruction", "scenario"
"""Whose a collision is: new in the replay; or of the scenario, whose own boxes overlap, by its kind."""


@dataclass(frozen=True, eq=False)
class Contacts(Columns):
    """Contacts (N,) of boxes a < b.

    Attributes
    ----------
    a, b : (N,) int
    first_row, last_row : (N,) float64
        Fractional rows of the first and last overlap within one step.
    """

    a: RowIndex
    b: RowIndex
    first_row: Array
    last_row: Array


def contacts(boxes: BoxTracks, moves: NDArray[np.bool_], only: NDArray[np.bool_] | None = None) -> Contacts:
    """Find contacts of two boxes of which at least one moves, a step at a time; `only` (A,) restricts the agents.

    Notes
    -----
    Broad phase: axis-aligned hulls of the circles about the boxes over `CHUNK` rows, sorted. Narrow phase: `first_contact`,
    forward for the first overlap and backward for the last. Where an agent does not move continuously, the boxes are compared
    at the row alone. Cost: A log A and the pairs in reach, a chunk.

    Raises
    ------
    ScenarioError
        For more than `MAX_CONTACTS`, of agents that lie on top of each other.
    """
    found, count = [Contacts(*np.zeros((2, 0), dtype=np.intp), *np.zeros((2, 0)))], 0
    for k, a, b in _in_batches(_candidates(boxes, moves, only)):
        first_row, last_row = _contact_rows(boxes, k, a, b)
        hit = ~np.isnan(first_row)
        found.append(Contacts(a[hit], b[hit], first_row[hit], last_row[hit]))
        count += len(found[-1].a)
        if count > MAX_CONTACTS:
            raise ScenarioError(
                f"{len(boxes.size_m)} agents touch in more than {MAX_CONTACTS} pairs and steps: they lie on top of each other; "
                "remove those that are no traffic"
            )
    return Contacts(*(np.concatenate([getattr(f, c) for f in found]) for c in ("a", "b", "first_row", "last_row")))


def _in_batches(candidates: Iterator[tuple[RowIndex, RowIndex, RowIndex]]) -> Iterator[NDArray[np.intp]]:
    """Yield candidates (3, N) joined and cut to at most `BATCH`."""
    waiting, count = list[NDArray[np.intp]](), 0
    for part in chain(candidates, [None]):
        if part is not None:
            waiting.append(np.stack(part))
            count += waiting[-1].shape[1]
        if count and (part is None or count >= BATCH):
            joined = np.concatenate(waiting, axis=1)
            yield from (joined[:, begin : begin + BATCH] for begin in range(0, count, BATCH))
            waiting, count = [], 0


def _candidates(
    boxes: BoxTracks, moves: NDArray[np.bool_], only: NDArray[np.bool_] | None
) -> Iterator[tuple[RowIndex, RowIndex, RowIndex]]:
    """Yield rows and pairs (3, N) that may touch before the next row."""
    for begin in range(0, len(boxes.x_m), CHUNK):
        rows = slice(begin, begin + CHUNK + 1)
        present = boxes.present[begin : begin + CHUNK]
        for i, j in _overlapping_hulls(boxes.x_m[rows], boxes.y_m[rows], boxes.radius_m, moves, only):
            row, pair = np.nonzero(present[:, i] & present[:, j])
            k, a, b = row + begin, i[pair], j[pair]
            near = _relative_motion(boxes, k, a, b).may_touch()
            yield k[near], a[near], b[near]


def _contact_rows(boxes: BoxTracks, k: RowIndex, a: RowIndex, b: RowIndex) -> tuple[Array, Array]:
    """Return fractional rows (N,) of the first and last overlap from rows `k` to the next; NaN without overlap."""
    motion = _relative_motion(boxes, k, a, b)
    first, last = first_contact(motion), np.zeros(len(k))
    hit = np.flatnonzero(~np.isnan(first))
    on = boxes.moves_on[k[hit], a[hit]] & boxes.moves_on[k[hit], b[hit]]
    last[hit] = np.where(on, 1.0 - first_contact(motion.take(hit).reversed()), 0.0)
    rows = k.astype(np.float64)
    return rows + first, rows + np.fmax(first, last)


def _relative_motion(boxes: BoxTracks, k: RowIndex, a: RowIndex, b: RowIndex) -> RelativeMotion:
    """Return the motion of pairs (N,) from rows to the next; none where one of them does not move continuously."""
    after = np.where(boxes.moves_on[k, a] & boxes.moves_on[k, b], k + 1, k)
    x, y, z = (c[k, b] - c[k, a] for c in (boxes.x_m, boxes.y_m, boxes.z_m))
    then_x, then_y, then_z = (c[after, b] - c[after, a] for c in (boxes.x_m, boxes.y_m, boxes.z_m))
    yaw_a, yaw_b = boxes.yaw_rad[k, a], boxes.yaw_rad[k, b]
    turn_a, turn_b = wrap_angle(boxes.yaw_rad[after, a] - yaw_a), wrap_angle(boxes.yaw_rad[after, b] - yaw_b)
    return RelativeMotion(
        x, y, z, then_x - x, then_y - y, then_z - z, yaw_a, yaw_b, turn_a, turn_b, boxes.size_m[a].T, boxes.size_m[b].T
    )


def _overlapping_hulls(
    x: Array, y: Array, radius: Array, moves: NDArray[np.bool_], only: NDArray[np.bool_] | None
) -> Iterator[tuple[RowIndex, RowIndex]]:
    """Yield pairs (P,), (P,), some `MAX_PAIRS` at a time, whose hulls over the rows overlap, at least one of them moving."""
    there = ~np.isnan(x).all(axis=0)
    present = np.flatnonzero(there if only is None else there & only)
    low = np.stack([np.nanmin(c[:, present], axis=0) - radius[present] for c in (x, y)])
    high = np.stack([np.nanmax(c[:, present], axis=0) + radius[present] for c in (x, y)])
    order = np.argsort(low[0], kind="stable")
    low, high, present = low[:, order], high[:, order], present[order]
    # Sorted by their lower end, the boxes that may meet box k in x are those up to the last one beginning before its end.
    reach = np.searchsorted(low[0], high[0], side="right")
    count = np.maximum(reach - np.arange(len(present)) - 1, 0)
    until = np.cumsum(count)
    last = np.searchsorted(until, np.arange(MAX_PAIRS, until[-1] if len(until) else 0, MAX_PAIRS)) + 1
    for k in np.split(np.arange(len(present)), np.unique(last)):
        a = np.repeat(k, count[k])
        b = a + 1 + np.arange(len(a)) - np.repeat(np.cumsum(count[k]) - count[k], count[k])
        meet = (low[1, a] <= high[1, b]) & (low[1, b] <= high[1, a]) & (moves[present[a]] | moves[present[b]])
        pair = np.sort(np.stack([present[a[meet]], present[b[meet]]]), axis=0)
        yield pair[0], pair[1]


def collisions(
    replayed: BoxTracks,
    source: BoxTracks,
    moves: NDArray[np.bool_],
    t_s: Array,
    ids: Sequence[str],
    *,
    source_kind: str = SCENARIO,
) -> list[dict[str, Any]]:
    """List collisions in order of time: pair, first and last contact, relative speed, and whose they are.

    Those that the boxes of the scenario, `source`, have themselves belong to `source_kind`, all others to the replay. `t_s`
    (S,) are the evenly spaced times of the rows; in between contacts are known to about 0.01 ms.
    """
    touching = contacts(replayed, moves)
    if not len(touching.a):
        return []
    involved = np.isin(np.arange(len(ids)), np.concatenate([touching.a, touching.b]))
    grown = replace(source, size_m=source.size_m + np.array([SCENARIO_MARGIN_M, SCENARIO_MARGIN_M, 0.0]))
    known = contacts(grown, moves, involved)
    velocity = np.stack(replayed.velocities(spacing_s(t_s)))
    rows = np.arange(len(t_s), dtype=np.float64)
    own_contacts = _by_pair(known)
    events: list[dict[str, Any]] = []
    for (a, b), contact in _by_pair(touching).items():
        own_s = np.interp(own_contacts.get((a, b), np.zeros((2, 0))), rows, t_s)
        together = max(replayed.first_row[a], replayed.first_row[b])
        for begin_row, end_row in _merged_contacts(contact, SAME_CONTACT_S / spacing_s(t_s)):
            begin, end = np.interp([begin_row, end_row], rows, t_s)
            own = (own_s[0] <= end + SCENARIO_WINDOW_S) & (own_s[1] >= begin - SCENARIO_WINDOW_S)
            events.append(
                {
                    "agents": [ids[a], ids[b]],
                    "t_s": round(float(begin), 6),
                    "until_s": round(float(end), 6),
                    "relative_speed_mps": round(_relative_speed(velocity, begin_row, a, b), 3),
                    "belongs_to": source_kind if own.any() else REPLAY,
                    "in_log": bool(own.any()),
                    "from_start": bool(begin_row == together),
                }
            )
    return sorted(events, key=lambda e: (e["t_s"], e["agents"]))


def _by_pair(found: Contacts) -> dict[tuple[int, int], Array]:
    """Group first and last rows (2, K) of contacts by pair, in order of time."""
    found = found.take(np.lexsort((found.first_row, found.b, found.a)))
    new = np.flatnonzero((np.diff(found.a) != 0) | (np.diff(found.b) != 0)) + 1
    rows = np.split(np.stack([found.first_row, found.last_row]), new, axis=1)
    begins = np.concatenate([[0], new])[: len(found.a)]
    return dict(zip(zip(found.a[begins].tolist(), found.b[begins].tolist()), rows))


def _merged_contacts(contact: Array, gap: float) -> list[tuple[float, float]]:
    """Return begin and end of contacts (2, K), merging those at most `gap` apart."""
    first, last = contact
    new = np.flatnonzero(first[1:] - last[:-1] > gap) + 1
    return [(float(f[0]), float(t[-1])) for f, t in zip(np.split(first, new), np.split(last, new))]


def _relative_speed(velocity: Array, row: float, a: int, b: int) -> float:
    """Interpolate the relative speed at a fractional row, from velocities (2, S, A)."""
    k = int(row)
    after = min(k + 1, velocity.shape[1] - 1)
    now, then = (velocity[:, r, b] - velocity[:, r, a] for r in (k, after))
    return float(np.hypot(*(now if np.isnan(then).any() else now + (row - k) * (then - now))))
