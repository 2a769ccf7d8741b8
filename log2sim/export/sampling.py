"""Agents sampled at common times, for formats with fixed steps."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent
from log2sim.errors import ScenarioError
from log2sim.geometry import Array

DERIVATIVE_S = (
    0.05  # half the span of difference quotients: half a step of most logs, so adjacent waypoints decide them
)
ROUNDING_S = 1e-6
MAX_STEPS = 100_000  # 2.8 hours at 10 Hz
# Memory of a table of all agents: at 2.8 hours 160 of them.
MAX_SAMPLED_BYTES = 1536 * 1024 * 1024
BYTES_PER_STATE = 96


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """States of one agent at requested times (T,), zero where `valid` is False.

    Attributes
    ----------
    valid : (T,) bool
    position_m : (T, 3) float64
        Box center.
    yaw_rad : (T,) float64, in [-pi, pi)
    velocity_mps, acceleration_mps2 : (T, 2) float64
        Of the box center, on the axes of the positions.
    """

    valid: NDArray[np.bool_]
    position_m: Array
    yaw_rad: Array
    velocity_mps: Array
    acceleration_mps2: Array


def sample_motion(agent: Agent, t_s: Array, margin_s: float = ROUNDING_S) -> SampledMotion:
    """Sample an agent at times (T,); times within `margin_s` outside its lifetime take the nearest end.

    Notes
    -----
    The speed of waypoints is along the heading. Where an agent turns, its box center also moves laterally, by yaw rate
    times its distance from the rear axle; without that term velocities contradict the positions.
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
        "acceleration_mps2": _rates(change, after - before),
    }
    zeroed = {k: np.where(at.valid if v.ndim == 1 else at.valid[:, None], v, 0.0) for k, v in columns.items()}
    return SampledMotion(valid=at.valid, **zeroed)


def _velocity(agent: Agent, t_s: Array) -> Array:
    """Return the velocity (T, 2) of the box center at times (T,) within the agent's lifetime."""
    w = agent.waypoints
    yaw = np.unwrap(w.yaw_rad)
    before, after = np.maximum(t_s - DERIVATIVE_S, w.t_s[0]), np.minimum(t_s + DERIVATIVE_S, w.t_s[-1])
    turned = np.interp(after, w.t_s, yaw) - np.interp(before, w.t_s, yaw)
    heading, speed = np.interp(t_s, w.t_s, yaw), np.interp(t_s, w.t_s, w.speed_mps)
    sideways = _rates(turned[:, None], after - before)[:, 0] * agent.rear_axle_offset_m
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([speed * c - sideways * s, speed * s + sideways * c], axis=-1)


def _rates(change: Array, span_s: Array) -> Array:
    """Return rates (T, k) of changes (T, k); zero for an agent with a single waypoint."""
    rates: Array = np.zeros_like(change)
    np.divide(change, span_s[:, None], out=rates, where=span_s[:, None] > 0)
    return rates


def sample_steps(agent: Agent, t_s: Array, step_s: float, at_least: int = 1) -> SampledMotion:
    """Sample an agent at equal steps (T,) of `step_s`.

    An agent that lives between two steps, or less than a step after the last, takes the `at_least` nearest steps, so
    that no agent is lost.
    """
    sampled = sample_motion(agent, t_s)
    if sampled.valid.sum() >= at_least:
        return sampled
    past_s = agent.waypoints.t_s[0] - t_s[-1]
    after = past_s + (at_least - 1) * step_s if 0 < past_s < step_s else 0.0
    return sample_motion(agent, t_s, margin_s=max(at_least * step_s / 2, after + ROUNDING_S))


def step_times(start_s: float, stop_s: float, step_s: float, agents: int = 1) -> Array:
    """Return times (T,) from `start_s` in equal steps up to `stop_s`, at least one, at which a number of agents are sampled.

    Raises
    ------
    ScenarioError
        For more than `MAX_STEPS`, or states of all agents of more than `MAX_SAMPLED_BYTES`, before anything is allocated.
    """
    steps = (stop_s - start_s) / step_s + 1e-6
    if steps > MAX_STEPS:
        raise ScenarioError(
            f"waypoints span {stop_s - start_s:g} s, at most {MAX_STEPS * step_s:g} s can be exported in steps of "
            f"{step_s:g} s; cut the scenario into parts"
        )
    require_sampled_bytes(agents * steps * BYTES_PER_STATE, f"{agents} agents over {stop_s - start_s:g} s")
    return start_s + step_s * np.arange(int(steps) + 1, dtype=np.float64)


def require_sampled_bytes(sampled_bytes: float, what: str) -> None:
    """Raise `ScenarioError` when samples would take more than `MAX_SAMPLED_BYTES`; `what` says of what they are."""
    if sampled_bytes > MAX_SAMPLED_BYTES:
        raise ScenarioError(
            f"{what}: their samples take {sampled_bytes / 2**30:.3g} GiB, at most {MAX_SAMPLED_BYTES / 2**30:g} GiB can be exported; "
            "cut the scenario into parts"
        )


def file_name(text: str) -> str:
    """Return a file name for any text: letters, digits, dot, dash and underscore, never empty or hidden."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).lstrip(".")[:100] or "scenario"
