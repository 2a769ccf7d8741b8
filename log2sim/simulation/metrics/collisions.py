"""Contacts of oriented boxes over time, exact between stored states, and the collisions that they form."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.errors import ScenarioError
from log2sim.geometry import Array, rectangles_overlap, separating_axes, wrap_angle
from log2sim.simulation.vehicles.vehicle import Columns

# A step that differs from both neighboring steps by more is a discontinuity: at 20 Hz it would take 400 m/s2.
DISCONTINUITY_M = 1.0

RowIndex = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class BoxTracks:
    """Boxes of A agents at S times; between two rows a box moves straight and turns evenly.

    `x_m`, `y_m`, `z_m` (S, A), m: box centers; NaN where an agent is absent. `yaw_rad`, `speed_mps` (S, A). `size_m`
    (A, 3).
    """

    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    size_m: Array

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Where an agent is present (S, A)."""
        return ~np.isnan(self.x_m)

    @cached_property
    def radius_m(self) -> Array:
        """Radius of the circle around each footprint (A,)."""
        return np.hypot(self.size_m[:, 0], self.size_m[:, 1]) / 2

    @cached_property
    def first_row(self) -> RowIndex:
        """First row (A,) with the agent; 0 where there is none."""
        return np.argmax(self.present, axis=0) if len(self.x_m) else np.zeros(len(self.size_m), dtype=np.intp)

    @cached_property
    def last_row(self) -> RowIndex:
        """Last row (A,) with the agent; the last of all where there is none."""
        if not len(self.x_m):
            return np.full(len(self.size_m), -1, dtype=np.intp)
        result: RowIndex = len(self.x_m) - 1 - np.argmax(self.present[::-1], axis=0)
        return result

    @cached_property
    def moves_on(self) -> NDArray[np.bool_]:
        """Where an agent moves continuously from a row to the next (S, A): it is present at both, without a discontinuity."""
        on = np.zeros(self.x_m.shape, dtype=bool)
        if len(on) > 1:
            step = np.diff(self.x_m, axis=0) + 1j * np.diff(self.y_m, axis=0)
            change = np.abs(np.diff(step, axis=0))
            nowhere = np.full((1, step.shape[1]), np.nan)
            least = np.fmin(np.concatenate([nowhere, change]), np.concatenate([change, nowhere]))
            on[:-1] = ~np.isnan(step) & ~(least > DISCONTINUITY_M)
        return on

    def velocities(self, spacing_s: float) -> tuple[Array, Array]:
        """Return the velocity on map axes (S, A) twice, NaN where absent: the mean of the steps before and after a row.

        An agent with neither step moves along its heading at its speed.
        """
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (
            self._rates(self.x_m, self.speed_mps * cos, spacing_s),
            self._rates(self.y_m, self.speed_mps * sin, spacing_s),
        )

    def climbs(self, spacing_s: float) -> Array:
        """Return the vertical velocity (S, A) likewise; 0 for an agent with neither step."""
        return self._rates(self.z_m, np.zeros(self.z_m.shape), spacing_s)

    def _rates(self, values: Array, alone: Array, spacing_s: float) -> Array:
        after = np.full(values.shape, np.nan)
        after[:-1] = np.where(self.moves_on[:-1], np.diff(values, axis=0) / spacing_s, np.nan)
        before = np.concatenate([after[-1:] * np.nan, after[:-1]])
        mean = np.where(np.isnan(after), before, np.where(np.isnan(before), after, (after + before) / 2))
        return np.where(np.isnan(mean) & self.present, alone, mean)

    def poses(self, row: Array | RowIndex, agent: RowIndex) -> tuple[Array, Array, Array, Array]:
        """Return x, y, z and yaw (N,) of agents (N,) at fractional rows (N,) within their lifetimes."""
        k = np.floor(row).astype(np.intp)
        fraction = np.where(self.moves_on[k, agent], row - k, 0.0)
        after = np.minimum(k + 1, len(self.x_m) - 1)
        x, y, z = (
            c[k, agent] + np.where(fraction > 0, fraction * (c[after, agent] - c[k, agent]), 0.0)
            for c in (self.x_m, self.y_m, self.z_m)
        )
        turn = wrap_angle(self.yaw_rad[after, agent] - self.yaw_rad[k, agent])
        return x, y, z, self.yaw_rad[k, agent] + np.where(fraction > 0, fraction * turn, 0.0)

    def overlap(self, row_a: Array | RowIndex, a: RowIndex, row_b: Array | RowIndex, b: RowIndex) -> NDArray[np.bool_]:
        """Whether box a at its row overlaps box b at its own row (N,)."""
        xa, ya, za, yaw_a = self.poses(row_a, a)
        xb, yb, zb, yaw_b = self.poses(row_b, b)
        size_a, size_b = self.size_m[a], self.size_m[b]
        vertical = np.abs(zb - za) < (size_a[:, 2] + size_b[:, 2]) / 2
        return vertical & rectangles_overlap(xb - xa, yb - ya, yaw_a, yaw_b, size_a, size_b)


