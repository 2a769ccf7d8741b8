"""Scenarios in closed form for the tests of the export formats, and what reads their files."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from worlds import waypoints

from log2sim.datatypes import Agent, Scenario
from log2sim.geometry import Array, wrap_angle

ROOT = Path(__file__).resolve().parents[1]
RADIUS_M, SPEED_MPS, REAR_M = 12.0, 6.0, 1.4


def straight(
    name: str,
    category: str = "car",
    *,
    start: tuple[float, float] = (0.0, 0.0),
    yaw: float = 0.0,
    speed: float = 5.0,
    t_s: Array | None = None,
) -> Agent:
    """An agent that keeps its speed and heading, with waypoints at uneven times unless given."""
    t = np.array([0.0, 0.13, 0.2, 0.55, 1.0, 1.9, 3.0]) if t_s is None else np.asarray(t_s, dtype=float)
    x, y = start[0] + speed * np.cos(yaw) * t, start[1] + speed * np.sin(yaw) * t
    return Agent(
        name, category, (4.4, 1.8, 1.6), waypoints(t, x, y, 0.8, wrap_angle(yaw), speed), rear_axle_offset_m=1.3
    )


def circling(name: str = "ego") -> Agent:
    """A car whose rear axle drives a circle of `RADIUS_M` at `SPEED_MPS`, counter-clockwise from (RADIUS_M, 0)."""
    t = np.arange(0.0, 3.001, 0.02)
    angle = SPEED_MPS / RADIUS_M * t
    yaw = angle + np.pi / 2
    x = RADIUS_M * np.cos(angle) + REAR_M * np.cos(yaw)
    y = RADIUS_M * np.sin(angle) + REAR_M * np.sin(yaw)
    return Agent(
        name, "car", (4.5, 1.9, 1.6), waypoints(t, x, y, 0.8, wrap_angle(yaw), SPEED_MPS), rear_axle_offset_m=REAR_M
    )


def world(*agents: Agent, name: str = "world") -> Scenario:
    """A scenario of these agents that starts in the year 2023."""
    return Scenario(name, 1_700_000_000_123_456_789, 3.0, agents)


def moved(scenario: Scenario, x_m: float, y_m: float) -> Scenario:
    """The same scenario elsewhere on the map."""

    def shift(agent: Agent) -> Agent:
        w = agent.waypoints
        return replace(agent, waypoints=replace(w, x_m=w.x_m + x_m, y_m=w.y_m + y_m))

    return replace(scenario, agents=tuple(shift(a) for a in scenario.agents))


def peer(name: str) -> Callable[..., str]:
    """Runs Python in the environment `name` of `tools/peers.sh` and returns what it printed; skips without it."""
    python = Path(os.environ.get("LOG2SIM_PEERS", ROOT / ".peers")) / name / "bin" / "python"
    if not python.exists():
        pytest.skip(f"the environment '{name}' is not there: tools/peers.sh makes it")

    def run(*arguments: object) -> str:
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        ran = subprocess.run([str(python), *map(str, arguments)], capture_output=True, text=True, env=environment)
        assert ran.returncode == 0, ran.stderr[-4000:]
        return ran.stdout

    return run
