"""The ground of random traffic: roads on a tilted, bent and wavy surface, and where rays meet it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array

NEWTON_STEPS = 3
Values = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Road:
    """A road of constant curvature with its reference line in the middle."""

    origin_m: Array  # (2,), m: point of the line at s = 0
    yaw_rad: float  # direction of the line there
    curvature_per_m: float
    half_width_m: float  # half of the carriageway, m
    lanes: int  # in all
    keeps_right: bool = True
    one_way: bool = False

    def at(self, s: float, d: float) -> tuple[Array, float]:
        """Position (2,) and direction of the line at s along it and d to its left, m."""
        k, a = self.curvature_per_m, self.yaw_rad
        turn = a + k * s
        if abs(k) < 1e-6:
            along = np.array([np.cos(a), np.sin(a)]) * s
        else:
            along = np.array([np.sin(turn) - np.sin(a), np.cos(a) - np.cos(turn)]) / k
        return self.origin_m + along + d * np.array([-np.sin(turn), np.cos(turn)]), float(turn)

    def offset(self, x: Values, y: Values) -> Values:
        """Distance (N,) to the left of the line, m."""
        k = self.curvature_per_m
        normal = np.array([-np.sin(self.yaw_rad), np.cos(self.yaw_rad)])
        dx, dy = x - np.float32(self.origin_m[0]), y - np.float32(self.origin_m[1])
        if abs(k) < 1e-6:
            return np.asarray(dx * np.float32(normal[0]) + dy * np.float32(normal[1]))
        center = normal / k
        radius = np.hypot(dx - np.float32(center[0]), dy - np.float32(center[1]))
        return np.asarray((np.float32(abs(1 / k)) - radius) * np.float32(np.sign(k)))


@dataclass(frozen=True, eq=False)
class Surface:
    """Ground: a tilted and bent plane with waves, and kerbs beside the roads."""

    coefficients: Array  # (5,): of x, y, x^2, x y, y^2
    waves: Array  # (K, 4): amplitude in m, wave numbers along x and y in rad/m, phase
    roads: tuple[Road, ...]
    kerb_m: float  # height of the ground beside the roads

    def height(self, x: Values, y: Values) -> Values:
        """Return heights (N,) without kerbs, m."""
        a, b, c, d, e = self.coefficients.astype(np.float32)
        return np.asarray(x * (a + c * x + d * y) + y * (b + e * y))

    def elevation(self, position: Array) -> float:
        """Return the height with waves and kerbs at one position (2,) or (3,), m."""
        x, y = position[:1].astype(np.float32), position[1:2].astype(np.float32)
        return float(self.height(x, y)[0] + self.relief(x, y)[0])

    def slope(self, x: Values, y: Values) -> tuple[Values, Values]:
        """Return derivatives (N,), (N,) of the height."""
        a, b, c, d, e = self.coefficients.astype(np.float32)
        return np.asarray(a + 2 * c * x + d * y), np.asarray(b + 2 * e * y + d * x)

    def relief(self, x: Values, y: Values) -> Values:
        """Return waves and kerbs (N,), m."""
        beside = np.ones(len(x), bool)
        for road in self.roads:
            beside &= np.abs(road.offset(x, y)) > road.half_width_m
        out = np.float32(self.kerb_m) * beside.astype(np.float32)
        for amplitude, kx, ky, phase in self.waves.astype(np.float32):
            out += amplitude * np.sin(kx * x + ky * y + phase)
        return np.asarray(out)


def meet(
    surface: Surface,
    eye: tuple[Values, ...],
    ray: tuple[Values, ...],
    t: Values,
    *,
    flattest: float,
    span: tuple[float, float],
) -> tuple[Values, Values, Values]:
    """Find by Newton's method where rays (N,), given by x, y, z, meet a surface without its relief, from a guess (N,).

    `flattest`: fall of a ray towards the surface, below which it counts as so steep. `span`: limits of the result. Returns lengths
    of the rays, what their ends are above the surface, m, and how they rise from it.
    """
    (x0, y0, z0), (dx, dy, dz) = eye, ray
    for step in range(NEWTON_STEPS + 1):
        x, y = x0 + t * dx, y0 + t * dy
        sx, sy = surface.slope(x, y)
        above, rise = z0 + t * dz - surface.height(x, y), dz - sx * dx - sy * dy
        if step < NEWTON_STEPS:
            t = np.clip(t - above / np.minimum(rise, np.float32(-flattest)), *span)
    return t, above, rise