def spacing_s(t_s: Array) -> float:
    """Return the spacing of evenly spaced times (S,); 1 for a single time."""
    return float(t_s[1] - t_s[0]) if len(t_s) > 1 else 1.0


MAX_STEPS = 64  # most steps in an interval; a contact shorter than one step, 0.8 ms of 50 ms, may be missed
BISECTIONS = 8  # of the last step: 3 us of 50 ms


@dataclass(frozen=True, eq=False)
class RelativeMotion(Columns):
    """Relative motion of N pairs of boxes over an interval."""

    apart_m: Array  # (3, N) from box a to box b at the begin
    change_m: Array  # (3, N) of that over the interval
    yaw_rad: Array  # (2, N) of a and b at the begin
    turn_rad: Array  # (2, N) change of these over the interval
    size_a_m: Array  # (3, N)
    size_b_m: Array

    def reversed(self) -> RelativeMotion:
        """Return the motion from the end to the begin."""
        yaw, apart = self.yaw_rad + self.turn_rad, self.apart_m + self.change_m
        return RelativeMotion(apart, -self.change_m, yaw, -self.turn_rad, self.size_a_m, self.size_b_m)

    def may_touch(self) -> NDArray[np.bool_]:
        """Whether the circles around the footprints meet (N,)."""
        reach = (np.hypot(*self.size_a_m[:2]) + np.hypot(*self.size_b_m[:2])) / 2
        (dx, dy, _), (vx, vy, _) = self.apart_m, self.change_m
        return circles_meet(dx, dy, vx, vy, reach, 0.0, 1.0)

    def free_for(self, u: Array) -> Array:
        """Return the share of the interval (N,) for which boxes certainly stay apart after the shares `u` (N,); 0 in overlap.

        Along an axis of a box the gap shrinks at most at the speed along it plus the contributions of both turns. The
        largest of these bounds, over the axes with a gap, is safe. Boxes that only touch return the smallest positive
        number.
        """
        (vx, vy, vz), (dx, dy, dz) = self.change_m, self.apart_m + u * self.change_m
        distance = np.hypot(dx, dy) + 2 * np.hypot(vx, vy) * (1.0 - u)
        yaw_a, yaw_b = self.yaw_rad + u * self.turn_rad
        spin_a, spin_b = np.abs(self.turn_rad)
        relative = np.abs(self.turn_rad[1] - self.turn_rad[0]) / 2
        radius_a, radius_b = (np.hypot(*size[:2]) for size in (self.size_a_m, self.size_b_m))
        free = _gap_duration(np.abs(dz) - (self.size_a_m[2] + self.size_b_m[2]) / 2, np.abs(vz))
        for nx, ny, reach, of_a in separating_axes(yaw_a, yaw_b, self.size_a_m.T, self.size_b_m.T):
            spin, radius = (spin_a, radius_b) if of_a else (spin_b, radius_a)
            rate = np.abs(vx * nx + vy * ny) + spin * distance + relative * radius
            free = np.maximum(free, _gap_duration(np.abs(dx * nx + dy * ny) - reach, rate))
        return free


def circles_meet(
    dx: Array, dy: Array, vx: Array, vy: Array, reach: Array, begin_s: float, end_s: float
) -> NDArray[np.bool_]:
    """Whether points that are dx, dy apart and move by vx, vy come nearer than `reach` (N,) between two times."""
    square, closing = vx * vx + vy * vy, -(dx * vx + dy * vy)
    t = np.clip(np.divide(closing, square, out=np.zeros_like(square), where=square > 0), begin_s, end_s)
    return np.asarray((dx + t * vx) ** 2 + (dy + t * vy) ** 2 <= reach**2)


