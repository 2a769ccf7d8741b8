"""Labeled 3D boxes at the stamp of a frame, from the stamps at which they were drawn, without their ids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array, rectangles_overlap, wrap_angle

MAX_AGE_S = 0.055  # a box without a partner on the other side of the frame is used up to this age
MAX_WINDOW_S = 1.1  # labels at 1 Hz and denser are interpolated
SCATTERED_S = 0.03  # labels closer in time than any sensor's period carry a stamp each
SCATTERED_WINDOW_S = 0.15  # then the sensor turns at 10 Hz, give or take the object's own motion
MAX_SPEED_MPS = 50.0
SIZE_WEIGHT = 3.0


@dataclass(frozen=True, eq=False)
class Boxes:
    """Boxes in the map frame: `t_ns` (L,), `category` (L,), `center_m` (L, 3), `size_m` (L, 3), `yaw_rad` (L,)."""

    t_ns: NDArray[np.int64]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array

    def take(self, index: NDArray[np.intp]) -> Boxes:
        """The rows at `index`."""
        return Boxes(
            self.t_ns[index], self.category[index], self.center_m[index], self.size_m[index], self.yaw_rad[index]
        )


def window_ns(t_ns: NDArray[np.int64]) -> int:
    """How far from a frame its labels are looked for: one period of theirs.

    Notes
    -----
    Some logs stamp all boxes of a sweep alike, others each by its own points. The latter leave no period to be seen.
    """
    stamps = np.unique(t_ns)
    period_s = float(np.median(np.diff(stamps))) / NS_PER_S if len(stamps) > 1 else 0.0
    if period_s < SCATTERED_S:
        return round(SCATTERED_WINDOW_S * NS_PER_S)
    return round(min(1.05 * period_s, MAX_WINDOW_S) * NS_PER_S)


def boxes_at(boxes: Boxes, t_ns: int, window: int) -> Boxes:
    """Boxes at a stamp: interpolated between the last one before and the first one after it.

    Parameters
    ----------
    boxes
        Boxes of all stamps in rising order.
    window
        From `window_ns`.

    Notes
    -----
    Partners before and after are mutual nearest neighbors in place and size: at 10 Hz a car at 15 m/s is 0.75 m off
    between two stamps. A box without a partner is new or about to leave, and stays where it was while it is young.
    """
    low, here, high = np.searchsorted(boxes.t_ns, [t_ns - window, t_ns + 1, t_ns + window + 1])
    before = boxes.take(one_of_each(boxes, np.arange(here - 1, low - 1, -1)))
    after = boxes.take(one_of_each(boxes, np.arange(here, high)))
    i, j = mutual_partners(before, after)
    alone_before, alone_after = (
        np.setdiff1d(np.arange(len(before.t_ns)), i),
        np.setdiff1d(np.arange(len(after.t_ns)), j),
    )
    age = round(MAX_AGE_S * NS_PER_S)
    parts = [
        between(before.take(i), after.take(j), t_ns),
        before.take(alone_before[t_ns - before.t_ns[alone_before] <= age]),
        after.take(alone_after[after.t_ns[alone_after] - t_ns <= age]),
    ]
    return Boxes(
        np.full(sum(len(p.t_ns) for p in parts), t_ns, dtype=np.int64),
        np.concatenate([p.category for p in parts]),
        np.concatenate([p.center_m for p in parts]),
        np.concatenate([p.size_m for p in parts]),
        np.concatenate([p.yaw_rad for p in parts]),
    )


def one_of_each(boxes: Boxes, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Rows of `index` without those that stand where an earlier row of it, of another stamp, already stands.

    Notes
    -----
    Two objects never share ground, so boxes of different stamps that overlap are one object seen twice.
    """
    if not len(index):
        return index
    center, size, stamp = boxes.center_m[index, :2], boxes.size_m[index], boxes.t_ns[index]
    reach = np.linalg.norm(size[:, :2], axis=1) / 2
    near = np.linalg.norm(center[:, None] - center, axis=-1) < reach[:, None] + reach
    k, m = np.nonzero(np.tril(near & (stamp[:, None] != stamp), -1))
    yaw, step = boxes.yaw_rad[index], center[m] - center[k]
    shared = rectangles_overlap(step[:, 0], step[:, 1], yaw[k], yaw[m], size[k], size[m])
    earlier = np.zeros(near.shape, dtype=bool)
    earlier[k[shared], m[shared]] = True
    kept = np.ones(len(index), dtype=bool)
    for row in np.flatnonzero(earlier.any(axis=1)):
        kept[row] = not kept[earlier[row]].any()
    return index[kept]


def between(before: Boxes, after: Boxes, t_ns: int) -> Boxes:
    """Boxes at a stamp from pairs of the same object around it; sizes of the nearer one in time."""
    span = (after.t_ns - before.t_ns).astype(np.float64)
    fraction = (t_ns - before.t_ns).astype(np.float64) / span
    center = before.center_m + fraction[:, None] * (after.center_m - before.center_m)
    yaw = wrap_angle(before.yaw_rad + fraction * wrap_angle(after.yaw_rad - before.yaw_rad))
    size = np.where(fraction[:, None] <= 0.5, before.size_m, after.size_m)
    return Boxes(before.t_ns, before.category, center, size, yaw)


def mutual_partners(a: Boxes, b: Boxes) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Indices of boxes in `a` and `b` that are each other's nearest of the same category and can have got there."""
    if not len(a.t_ns) or not len(b.t_ns):
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    distance = np.linalg.norm(a.center_m[:, None] - b.center_m[None], axis=-1)
    cost = distance + SIZE_WEIGHT * np.linalg.norm(a.size_m[:, None] - b.size_m[None], axis=-1)
    reachable = distance <= MAX_SPEED_MPS * np.abs(b.t_ns[None] - a.t_ns[:, None]) / NS_PER_S
    cost = np.where((a.category[:, None] == b.category[None]) & reachable, cost, np.inf)
    partner = np.argmin(cost, axis=1)
    own = np.arange(len(partner))
    mutual = np.isfinite(cost[own, partner]) & (np.argmin(cost, axis=0)[partner] == own)
    return own[mutual], partner[mutual]
