"""Agents and scenarios for the tests of what goes to CARLA, and the sizes of a server's blueprints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario
from log2sim.simulation.carla.data import BY_CATEGORY

SIZES = {blueprint: size_m for offers in BY_CATEGORY.values() for blueprint, size_m in offers.items()}


def agent(name: str, t: Any, x: Any, y: Any, yaw: Any, speed: Any, **changes: Any) -> Agent:
    made = Agent(name, "car", (4.6, 1.9, 1.6), waypoints(t, x, y, 0.8, yaw, speed), rear_axle_offset_m=1.4)
    return replace(made, **changes)


def left_turn(
    name: str = "ego",
    radius_m: float = 12.0,
    speed: float = 6.0,
    at: tuple[float, float] = (0.0, 0.0),
    spacing_s: float = 0.1,
) -> Agent:
    """A car that drives 12 m straight on to the east, then a quarter circle to the left, as its rear axle rolls."""
    t = np.arange(0.0, 6.001, spacing_s)
    way = speed * t - 12.0
    yaw = np.clip(way, 0.0, radius_m * np.pi / 2) / radius_m
    on = np.maximum(way - radius_m * np.pi / 2, 0.0)
    x = at[0] + np.minimum(way, 0.0) + radius_m * np.sin(yaw) + 1.4 * np.cos(yaw)
    y = at[1] + radius_m * (1 - np.cos(yaw)) + on + 1.4 * np.sin(yaw)
    return agent(name, t, x, y, yaw, speed)


def of(*agents: Agent) -> Scenario:
    return Scenario("made", 0, float(max(a.waypoints.t_s[-1] for a in agents)), agents)