def first_contact(motion: RelativeMotion) -> Array:
    """Return the share of the interval (N,) after which the boxes first overlap, NaN where they do not.

    Conservative advancement (Mirtich, 1996) with separating axes in place of a distance: every step is as long as the
    boxes certainly stay apart, but at least 1 / `MAX_STEPS`; the last step is bisected.
    """
    touch = np.full(motion.apart_m.shape[1], np.nan)
    active = np.flatnonzero(motion.may_touch())
    before = u = np.zeros(len(active))
    while len(active):
        moving = motion.take(active)
        free = moving.free_for(u)
        hit = free == 0
        met, apart, overlapping = moving.take(hit), before[hit], u[hit]
        for _ in range(BISECTIONS if hit.any() else 0):
            middle = (apart + overlapping) / 2
            inside = met.free_for(middle) == 0
            apart, overlapping = np.where(inside, apart, middle), np.where(inside, middle, overlapping)
        touch[active[hit]] = overlapping
        on = ~hit & (u < 1) & (u + free < 1)
        active, before, step = active[on], u[on], np.maximum(free[on], 1 / MAX_STEPS)
        u = np.minimum(before + step, 1.0)
    return touch


def _gap_duration(gap: Array, rate: Array) -> Array:
    """Return how long (N,) a gap lasts that shrinks at a rate; 0 without a gap, inf for a constant one."""
    lasts = np.divide(gap, rate, out=np.full(len(gap), np.inf), where=rate > 0)
    return np.where(gap < 0, 0.0, np.maximum(lasts, np.finfo(float).tiny))


CHUNK = 20  # rows in one broad phase
BATCH = 100_000  # pairs evaluated together, which bounds memory
MAX_PAIRS = 50_000  # pairs of agents whose motion over `CHUNK` rows is compared at once: a million rows
# Contacts that are kept, some 80 MB: a thousand pairs that overlap for 100 s. More are no traffic.
MAX_CONTACTS = 2_000_000

SAME_CONTACT_S = 0.5  # contacts of a pair that are closer in time form one collision
SCENARIO_WINDOW_S = 0.5  # the scenario has a collision itself when its boxes overlap within this time of it,
SCENARIO_MARGIN_M = 0.1  # or pass with a smaller gap than this, which is below the errors of boxes

# Whose a collision is: new in the replay; or of the scenario, whose own boxes overlap, by its kind.
REPLAY, RECONSTRUCTION, SCENARIO = "replay", "reconstruction", "scenario"


@dataclass(frozen=True, eq=False)
class Contacts(Columns):
    """Contacts (N,) of boxes a < b."""

    a: RowIndex
    b: RowIndex
    first_row: Array  # fractional rows of the first and last overlap within one step
    last_row: Array


def contacts(boxes: BoxTracks, moves: NDArray[np.bool_], only: NDArray[np.bool_] | None = None) -> Contacts:
    """Find contacts of two boxes of which at least one moves, a step at a time; `only` (A,) restricts the agents.

    Broad phase: axis-aligned hulls of the circles about the boxes over `CHUNK` rows, sorted. Narrow phase: `first_contact`,
    forward for the first overlap and backward for the last. Where an agent does not move continuously, the boxes are compared
    at the row alone. Cost: A log A and the pairs in reach, a chunk.

    Raises `ScenarioError` for more than `MAX_CONTACTS`, of agents that lie on top of each other.
    """
    found, count = [Contacts(*np.zeros((2, 0), dtype=np.intp), *np.zeros((2, 0)))], 0
    for k, a, b in _candidates(boxes, moves, only):
        motion = _relative_motion(boxes, k, a, b)
        first = first_contact(motion)
        hit = np.flatnonzero(~np.isnan(first))
        k, a, b, first = k[hit], a[hit], b[hit], first[hit]
        on = boxes.moves_on[k, a] & boxes.moves_on[k, b]
        last = np.where(on, 1.0 - first_contact(motion.take(hit).reversed()), 0.0)
        found.append(Contacts(a, b, k + first, k + np.fmax(first, last)))
        count += len(found[-1].a)
        if count > MAX_CONTACTS:
            raise ScenarioError(
                f"{len(boxes.size_m)} agents touch in more than {MAX_CONTACTS} pairs and steps: they lie on top of each other; "
                "remove those that are no traffic"
            )
    return Contacts(*(np.concatenate([getattr(f, c) for f in found]) for c in ("a", "b", "first_row", "last_row")))


