"""Positions that change by white jerk: knots in time, and what the motion model and the observations say about them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.quadratic import Quadratic
from log2sim.geometry import Array

# Knots stand no nearer to each other than this; in between the acceleration is taken as constant, which at 100 m/s3 of
# jerk costs 0.02 mm. The information that ties two knots grows like the fifth power of the inverse step: 1 ms apart they
# would leave no digits for the data.
KNOT_STEP_S = 0.02
# Vague beliefs about the first state.
VELOCITY_PRIOR_MPS = 40.0
ACCELERATION_PRIOR_MPS2 = 4.0

# Covariance of position, velocity, acceleration after unit time of white jerk of unit density, and its inverse.
_UNIT_Q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_UNIT_INFORMATION = np.linalg.inv(_UNIT_Q)


@dataclass(frozen=True, eq=False)
class Observations:
    """Positions `xy` (n, 2) with covariances `r` (n, 2, 2) at times `t_s` (n,)."""

    t_s: Array
    xy: Array
    r: Array


@dataclass(frozen=True, eq=False)
class Chain:
    """Knots (K,) and the motion between them: `step` (K-1, 3, 3) carries position, velocity and acceleration on,
    `inverse` (K-1, 3, 3) is the information about what is left, at a jerk density of 1, `inverse_before` the same seen from
    the earlier knot. `diagonal` (K, 3, 3) and `cross` (K-1, 3, 3) are the blocks of the squared jerk.
    """

    knots_s: Array
    step: Array
    inverse: Array
    inverse_before: Array
    cross: Array
    diagonal: Array

    @classmethod
    def over(cls, t_s: Array, step_s: float = KNOT_STEP_S) -> Chain:
        """Chain with knots out of the times (n,), no nearer to each other than a step."""
        knots = place_knots(t_s, step_s)
        dt = np.diff(knots)
        # Inverted in units of the step: steps from milliseconds to seconds are equally well conditioned.
        scale = np.stack([dt**-2.5, dt**-1.5, dt**-0.5], axis=-1)
        step = np.zeros((len(dt), 3, 3))
        step[:, [0, 1, 2], [0, 1, 2]] = 1.0
        step[:, 0, 1], step[:, 1, 2], step[:, 0, 2] = dt, dt, dt**2 / 2
        inverse = _UNIT_INFORMATION * scale[:, :, None] * scale[:, None, :]
        cross = -np.swapaxes(step, 1, 2) @ inverse
        diagonal = np.zeros((len(knots), 3, 3))
        before = -cross @ step
        diagonal[:-1] = before
        diagonal[1:] += inverse
        return cls(knots, step, inverse, before, cross, diagonal)

    def __len__(self) -> int:
        return len(self.knots_s)

    def jerk(self, state: Array) -> Quadratic:
        """Squared jerk of every column of a reference state (K, 3, 2), over a density of 1."""
        return Quadratic.of(self.diagonal, self.cross, *self._pull(state[1:] - self.step @ state[:-1]))

    def jerk_by_direction(self, state: Array, direction: Array) -> tuple[Quadratic, Quadratic]:
        """The squared jerk along and across a direction (K-1, 2) at every step, over all six unknowns of a knot."""
        outer = direction[:, :, None] * direction[:, None, :]
        left = state[1:] - self.step @ state[:-1]
        along = left @ outer
        # Each step has a direction of its own, so a knot's block takes two of them.
        diagonal = np.zeros((len(self), 6, 6))
        diagonal[:-1] = spread(self.inverse_before, outer)
        diagonal[1:] += spread(self.inverse, outer)
        cross = spread(self.cross, outer)
        lengthwise = self._part(along, diagonal, cross)
        np.negative(diagonal, out=diagonal)
        np.negative(cross, out=cross)
        for axis in range(2):  # across is all that is not along
            diagonal[:, axis::2, axis::2] += self.diagonal
            cross[:, axis::2, axis::2] += self.cross
        return lengthwise, self._part(left - along, diagonal, cross)

    def _part(self, left: Array, diagonal: Array, cross: Array) -> Quadratic:
        pull, value = self._pull(left)
        return Quadratic.of(diagonal, cross, pull.reshape(-1, 6, 1), value)

    def _pull(self, left: Array) -> tuple[Array, float]:
        """How what is left (K-1, 3, 2) of every step pulls at the knots (K, 3, 2), and its square."""
        weighted = self.inverse @ left
        pull = np.zeros((len(self), 3, 2))
        pull[:-1] = np.swapaxes(self.step, 1, 2) @ weighted
        pull[1:] -= weighted
        return pull, float(np.vdot(left, weighted))


def spread(blocks: Array, over: Array) -> Array:
    """Blocks (n, 3, 3) of one axis times weights (n, 2, 2) of each pair of axes: (n, 6, 6)."""
    product = np.empty((len(blocks), 6, 6))
    for first in range(2):
        for second in range(2):
            np.multiply(blocks, over[:, first, second, None, None], out=product[:, first::2, second::2])
    return product


def place_knots(t_s: Array, step_s: float = KNOT_STEP_S) -> Array:
    """Times (K,) out of those given (n,), from the first on, none nearer to the one before than `step_s`."""
    times = np.unique(t_s)
    if np.all(np.diff(times) >= step_s):
        return times
    knots: list[float] = []
    for t in times.tolist():
        if not knots or t - knots[-1] >= step_s:
            knots.append(t)
    return np.array(knots)


def nearest_index(knots: Array, t: Array) -> NDArray[np.intp]:
    """Index of the knot nearest to every time."""
    if len(knots) == 1:
        return np.zeros(len(t), dtype=np.intp)
    i = np.clip(np.searchsorted(knots, t), 1, len(knots) - 1)
    return np.where(np.abs(knots[i - 1] - t) <= np.abs(knots[i] - t), i - 1, i)
