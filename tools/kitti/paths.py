"""Smoothed states of tracks at every tick: the tracker's filter forward, then backward, all tracks at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import GROUP_OF, Measurements, Track
from log2sim.geometry import NS_PER_S, Array
from log2sim.tracking.forward import ACCELERATION_MPS2, first_velocity, measurement_noise, predict, update


@dataclass(frozen=True, eq=False)
class Paths:
    """Smoothed states, one row a track and tick, sorted by track."""

    track: NDArray[np.int64]  # (N,)
    tick: NDArray[np.int64]  # (N,)
    row: NDArray[np.int64]  # (N,): row of the measurement in the track, -1 in a gap
    mean: Array  # (N, 4): x, y, vx, vy in the map
    covariance: Array  # (N, 4, 4)


def smooth_paths(
    tracks: Sequence[Track],
    t_ns: NDArray[np.int64],
    *,
    whole_boxes: bool = False,
    beyond: NDArray[np.int64] | None = None,
) -> Paths:
    """Estimate the states of all tracks at all ticks from their first to their last measurement.

    Each is carried on at both ends by `beyond` (A,) ticks, as far as there are ticks.

    Kalman filter and Rauch-Tung-Striebel smoother. All tracks are processed in parallel, each from its own first tick on, so
    the number of steps is the length of the longest track.
    """
    if not tracks:
        none = np.zeros(0, dtype=np.int64)
        return Paths(none, none, none, np.zeros((0, 4)), np.zeros((0, 4, 4)))
    first = np.array([t.tick[0] for t in tracks])
    length = np.array([t.tick[-1] for t in tracks]) - first + 1
    start = np.cumsum(length) - length
    track = np.repeat(np.arange(len(tracks)), length)
    tick = np.arange(length.sum()) - start[track] + first[track]
    row = np.full(len(track), -1, dtype=np.int64)
    for k, t in enumerate(tracks):
        row[start[k] + t.tick - first[k]] = np.arange(len(t))
    grid = _Grid(tracks, start, length, np.asarray(t_ns, dtype=np.int64)[tick], row, whole_boxes=whole_boxes)
    paths = Paths(track, tick, row, *grid.smooth())
    if beyond is None or not beyond.any():
        return paths
    step = np.arange(beyond.sum()) - np.repeat(np.cumsum(beyond) - beyond, beyond) + 1
    origin = np.concatenate([np.repeat(start + length - 1, beyond), np.repeat(start, beyond)])
    return _extended(paths, origin, np.concatenate([step, -step]), grid.noise, t_ns)


def _extended(
    paths: Paths, origin: NDArray[np.int64], step: NDArray[np.int64], noise: Array, t_ns: NDArray[np.int64]
) -> Paths:
    """Add to the paths rows predicted `step` (K,) ticks from the rows `origin` (K,), in the order of tracks and ticks."""
    tick = paths.tick[origin] + step
    there = (tick >= 0) & (tick < len(t_ns))
    origin, tick = origin[there], tick[there]
    dt_s = (t_ns[tick] - t_ns[paths.tick[origin]]) / NS_PER_S
    mean, covariance = predict(paths.mean[origin], paths.covariance[origin], dt_s, noise[paths.track[origin]])
    track = np.concatenate([paths.track, paths.track[origin]])
    ticks = np.concatenate([paths.tick, tick])
    order = np.lexsort([ticks, track])
    row = np.concatenate([paths.row, np.full(len(tick), -1)])
    means, covariances = np.concatenate([paths.mean, mean]), np.concatenate([paths.covariance, covariance])
    return Paths(track[order], ticks[order], row[order], means[order], covariances[order])


class _Grid:
    """Measurements of all tracks laid out by tick, `start` (A,) and `length` (A,) of every track's rows."""

    def __init__(
        self, tracks: Sequence[Track], start: NDArray[np.int64], length: NDArray[np.int64], t_ns: NDArray[np.int64],
        row: NDArray[np.int64], *, whole_boxes: bool,
    ) -> None:  # fmt: skip
        self.start, self.length, self.t_ns = start, length, t_ns
        group = np.array([GROUP_OF[t.category] for t in tracks])
        self.noise = np.array([ACCELERATION_MPS2[g] for g in group.tolist()])
        axis = np.array([t.measurements.yaw_rad[0] if whole_boxes else np.nan for t in tracks])
        self.first_velocity = first_velocity(axis, group)
        m = Measurements.join([t.measurements for t in tracks])
        at = np.flatnonzero(row >= 0)
        self.seen = row >= 0
        self.xy, self.r, self.age_s = np.zeros((len(row), 2)), np.zeros((len(row), 2, 2)), np.zeros(len(row))
        self.xy[at] = m.center_m[:, :2]
        self.r[at] = measurement_noise(
            m.covariance, np.repeat(group, [len(t) for t in tracks]), whole_boxes=whole_boxes
        )
        self.age_s[at] = (m.t_ns - t_ns[at]) / NS_PER_S

    def smooth(self) -> tuple[Array, Array]:
        """Return the smoothed states (N, 4) and covariances (N, 4, 4)."""
        mean, covariance = np.zeros((len(self.xy), 4)), np.zeros((len(self.xy), 4, 4))
        ahead_mean, ahead_covariance = mean.copy(), covariance.copy()
        mean[self.start, :2], covariance[self.start, :2, :2] = self.xy[self.start], self.r[self.start]
        covariance[self.start, 2:, 2:] = self.first_velocity
        dt_s = np.diff(self.t_ns, prepend=0) / NS_PER_S
        longest = int(self.length.max())
        for k in range(1, longest):
            on = np.flatnonzero(self.length > k)
            i = self.start[on] + k
            ahead_mean[i], ahead_covariance[i] = predict(mean[i - 1], covariance[i - 1], dt_s[i], self.noise[on])
            mean[i], covariance[i] = ahead_mean[i], ahead_covariance[i]
            j = i[self.seen[i]]
            if len(j):
                mean[j], covariance[j] = update(mean[j], covariance[j], self.xy[j], self.r[j], self.age_s[j])
        for k in range(longest - 1, 0, -1):
            i = self.start[self.length > k] + k
            step = np.tile(np.eye(4), (len(i), 1, 1))
            step[:, 0, 2] = step[:, 1, 3] = dt_s[i]
            back = np.swapaxes(np.linalg.solve(ahead_covariance[i], step @ covariance[i - 1]), 1, 2)
            mean[i - 1] += (back @ (mean[i] - ahead_mean[i])[:, :, None])[..., 0]
            covariance[i - 1] += back @ (covariance[i] - ahead_covariance[i]) @ np.swapaxes(back, 1, 2)
        return mean, covariance
