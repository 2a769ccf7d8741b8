"""Agents on a common clock, as formats with fixed steps need them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.errors import ScenarioError
from log2sim.geometry import Array

DERIVATIVE_S = 0.05  # half the span over which rates are taken: half a step of most logs, so neighbors decide them
ROUNDING_S = 1e-6
MOST_STEPS = 100_000  # 2.8 hours at 10 Hz; a table of all agents' states at more of them hardly fits into memory


@dataclass(frozen=True, eq=False)
class Motion:
    """States of one agent at asked times (T,), zero where `valid` is False.

    `position_m` (T, 3) box centers, `yaw_rad` (T,) in [-pi, pi), `velocity_mps` and `acceleration_mps2` (T, 2) of the
    box center along the axes of the positions.
    """

    valid: NDArray[np.bool_]
    position_m: Array
    yaw_rad: Array
    velocity_mps: Array
    acceleration_mps2: Array


def motion(agent: Agent, t_s: Array, margin_s: float = ROUNDING_S) -> Motion:
    """Sample an agent at times (T,); times within `margin_s` outside its life take its end.

    Notes
    -----
    The speed of waypoints is along the heading. Where an agent turns, its box center also moves sideways, by yaw rate
    times the center's distance from the rear axle; without that term velocities contradict the positions.
    """
    w = agent.waypoints
    at = agent.at(t_s, margin_s=margin_s)
    inside = np.clip(t_s, w.t_s[0], w.t_s[-1])
    before, after = np.maximum(inside - DERIVATIVE_S, w.t_s[0]), np.minimum(inside + DERIVATIVE_S, w.t_s[-1])
    change = _velocity(agent, after) - _velocity(agent, before)
    columns = {
        "position_m": np.stack([at.x_m, at.y_m, at.z_m], axis=-1),
        "yaw_rad": at.yaw_rad,
        "velocity_mps": _velocity(agent, inside),
        "acceleration_mps2": _over(change, after - before),
    }
    zeroed = {k: np.where(at.valid if v.ndim == 1 else at.valid[:, None], v, 0.0) for k, v in columns.items()}
    return Motion(valid=at.valid, **zeroed)


def _velocity(agent: Agent, t_s: Array) -> Array:
    """Velocities (T, 2) of the box center at times (T,) within the agent's life."""
    w = agent.waypoints
    yaw = np.unwrap(w.yaw_rad)
    before, after = np.maximum(t_s - DERIVATIVE_S, w.t_s[0]), np.minimum(t_s + DERIVATIVE_S, w.t_s[-1])
    turned = np.interp(after, w.t_s, yaw) - np.interp(before, w.t_s, yaw)
    heading, speed = np.interp(t_s, w.t_s, yaw), np.interp(t_s, w.t_s, w.speed_mps)
    sideways = _over(turned[:, None], after - before)[:, 0] * agent.rear_axle_offset_m
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([speed * c - sideways * s, speed * s + sideways * c], axis=-1)


def _over(change: Array, span_s: Array) -> Array:
    """Rates (T, k) of changes (T, k); zero for an agent that is seen at one time only."""
    rates: Array = np.zeros_like(change)
    np.divide(change, span_s[:, None], out=rates, where=span_s[:, None] > 0)
    return rates


def on_clock(agent: Agent, t_s: Array, step_s: float, at_least: int = 1) -> Motion:
    """Sample an agent at equal steps (T,) of `step_s`.

    One that lives between them, or after the last before the next would come, takes the `at_least` nearest, so nobody is
    lost.
    """
    sampled = motion(agent, t_s)
    if sampled.valid.sum() >= at_least:
        return sampled
    past_s = agent.waypoints.t_s[0] - t_s[-1]
    after = past_s + (at_least - 1) * step_s if 0 < past_s < step_s else 0.0
    return motion(agent, t_s, margin_s=max(at_least * step_s / 2, after + ROUNDING_S))


def clock(start_s: float, stop_s: float, step_s: float) -> Array:
    """Times (T,) from `start_s` in equal steps up to `stop_s`, at least one.

    Raises
    ------
    ScenarioError
        For more than `MOST_STEPS`, before anything is allocated for them.
    """
    steps = (stop_s - start_s) / step_s + 1e-6
    if steps > MOST_STEPS:
        raise ScenarioError(
            f"waypoints span {stop_s - start_s:g} s, at most {MOST_STEPS * step_s:g} s can be exported in steps of "
            f"{step_s:g} s; cut the scenario into parts"
        )
    return start_s + step_s * np.arange(int(steps) + 1, dtype=np.float64)


def file_name(text: str) -> str:
    """A name for files from any text: letters, digits, dot, dash and underscore, never empty or hidden."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip(".")[:100] or "scenario"
