"""Forward tracking: measurements of every tick assigned to constant-velocity tracks in the map frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import NS_PER_S, Array
from log2sim.track.motion import (
    ACCELERATION_MPS2,
    FIRST_SPEED_MPS,
    innovation,
    measurement_noise,
    predict,
    update,
)
from log2sim.types import GROUP_OF, Measurements

# 99.9 % of the squared Mahalanobis distance with 2 degrees of freedom.
GATE = 13.8
NOT_ALLOWED = 1e6
# A rider is taken for a pedestrian now and then and the other way round; it costs as much as 2.4 sigma.
OTHER_GROUP_COST = 6.0
RELATED = {("pedestrian", "two_wheeler"), ("two_wheeler", "pedestrian")}
TENTATIVE_HITS = 3
TENTATIVE_AGE_S = 0.45
CONFIRMED_AGE_S = 1.2


@dataclass(eq=False)
class Tracklet:
    """A growing track: what it was given, its state at the last of it, and when that was."""

    mean: Array
    covariance: Array
    group: str
    last_ns: int
    ticks: list[int] = field(default_factory=list)
    rows: list[int] = field(default_factory=list)


def track_forward(
    measurements: Sequence[Measurements], t_ns: NDArray[np.int64], *, birth_score: float
) -> list[Tracklet]:
    """Assign the measurements of T ticks (stamps (T,)) to tracklets.

    Those with a score of at least `birth_score` may start a track; weaker ones only continue one (Zhang et al.,
    "ByteTrack", ECCV 2022), after the strong ones had their choice.
    """
    alive: list[Tracklet] = []
    done: list[Tracklet] = []
    for tick, found in enumerate(measurements):
        placed = np.flatnonzero(found.source != "")
        now = int(t_ns[tick])
        still = [t for t in alive if (now - t.last_ns) / NS_PER_S <= _patience(t)]
        done += [t for t in alive if t not in still]
        alive = still
        columns = _Columns(found, placed, now)
        means, covariances = _predicted(alive, now)
        strong = found.score[placed] >= birth_score
        taken_tracks: set[int] = set()
        taken_rows: set[int] = set()
        for stage in (strong, ~strong):
            rows = np.array([k for k in np.flatnonzero(stage) if k not in taken_rows], dtype=np.intp)
            free = np.array([k for k in range(len(alive)) if k not in taken_tracks], dtype=np.intp)
            for a, m in _assign(alive, means, covariances, free, columns, rows):
                track = alive[a]
                track.mean, track.covariance = columns.updated(means[a], covariances[a], m)
                track.last_ns = now
                track.ticks.append(tick)
                track.rows.append(int(placed[m]))
                taken_tracks.add(a)
                taken_rows.add(m)
        alive += [columns.born(int(m), tick) for m in np.flatnonzero(strong) if m not in taken_rows]
    return done + alive


class _Columns:
    """The placed measurements of one tick as arrays for the filter."""

    def __init__(self, found: Measurements, placed: NDArray[np.intp], now_ns: int) -> None:
        self.xy = found.center_m[placed, :2]
        self.group = np.array([GROUP_OF[str(c)] for c in found.category[placed]], dtype="<U16")
        self.r = measurement_noise(found.covariance[placed], self.group)
        self.age_s = (found.t_ns[placed] - now_ns) / NS_PER_S
        self.placed = placed
        self.now_ns = now_ns

    def updated(self, mean: Array, covariance: Array, m: int) -> tuple[Array, Array]:
        one = slice(m, m + 1)
        means, covariances = update(mean[None], covariance[None], self.xy[one], self.r[one], self.age_s[one])
        return means[0], covariances[0]

    def born(self, m: int, tick: int) -> Tracklet:
        group = str(self.group[m])
        covariance = np.diag([0, 0, FIRST_SPEED_MPS[group] ** 2, FIRST_SPEED_MPS[group] ** 2]).astype(np.float64)
        covariance[:2, :2] = self.r[m]
        return Tracklet(np.r_[self.xy[m], 0, 0], covariance, group, self.now_ns, [tick], [int(self.placed[m])])


def _patience(track: Tracklet) -> float:
    return CONFIRMED_AGE_S if len(track.ticks) >= TENTATIVE_HITS else TENTATIVE_AGE_S


def _predicted(alive: list[Tracklet], now_ns: int) -> tuple[Array, Array]:
    if not alive:
        return np.zeros((0, 4)), np.zeros((0, 4, 4))
    dt = np.array([(now_ns - t.last_ns) / NS_PER_S for t in alive])
    acceleration = np.array([ACCELERATION_MPS2[t.group] for t in alive])
    return predict(np.array([t.mean for t in alive]), np.array([t.covariance for t in alive]), dt, acceleration)


def _assign(
    alive: list[Tracklet], means: Array, covariances: Array, free: NDArray[Any], columns: _Columns, rows: NDArray[Any]
) -> list[tuple[int, int]]:
    """Pairs (track, row) of the cheapest assignment inside the gate; cost is the negative log-likelihood."""
    from scipy.optimize import linear_sum_assignment

    if len(free) == 0 or len(rows) == 0:
        return []
    squared, log_determinant = innovation(
        means[free], covariances[free], columns.xy[rows], columns.r[rows], columns.age_s[rows]
    )
    groups = np.array([alive[a].group for a in free])
    other = groups[:, None] != columns.group[rows][None, :]
    related = np.array([[(a, b) in RELATED for b in columns.group[rows]] for a in groups])
    cost = squared + log_determinant + np.where(other, OTHER_GROUP_COST, 0.0)
    allowed = (squared <= GATE) & (~other | related)
    a, m = linear_sum_assignment(np.where(allowed, cost, NOT_ALLOWED))
    return [(int(free[i]), int(rows[j])) for i, j in zip(a, m) if allowed[i, j]]
