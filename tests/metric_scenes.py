"""Scenarios of a few agents on known trajectories, for the figures of `evaluate`."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario

T_S = np.arange(31) / 10
CAR = (4.4, 1.8, 1.5)


def agent(id, x, y=0.0, yaw=0.0, speed=0.0, t_s=T_S, category="car", size_m=CAR, visible=None, **kwargs):
    seen = None if visible is None else np.broadcast_to(visible, len(t_s)).copy()
    w = waypoints(t_s, x, y, 0.0, yaw, speed, sigma_m=0.0, visible=seen)
    return Agent(id, category, size_m, w, **kwargs)


def scenario(*agents, **kwargs):
    return Scenario(**{"name": "s", "t0_ns": 0, "duration_s": 3.0, "agents": agents, **kwargs})


def moved(a, dx=0.0, dy=0.0, **columns):
    w = a.waypoints
    return replace(a, waypoints=replace(w, x_m=w.x_m + dx, y_m=w.y_m + dy, **columns))


def world():
    """An ego, a moving and a parked car, a walking and a standing pedestrian, a cyclist."""
    return scenario(
        agent("ego", 5 * T_S, speed=5.0),
        agent("a", 10 + 5 * T_S, 3.0, speed=5.0),
        agent("b", 15.0, -4.0, yaw=1.0, static=True),
        agent("c", 8.0, 10 - T_S, yaw=-np.pi / 2, speed=1.0, category="pedestrian", size_m=(0.6, 0.6, 1.7)),
        agent("d", 3.0, 8.0, yaw=2.0, category="pedestrian", size_m=(0.6, 0.6, 1.7)),
        agent("e", 30 - 4 * T_S, -8.0, yaw=np.pi - 1e-9, speed=4.0, category="cyclist", size_m=(1.8, 0.6, 1.7)),
    )


def shifted(s, dx, dy=0.0):
    return replace(s, agents=tuple(moved(a, dx, dy) for a in s.agents))
