"""Poses over time, interpolated on SE(3)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from log2sim.files.documents import short_repr
from log2sim.geometry.transforms import (
    NS_PER_S,
    Array,
    quaternion_from_rotation,
    rotation_from_quaternion,
    slerp,
    transform,
)

# Poses of some logs are 1 ns apart; beyond the ends of a track motion is taken from poses at least this far apart, if there are.
MIN_EXTRAPOLATION_BASE_NS = 10_000_000


@dataclass(frozen=True, eq=False)
class PoseTrack:
    """Poses of the ego over time.

    `t_ns` (P,): strictly increasing absolute stamps. `map_T_ego` (P, 4, 4). `max_gap_s`, s: poses are not interpolated
    between stamps farther apart than this. `extrapolate_s`, s: poses are extrapolated up to this far outside the track.
    `sigma_m`, `sigma_yaw_rad` (P,), optional: standard deviations of the position along each axis, m, and of the yaw, rad;
    None where they are not known.
    """

    __repr__ = short_repr

    t_ns: NDArray[np.int64]
    map_T_ego: Array
    max_gap_s: float = 1.0
    extrapolate_s: float = 0.2
    sigma_m: Array | None = None
    sigma_yaw_rad: Array | None = None

    def __post_init__(self) -> None:
        """Check that stamps increase and that there is one pose for each."""
        if len(self.t_ns) == 0 or len(self.t_ns) != len(self.map_T_ego):
            raise ValueError("a pose track needs one pose per stamp and at least one of them")
        if np.any(np.diff(self.t_ns) <= 0):
            raise ValueError("stamps of a pose track must be strictly increasing")
        if any(s is not None and len(s) != len(self.t_ns) for s in (self.sigma_m, self.sigma_yaw_rad)):
            raise ValueError("a pose track with standard deviations needs one per stamp")

    @cached_property
    def _quaternions(self) -> Array:
        return quaternion_from_rotation(self.map_T_ego[:, :3, :3])

    def at(self, t_ns: ArrayLike) -> tuple[Array, NDArray[np.bool_]]:
        """Interpolate the pose at stamps (N,) int64 ns: rotation by slerp, translation linearly.

        Returns `map_T_ego`: (N, 4, 4); `valid`: (N,): false in gaps longer than `max_gap_s` and farther than `extrapolate_s`
        outside the track.
        """
        t = np.atleast_1d(np.asarray(t_ns, dtype=np.int64))
        if len(self.t_ns) == 1:
            near = np.abs(t - self.t_ns[0]) <= round(self.extrapolate_s * NS_PER_S)
            return np.repeat(self.map_T_ego, len(t), axis=0), near
        i, k = self._neighbors(t)
        span = (self.t_ns[k] - self.t_ns[i]).astype(np.float64)
        fraction = (t - self.t_ns[i]).astype(np.float64) / span
        q = self._quaternions
        position = self.map_T_ego[:, :3, 3]
        poses = transform(
            rotation_from_quaternion(slerp(q[i], q[k], fraction)),
            position[i] + fraction[:, None] * (position[k] - position[i]),
        )
        margin = round(self.extrapolate_s * NS_PER_S)
        inside = (t >= self.t_ns[0] - margin) & (t <= self.t_ns[-1] + margin)
        recorded = (t == self.t_ns[i]) | (t == self.t_ns[k])
        return poses, inside & ((span <= self.max_gap_s * NS_PER_S) | recorded)

    def sigmas_at(self, t_ns: ArrayLike, usual: tuple[float, float]) -> Array:
        """Interpolate the standard deviations (N, 2) of position, m, and yaw, rad, at stamps (N,) int64 ns.

        `usual`: what they are where the track does not know them.
        """
        t_s = (np.atleast_1d(np.asarray(t_ns, dtype=np.int64)) - self.t_ns[0]) / NS_PER_S
        known_s = (self.t_ns - self.t_ns[0]) / NS_PER_S
        out = np.tile(usual, (len(t_s), 1)).astype(np.float64)
        for k, sigma in enumerate((self.sigma_m, self.sigma_yaw_rad)):
            if sigma is not None:
                out[:, k] = np.interp(t_s, known_s, sigma)
        return out

    def _neighbors(self, t_ns: NDArray[np.int64]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Rows (N,) before and after stamps; outside the track its end and a row some time away, never two at nearly one time."""
        last = len(self.t_ns) - 1
        after = np.clip(np.searchsorted(self.t_ns, t_ns, side="right"), 1, last)
        start, end = t_ns < self.t_ns[0], t_ns > self.t_ns[-1]
        if not (start.any() or end.any()):
            return after - 1, after
        second = min(int(np.searchsorted(self.t_ns, self.t_ns[0] + MIN_EXTRAPOLATION_BASE_NS)), last)
        early_ns = self.t_ns[-1] - MIN_EXTRAPOLATION_BASE_NS
        second_last = max(int(np.searchsorted(self.t_ns, early_ns, side="right")) - 1, 0)
        return np.where(end, second_last, after - 1), np.where(start, second, after)
