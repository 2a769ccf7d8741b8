"""The course of an agent through its waypoints, at any time: what a replay is held against."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.geometry import Array, wrap_angle

MIN_DISCONTINUITY_M = 2.0
MIN_DISCONTINUITY_MPS = 15.0


@dataclass(frozen=True, eq=False)
class Path:
    """Course of an agent's box center through its waypoints.

    `t_s` (T,), `x_m`, `y_m` (T,) in m relative to `origin_m`, `yaw_rad` (T,) unwrapped, `speed_mps` (T,), tangents
    `velocity_x_mps`, `velocity_y_mps` (T,), `jump` (T - 1,) True where the log leaps and is not followed.
    """

    t_s: Array
    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    velocity_x_mps: Array
    velocity_y_mps: Array
    jump: NDArray[np.bool_]
    origin_m: tuple[float, float]

    def at(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """x, y relative to the origin, yaw (unwrapped) and logged speed at times (N,), held outside the life.

        Between waypoints the position is a cubic with their velocities (Hermite). Before a leap it goes straight on.
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
        leaps = self.jump[i] & (t < self.t_s[i + 1])
        if leaps.any():
            x = np.where(leaps, self.x_m[i] + since * self.velocity_x_mps[i], x)
            y = np.where(leaps, self.y_m[i] + since * self.velocity_y_mps[i], y)
            yaw = np.where(leaps, self.yaw_rad[i], yaw)
        return x, y, yaw, speed

    def centers(self, t_s: Array) -> tuple[Array, Array, Array, Array]:
        """Box center x, y in the map, yaw in [-pi, pi) and logged speed at times (N,)."""
        x, y, yaw, speed = self.at(t_s)
        return x + self.origin_m[0], y + self.origin_m[1], wrap_angle(yaw), speed

    def heights(self, t_s: Array) -> Array:
        """Height z of the box center in the map at times (N,), held outside the life."""
        return np.interp(t_s, self.t_s, self.z_m)

    def jump_times(self) -> Array:
        """Times (J,) at which the log stands elsewhere than it could have driven to."""
        return self.t_s[1:][self.jump]


def path_of(agent: Agent, rear_axle_offset_m: float) -> Path:
    """The path of an agent whose box center is `rear_axle_offset_m` ahead of the axle that rolls along the heading."""
    w = agent.waypoints
    origin_m = (float(w.x_m[0]), float(w.y_m[0]))
    x, y, yaw = w.x_m - origin_m[0], w.y_m - origin_m[1], np.unwrap(w.yaw_rad)
    vx, vy = w.speed_mps * np.cos(yaw), w.speed_mps * np.sin(yaw)
    jump = np.zeros(max(len(w) - 1, 0), dtype=bool)
    if len(w) > 1:
        span = np.diff(w.t_s)
        miss = np.hypot(np.diff(x) - (vx[1:] + vx[:-1]) / 2 * span, np.diff(y) - (vy[1:] + vy[:-1]) / 2 * span)
        jump = (miss > MIN_DISCONTINUITY_M) & (miss > MIN_DISCONTINUITY_MPS * span)
        beside_jump = np.concatenate([jump, [False]]) | np.concatenate([[False], jump])
        swing = np.where(beside_jump, 0.0, rear_axle_offset_m * np.gradient(yaw, w.t_s))
        vx, vy = _tangents(w.t_s, x, y, vx - swing * np.sin(yaw), vy + swing * np.cos(yaw), beside_jump)
    return Path(w.t_s, x, y, w.z_m, yaw, w.speed_mps, vx, vy, jump, origin_m)


def _tangents(
    t_s: Array, x: Array, y: Array, vx: Array, vy: Array, beside_jump: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Velocities (T,) at the waypoints: the logged ones, or difference quotients where these say something else.

    Sideways steps of a pedestrian and a box labeled back to front would otherwise bend the course into loops.
    """
    dx, dy = np.gradient(x, t_s), np.gradient(y, t_s)
    differs = np.hypot(vx - dx, vy - dy) > 0.5 + 0.3 * np.hypot(dx, dy)
    replace = differs & ~beside_jump
    return np.where(replace, dx, vx), np.where(replace, dy, vy)


def hermite(value: Array, slope: Array, i: NDArray[np.intp], t: Array, span: Array) -> Array:
    """Cubics (..., N) through value[..., i] and value[..., i + 1] with their slopes, at `t` (N,) after the first."""
    f = t / span
    begin, end = value.take(i, axis=-1), value.take(i + 1, axis=-1)
    begin_rise, end_rise, rise = span * slope.take(i, axis=-1), span * slope.take(i + 1, axis=-1), end - begin
    return begin + f * (
        begin_rise + f * (3 * rise - 2 * begin_rise - end_rise + f * (begin_rise + end_rise - 2 * rise))
    )
