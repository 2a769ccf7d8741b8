"""Stitching: tracklets that an occlusion cut in pieces become one track again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array
from log2sim.track.motion import ACCELERATION_MPS2, FIRST_SPEED_MPS, measurement_noise, predict, update
from log2sim.types import GROUP_OF, Measurements, Track

GATE = 13.8
# Where both ends could meet anywhere within this (one sigma), meeting proves nothing.
VAGUE_M = 2.0
# An object that stands still is the same object however long it was hidden, if it stands where it stood.
STANDING_MPS = 0.5
STANDING_APART_M = 1.0


@dataclass(frozen=True, eq=False)
class _Ends:
    """State (4,) and covariance (4, 4) of a track at both of its ends, from one filter pass in each direction."""

    first_ns: int
    last_ns: int
    first: tuple[Array, Array]
    last: tuple[Array, Array]
    group: str


def stitch(tracks: Sequence[Track], t_ns: NDArray[np.int64], *, max_gap_s: float) -> list[Track]:
    """Join tracks whose ends meet, cheapest pairs first, until nothing meets any more.

    Both ends are carried to the middle of the gap with the uncertainty that the gap adds, and must agree there in place
    and speed.
    """
    from scipy.optimize import linear_sum_assignment

    current = list(tracks)
    while len(current) > 1:
        ends = [_ends(t, t_ns) for t in current]
        cost = np.full((len(current), len(current)), 1e6)
        for i, a in enumerate(ends):
            for j, b in enumerate(ends):
                if i != j and a.group == b.group and b.first_ns > a.last_ns:
                    cost[i, j] = _meeting_cost(a, b, max_gap_s)
        pairs = [(int(i), int(j)) for i, j in zip(*linear_sum_assignment(cost)) if cost[i, j] < 1e6]
        if not pairs:
            break
        following = dict(pairs)
        heads = [i for i in range(len(current)) if i not in following.values()]
        joined = []
        for head in heads:
            chain = [head]
            while chain[-1] in following:
                chain.append(following[chain[-1]])
            joined.append(_concatenate([current[k] for k in chain]))
        current = joined
    return current


def _meeting_cost(a: _Ends, b: _Ends, max_gap_s: float) -> float:
    gap_s = (b.first_ns - a.last_ns) / NS_PER_S
    standing = max(np.hypot(*a.last[0][2:]), np.hypot(*b.first[0][2:])) < STANDING_MPS
    if standing and np.hypot(*(a.last[0] - b.first[0])[:2]) < STANDING_APART_M:
        return float(np.hypot(*(a.last[0] - b.first[0])[:2]))
    if gap_s > max_gap_s:
        return 1e6
    noise = np.array([ACCELERATION_MPS2[a.group]])
    forward = predict(a.last[0][None], a.last[1][None], gap_s / 2, noise)
    backward = predict(b.first[0][None], b.first[1][None], -gap_s / 2, noise)
    difference, covariance = (forward[0] - backward[0])[0], (forward[1] + backward[1])[0]
    if np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]) > VAGUE_M:
        return 1e6
    squared = float(difference @ np.linalg.solve(covariance, difference))
    # 4 degrees of freedom; an uncertain meeting must not win over a sure one, hence the determinant.
    return squared + float(np.log(np.linalg.det(covariance[:2, :2]))) + 10.0 if squared <= GATE * 1.35 else 1e6


def _ends(track: Track, t_ns: NDArray[np.int64]) -> _Ends:
    group = GROUP_OF[track.category]
    m = track.measurements
    return _Ends(
        int(m.t_ns[0]), int(m.t_ns[-1]), _filtered(m, group, reverse=True), _filtered(m, group, reverse=False), group
    )


def _filtered(m: Measurements, group: str, *, reverse: bool) -> tuple[Array, Array]:
    """Filter state at the last measurement in the given direction of time."""
    order = np.arange(len(m))[::-1] if reverse else np.arange(len(m))
    # What lies seconds back says nothing about the end; the filter has forgotten it.
    order = order[-20:]
    r = measurement_noise(m.covariance[order], np.full(len(order), group))
    mean = np.r_[m.center_m[order[0], :2], 0.0, 0.0][None]
    covariance = np.zeros((1, 4, 4))
    covariance[0, :2, :2] = r[0]
    covariance[0, 2, 2] = covariance[0, 3, 3] = FIRST_SPEED_MPS[group] ** 2
    noise, zero = np.array([ACCELERATION_MPS2[group]]), np.zeros(1)
    for k in range(1, len(order)):
        dt = (m.t_ns[order[k]] - m.t_ns[order[k - 1]]) / NS_PER_S
        mean, covariance = predict(mean, covariance, float(dt), noise)
        mean, covariance = update(mean, covariance, m.center_m[order[k : k + 1], :2], r[k : k + 1], zero)
    return mean[0], covariance[0]


def _concatenate(parts: Sequence[Track]) -> Track:
    if len(parts) == 1:
        return parts[0]
    m = Measurements.join([p.measurements for p in parts])
    return Track(category_of(m), np.concatenate([p.tick for p in parts]), m)


def category_of(m: Measurements) -> str:
    """The category that got most of the score over a track's life; ties go to the first by name."""
    votes = {str(c): float(m.score[m.category == c].sum()) for c in np.unique(m.category)}
    return max(sorted(votes), key=lambda c: votes[c])
