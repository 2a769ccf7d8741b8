"""Straight drives and drivers for tests of the closed loop."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from replay_maneuvers import agent_from

from log2sim.datatypes import Agent
from log2sim.simulation.policy import Controls, Observation
from log2sim.simulation.result import Replay

LENGTH_M = 4.4


def line(
    id: str, x_m: float, y_m: float = 0.0, speed: float = 25.0, duration_s: float = 20.0, yaw: float = 0.0, **options
) -> Agent:
    """An agent that drives straight on from a place at constant speed."""
    t = np.arange(round(duration_s * 10) + 1) * 0.1
    way = speed * t
    return agent_from(
        t,
        x_m + way * np.cos(yaw),
        y_m + way * np.sin(yaw),
        np.full(len(t), yaw),
        np.full(len(t), speed),
        id=id,
        **options,
    )


def walker(id: str, x_m: float, y_m: float, speed: float, duration_s: float, yaw: float) -> Agent:
    return line(id, x_m, y_m, speed, duration_s, yaw, category="pedestrian", size_m=(0.6, 0.6, 1.8), offset_m=0.0)


def parked(id: str, x_m: float, y_m: float, yaw: float = 0.0) -> Agent:
    return agent_from([0.0], [x_m], [y_m], [yaw], [0.0], id=id, static=True)


class Speed:
    """Drives straight on at a speed that depends on time."""

    def __init__(self, speed: Callable[[float], float]) -> None:
        self.speed = speed

    def __call__(self, seen: Observation) -> Controls:
        return Controls(float(np.clip(2 * (self.speed(seen.t_s) - seen.ego.speed_mps), -8.0, 5.0)), 0.0)


def gap(result: Replay, follower: str, ahead: str = "ego") -> np.ndarray:
    """Bumper to bumper in m at all common stored times."""
    a, b = result.agent(follower), result.agent(ahead)
    count = min(len(a), len(b))
    return (b.x_m[:count] - a.x_m[:count]) - LENGTH_M


def departure(result: Replay, log: Replay, id: str) -> float:
    """Largest distance in m between two replays of an agent; inf when they do not last equally long."""
    a, b = result.agent(id), log.agent(id)
    return float(np.hypot(a.x_m - b.x_m, a.y_m - b.y_m).max()) if len(a) == len(b) else np.inf
