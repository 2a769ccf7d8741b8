"""Exponential smoothing of velocity and turn rate, with constants weighed by how well they explain the agent's own past."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.geometry import Array
from log2sim.prediction.motion_table import Complex, MotionTable

CONSTANTS_S = tuple(itertools.product((0.0, 0.3, 0.6, 1.2), (0.0, 0.3, 0.6, 1.2, 2.4, np.inf)))
"""Time constants to choose from, of velocity and of turn rate: 0 takes the latest value, and infinity none, so that the agent
goes straight on."""

LATEST_ADVANTAGE = 3.0
"""Log-odds, before anything is known, of taking the latest velocity as it is: states of scenarios are smoothed already."""

PROOF_S = 1.0
"""Constants are judged by predictions over this time, of which the outcome is known already."""

USUAL_ERROR_M = 0.3
"""What such a prediction is off by usually: a tenth of what 0.6 m/s2 make of three seconds; smaller differences prove nothing."""

USUAL_ERRORS = 2.0
"""How many errors of the past `USUAL_ERROR_M` counts as."""

MIN_COURSE_MPS = 0.5
"""Of slower agents the velocity does not tell the course: smoothed speeds err by 0.15 m/s, which is 17 degrees here."""

MAX_LATERAL_MPS2 = 8.8
"""Tires on dry asphalt hold about 0.9 g."""

MAX_CURVATURE_1PM = 0.3
"""Beyond it a vehicle's motion is infeasible for Waymax (Gulino et al., 2023)."""


@dataclass(frozen=True, eq=False)
class SmoothedMotion:
    """Velocity and turn rate of agents, smoothed over their past.

    Attributes
    ----------
    velocity_mps : (A, T) complex128, m/s
    turn_radps : (A, T) float64, rad/s
    constants_s : (A, T, 2) float64, s
        The likeliest time constants of velocity and turn rate, by the past up to each tick.
    """

    velocity_mps: Complex
    turn_radps: Array
    constants_s: Array


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
    walks = np.array([a.category == "pedestrian" for a in table.agents], dtype=bool)[:, None]
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
    judge = _Judge(len(table.agents), round(PROOF_S / table.tick_s), table.tick_s)
    fresh, rates = table.begins, turn_rates(table)
    share_v, share_w = (_shares(np.array(c), table.tick_s) for c in zip(*CONSTANTS_S))
    velocity = np.zeros((len(table.agents), len(CONSTANTS_S)), dtype=complex)
    turn = np.zeros(velocity.shape)
    out = SmoothedMotion(np.empty_like(table.velocity_mps), np.empty(rates.shape), np.empty((*rates.shape, 2)))
    constants = np.array(CONSTANTS_S)
    for n in range(len(table.t_s)):
        new, latest = fresh[:, n, None], table.velocity_mps[:, n, None]
        turn = np.where(new, 0.0, turn + share_w * (rates[:, n, None] - turn))
        velocity = velocity * np.exp(1j * table.tick_s * turn)
        velocity = np.where(new, latest, velocity + share_v * (latest - velocity))
        weight = judge.weigh(n, table.position_m[:, n, None], fresh[:, n], velocity, turn)
        out.velocity_mps[:, n], out.turn_radps[:, n] = (weight * velocity).sum(axis=1), (weight * turn).sum(axis=1)
        out.constants_s[:, n] = constants[weight.argmax(axis=1)]
    return out


def _shares(constants_s: Array, tick_s: float) -> Array:
    """Weights of the latest value by time constants; 1 for a constant of 0."""
    rate = np.divide(tick_s, constants_s, out=np.full(len(constants_s), np.inf), where=constants_s > 0)
    return np.asarray(-np.expm1(-rate))


class _Judge:
    """Weighs constants by predictions whose outcome is known."""

    def __init__(self, agents: int, ticks: int, tick_s: float) -> None:
        shape = (agents, len(CONSTANTS_S))
        self._ticks, self._weight = ticks, 1.0 / ticks
        self._lead_s = ticks * tick_s
        self._pending = np.full((ticks, *shape), np.nan, dtype=complex)
        self._before = LATEST_ADVANTAGE * np.array([velocity_s == 0 for velocity_s, _ in CONSTANTS_S])
        self._squares, self._errors = np.zeros(shape), np.zeros((agents, 1))

    def weigh(self, n: int, position: Complex, fresh: NDArray[np.bool_], velocity: Complex, turn: Array) -> Array:
        """Return the weights (A, K) of constants at tick `n`, where positions are (A, 1), velocities and turn rates (A, K)."""
        slot = n % self._ticks
        self._pending[:, fresh] = np.nan
        self._squares[fresh] = self._errors[fresh] = 0.0
        error = position - self._pending[slot]
        square = error.real**2 + error.imag**2
        known = np.isfinite(square)
        self._squares += np.where(known, self._weight * square, 0.0)
        self._errors += self._weight * known[:, :1]
        self._pending[slot] = position + displacement(velocity, turn, self._lead_s)
        usual = USUAL_ERRORS * USUAL_ERROR_M**2
        likelihood = -(USUAL_ERRORS + self._errors) * np.log(usual + self._squares)
        likelihood += self._before
        weight = np.exp(likelihood - likelihood.max(axis=1, keepdims=True))
        return np.asarray(weight / weight.sum(axis=1, keepdims=True))
