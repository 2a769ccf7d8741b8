"""States of all agents at common ticks, and the smoothing of their velocities and turn rates."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from log2sim.datatypes import MARGIN_S, Agent, AgentTable, Scenario
from log2sim.datatypes.categories import MAX_CURVATURE_1PM, MAX_LATERAL_MPS2
from log2sim.geometry import Array

TICK_S = 0.1  # interval of ticks: the rate of most LiDARs, at which a driver's reaction takes ten ticks

Complex = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class MotionTable(AgentTable):
    """Agents at T ticks. Positions and velocities are complex numbers x + iy, so that a turn is a product."""

    tick_s: float  # between ticks
    velocity_mps: Complex  # (A, T) slope of the trajectory; NaN where the agent is absent
    sigma_m: Array  # (A, T) one standard deviation of the position
    # (A, T) False where the agent is absent or its trajectory fills a gap of the observations
    observed: NDArray[np.bool_]
    # (A, T) rises by one where the log jumps, from where on it is another object; -1 where the agent is absent
    piece: NDArray[np.intp]

    @cached_property
    def position_m(self) -> Complex:
        """Box centers (A, T)."""
        return np.asarray(self.center_m[..., 0] + 1j * self.center_m[..., 1])

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


def table_of(scenario: Scenario) -> MotionTable:
    """Sample the trajectories of a scenario every `TICK_S` from its begin to its end."""
    agents = scenario.agents
    begin_s = min([0.0, *(float(a.waypoints.t_s[0]) for a in agents)])
    end_s = max([scenario.duration_s, *(float(a.waypoints.t_s[-1]) for a in agents)])
    first, last = (round(np.floor(t / TICK_S + MARGIN_S)) for t in (begin_s, end_s))
    return tabulate(agents, np.arange(first, last + 1) * TICK_S)


def tabulate(agents: Sequence[Agent], t_s: Array) -> MotionTable:
    """Sample the trajectories of agents at ticks (T,), `TICK_S` apart."""
    table = AgentTable.of(agents, t_s, permanent=True)
    shape = table.present.shape
    velocity, sigma = np.full(shape, np.nan, dtype=complex), np.full(shape, np.nan)
    observed, piece = np.zeros(shape, dtype=bool), np.full(shape, -1, dtype=np.intp)
    for k, agent in enumerate(agents):
        there, w, path = table.present[k], agent.waypoints, agent.trajectory
        t = t_s[there]
        vx, vy = path.velocity(t)
        velocity[k, there] = 0.0 if agent.static else vx + 1j * vy
        sigma[k, there] = np.interp(t, w.t_s, w.sigma_xy_m)
        # Observed at an observed waypoint, or between two of them.
        after = np.clip(np.searchsorted(w.t_s, t - MARGIN_S), 0, len(w) - 1)
        before = np.clip(np.searchsorted(w.t_s, t + MARGIN_S, side="right") - 1, 0, len(w) - 1)
        observed[k, there] = w.observed[after] & w.observed[before]
        piece[k, there] = np.searchsorted(path.discontinuity_times(), t + MARGIN_S, side="right")
    columns = table.agents, t_s, table.center_m, table.yaw_rad, table.speed_mps
    return MotionTable(*columns, TICK_S, velocity, sigma, observed, piece)


# Time constants to choose from, of velocity and of turn rate: 0 takes the latest value, and infinity none, so that the
# agent goes straight on.
CONSTANTS_S = tuple(itertools.product((0.0, 0.3, 0.6, 1.2), (0.0, 0.3, 0.6, 1.2, 2.4, np.inf)))
# Log-odds, before anything is known, of taking the latest velocity as it is: states of scenarios are smoothed already.
LATEST_ADVANTAGE = 3.0
PROOF_S = 1.0  # constants are judged by predictions over this time, of which the outcome is known already
# What such a prediction is off by usually: a tenth of what 0.6 m/s2 make of three seconds; smaller differences prove
# nothing.
USUAL_ERROR_M = 0.3
USUAL_ERRORS = 2.0  # how many errors of the past `USUAL_ERROR_M` counts as
# Of slower agents the velocity does not tell the course: smoothed speeds err by 0.15 m/s, which is 17 degrees here.
MIN_COURSE_MPS = 0.5


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Velocity and turn rate of agents, smoothed over their past."""

    velocity_mps: Complex  # (A, T)
    turn_radps: Array  # (A, T)
    constants_s: Array  # (A, T, 2) the likeliest time constants of velocity and turn rate, by the past up to each tick


