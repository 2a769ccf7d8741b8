"""Where the ego goes: along its path, at its speed, or on braking as it does."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Trajectory
from log2sim.geometry import Array, wrap_angle
from log2sim.prediction.motion_table import Complex
from log2sim.simulation.reactive.path_table import PathTable
from log2sim.simulation.reactive.prediction import ON_PATH_COS, ON_PATH_M
from log2sim.simulation.warnings.expected_paths import ExpectedPaths

KEEPING_SIGMA_M, KEEPING_S = 0.3, 1.0
"""Drivers keep to a lane within some 0.3 m, which they may be off after about a second: what nearly touches may just as well
not."""


class EgoStates(NamedTuple):
    """States of the ego (C,).

    Attributes
    ----------
    x_m, y_m : (C,) float64, m
        Box center, map frame.
    yaw_rad : (C,) float64
    speed_mps : (C,) float64, m/s
    accel_mps2 : (C,) float64, m/s2
        Of the speed's amount.
    progress_m : (C,) float64, m
        How far along its path.
    """

    x_m: Array
    y_m: Array
    yaw_rad: Array
    speed_mps: Array
    accel_mps2: Array
    progress_m: Array

    def take(self, index: NDArray[np.generic]) -> EgoStates:
        """Return some of the states."""
        return EgoStates(*(column[index] for column in self))


class EgoPath:
    """Expected motion of the ego along the path that it has in the scenario: its route, which it knows."""

    def __init__(self, ego: Agent) -> None:
        self._trajectory = Trajectory.through(ego.waypoints, ego.rear_axle_offset_m)
        self._paths = PathTable([self._trajectory])
        self.size_m = ego.size_m

    def progress(self, x_m: Array, y_m: Array) -> Array:
        """Return how far along the path successive places (N,) are."""
        gone, out = 0.0, np.zeros(len(x_m))
        for k, (x, y) in enumerate(zip(x_m.tolist(), y_m.tolist())):
            out[k] = gone = self._paths.progress_near(0, gone, x, y)
        return out

    def at(self, ego: EgoStates, lead_s: Array) -> ExpectedPaths:
        """Return where the ego is expected at leads (H,): on its path, as far aside as it is; off it, straight on.

        It keeps its speed, or goes on braking as it does until it stands.
        """
        ahead = way_after(np.abs(ego.speed_mps), np.minimum(ego.accel_mps2, 0.0), lead_s)
        one = np.zeros((1, 1), dtype=np.intp)
        x0, y0, cos0, sin0, _ = self._paths.along(one, ego.progress_m[:, None])
        x, y, cos, sin, _ = self._paths.along(one, ego.progress_m[:, None] + ahead)
        origin = complex(*self._paths.origin_m)
        here = (ego.x_m + 1j * ego.y_m)[:, None]
        left = ((here - origin - (x0 + 1j * y0)) * (cos0 - 1j * sin0)).imag
        facing = np.exp(1j * ego.yaw_rad)[:, None]
        travel = facing * np.where(ego.speed_mps < 0, -1.0, 1.0)[:, None]
        on = (np.abs(left) < ON_PATH_M) & ((travel * (cos0 - 1j * sin0)).real > ON_PATH_COS)
        along = np.where(on, cos + 1j * sin, travel)
        direction: Complex = np.asarray(along / np.abs(along), dtype=np.complex128)
        position = np.where(on, origin + x + 1j * y + 1j * left * direction, here + ahead * travel)
        turned = np.where(on, np.angle(direction * (cos0 - 1j * sin0)), 0.0)
        yaw = wrap_angle(ego.yaw_rad[:, None] + turned)
        off = KEEPING_SIGMA_M * np.minimum(lead_s / KEEPING_S, 1.0)
        sigma = np.broadcast_to(off[:, None], (*position.shape, 2))
        return ExpectedPaths(
            position, yaw, direction, sigma, np.broadcast_to(np.array(self.size_m[:2]), (len(position), 2))
        )

    def heights(self, progress_m: Array, reach_m: Array) -> Array:
        """Return the heights (C, 7), m, of the ego's center on the next `reach_m` (C,) of its path."""
        ahead = progress_m[:, None] + np.linspace(0.0, 1.0, 7) * reach_m[:, None]
        at_s = self._paths.times(np.zeros((1, 1), dtype=np.intp), ahead)
        return self._trajectory.heights(at_s.ravel()).reshape(at_s.shape)


def way_after(speed_mps: Array, accel_mps2: Array, lead_s: Array) -> Array:
    """Compute the ways (C, H), m, of vehicles with speeds (C,) that keep their deceleration (C,) until they stand."""
    brakes = accel_mps2 < 0
    stands_s = np.divide(-speed_mps, accel_mps2, out=np.full(len(speed_mps), np.inf), where=brakes)
    t = np.minimum(lead_s, stands_s[:, None])
    return np.asarray(speed_mps[:, None] * t + np.where(brakes, accel_mps2, 0.0)[:, None] * t**2 / 2)
