"""Trajectories: where a box center is at any time, from its waypoints."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes.waypoints import Waypoints
from log2sim.geometry import Array, wrap_angle

STANDSTILL_MPS = 0.15
"""An agent stands when it is slower: half a kilometer per hour, the standard deviation of smoothed speeds of distant boxes."""

STANDSTILL_DRIFT_M = 2.0 * STANDSTILL_MPS
"""How far a standing agent may seem to move: 2 s at that speed, after which a smoothed drift is seen as motion."""

MIN_DISCONTINUITY_M = 2.0
"""A waypoint is discontinuous when it is farther than this from where the speeds lead, and"""

MIN_DISCONTINUITY_MPS = 15.0
"""when getting there would take this much more speed: no road user, but another object under the same id."""


class TrajectoryStates(NamedTuple):
    """Box centers on a trajectory, map frame.

    Attributes
    ----------
    x_m, y_m, z_m : (N,) float64, m
    yaw_rad : (N,) float64, in [-pi, pi)
    speed_mps : (N,) float64, m/s
        Along the heading.
    """

    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Cubic Hermite spline through the waypoints of a box center.

    Attributes
    ----------
    t_s : (T,) float64, s
    x_m, y_m : (T,) float64, m
        Relative to `origin_m`, which keeps digits far from the origin of the map.
    z_m : (T,) float64, m
    yaw_rad : (T,) float64
        Unwrapped.
    speed_mps : (T,) float64, m/s
    velocity_x_mps, velocity_y_mps : (T,) float64, m/s
        Tangents of the spline.
    discontinuous : (T - 1,) bool
        Steps over which the log jumps instead of moving.
    origin_m : (2,) tuple of float, m
        The first waypoint.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    velocity_x_mps: Array
    velocity_y_mps: Array
    discontinuous: NDArray[np.bool_]
    origin_m: tuple[float, float]

    @classmethod
    def through(cls, waypoints: Waypoints, rear_axle_offset_m: float = 0.0) -> Trajectory:
        """Fit the trajectory of a box center that is `rear_axle_offset_m` ahead of the axle that rolls along the heading."""
        w = waypoints
        origin_m = (float(w.x_m[0]), float(w.y_m[0]))
        x, y, yaw = w.x_m - origin_m[0], w.y_m - origin_m[1], np.unwrap(w.yaw_rad)
        vx, vy = w.speed_mps * np.cos(yaw), w.speed_mps * np.sin(yaw)
        jump = np.zeros(max(len(w) - 1, 0), dtype=bool)
        if len(w) > 1:
            span = np.diff(w.t_s)
            miss = np.hypot(np.diff(x) - (vx[1:] + vx[:-1]) / 2 * span, np.diff(y) - (vy[1:] + vy[:-1]) / 2 * span)
            jump = (miss > MIN_DISCONTINUITY_M) & (miss > MIN_DISCONTINUITY_MPS * span)
            at_jump = np.concatenate([jump, [False]]) | np.concatenate([[False], jump])
            swing = np.where(at_jump, 0.0, rear_axle_offset_m * np.gradient(yaw, w.t_s))
            vx, vy = _tangents(w.t_s, x, y, vx - swing * np.sin(yaw), vy + swing * np.cos(yaw), at_jump)
        return cls(w.t_s, x, y, w.z_m, yaw, w.speed_mps, vx, vy, jump, origin_m)

    def at(self, t_s: Array) -> TrajectoryStates:
        """Interpolate at times (N,); before the first and after the last waypoint the end is held."""
        x, y, yaw, speed = self.relative(t_s)
        z = np.interp(t_s, self.t_s, self.z_m)
        return TrajectoryStates(x + self.origin_m[0], y + self.origin_m[1], z, wrap_angle(yaw), speed)

    def relative(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Interpolate x, y relative to the origin, unwrapped yaw and speed at times (N,); the ends are held.

        Position by cubics with the velocities of the waypoints (Hermite), yaw and speed linearly. Up to a discontinuity the
        agent goes straight on.
        """
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        yaw, speed = np.interp(t, self.t_s, self.yaw_rad), np.interp(t, self.t_s, self.speed_mps)
        if len(self.t_s) == 1:
            return np.full(len(t), self.x_m[0]), np.full(len(t), self.y_m[0]), yaw, speed
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        span = self.t_s[i + 1] - self.t_s[i]
        since = t - self.t_s[i]
        x = hermite(self.x_m, self.velocity_x_mps, i, since, span)
        y = hermite(self.y_m, self.velocity_y_mps, i, since, span)
        jumps = self.discontinuous[i] & (t < self.t_s[i + 1])
        if jumps.any():
            x = np.where(jumps, self.x_m[i] + since * self.velocity_x_mps[i], x)
            y = np.where(jumps, self.y_m[i] + since * self.velocity_y_mps[i], y)
            yaw = np.where(jumps, self.yaw_rad[i], yaw)
        return x, y, yaw, speed

    def velocity(self, t_s: Array) -> tuple[Array, Array]:
        """Compute the velocity vx, vy, m/s, at times (N,): the slope of the spline, straight on up to a discontinuity."""
        t = np.clip(t_s, self.t_s[0], self.t_s[-1])
        if len(self.t_s) == 1:
            return np.full(len(t), self.velocity_x_mps[0]), np.full(len(t), self.velocity_y_mps[0])
        i = np.clip(np.searchsorted(self.t_s, t, side="right") - 1, 0, len(self.t_s) - 2)
        span = self.t_s[i + 1] - self.t_s[i]
        since = t - self.t_s[i]
        vx = hermite_slope(self.x_m, self.velocity_x_mps, i, since, span)
        vy = hermite_slope(self.y_m, self.velocity_y_mps, i, since, span)
        jumps = self.discontinuous[i] & (t < self.t_s[i + 1])
        return np.where(jumps, self.velocity_x_mps[i], vx), np.where(jumps, self.velocity_y_mps[i], vy)

    def heights(self, t_s: Array) -> Array:
        """Interpolate the height z of the box center at times (N,); the ends are held."""
        return np.interp(t_s, self.t_s, self.z_m)

    def discontinuity_times(self) -> Array:
        """Return the times (J,) of the waypoints that the agent cannot have moved to."""
        return self.t_s[1:][self.discontinuous]


