"""The measurement model and pseudo-measurements of a chain of states, each as a quadratic form, and robust weights."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from log2sim.agents.smooth.motion_prior import (
    ACCELERATION_PRIOR_MPS2,
    VELOCITY_PRIOR_MPS,
    MotionPrior,
    NoisyPositions,
    kronecker,
    nearest_index,
)
from log2sim.agents.smooth.quadratic import Quadratic
from log2sim.geometry import Array

# Information about position, velocity and acceleration of the first knot.
INITIAL_INFORMATION = np.array([0.0, VELOCITY_PRIOR_MPS**-2, ACCELERATION_PRIOR_MPS2**-2])
# Prior share of outliers and the ratio of their standard deviation to that of inliers.
OUTLIER_SHARE, OUTLIER_WIDTH = 0.02, 10.0
# Scale of the Geman-McClure weights: an observation at this many sigmas counts a quarter.
GEMAN_MCCLURE_SIGMAS = 3.0


@dataclass(frozen=True, eq=False)
class MeasurementModel:
    """Which state each observation measures, and how.

    All forms contain the vague prior of the first knot, with which a single observation, or two of them, have a solution.

    Attributes
    ----------
    observed : NoisyPositions
    knot : (n,) int
        Index of the knot that each observation measures.
    design : (n, 3) float64
        Row that takes the knot's position, velocity and acceleration to the observed position.
    group_start : (G,) int
        Rows at which the observations of another knot begin.
    """

    observed: NoisyPositions
    knot: NDArray[np.intp]
    design: Array
    group_start: NDArray[np.intp]

    @classmethod
    def of(cls, observed: NoisyPositions, prior: MotionPrior) -> MeasurementModel:
        """Tie each observation to the nearest knot of a motion prior."""
        knot = nearest_index(prior.knots_s, observed.t_s)
        start = np.concatenate([[0], np.flatnonzero(knot[1:] > knot[:-1]) + 1])
        return cls(observed, knot, position_row(observed.t_s - prior.knots_s[knot]), start)

    def residual(self, state: Array) -> Array:
        """Observed minus predicted positions (n, 2) for a state (K, 3, 2)."""
        return np.asarray(self.observed.xy - np.einsum("ni,nia->na", self.design, state[self.knot]))

    def independent_axes(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals with scalar information (n,), over the three unknowns that both axes share."""
        residual = self.residual(state)
        rows = self.design * information[:, None]
        diagonal = self._sum_by_knot(rows[:, :, None] * self.design[:, None, :], len(state))
        gradient = self._sum_by_knot(rows[:, :, None] * residual[:, None, :], len(state))
        diagonal[0] += np.diag(INITIAL_INFORMATION)
        gradient[0] -= INITIAL_INFORMATION[:, None] * state[0]
        value = float(information @ (residual**2).sum(axis=1) + INITIAL_INFORMATION @ (state[0] ** 2).sum(axis=1))
        return Quadratic.of(diagonal, None, gradient, value)

    def coupled_axes(self, state: Array, information: Array) -> Quadratic:
        """Squared residuals with information (n, 2, 2), over all six unknowns of a knot."""
        residual = self.residual(state)
        weighted = np.einsum("nab,nb->na", information, residual)
        h = self.design
        diagonal = self._sum_by_knot(kronecker(h[:, :, None] * h[:, None, :], information), len(state))
        gradient = self._sum_by_knot((h[:, :, None] * weighted[:, None, :]).reshape(-1, 6, 1), len(state))
        initial = np.repeat(INITIAL_INFORMATION, 2)
        diagonal[0] += np.diag(initial)
        gradient[0, :, 0] -= initial * state[0].ravel()
        value = float(np.vdot(weighted, residual) + initial @ state[0].ravel() ** 2)
        return Quadratic.of(diagonal, None, gradient, value)

    def _sum_by_knot(self, values: Array, count: int) -> Array:
        """Sum values (n, ...) of the observations of each knot to (K, ...)."""
        sums = np.zeros((count, *values.shape[1:]))
        unique = len(self.group_start) == len(self.knot)
        sums[self.knot[self.group_start]] = values if unique else np.add.reduceat(values, self.group_start, axis=0)
        return sums


def position_row(offset_s: Array) -> Array:
    """Rows (n, 3) that take position, velocity and acceleration to the position after an offset (n,)."""
    return np.stack([np.ones_like(offset_s), offset_s, offset_s**2 / 2], axis=-1)


def transition(offset_s: Array) -> Array:
    """Transition matrices (n, 3, 3) over offsets (n,) at constant acceleration."""
    step = np.zeros((len(offset_s), 3, 3))
    step[:, 0] = position_row(offset_s)
    step[:, 1, 1:] = step[:, 0, :2]
    step[:, 2, 2] = 1.0
    return step


def propagate(prior: MotionPrior, state: Array, t_s: Array) -> Array:
    """Propagate the state (K, 3, 2) from the nearest knot to each time (T,): (T, 3, 2)."""
    knot = nearest_index(prior.knots_s, t_s)
    return transition(t_s - prior.knots_s[knot]) @ state[knot]


def zero_motion(state: Array, velocity_information: Array, acceleration_information: Array) -> Quadratic:
    """Pseudo-measurements of zero velocity and zero acceleration, with information (K, 2, 2) about each."""
    count = len(state)
    diagonal, gradient = np.zeros((count, 6, 6)), np.zeros((count, 6, 1))
    diagonal[:, 2:4, 2:4], diagonal[:, 4:, 4:] = velocity_information, acceleration_information
    v = np.einsum("kab,kb->ka", velocity_information, state[:, 1])
    a = np.einsum("kab,kb->ka", acceleration_information, state[:, 2])
    gradient[:, 2:4, 0], gradient[:, 4:, 0] = -v, -a
    return Quadratic.of(diagonal, None, gradient, float(np.vdot(v, state[:, 1]) + np.vdot(a, state[:, 2])))


def geman_mcclure_weights(squared: Array) -> Array:
    """Robust weights (n,) of squared residuals in sigmas, while the outliers are not yet known.

    Notes
    -----
    Geman and McClure, Statistical methods for tomographic image reconstruction (1987).
    """
    return np.asarray(1.0 / (1.0 + squared / GEMAN_MCCLURE_SIGMAS**2) ** 2)


def inlier_probability(squared: Array) -> Array:
    """Probability (n,) of being an inlier, from squared residuals in sigmas, relative to that of a residual of zero.

    Notes
    -----
    Mixture of two Gaussians, that of the outliers `OUTLIER_WIDTH` times as wide (expectation step of Dempster, Laird and
    Rubin, 1977, section 4.3). Inliers keep nearly all their weight, unlike with `geman_mcclure_weights`.
    """
    odds = OUTLIER_SHARE / (1.0 - OUTLIER_SHARE) / OUTLIER_WIDTH**2
    exponent = np.minimum(squared, 200.0) / 2.0 * (1.0 - OUTLIER_WIDTH**-2)
    return np.asarray((1.0 + odds) / (1.0 + odds * np.exp(exponent)))
