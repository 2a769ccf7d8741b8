"""What observations and assumptions say about a chain of states, each as a quadratic form."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.motion_prior import (
    ACCELERATION_PRIOR_MPS2,
    VELOCITY_PRIOR_MPS,
    Chain,
    Observations,
    nearest_index,
    spread,
)
from log2sim.agents.smooth.quadratic import Quadratic
from log2sim.geometry import Array

# Information about position, velocity and acceleration of the first knot.
BELIEFS = np.array([0.0, VELOCITY_PRIOR_MPS**-2, ACCELERATION_PRIOR_MPS2**-2])
# Share of positions that are wrong and how much wider they scatter than the others.
WRONG_SHARE, WRONG_WIDTH = 0.02, 10.0
# While the trajectory is not yet known, an observation at this many sigmas counts a quarter.
TOLERANCE_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class Readings:
    """Observations and how each is read off a chain: knot `place` (n,), and `reading` (n, 3) of its three unknowns.

    `first` are the rows with which another knot begins. All forms contain vague beliefs about the first knot, which make a
    single observation, or a pair of them, have an answer.
    """

    observed: Observations
    place: NDArray[np.intp]
    reading: Array
    first: NDArray[np.intp]

    @classmethod
    def of(cls, observed: Observations, chain: Chain) -> Readings:
        place = nearest_index(chain.knots_s, observed.t_s)
        first = np.concatenate([[0], np.flatnonzero(place[1:] > place[:-1]) + 1])
        return cls(observed, place, taylor(observed.t_s - chain.knots_s[place]), first)

    def residual(self, state: Array) -> Array:
        """Observed less read (n, 2)."""
        return self.observed.xy - np.einsum("ni,nia->na", self.reading, state[self.place])

    def apart(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals under scalar information (n,), over the three unknowns that both axes share."""
        residual = self.residual(state)
        rows = self.reading * information[:, None]
        diagonal = self._gather(rows[:, :, None] * self.reading[:, None, :], len(state))
        pull = self._gather(rows[:, :, None] * residual[:, None, :], len(state))
        diagonal[0] += np.diag(BELIEFS)
        pull[0] -= BELIEFS[:, None] * state[0]
        value = float(information @ (residual**2).sum(axis=1) + BELIEFS @ (state[0] ** 2).sum(axis=1))
        return Quadratic.of(diagonal, None, pull, value)

    def together(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals under information (n, 2, 2), over all six unknowns of a knot."""
        residual = self.residual(state)
        weighted = np.einsum("nab,nb->na", information, residual)
        h = self.reading
        diagonal = self._gather(spread(h[:, :, None] * h[:, None, :], information), len(state))
        pull = self._gather((h[:, :, None] * weighted[:, None, :]).reshape(-1, 6, 1), len(state))
        believed = np.repeat(BELIEFS, 2)
        diagonal[0] += np.diag(believed)
        pull[0, :, 0] -= believed * state[0].ravel()
        value = float(np.vdot(weighted, residual) + believed @ state[0].ravel() ** 2)
        return Quadratic.of(diagonal, None, pull, value)

    def _gather(self, values: Array, count: int) -> Array:
        """Sums (K, ...) of the values (n, ...) read off each knot."""
        gathered = np.zeros((count, *values.shape[1:]))
        unique = len(self.first) == len(self.place)
        gathered[self.place[self.first]] = values if unique else np.add.reduceat(values, self.first, axis=0)
        return gathered


def taylor(offset_s: Array) -> Array:
    """How position, velocity and acceleration make a position at an offset (n,): (n, 3)."""
    return np.stack([np.ones_like(offset_s), offset_s, offset_s**2 / 2], axis=-1)


def carrying(offset_s: Array) -> Array:
    """How a state passes on over an offset (n,) at constant acceleration: (n, 3, 3)."""
    step = np.zeros((len(offset_s), 3, 3))
    step[:, 0] = taylor(offset_s)
    step[:, 1, 1:] = step[:, 0, :2]
    step[:, 2, 2] = 1.0
    return step


def carry(chain: Chain, state: Array, asked_s: Array) -> Array:
    """States (T, 3, 2) at asked times, each from the nearest knot's (K, 3, 2)."""
    place = nearest_index(chain.knots_s, asked_s)
    return carrying(asked_s - chain.knots_s[place]) @ state[place]


def hold(state: Array, velocity_information: Array, acceleration_information: Array) -> Quadratic:
    """Beliefs that velocities and accelerations are zero, with information (K, 2, 2) about each."""
    count = len(state)
    diagonal, pull = np.zeros((count, 6, 6)), np.zeros((count, 6, 1))
    diagonal[:, 2:4, 2:4], diagonal[:, 4:, 4:] = velocity_information, acceleration_information
    v = np.einsum("kab,kb->ka", velocity_information, state[:, 1])
    a = np.einsum("kab,kb->ka", acceleration_information, state[:, 2])
    pull[:, 2:4, 0], pull[:, 4:, 0] = -v, -a
    return Quadratic.of(diagonal, None, pull, float(np.vdot(v, state[:, 1]) + np.vdot(a, state[:, 2])))


def tolerant(squared: Array) -> Array:
    """Weights (n,) for squared distances in sigmas before the outliers are known: none is believed or refused wholly."""
    return np.asarray(1.0 / (1.0 + squared / TOLERANCE_SIGMAS**2) ** 2)


def decided(squared: Array) -> Array:
    """Probability (n,) that an observation is none of the wrong ones, from its squared distance in sigmas, 1 at none.

    Two Gaussians, the wrong ones' wider. What is right keeps nearly all its weight, unlike under `tolerant`.
    """
    odds = WRONG_SHARE / (1.0 - WRONG_SHARE) / WRONG_WIDTH**2
    exponent = np.minimum(squared, 200.0) / 2.0 * (1.0 - WRONG_WIDTH**-2)
    return np.asarray((1.0 + odds) / (1.0 + odds * np.exp(exponent)))