def _tangents(t_s: Array, x: Array, y: Array, vx: Array, vy: Array, at_jump: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Choose the velocities (T,) at the waypoints: the logged ones, or difference quotients where the two disagree.

    Sideways steps of a pedestrian and a box labeled back to front would otherwise bend the spline into loops.
    """
    dx, dy = np.gradient(x, t_s), np.gradient(y, t_s)
    differs = np.hypot(vx - dx, vy - dy) > 0.5 + 0.3 * np.hypot(dx, dy)
    replaced = differs & ~at_jump
    return np.where(replaced, dx, vx), np.where(replaced, dy, vy)


def hermite(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array) -> Array:
    """Evaluate cubics (..., N) through value[..., i] and value[..., i + 1] with their slopes, at `t` (N,) after the first."""
    f = t / span
    begin, end = value.take(i, axis=-1), value.take(i + 1, axis=-1)
    begin_rise, end_rise, rise = span * slope.take(i, axis=-1), span * slope.take(i + 1, axis=-1), end - begin
    return begin + f * (
        begin_rise + f * (3 * rise - 2 * begin_rise - end_rise + f * (begin_rise + end_rise - 2 * rise))
    )


def hermite_slope(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array) -> Array:
    """Evaluate the slopes (N,) of the cubics of `hermite`."""
    f = t / span
    begin, end, rise = slope[i], slope[i + 1], (value[i + 1] - value[i]) / span
    return begin + f * (2 * (3 * rise - 2 * begin - end) + 3 * f * (begin + end - 2 * rise))
