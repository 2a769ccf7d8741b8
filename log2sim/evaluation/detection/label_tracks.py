"""Labels along their tracks: where a labeled object was at the moment at which a LiDAR saw it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Labels
from log2sim.geometry import NS_PER_S, Array, wrap_angle

MAX_LAG_NS = 60_000_000
"""A label holds for this time around its stamp: half a period at 10 Hz, and jitter."""
MAX_PERIODS = 1.5
"""Between labels of a track that are farther apart than this many periods the object was not labeled."""


@dataclass(frozen=True, eq=False)
class LabelTracks:
    """Labels in the order of their tracks and stamps.

    Attributes
    ----------
    t_ns : (L,) int64
    pose : (L, 4) float64
        Center x, y, z and yaw.
    size_m : (rows of the log's labels, 3) float64
        In the order of the log.
    row : (L,) int64
        Index in the log's labels.
    first : (K + 1,) int64
        Where each of K tracks begins, and L.
    period_s : float
        Median time between labels of a track; 0 where no track has two.
    """

    t_ns: NDArray[np.int64]
    pose: Array
    size_m: Array
    row: NDArray[np.int64]
    first: NDArray[np.int64]
    period_s: float

    @classmethod
    def of(cls, labels: Labels) -> LabelTracks:
        """Sort labels; of two of one object at one stamp the first is kept."""
        _, track = np.unique(labels.track_id, return_inverse=True)
        order = np.lexsort((labels.t_ns, track))
        t, k = labels.t_ns[order], track[order]
        order = order[np.r_[True, (np.diff(t) > 0) | (np.diff(k) != 0)]]
        t, k = labels.t_ns[order], track[order]
        steps = np.diff(t)[np.diff(k) == 0]
        return cls(
            t,
            np.column_stack([labels.center_m[order], labels.yaw_rad[order]]),
            labels.size_m,
            order.astype(np.int64),
            np.append(np.flatnonzero(np.diff(k, prepend=-1)), len(order)).astype(np.int64),
            float(np.median(steps)) / NS_PER_S if len(steps) else 0.0,
        )

    def present(self, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """List the moments (P,), indices into `t_ns` (F,), and tracks (P,) labeled at them, in the order of moments."""
        moments, tracks = [], []
        for k, (begin, end) in enumerate(zip(self.first[:-1], self.first[1:], strict=True)):
            stamps = self.t_ns[begin:end]
            after = np.searchsorted(stamps, t_ns)
            before_ns = t_ns - stamps[np.maximum(after - 1, 0)]
            after_ns = stamps[np.minimum(after, len(stamps) - 1)] - t_ns
            near = np.minimum(np.abs(before_ns), np.abs(after_ns)) <= MAX_LAG_NS
            gap_s = (before_ns + after_ns) / NS_PER_S
            between = (after > 0) & (after < len(stamps)) & (gap_s <= MAX_PERIODS * self.period_s)
            found = np.flatnonzero(near | between)
            moments.append(found)
            tracks.append(np.full(len(found), k))
        moment, track = np.concatenate(moments), np.concatenate(tracks)
        order = np.argsort(moment, kind="stable")
        return moment[order].astype(np.int64), track[order].astype(np.int64)

    def at(self, track: NDArray[np.int64], t_ns: NDArray[np.int64]) -> tuple[Array, NDArray[np.int64]]:
        """Interpolate tracks (P,) at stamps (P,).

        Returns
        -------
        pose : (P, 4) float64
            Center x, y, z and yaw, on the line through the labels before and after; beyond the ends, and next to a gap, on
            the line through the two nearest ones.
        row : (P,) int64
            Index of the nearest label in the log's labels.
        """
        pose, row = np.empty((len(track), 4)), np.empty(len(track), dtype=np.int64)
        for k in np.unique(track):
            mine = np.flatnonzero(track == k)
            part = slice(self.first[k], self.first[k + 1])
            pose[mine], nearest = _along(self.t_ns[part], self.pose[part], t_ns[mine], self.period_s)
            row[mine] = self.row[part][nearest]
        return pose, row


def _along(
    stamps: NDArray[np.int64], pose: Array, t_ns: NDArray[np.int64], period_s: float
) -> tuple[Array, NDArray[np.intp]]:
    """Interpolate one track with stamps (K,) and poses (K, 4) at times (P,); also the index (P,) of the nearest stamp."""
    nearest = np.abs(stamps - t_ns[:, None]).argmin(axis=1)
    toward = np.where(t_ns >= stamps[nearest], 1, -1)
    linked = np.append(np.diff(stamps) / NS_PER_S <= MAX_PERIODS * period_s, False)
    partner = nearest.copy()
    for step in (-toward, toward):  # the last one that can be had is taken
        there = nearest + step
        usable = (there >= 0) & (there < len(stamps)) & linked[np.minimum(nearest, there)]
        partner = np.where(usable, there, partner)
    span = stamps[partner] - stamps[nearest]
    share = np.divide(t_ns - stamps[nearest], span, out=np.zeros(len(t_ns)), where=span != 0)
    way = pose[partner] - pose[nearest]
    way[:, 3] = wrap_angle(way[:, 3])
    return pose[nearest] + share[:, None] * way, nearest
