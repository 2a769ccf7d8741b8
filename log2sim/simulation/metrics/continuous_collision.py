"""Continuous collision detection: when two moving and turning boxes first touch, by conservative advancement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, separating_axes
from log2sim.simulation.vehicles.vehicle import Columns

MAX_STEPS = 64
"""Most steps in an interval; a contact shorter than one step, 0.8 ms of 50 ms, may be missed."""

BISECTIONS = 8  # of the last step: 3 us of 50 ms


@dataclass(frozen=True, eq=False)
class RelativeMotion(Columns):
    """Relative motion of N pairs of boxes over an interval.

    Attributes
    ----------
    dx_m, dy_m, dz_m : (N,) float64
        From box a to box b at the begin.
    vx_m, vy_m, vz_m : (N,) float64
        Change of these over the interval.
    yaw_a_rad, yaw_b_rad : (N,) float64
        At the begin.
    turn_a_rad, turn_b_rad : (N,) float64
        Change of these over the interval.
    size_a_m, size_b_m : (3, N) float64
    """

    dx_m: Array
    dy_m: Array
    dz_m: Array
    vx_m: Array
    vy_m: Array
    vz_m: Array
    yaw_a_rad: Array
    yaw_b_rad: Array
    turn_a_rad: Array
    turn_b_rad: Array
    size_a_m: Array
    size_b_m: Array

    def reversed(self) -> RelativeMotion:
        """Return the motion from the end to the begin."""
        return RelativeMotion(
            self.dx_m + self.vx_m, self.dy_m + self.vy_m, self.dz_m + self.vz_m,
            -self.vx_m, -self.vy_m, -self.vz_m,
            self.yaw_a_rad + self.turn_a_rad, self.yaw_b_rad + self.turn_b_rad,
            -self.turn_a_rad, -self.turn_b_rad, self.size_a_m, self.size_b_m,
        )  # fmt: skip

    def may_touch(self) -> NDArray[np.bool_]:
        """Whether the circles around the footprints meet (N,)."""
        square = self.vx_m**2 + self.vy_m**2
        closing = -(self.dx_m * self.vx_m + self.dy_m * self.vy_m)
        u = np.clip(np.divide(closing, square, out=np.zeros_like(square), where=square > 0), 0.0, 1.0)
        reach = (np.hypot(*self.size_a_m[:2]) + np.hypot(*self.size_b_m[:2])) / 2
        meets: NDArray[np.bool_] = np.hypot(self.dx_m + u * self.vx_m, self.dy_m + u * self.vy_m) < reach
        return meets

    def free_for(self, u: Array) -> Array:
        """Return the share of the interval (N,) for which boxes certainly stay apart after the shares `u` (N,); 0 in overlap.

        Along an axis of a box the gap shrinks at most at the speed along it plus the contributions of both turns. The
        largest of these bounds, over the axes with a gap, is safe. Boxes that only touch return the smallest positive
        number.
        """
        left = 1.0 - u
        dx, dy = self.dx_m + u * self.vx_m, self.dy_m + u * self.vy_m
        travel = np.hypot(self.vx_m, self.vy_m)
        distance = np.hypot(dx, dy) + 2 * travel * left
        yaw_a, yaw_b = self.yaw_a_rad + u * self.turn_a_rad, self.yaw_b_rad + u * self.turn_b_rad
        spin_a, spin_b = np.abs(self.turn_a_rad), np.abs(self.turn_b_rad)
        relative = np.abs(self.turn_b_rad - self.turn_a_rad) / 2
        radius_a, radius_b = (np.hypot(*size[:2]) for size in (self.size_a_m, self.size_b_m))
        free = _gap_duration(
            np.abs(self.dz_m + u * self.vz_m) - (self.size_a_m[2] + self.size_b_m[2]) / 2, np.abs(self.vz_m)
        )
        for nx, ny, reach, of_a in separating_axes(yaw_a, yaw_b, self.size_a_m.T, self.size_b_m.T):
            spin, radius = (spin_a, radius_b) if of_a else (spin_b, radius_a)
            rate = np.abs(self.vx_m * nx + self.vy_m * ny) + spin * distance + relative * radius
            free = np.maximum(free, _gap_duration(np.abs(dx * nx + dy * ny) - reach, rate))
        return free


def first_contact(motion: RelativeMotion) -> Array:
    """Return the share of the interval (N,) after which the boxes first overlap, NaN where they do not.

    Notes
    -----
    Conservative advancement (Mirtich, 1996) with separating axes in place of a distance: every step is as long as the
    boxes certainly stay apart, but at least 1 / `MAX_STEPS`; the last step is bisected.
    """
    touch = np.full(len(motion.dx_m), np.nan)
    active = np.flatnonzero(motion.may_touch())
    before = u = np.zeros(len(active))
    while len(active):
        moving = motion.take(active)
        free = moving.free_for(u)
        hit = free == 0
        touch[active[hit]] = _bisected(moving.take(hit), before[hit], u[hit])
        on = ~hit & (u < 1) & (u + free < 1)
        active, before, step = active[on], u[on], np.maximum(free[on], 1 / MAX_STEPS)
        u = np.minimum(before + step, 1.0)
    return touch


def _bisected(motion: RelativeMotion, apart: Array, overlapping: Array) -> Array:
    """Bisect for the first share (N,) with an overlap, between one without and one with it."""
    for _ in range(BISECTIONS):
        middle = (apart + overlapping) / 2
        inside = motion.free_for(middle) == 0
        apart, overlapping = np.where(inside, apart, middle), np.where(inside, middle, overlapping)
    return overlapping


def _gap_duration(gap: Array, rate: Array) -> Array:
    """Return how long (N,) a gap lasts that shrinks at a rate; 0 without a gap, inf for a constant one."""
    lasts = np.divide(gap, rate, out=np.full(len(gap), np.inf), where=rate > 0)
    return np.where(gap < 0, 0.0, np.maximum(lasts, np.finfo(float).tiny))
