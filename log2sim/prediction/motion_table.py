"""States of all agents at common ticks, as predictions start from them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import Agent, Scenario
from log2sim.geometry import Array
from log2sim.numerals import short_repr

TICK_S = 0.1
"""Interval of ticks: the rate of most LiDARs, at which a driver's reaction takes ten ticks."""

_MARGIN_S = 1e-6

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class MotionTable:
    """States of A agents at T ticks. Positions and velocities are complex numbers x + iy, so that a turn is a product.

    Attributes
    ----------
    agents : tuple of Agent
    t_s : (T,) float64, s
        Ticks, `tick_s` apart.
    tick_s : float, s
    position_m : (A, T) complex128, m
        Box centers, map frame; NaN where the agent is absent.
    velocity_mps : (A, T) complex128, m/s
    yaw_rad : (A, T) float64
    sigma_m : (A, T) float64, m
        One standard deviation of the position.
    observed : (A, T) bool
        False where the agent is absent or its trajectory fills a gap of the observations.
    piece : (A, T) int
        Rises by one where the log jumps, from where on it is another object; -1 where the agent is absent.
    """

    __repr__ = short_repr

    agents: tuple[Agent, ...]
    t_s: Array
    tick_s: float
    position_m: Complex
    velocity_mps: Complex
    yaw_rad: Array
    sigma_m: Array
    observed: NDArray[np.bool_]
    piece: NDArray[np.intp]

    @property
    def present(self) -> NDArray[np.bool_]:
        """Return where agents are present (A, T)."""
        return self.piece >= 0

    @property
    def begins(self) -> NDArray[np.bool_]:
        """Return where a piece begins (A, T): before it, nothing is known of the object."""
        before = np.concatenate([np.full((len(self.piece), 1), -1), self.piece[:, :-1]], axis=1)
        return np.asarray(self.present & (before != self.piece))

    def later(self, ticks: int) -> tuple[Complex, NDArray[np.bool_]]:
        """Return the positions (A, T) `ticks` later, NaN where there are none, and whether they were observed, as the present was."""
        position = np.full_like(self.position_m, np.nan)
        observed = np.zeros_like(self.observed)
        if ticks < len(self.t_s):
            same = (self.piece[:, ticks:] == self.piece[:, : len(self.t_s) - ticks]) & self.present[:, ticks:]
            position[:, : len(self.t_s) - ticks] = np.where(same, self.position_m[:, ticks:], np.nan)
            observed[:, : len(self.t_s) - ticks] = same & self.observed[:, ticks:]
        return position, observed & self.observed


def table_of(scenario: Scenario, tick_s: float = TICK_S) -> MotionTable:
    """Sample the trajectories of a scenario every `tick_s` from its begin to its end."""
    agents = scenario.agents
    begin_s = min([0.0, *(float(a.waypoints.t_s[0]) for a in agents)])
    end_s = max([scenario.duration_s, *(float(a.waypoints.t_s[-1]) for a in agents)])
    first, last = (round(np.floor(t / tick_s + _MARGIN_S)) for t in (begin_s, end_s))
    return tabulate(agents, np.arange(first, last + 1) * tick_s, tick_s)


def tabulate(agents: Sequence[Agent], t_s: Array, tick_s: float) -> MotionTable:
    """Sample the trajectories of agents at ticks (T,)."""
    shape = (len(agents), len(t_s))
    position, velocity = np.full(shape, np.nan, dtype=complex), np.full(shape, np.nan, dtype=complex)
    yaw, sigma = np.full(shape, np.nan), np.full(shape, np.nan)
    observed, piece = np.zeros(shape, dtype=bool), np.full(shape, -1, dtype=np.intp)
    for k, agent in enumerate(agents):
        w, path = agent.waypoints, agent.trajectory
        there = (t_s >= w.t_s[0] - _MARGIN_S) & (t_s <= w.t_s[-1] + _MARGIN_S) | agent.is_permanent
        t = t_s[there]
        x, y, heading, _ = path.relative(t)
        vx, vy = path.velocity(t)
        position[k, there] = x + path.origin_m[0] + 1j * (y + path.origin_m[1])
        velocity[k, there] = 0.0 if agent.static else vx + 1j * vy
        yaw[k, there], sigma[k, there] = heading, np.interp(t, w.t_s, w.sigma_xy_m)
        observed[k, there] = _is_observed(agent, t)
        piece[k, there] = np.searchsorted(path.discontinuity_times(), t + _MARGIN_S, side="right")
    return MotionTable(tuple(agents), t_s, tick_s, position, velocity, yaw, sigma, observed, piece)


def _is_observed(agent: Agent, t_s: Array) -> NDArray[np.bool_]:
    """Whether times (T,) are at an observed waypoint or between two of them."""
    w = agent.waypoints
    after = np.clip(np.searchsorted(w.t_s, t_s - _MARGIN_S), 0, len(w) - 1)
    before = np.clip(np.searchsorted(w.t_s, t_s + _MARGIN_S, side="right") - 1, 0, len(w) - 1)
    return np.asarray(w.observed[after] & w.observed[before])
