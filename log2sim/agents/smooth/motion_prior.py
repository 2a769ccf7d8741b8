"""The motion prior: states at knots in time, tied by a constant-acceleration model that is driven by white jerk.

It is the continuous Wiener process acceleration model of Bar-Shalom, Li and Kirubarajan, Estimation with Applications to
Tracking and Navigation (2001), section 6.2.3, for uneven steps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.quadratic import Quadratic
from log2sim.geometry import Array

# Minimum distance of two knots; in between the acceleration is taken as constant, which at 100 m/s3 of jerk costs 0.02 mm.
# The information that ties two knots grows with the fifth power of the inverse step: 1 ms apart they would leave no digits
# for the data.
KNOT_STEP_S = 0.02
# Standard deviations of the vague prior of the first state.
VELOCITY_PRIOR_MPS = 40.0
ACCELERATION_PRIOR_MPS2 = 4.0

# Covariance of position, velocity, acceleration after unit time of white jerk of unit density, and its inverse.
_UNIT_Q = np.array([[1 / 20, 1 / 8, 1 / 6], [1 / 8, 1 / 3, 1 / 2], [1 / 6, 1 / 2, 1.0]])
_UNIT_INFORMATION = np.linalg.inv(_UNIT_Q)


@dataclass(frozen=True, eq=False)
class NoisyPositions:
    """Measured positions with their noise.

    Attributes
    ----------
    t_s : (n,) float64, s
    xy : (n, 2) float64, m
    r : (n, 2, 2) float64, m2
        Covariance of each position.
    unknown_scale : bool
        Whether `r` is known up to a common factor only.
    correlated : bool
        Whether errors repeat from tick to tick and have heavier tails than Gaussian ones, as those of measured boxes.
    """

    t_s: Array
    xy: Array
    r: Array
    unknown_scale: bool = False
    correlated: bool = False


@dataclass(frozen=True, eq=False)
class MotionPrior:
    """Knots and the motion between them, at a jerk density of 1 m2/s5.

    Attributes
    ----------
    knots_s : (K,) float64, s
    step : (K-1, 3, 3) float64
        Transition of position, velocity and acceleration to the next knot.
    inverse : (K-1, 3, 3) float64
        Information about the process noise of each step.
    inverse_before : (K-1, 3, 3) float64
        The same, propagated to the earlier knot.
    cross : (K-1, 3, 3) float64
        Blocks above the diagonal of the squared jerk.
    diagonal : (K, 3, 3) float64
        Blocks on the diagonal of the squared jerk.
    """

    knots_s: Array
    step: Array
    inverse: Array
    inverse_before: Array
    cross: Array
    diagonal: Array

    @classmethod
    def over(cls, t_s: Array, step_s: float = KNOT_STEP_S) -> MotionPrior:
        """Build the prior with knots out of the times (n,), none nearer to another than `step_s`."""
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
        """Return the number of knots."""
        return len(self.knots_s)

    def jerk(self, state: Array) -> Quadratic:
        """Squared jerk over the three unknowns that both axes share, about a state (K, 3, 2)."""
        return Quadratic.of(self.diagonal, self.cross, *self._gradient(state[1:] - self.step @ state[:-1]))

    def jerk_by_direction(self, state: Array, direction: Array) -> tuple[Quadratic, Quadratic]:
        """Squared jerk along and across unit directions (K-1, 2) of the steps, over all six unknowns of a knot."""
        outer = direction[:, :, None] * direction[:, None, :]
        noise = state[1:] - self.step @ state[:-1]
        along = noise @ outer
        # Each step has a direction of its own, so a knot's block takes two of them.
        diagonal = np.zeros((len(self), 6, 6))
        diagonal[:-1] = kronecker(self.inverse_before, outer)
        diagonal[1:] += kronecker(self.inverse, outer)
        cross = kronecker(self.cross, outer)
        longitudinal = self._form(along, diagonal, cross)
        np.negative(diagonal, out=diagonal)
        np.negative(cross, out=cross)
        for axis in range(2):  # across is all that is not along
            diagonal[:, axis::2, axis::2] += self.diagonal
            cross[:, axis::2, axis::2] += self.cross
        return longitudinal, self._form(noise - along, diagonal, cross)

    def _form(self, noise: Array, diagonal: Array, cross: Array) -> Quadratic:
        gradient, value = self._gradient(noise)
        return Quadratic.of(diagonal, cross, gradient.reshape(-1, 6, 1), value)

    def _gradient(self, noise: Array) -> tuple[Array, float]:
        """Negative half gradient (K, 3, 2) of the squared jerk for process noise (K-1, 3, 2), and its value."""
        weighted = self.inverse @ noise
        gradient = np.zeros((len(self), 3, 2))
        gradient[:-1] = np.swapaxes(self.step, 1, 2) @ weighted
        gradient[1:] -= weighted
        return gradient, float(np.vdot(noise, weighted))


def kronecker(blocks: Array, weights: Array) -> Array:
    """Kronecker products (n, 6, 6) of blocks (n, 3, 3) of one axis and weights (n, 2, 2) of each pair of axes."""
    product = np.empty((len(blocks), 6, 6))
    for first in range(2):
        for second in range(2):
            np.multiply(blocks, weights[:, first, second, None, None], out=product[:, first::2, second::2])
    return product


def place_knots(t_s: Array, step_s: float = KNOT_STEP_S) -> Array:
    """Select knots (K,) from times (n,), from the first on, none nearer to the one before than `step_s`."""
    times = np.unique(t_s)
    if np.all(np.diff(times) >= step_s):
        return times
    knots: list[float] = []
    for t in times.tolist():
        if not knots or t - knots[-1] >= step_s:
            knots.append(t)
    return np.array(knots)


def nearest_index(knots: Array, t: Array) -> NDArray[np.intp]:
    """Index of the knot nearest to each time."""
    if len(knots) == 1:
        return np.zeros(len(t), dtype=np.intp)
    i = np.clip(np.searchsorted(knots, t), 1, len(knots) - 1)
    return np.where(np.abs(knots[i - 1] - t) <= np.abs(knots[i] - t), i - 1, i)
