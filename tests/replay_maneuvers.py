"""Maneuvers with known motion: columns of box centers made by integrating a rear axle that rolls along its heading."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario
from log2sim.geometry import Array, wrap_angle

OFFSET_M = 1.3
FINE_S = 0.001


def agent_from(
    t_s: Array,
    x_m: Array,
    y_m: Array,
    yaw_rad: Array,
    speed_mps: Array,
    *,
    id: str = "a",
    category: str = "car",
    size_m: tuple[float, float, float] = (4.4, 1.8, 1.5),
    offset_m: float = OFFSET_M,
    static: bool = False,
) -> Agent:
    """An agent whose columns (T,) are box centers."""
    w = waypoints(t_s, x_m, y_m, 0.0, wrap_angle(yaw_rad), speed_mps, sigma_m=0.05)
    return Agent(id, category, size_m, w, rear_axle_offset_m=offset_m, static=static)


def driven(
    speed: Callable[[Array], Array],
    curvature: Callable[[Array], Array],
    duration_s: float,
    *,
    rate_hz: float = 10.0,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
    id: str = "a",
    offset_m: float = OFFSET_M,
) -> Agent:
    """A car whose rear axle has the given speed (of time) and curvature (of distance), sampled at `rate_hz`."""
    t = np.arange(0, round(duration_s / FINE_S) + 1) * FINE_S
    v = speed(t)

    def summed(f: Array) -> Array:
        return np.concatenate([[0.0], np.cumsum((f[1:] + f[:-1]) / 2 * FINE_S)])

    yaw = start[2] + summed(v * curvature(summed(v)))
    x = start[0] + summed(v * np.cos(yaw)) + offset_m * np.cos(yaw)
    y = start[1] + summed(v * np.sin(yaw)) + offset_m * np.sin(yaw)
    k = np.arange(0, len(t), round(1 / (rate_hz * FINE_S)))
    return agent_from(t[k], x[k], y[k], yaw[k], v[k], id=id, offset_m=offset_m)


def scenario_of(*agents: Agent) -> Scenario:
    end = max((float(a.waypoints.t_s[-1]) for a in agents), default=0.0)
    return Scenario(name="maneuver", t0_ns=0, duration_s=end, agents=agents)


def ramp(t: Array, *points: tuple[float, float]) -> Array:
    return np.interp(t, [p[0] for p in points], [p[1] for p in points])


def lane_change(distance: Array) -> Array:
    """Curvature of 3.5 m sideways within 60 m, a sine over its length."""
    length = 60.0
    peak = 3.5 * 2 * np.pi / length**2
    return np.where(
        (distance > 30) & (distance < 30 + length), peak * np.sin(2 * np.pi * (distance - 30) / length), 0.0
    )


MANEUVERS: dict[str, Callable[[], Agent]] = {
    "straight": lambda: driven(lambda t: np.full_like(t, 12.0), np.zeros_like, 8.0),
    "brake to stop and go": lambda: driven(
        lambda t: ramp(t, (0, 10), (2, 10), (5, 0), (8, 0), (12, 8), (14, 8)), np.zeros_like, 14.0
    ),
    "turn of radius 8 m": lambda: driven(
        lambda t: np.full_like(t, 5.0), lambda s: ramp(s, (8, 0), (11, 1 / 8), (21, 1 / 8), (24, 0)), 8.0
    ),
    "lane change": lambda: driven(lambda t: np.full_like(t, 15.0), lane_change, 10.0),
    "slow start from rest": lambda: driven(
        lambda t: 0.5 * np.maximum(t - 1.5, 0), lambda s: np.minimum(0.02 * s, 0.08), 9.0
    ),
    "reversing": lambda: driven(
        lambda t: ramp(t, (0, 3), (2, 3), (4, 0), (5, 0), (6.5, -2), (10, -2), (12, 0), (13, 0)),
        lambda s: ramp(s, (0, 0.0), (4, 0.1), (9, 0.1)),
        13.0,
    ),
    "60 m/s": lambda: driven(
        lambda t: np.full_like(t, 60.0), lambda s: ramp(s, (60, 0), (180, 0.001), (300, 0.001), (420, 0)), 10.0
    ),
}
