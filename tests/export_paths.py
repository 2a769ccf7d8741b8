"""Scenarios for exports: agents on given paths, with everything a file has to carry."""

from __future__ import annotations

from typing import Any

import numpy as np

from log2sim.datatypes import Agent, MapFrame, Scenario, Waypoints
from log2sim.geometry import Array, wrap_angle

UTM = MapFrame(49.0, 8.4, 115.0, "+proj=utm +zone=32 +datum=WGS84 +units=m", (456000.0, 5428000.0, 100.0))


def agent(
    xy_m: Any, name: str = "ego", *, yaw_rad: Any = None, first_s: float = 0.0, step_s: float = 0.1, ground_m: Any = 0.0, **changes: Any
) -> Agent:  # fmt: skip
    """An agent at points (T, 2), facing along them unless told otherwise, its box standing on `ground_m`."""
    xy = np.asarray(xy_m, dtype=np.float64)
    t = first_s + step_s * np.arange(len(xy))
    if yaw_rad is None:
        yaw_rad = np.arctan2(*np.gradient(xy, axis=0).T[::-1])
    yaw = np.broadcast_to(np.asarray(yaw_rad, dtype=np.float64), len(xy)).copy()
    size = changes.pop("size_m", (4.6, 1.9, 1.6))
    velocity = np.gradient(xy, t, axis=0) if len(xy) > 1 else np.zeros((1, 2))
    waypoints = Waypoints(
        t, xy[:, 0], xy[:, 1], np.broadcast_to(ground_m, len(xy)) + size[2] / 2, wrap_angle(yaw),
        changes.pop("speed_mps", velocity[:, 0] * np.cos(yaw) + velocity[:, 1] * np.sin(yaw)),
        np.arange(len(xy)) % 3 > 0, np.full(len(xy), 0.05),
    )  # fmt: skip
    return Agent(name, changes.pop("category", "car"), size, waypoints, **{"rear_axle_offset_m": 1.4, **changes})


def scenario(*agents: Agent, **changes: Any) -> Scenario:
    """A scenario of agents that lasts as long as they do."""
    last_s = max((float(a.waypoints.t_s[-1]) for a in agents if len(a.waypoints)), default=0.0)
    return Scenario(**{"name": "test", "t0_ns": 1_700_000_000_000_000_000, "duration_s": last_s, "agents": agents, "map": UTM, **changes})  # fmt: skip


def line(
    length_m: float = 30.0, count: int = 31, heading_rad: float = 0.0, start: tuple[float, float] = (0.0, 0.0)
) -> Array:
    """Points (count, 2) on a straight line."""
    along = np.linspace(0.0, length_m, count)
    return np.column_stack([start[0] + along * np.cos(heading_rad), start[1] + along * np.sin(heading_rad)])


def bend(radius_m: float = 15.0, turn_rad: float = np.pi / 2, count: int = 60) -> Array:
    """Points (count, 2) of a left turn that begins at the origin along +x."""
    angle = np.linspace(0.0, turn_rad, count)
    return np.column_stack([radius_m * np.sin(angle), radius_m * (1 - np.cos(angle))])