def _candidates(
    boxes: BoxTracks, moves: NDArray[np.bool_], only: NDArray[np.bool_] | None
) -> Iterator[NDArray[np.intp]]:
    """Yield rows and pairs (3, N) that may touch before the next row, some `BATCH` at a time."""
    waiting, count = [np.zeros((3, 0), dtype=np.intp)], 0
    for begin in range(0, len(boxes.x_m), CHUNK):
        rows = slice(begin, begin + CHUNK + 1)
        present = boxes.present[begin : begin + CHUNK]
        for i, j in _overlapping_hulls(boxes.x_m[rows], boxes.y_m[rows], boxes.radius_m, moves, only):
            row, pair = np.nonzero(present[:, i] & present[:, j])
            k, a, b = row + begin, i[pair], j[pair]
            near = _relative_motion(boxes, k, a, b).may_touch()
            waiting.append(np.stack([k, a, b])[:, near])
            count += waiting[-1].shape[1]
            if count >= BATCH:
                joined = np.concatenate(waiting, axis=1)
                yield from (joined[:, first : first + BATCH] for first in range(0, count, BATCH))
                waiting, count = waiting[:1], 0
    yield np.concatenate(waiting, axis=1)


def _relative_motion(boxes: BoxTracks, k: RowIndex, a: RowIndex, b: RowIndex) -> RelativeMotion:
    """Return the motion of pairs (N,) from rows to the next; none where one of them does not move continuously."""
    after = np.where(boxes.moves_on[k, a] & boxes.moves_on[k, b], k + 1, k)
    centers = (boxes.x_m, boxes.y_m, boxes.z_m)
    apart, then = (np.stack([c[row, b] - c[row, a] for c in centers]) for row in (k, after))
    yaw = np.stack([boxes.yaw_rad[k, a], boxes.yaw_rad[k, b]])
    turn = wrap_angle(np.stack([boxes.yaw_rad[after, a], boxes.yaw_rad[after, b]]) - yaw)
    return RelativeMotion(apart, then - apart, yaw, turn, boxes.size_m[a].T, boxes.size_m[b].T)


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
        first, last = contact
        new = np.flatnonzero(first[1:] - last[:-1] > SAME_CONTACT_S / spacing_s(t_s)) + 1
        for begin_row, end_row in ((f[0], t[-1]) for f, t in zip(np.split(first, new), np.split(last, new))):
            begin, end = np.interp([begin_row, end_row], rows, t_s)
            k = int(begin_row)
            now, then = (velocity[:, r, b] - velocity[:, r, a] for r in (k, min(k + 1, len(t_s) - 1)))
            relative = now if np.isnan(then).any() else now + (begin_row - k) * (then - now)
            own = (own_s[0] <= end + SCENARIO_WINDOW_S) & (own_s[1] >= begin - SCENARIO_WINDOW_S)
            events.append({
                "agents": [ids[a], ids[b]], "t_s": round(float(begin), 6), "until_s": round(float(end), 6),
                "relative_speed_mps": round(float(np.hypot(*relative)), 3),
                "belongs_to": source_kind if own.any() else REPLAY, "in_log": bool(own.any()),
                "from_start": bool(begin_row == together),
            })  # fmt: skip
    return sorted(events, key=lambda e: (e["t_s"], e["agents"]))


def _by_pair(found: Contacts) -> dict[tuple[int, int], Array]:
    """Group first and last rows (2, K) of contacts by pair, in order of time."""
    found = found.take(np.lexsort((found.first_row, found.b, found.a)))
    new = np.flatnonzero((np.diff(found.a) != 0) | (np.diff(found.b) != 0)) + 1
    rows = np.split(np.stack([found.first_row, found.last_row]), new, axis=1)
    begins = np.concatenate([[0], new])[: len(found.a)]
    return dict(zip(zip(found.a[begins].tolist(), found.b[begins].tolist()), rows))
