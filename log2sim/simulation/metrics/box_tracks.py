"""Oriented boxes of all agents over time."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array, rectangles_overlap, wrap_angle

DISCONTINUITY_M = 1.0
"""A step that differs from both neighboring steps by more is a discontinuity: at 20 Hz it would take 400 m/s2."""

RowIndex = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class BoxTracks:
    """Boxes of A agents at S times; between two rows a box moves straight and turns evenly.

    Attributes
    ----------
    x_m, y_m, z_m : (S, A) float64, m
        Box centers; NaN where an agent is absent.
    yaw_rad, speed_mps : (S, A) float64
    size_m : (A, 3) float64
    """

    x_m: Array
    y_m: Array
    z_m: Array
    yaw_rad: Array
    speed_mps: Array
    size_m: Array

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Where an agent is present (S, A)."""
        return ~np.isnan(self.x_m)

    @cached_property
    def radius_m(self) -> Array:
        """Radius of the circle around each footprint (A,)."""
        return np.hypot(self.size_m[:, 0], self.size_m[:, 1]) / 2

    @cached_property
    def first_row(self) -> RowIndex:
        """First row (A,) with the agent; 0 where there is none."""
        return np.argmax(self.present, axis=0) if len(self.x_m) else np.zeros(len(self.size_m), dtype=np.intp)

    @cached_property
    def last_row(self) -> RowIndex:
        """Last row (A,) with the agent; the last of all where there is none."""
        if not len(self.x_m):
            return np.full(len(self.size_m), -1, dtype=np.intp)
        result: RowIndex = len(self.x_m) - 1 - np.argmax(self.present[::-1], axis=0)
        return result

    @cached_property
    def moves_on(self) -> NDArray[np.bool_]:
        """Where an agent moves continuously from a row to the next (S, A): it is present at both, without a discontinuity."""
        on = np.zeros(self.x_m.shape, dtype=bool)
        if len(on) > 1:
            step = np.diff(self.x_m, axis=0) + 1j * np.diff(self.y_m, axis=0)
            change = np.abs(np.diff(step, axis=0))
            nowhere = np.full((1, step.shape[1]), np.nan)
            least = np.fmin(np.concatenate([nowhere, change]), np.concatenate([change, nowhere]))
            on[:-1] = ~np.isnan(step) & ~(least > DISCONTINUITY_M)
        return on

    def velocities(self, spacing_s: float) -> tuple[Array, Array]:
        """Return the velocity on map axes (S, A) twice, NaN where absent: the mean of the steps before and after a row.

        An agent with neither step moves along its heading at its speed.
        """
        cos, sin = np.cos(self.yaw_rad), np.sin(self.yaw_rad)
        return (
            self._rates(self.x_m, self.speed_mps * cos, spacing_s),
            self._rates(self.y_m, self.speed_mps * sin, spacing_s),
        )

    def climbs(self, spacing_s: float) -> Array:
        """Return the vertical velocity (S, A) likewise; 0 for an agent with neither step."""
        return self._rates(self.z_m, np.zeros(self.z_m.shape), spacing_s)

    def _rates(self, values: Array, alone: Array, spacing_s: float) -> Array:
        after = np.full(values.shape, np.nan)
        after[:-1] = np.where(self.moves_on[:-1], np.diff(values, axis=0) / spacing_s, np.nan)
        before = np.concatenate([after[-1:] * np.nan, after[:-1]])
        mean = np.where(np.isnan(after), before, np.where(np.isnan(before), after, (after + before) / 2))
        return np.where(np.isnan(mean) & self.present, alone, mean)

    def poses(self, row: Array | RowIndex, agent: RowIndex) -> tuple[Array, Array, Array, Array]:
        """Return x, y, z and yaw (N,) of agents (N,) at fractional rows (N,) within their lifetimes."""
        k = np.floor(row).astype(np.intp)
        fraction = np.where(self.moves_on[k, agent], row - k, 0.0)
        after = np.minimum(k + 1, len(self.x_m) - 1)
        x, y, z = (
            c[k, agent] + np.where(fraction > 0, fraction * (c[after, agent] - c[k, agent]), 0.0)
            for c in (self.x_m, self.y_m, self.z_m)
        )
        turn = wrap_angle(self.yaw_rad[after, agent] - self.yaw_rad[k, agent])
        return x, y, z, self.yaw_rad[k, agent] + np.where(fraction > 0, fraction * turn, 0.0)

    def overlap(self, row_a: Array | RowIndex, a: RowIndex, row_b: Array | RowIndex, b: RowIndex) -> NDArray[np.bool_]:
        """Whether box a at its row overlaps box b at its own row (N,)."""
        xa, ya, za, yaw_a = self.poses(row_a, a)
        xb, yb, zb, yaw_b = self.poses(row_b, b)
        size_a, size_b = self.size_m[a], self.size_m[b]
        vertical = np.abs(zb - za) < (size_a[:, 2] + size_b[:, 2]) / 2
        return vertical & rectangles_overlap(xb - xa, yb - ya, yaw_a, yaw_b, size_a, size_b)


def spacing_s(t_s: Array) -> float:
    """Return the spacing of evenly spaced times (S,); 1 for a single time."""
    return float(t_s[1] - t_s[0]) if len(t_s) > 1 else 1.0