def displacement(velocity_mps: Complex, turn_radps: Array, lead_s: Array | float) -> Complex:
    """Compute how far a constant speed leads that turns at a constant rate: along a circle, straight without turn."""
    angle = turn_radps * lead_s
    return np.asarray(velocity_mps * lead_s * np.exp(0.5j * angle) * np.sinc(angle / (2 * np.pi)))


def turn_rates(table: MotionTable) -> Array:
    """Measure turn rates (A, T), rad/s, from the courses at each tick and the one before; 0 where either is unknown."""
    velocity = np.where(table.present, table.velocity_mps, 0.0)
    speed = np.abs(velocity)
    known = speed > MIN_COURSE_MPS
    angle = np.zeros(speed.shape)
    angle[:, 1:] = np.angle(velocity[:, 1:] * velocity[:, :-1].conj())
    known[:, 1:] &= known[:, :-1] & ~table.begins[:, 1:] & (np.abs(angle[:, 1:]) < np.pi / 2)
    known[:, 0] = False
    turn = np.where(known, angle / table.tick_s, 0.0)
    limit = MAX_LATERAL_MPS2 / np.maximum(speed, MIN_COURSE_MPS)
    walks = (table.category == "pedestrian")[:, None]
    limit = np.where(walks, limit, np.minimum(limit, MAX_CURVATURE_1PM * speed))
    return np.clip(turn, -limit, limit)


def smooth_motion(table: MotionTable) -> SmoothedMotion:
    """Smooth velocities and turn rates over the past of each tick.

    Notes
    -----
    Exponential smoothing, v_n = s x_n + (1 - s) v_(n-1) (Brown, "Statistical Forecasting for Inventory Control", 1959), with
    s = 1 - exp(-tick / constant). The earlier velocity is turned by the smoothed turn rate before it is averaged, so that
    a steady circle is followed without lag. For each pair of `CONSTANTS_S` the positions `PROOF_S` ahead are predicted;
    the likelihood of the errors known so far, normal with unknown variance, weighs the pairs, and their values are
    averaged: while little is known, that errs less than the likeliest alone. Errors of overlapping times count as one for
    each `PROOF_S`. Cost: linear in agents, ticks and constants.
    """
    fresh, rates, constants = table.begins, turn_rates(table), np.array(CONSTANTS_S)
    # Weights of the latest value by time constants; 1 for a constant of 0.
    share_v, share_w = -np.expm1(
        -np.divide(table.tick_s, constants.T, out=np.full((2, len(constants)), np.inf), where=constants.T > 0)
    )
    velocity = np.zeros((len(table.agents), len(CONSTANTS_S)), dtype=complex)
    turn = np.zeros(velocity.shape)
    out = SmoothedMotion(np.empty_like(table.velocity_mps), np.empty(rates.shape), np.empty((*rates.shape, 2)))
    # Predictions whose outcome is not known yet, and the errors of those whose outcome is.
    ticks = round(PROOF_S / table.tick_s)
    pending = np.full((ticks, *velocity.shape), np.nan, dtype=complex)
    squares, errors, usual = np.zeros(velocity.shape), np.zeros((len(velocity), 1)), USUAL_ERRORS * USUAL_ERROR_M**2
    advantage = LATEST_ADVANTAGE * (constants[:, 0] == 0)
    for n in range(len(table.t_s)):
        new, latest, position = fresh[:, n, None], table.velocity_mps[:, n, None], table.position_m[:, n, None]
        turn = np.where(new, 0.0, turn + share_w * (rates[:, n, None] - turn))
        velocity = velocity * np.exp(1j * table.tick_s * turn)
        velocity = np.where(new, latest, velocity + share_v * (latest - velocity))
        pending[:, fresh[:, n]] = np.nan
        squares[fresh[:, n]] = errors[fresh[:, n]] = 0.0
        error = position - pending[n % ticks]
        square = error.real**2 + error.imag**2
        known = np.isfinite(square)
        squares += np.where(known, 1.0 / ticks * square, 0.0)
        errors += 1.0 / ticks * known[:, :1]
        pending[n % ticks] = position + displacement(velocity, turn, ticks * table.tick_s)
        likelihood = -(USUAL_ERRORS + errors) * np.log(usual + squares)
        likelihood += advantage
        weight = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
        weight = weight / weight.sum(axis=1, keepdims=True)
        out.velocity_mps[:, n], out.turn_radps[:, n] = (weight * velocity).sum(axis=1), (weight * turn).sum(axis=1)
        out.constants_s[:, n] = constants[weight.argmax(axis=1)]
    return out
