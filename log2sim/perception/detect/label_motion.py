"""Interpolation of labeled 3D boxes to the stamp of a camera frame, without their track ids."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array, period_of, rectangles_overlap, wrap_angle

# A box without a partner on the other side of the frame is used up to this age: half a period of 10 Hz and some.
MAX_AGE_S = 0.055
# Labels at 1 Hz and denser are interpolated.
MAX_WINDOW_S = 1.1
# Labels closer in time than the period of any sensor carry a stamp each; then the sensor turns at 10 Hz.
SCATTERED_S = 0.03
SCATTERED_WINDOW_S = 0.15
# Partners are not farther apart than an object of this speed moves between their stamps.
MAX_SPEED_MPS = 50.0
# A difference in size counts this many times a distance between centers: sizes do not change, places do.
SIZE_WEIGHT = 3.0


@dataclass(frozen=True, eq=False)
class LabelBoxes:
    """Labeled boxes in the map frame.

    Attributes
    ----------
    t_ns : (L,) int64
    category : (L,) str
    center_m : (L, 3) float64
    size_m : (L, 3) float64
        Length, width, height.
    yaw_rad : (L,) float64
    """

    t_ns: NDArray[np.int64]
    category: NDArray[np.str_]
    center_m: Array
    size_m: Array
    yaw_rad: Array

    def take(self, index: NDArray[np.intp]) -> LabelBoxes:
        """Select the rows at `index`."""
        return LabelBoxes(
            self.t_ns[index], self.category[index], self.center_m[index], self.size_m[index], self.yaw_rad[index]
        )


def window_ns(t_ns: NDArray[np.int64]) -> int:
    """Compute the time around a frame in which its labels are searched: one period of the labels, ns.

    Notes
    -----
    Some logs stamp all boxes of a sweep alike, others each by its own points, from which no period can be read.
    """
    stamps = np.unique(t_ns)
    period_s = period_of(stamps)
    if period_s < SCATTERED_S:
        return round(SCATTERED_WINDOW_S * NS_PER_S)
    return round(min(1.05 * period_s, MAX_WINDOW_S) * NS_PER_S)


def interpolate_boxes(boxes: LabelBoxes, t_ns: int, window: int) -> LabelBoxes:
    """Interpolate boxes to a stamp, between the last one before and the first one after it.

    Parameters
    ----------
    boxes
        Boxes of all stamps in ascending order.
    window
        From `window_ns`.

    Notes
    -----
    Partners before and after are mutual nearest neighbors in place and size: without interpolation a car at 15 m/s is
    0.75 m off between two stamps at 10 Hz. A box without a partner is kept in its place up to `MAX_AGE_S`.
    """
    low, here, high = np.searchsorted(boxes.t_ns, [t_ns - window, t_ns + 1, t_ns + window + 1])
    before = boxes.take(drop_repeated_objects(boxes, np.arange(here - 1, low - 1, -1)))
    after = boxes.take(drop_repeated_objects(boxes, np.arange(here, high)))
    i, j = mutual_nearest(before, after)
    alone_before, alone_after = (
        np.setdiff1d(np.arange(len(before.t_ns)), i),
        np.setdiff1d(np.arange(len(after.t_ns)), j),
    )
    age = round(MAX_AGE_S * NS_PER_S)
    parts = [
        interpolate_pairs(before.take(i), after.take(j), t_ns),
        before.take(alone_before[t_ns - before.t_ns[alone_before] <= age]),
        after.take(alone_after[after.t_ns[alone_after] - t_ns <= age]),
    ]
    return LabelBoxes(
        np.full(sum(len(p.t_ns) for p in parts), t_ns, dtype=np.int64),
        np.concatenate([p.category for p in parts]),
        np.concatenate([p.center_m for p in parts]),
        np.concatenate([p.size_m for p in parts]),
        np.concatenate([p.yaw_rad for p in parts]),
    )


def drop_repeated_objects(boxes: LabelBoxes, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Drop rows of `index` that overlap an earlier row of another stamp: the same object once more.

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


def interpolate_pairs(before: LabelBoxes, after: LabelBoxes, t_ns: int) -> LabelBoxes:
    """Interpolate pairs of boxes of the same object to a stamp; sizes are those of the nearer one in time."""
    span = (after.t_ns - before.t_ns).astype(np.float64)
    fraction = (t_ns - before.t_ns).astype(np.float64) / span
    center = before.center_m + fraction[:, None] * (after.center_m - before.center_m)
    yaw = wrap_angle(before.yaw_rad + fraction * wrap_angle(after.yaw_rad - before.yaw_rad))
    size = np.where(fraction[:, None] <= 0.5, before.size_m, after.size_m)
    return LabelBoxes(before.t_ns, before.category, center, size, yaw)


def mutual_nearest(a: LabelBoxes, b: LabelBoxes) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Find the indices of boxes in `a` and `b` that are mutual nearest neighbors of one category and within reach."""
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
